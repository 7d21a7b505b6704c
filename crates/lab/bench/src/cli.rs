//! The command line.

use crate::chain::{Programs, STAGES};
use crate::page::Results;
use crate::plan::Plan;
use crate::{ceilings, cells, compare, growth, page, pictures, tables, tradeoff};
use gs_io::{Claim, Error, Result, create_dir, write_bytes, write_json};
use serde::Serialize;
use serde_json::json;
use stage::{CommonArgs, Machine, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Experiments on the pipeline: tables of scores, run time against error, growth, two builds beside each other
#[derive(Debug, clap::Parser)]
#[command(name = "bench", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    /// Folder of the stages' programs
    #[arg(long, global = true, value_name = "DIR", default_value = "target/release")]
    bin: PathBuf,
    /// Folder for scenes and what is made of them. Finished runs of tables and knobs there are not done again: remove it after
    /// a change of the programs
    #[arg(long, global = true, value_name = "DIR", default_value = "out/bench/work")]
    work: PathBuf,
    /// Output file, JSON; the same is written beside it as .md and .html, of a plan with rivals pictures as .svg (compare writes no .html, ceilings writes instances)
    #[arg(long, global = true, value_name = "FILE", default_value = "out/bench/report.json")]
    out: PathBuf,
    /// What run does: names of tables, knobs and axes, with commas between; what stress does: parts of names of scenes [default: all]
    #[arg(long, global = true, value_name = "NAMES", value_delimiter = ',')]
    only: Vec<String>,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Run a plan: its tables of scores, then every setting of its approximations and every size, timed. Runs of tables are
    /// of one thread each, as many at a time as --threads says; timed runs go one after another
    Run {
        /// The plan, such as pipelines/ablation.plan
        plan: PathBuf,
    },
    /// Time all stages of two builds in turns
    Compare {
        /// The plan whose scenes are run, such as pipelines/tradeoffs.plan
        plan: PathBuf,
        /// Folder of the programs to compare with
        base: PathBuf,
    },
    /// Run every stage on hostile scenes and with hostile settings, and check the results
    Stress,
    /// What instances of a synthetic scene can reach at most: true labels on the Gaussians, and masks grouped by the truth.
    /// Instances for eval score, and how pure the masks are
    Ceilings(ceilings::Inputs),
}

impl stage::Program for Args {
    const NAME: &'static str = "bench";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        false
    }

    fn run(self, stage: &Stage) -> Result<()> {
        // Timings are of one thread unless more are asked for: fewer other programs get between.
        let programs = || programs(&self.bin, self.common.threads.max(1));
        match &self.command {
            Command::Run { plan } => self.experiments(&Plan::read(plan)?.only(&self.only)?, &programs()?, stage),
            Command::Compare { plan, base } => self.comparison(&Plan::read(plan)?, base, &programs()?, stage),
            Command::Stress => self.stress(&programs()?, stage),
            Command::Ceilings(inputs) => ceilings::run(inputs, &self.out, stage),
        }
    }
}

fn programs(folder: &Path, threads: usize) -> Result<Programs> {
    let all = ["synth-scene", "gs-geom", "graph-precompute", "feat-train", "cluster-match", "eval"];
    match all.into_iter().find(|program| !folder.join(program).exists()) {
        None => Ok(Programs { folder: folder.into(), threads }),
        Some(lacking) => Err(Error::new("a program is missing").file(folder).expected(lacking).hint("run make build")),
    }
}

impl Args {
    /// The right to write the results: JSON, beside it the same as Markdown and HTML, and pictures.
    fn claim(&self, stage: &Stage) -> Result<Claim> {
        let beside = ["md", "html", "svg"].map(|extension| self.out.with_extension(extension));
        let claim = stage.outputs(&self.out).file(&self.out).files(beside).claim()?;
        create_dir(&self.work)?;
        Ok(claim)
    }

    fn write(&self, value: &impl Serialize, text: &str, page: Option<&str>) -> Result<()> {
        write_json(&self.out, value)?;
        write_bytes(self.out.with_extension("md"), text.as_bytes())?;
        page.map_or(Ok(()), |page| write_bytes(self.out.with_extension("html"), page.as_bytes()))
    }

    fn experiments(&self, plan: &Plan, programs: &Programs, stage: &Stage) -> Result<()> {
        let mut claim = self.claim(stage)?;
        let mut results = Results::default();
        if plan.has_rivals() && !programs.folder.join("peers").exists() {
            let e = Error::new("a program is missing").file(&programs.folder).expected("peers");
            return Err(e.hint("run make build"));
        }
        if let Some(table) = plan.tables.first() {
            cells::run(programs, plan, &self.work, stage)?;
            results.tables = tables::results(plan, &self.work)?;
            if plan.has_rivals() {
                pictures::write(plan, table, &self.work, &self.out.with_extension("svg"))?;
            }
        }
        for scene in plan.scenes.iter().filter(|_| !plan.knobs.is_empty()) {
            let folder = self.work.join(&scene.name);
            let base = tradeoff::prepare(programs, scene, &folder)?;
            for s in STAGES.into_iter().skip(1) {
                base.run(programs, s, &crate::chain::Options::default())?;
            }
            for knob in &plan.knobs {
                stage.info(&format!("{} on {}", knob.title, scene.name));
                results.curves.push(tradeoff::measure(programs, plan, knob, scene, &base, &folder)?);
            }
        }
        for axis in &plan.axes {
            stage.info(&format!("growth along {}", axis.title));
            results.growth.extend(growth::measure(programs, plan, axis, &self.work)?);
        }
        page::warnings(&results.curves).iter().for_each(|w| stage.warn(w));
        let subtitle = format!("Revision {}, {}.", stage::REVISION, Machine::here());
        self.write(&results, &page::text(&results, &subtitle), Some(&page::html(&results, &subtitle)))?;
        let summary = json!({"tables": results.tables.len(), "curves": results.curves.len(),
            "dominated": page::warnings(&results.curves).len()});
        stage.record(&mut claim, json!({"command": "run"}), BTreeMap::new(), summary)?;
        tables::check(plan, &results.tables)
    }

    fn comparison(&self, plan: &Plan, base: &Path, own: &Programs, stage: &Stage) -> Result<()> {
        let mut claim = self.claim(stage)?;
        let all = compare::compare(&programs(base, own.threads)?, own, plan, &self.work)?;
        let (head, rows) = page::compare_table(&all);
        let text = report::sheet::markdown(&head, &rows);
        text.lines().for_each(|l| stage.info(l));
        self.write(&all, &text, None)?;
        stage.record(&mut claim, json!({"command": "compare"}), BTreeMap::new(), json!({}))
    }

    fn stress(&self, programs: &Programs, stage: &Stage) -> Result<()> {
        let mut claim = self.claim(stage)?;
        let rows = crate::stress::run(programs, &self.work, &self.only, &|name| stage.info(name))?;
        let (text, page) = page::stress(&rows);
        self.write(&rows, &text, Some(&page))?;
        let bad: Vec<_> = rows.iter().filter(|r| !r.good).collect();
        let summary = json!({"cells": rows.len(), "bad": bad.len()});
        stage.record(&mut claim, json!({"command": "stress"}), BTreeMap::new(), summary)?;
        stage.info(&format!("{} of {} cells are good", rows.len() - bad.len(), rows.len()));
        match bad.first() {
            None => Ok(()),
            Some(first) => Err(Error::new(format!("{} cells are not good", bad.len()))
                .file(&self.out)
                .field(format!("{}, {}", first.scene, first.stage))
                .found(&first.note)),
        }
    }
}
