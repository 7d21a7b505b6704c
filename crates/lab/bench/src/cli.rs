//! The command line.

use crate::chain::{Programs, STAGES};
use crate::plan::Plan;
use crate::{compare, growth, page, tradeoff};
use gs_io::{Claim, Error, Result, create_dir, write_bytes};
use serde::Serialize;
use serde_json::json;
use stage::{CommonArgs, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Benchmarks of the pipeline: run time against error, growth, two builds beside each other.
#[derive(Debug, clap::Parser)]
#[command(name = "bench", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Time every setting of every approximation of a plan, and measure its error against the exact one
    Tradeoff(TradeoffArgs),
    /// Time all stages of two builds in turns
    Compare(CompareArgs),
    /// Run every stage on hostile scenes and with hostile settings, and hold what comes out against what should
    Stress(StressArgs),
}

/// Options of every command.
#[derive(Debug, clap::Args)]
struct Common {
    /// Folder of the stages' programs
    #[arg(long, value_name = "DIR", default_value = "target/release")]
    bin: PathBuf,
    /// Folder for scenes and what is made of them; what tradeoff and compare find there is not made again
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Output file, JSON; a .md (and but for compare a .html) of the same is written beside it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct TradeoffArgs {
    #[command(flatten)]
    common: Common,
    /// What to measure, such as pipelines/tradeoffs.plan
    #[arg(long, value_name = "FILE")]
    plan: PathBuf,
    /// Only these knobs and axes of the plan [all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    only: Vec<String>,
}

#[derive(Debug, clap::Args)]
struct CompareArgs {
    #[command(flatten)]
    common: Common,
    /// The plan whose scenes are run, such as pipelines/tradeoffs.plan
    #[arg(long, value_name = "FILE")]
    plan: PathBuf,
    /// Folder of the programs to compare with
    #[arg(long, value_name = "DIR")]
    base: PathBuf,
}

#[derive(Debug, clap::Args)]
struct StressArgs {
    #[command(flatten)]
    common: Common,
    /// Only scenes whose name contains this
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
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
        let threads = self.common.threads.max(1);
        match &self.command {
            Command::Tradeoff(a) => tradeoffs(a, threads, stage),
            Command::Compare(a) => comparison(a, threads, stage),
            Command::Stress(a) => stress(a, threads, stage),
        }
    }
}

fn programs(folder: &Path, threads: usize) -> Result<Programs> {
    if folder.join("gs-geom").exists() {
        return Ok(Programs { folder: folder.into(), threads });
    }
    Err(Error::new("no programs here").file(folder).expected("gs-geom and the other stages").hint("run make build"))
}

/// The right to write the results: JSON, and the same as Markdown and HTML beside it.
fn claim(out: &Path, stage: &Stage) -> Result<Claim> {
    stage.outputs(out).file(out).files(["md", "html"].map(|extension| out.with_extension(extension))).claim()
}

fn write(out: &Path, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_vec_pretty(value).map_err(|e| Error::new(e.to_string()).file(out))?;
    write_bytes(out, &text)
}

fn tradeoffs(a: &TradeoffArgs, threads: usize, stage: &Stage) -> Result<()> {
    let c = &a.common;
    let plan = Plan::read(&a.plan)?;
    let programs = programs(&c.bin, threads)?;
    let mut claim = claim(&c.out, stage)?;
    create_dir(&c.work)?;
    let names: Vec<&str> = plan.knobs.iter().map(|k| &*k.name).chain(plan.axes.iter().map(|x| &*x.name)).collect();
    if let Some(unknown) = a.only.iter().find(|o| !names.contains(&o.as_str())) {
        return Err(Error::new("no such knob or axis").field("--only").found(unknown).expected(names.join(", ")));
    }
    let wanted = |name: &str| a.only.is_empty() || a.only.iter().any(|o| o == name);
    let (mut curves, mut grown) = (Vec::new(), Vec::new());
    let any = plan.knobs.iter().any(|k| wanted(&k.name));
    for scene in plan.scenes.iter().filter(|_| any) {
        let folder = c.work.join(&scene.name);
        let base = tradeoff::prepare(&programs, scene, &folder)?;
        for s in STAGES.into_iter().skip(1) {
            base.run(&programs, s, &crate::chain::Options::default())?;
        }
        for knob in plan.knobs.iter().filter(|k| wanted(&k.name)) {
            stage.info(&format!("{} on {}", knob.title, scene.name));
            curves.push(tradeoff::measure(&programs, &plan, knob, scene, &base, &folder)?);
        }
    }
    for axis in plan.axes.iter().filter(|x| wanted(&x.name)) {
        stage.info(&format!("growth along {}", axis.title));
        grown.extend(growth::measure(&programs, &plan, axis, &c.work)?);
    }
    page::warnings(&curves).iter().for_each(|w| stage.warn(w));
    write(&c.out, &json!({"threads": threads, "curves": curves, "growth": grown}))?;
    write_bytes(c.out.with_extension("md"), page::text(&curves, &grown).as_bytes())?;
    let subtitle = format!("{} runs of each, {threads} threads", plan.repeats);
    write_bytes(c.out.with_extension("html"), page::html(&curves, &grown, &subtitle).as_bytes())?;
    let summary = json!({"curves": curves.len(), "dominated": page::warnings(&curves).len()});
    stage.record(&mut claim, json!({"command": "tradeoff"}), BTreeMap::new(), summary)
}

fn comparison(a: &CompareArgs, threads: usize, stage: &Stage) -> Result<()> {
    let c = &a.common;
    let plan = Plan::read(&a.plan)?;
    let mut claim = claim(&c.out, stage)?;
    let all = compare::compare(&programs(&a.base, threads)?, &programs(&c.bin, threads)?, &plan, &c.work)?;
    let (head, rows) = page::compare_table(&all);
    let text = page::markdown(&head, &rows);
    text.lines().for_each(|l| stage.info(l));
    write(&c.out, &all)?;
    write_bytes(c.out.with_extension("md"), text.as_bytes())?;
    stage.record(&mut claim, json!({"command": "compare"}), BTreeMap::new(), json!({}))
}

fn stress(a: &StressArgs, threads: usize, stage: &Stage) -> Result<()> {
    let c = &a.common;
    let mut claim = claim(&c.out, stage)?;
    create_dir(&c.work)?;
    let rows = crate::stress::run(&programs(&c.bin, threads)?, &c.work, &a.only, &|name| stage.info(name))?;
    write(&c.out, &rows)?;
    let (text, page) = page::stress(&rows);
    write_bytes(c.out.with_extension("md"), text.as_bytes())?;
    write_bytes(c.out.with_extension("html"), page.as_bytes())?;
    let bad: Vec<_> = rows.iter().filter(|r| !r.good).collect();
    stage.record(
        &mut claim,
        json!({"command": "stress"}),
        BTreeMap::new(),
        json!({"cells": rows.len(), "bad": bad.len()}),
    )?;
    stage.info(&format!("{} of {} cells are good", rows.len() - bad.len(), rows.len()));
    match bad.first() {
        None => Ok(()),
        Some(first) => Err(Error::new(format!("{} cells are not good", bad.len()))
            .file(&c.out)
            .field(format!("{}, {}", first.scene, first.stage))
            .found(&first.note)),
    }
}
