//! `eval ablation`.

use crate::ablation::{self, Plan, Runs, Table};
use gs_io::{Error, IoContext, Result, write_bytes};
use report::html::Page;
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::PathBuf;

#[derive(Debug, clap::Args)]
pub(super) struct AblationArgs {
    /// Plan of the ablation, such as pipelines/ablation.plan
    #[arg(long, value_name = "FILE")]
    plan: PathBuf,
    /// Folder of the runs that make ablation made
    #[arg(long, value_name = "DIR")]
    runs: PathBuf,
    /// Output folder: <table>.json and <table>.md of every table of the plan, and all of them in report.html
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Documents to fill with the tables: what stands between <!-- ablation TABLE --> and <!-- end --> is replaced
    #[arg(long, value_name = "FILES", value_delimiter = ',')]
    docs: Vec<PathBuf>,
}

pub(super) fn run(a: &AblationArgs, stage: &Stage) -> Result<String> {
    let plan = Plan::read(&a.plan)?;
    let (tables, missing) = ablation::results(&Runs { folder: &a.runs, plan: &plan })?;
    if let Some(first) = missing.first() {
        stage.warn(&format!("{} runs are missing, the first {}", missing.len(), first.display()));
    }
    let documents = a.docs.iter().map(|path| {
        let text = std::fs::read_to_string(path).at("read", path)?;
        let (filled, unknown) = ablation::fill(&text, &tables).map_err(|e| e.file(path))?;
        unknown.iter().for_each(|name| stage.warn(&format!("{}: the plan has no table {name}", path.display())));
        Ok((path, filled))
    });
    let documents: Vec<_> = documents.collect::<Result<_>>()?;
    let path = a.out.join("report.html");
    let names = tables.iter().flat_map(|t| ["json", "md"].map(|extension| format!("{}.{extension}", t.name)));
    let mut claim = stage.outputs(&path).file(&path).files_in(&a.out, names).reads([&a.plan]).claim()?;
    let mut shown = String::new();
    for table in &tables {
        let path = a.out.join(format!("{}.json", table.name));
        let json = serde_json::to_vec_pretty(table).map_err(|e| Error::new(e.to_string()).file(&path))?;
        let markdown = ablation::markdown(table);
        shown += &format!("{}\n\n{markdown}\n", table.title);
        write_bytes(&path, &json)?;
        write_bytes(path.with_extension("md"), format!("# {}\n\n{markdown}", table.title).as_bytes())?;
    }
    let mut page = Page::default();
    ablation::sections(&mut page, &tables);
    write_bytes(&path, page.finish("Ablation", &subtitle(&tables)).as_bytes())?;
    for (path, text) in documents {
        write_bytes(path, text.as_bytes())?;
    }
    let summary = json!({"tables": tables.len(), "missing": missing.len()});
    stage.record(&mut claim, json!({"command": "ablation"}), BTreeMap::new(), summary)?;
    Ok(shown)
}

fn subtitle(tables: &[Table]) -> String {
    tables.first().map_or(String::new(), |t| {
        format!("{} synthetic scenes, {} seeds each; see docs/accuracy.md", t.scenes.len(), t.seeds.len())
    })
}
