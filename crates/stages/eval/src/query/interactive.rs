//! Texts from standard input, answered one by one.

use super::ask::{Asked, Asker};
use super::granularity;
use super::show;
use crate::options::QueryOptions;
use crate::scene::numbered;
use gs_io::{Error, Result};
use gs_scene::dataset::Dataset;
use query::LabelledScene;
use stage::Stage;
use std::io::BufRead;
use std::path::Path;
use std::time::{Duration, Instant};

/// Reads texts line by line until the end, or `:quit`. A text that a table does not hold is a warning.
pub(super) fn run(
    o: &QueryOptions,
    scene: &LabelledScene,
    dataset: &Dataset,
    asker: &Asker<'_>,
    stage: &Stage,
    json_lines: bool,
) -> Result<()> {
    let source = asker.source.as_ref().expect("opened for texts");
    stage.info(&format!("{} instances, {}; a text a line, :quit to end", scene.instances.len(), source.describe()));
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|e| Error::new(format!("cannot read the texts: {e}")).field("standard input"))?;
        let text = line.trim();
        if text == ":quit" || stage.interrupted() {
            break;
        }
        if text.is_empty() {
            continue;
        }
        let started = Instant::now();
        let feature = source.encode_in(&asker.templates, &[text.to_string()])?.remove(0);
        let encoding = started.elapsed();
        let Some(feature) = feature else {
            stage.warn(&source.unknown(text).to_string());
            continue;
        };
        let started = Instant::now();
        let mut asked = Asked::new(text.into(), "text", None, asker.answer_text(&feature));
        asked.name(&scene.remarks.names);
        let took = started.elapsed();
        let asked = granularity::apply(o.granularity, &scene.instances, asked, &|why| stage.warn(why));
        let shown = match &o.out {
            None => asked.into_iter().map(|a| a.result).collect(),
            Some(out) => show::write(o, scene, dataset, asker, asked, None, &out.join(free_name(out, text)))?.queries,
        };
        let mut printed = String::new();
        for one in &shown {
            printed += &if json_lines {
                serde_json::to_string(one).map_err(|e| Error::new(e.to_string()))? + "\n"
            } else {
                show::answer_table(one)
            };
        }
        if !json_lines {
            let ms = |t: Duration| t.as_secs_f64() * 1e3;
            printed += &format!("\n  {:.1} ms encoding, {:.2} ms query\n", ms(encoding), ms(took));
        }
        if !stage.print(&printed)? {
            break;
        }
    }
    Ok(())
}

/// The name of a new folder for a text: earlier answers stay.
fn free_name(out: &Path, text: &str) -> String {
    let taken = |number: usize| {
        let prefix = format!("{number:02}-");
        let entries = std::fs::read_dir(out).into_iter().flatten().flatten();
        entries.into_iter().any(|e| e.file_name().to_string_lossy().starts_with(&prefix))
    };
    let number = (1..).find(|&n| !taken(n)).unwrap_or(usize::MAX);
    numbered(number, text)
}
