//! The commands of `eval`.

use crate::options::{
    CheckOptions, LerfOptions, MasksOptions, NamesOptions, QueryOptions, ReportOptions, ScannetOptions, ScoreOptions,
    TableOptions,
};
use crate::{check, mask_stats, names, page, protocols, query, score};
use clap::{Parser, Subcommand};
use gs_io::{Error, Result};
use serde::Serialize;
use stage::{CommonArgs, Program, Stage};

/// Text queries, evaluation protocols and the report
#[derive(Debug, Parser)]
#[command(name = "eval", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Subcommand, Serialize)]
#[serde(tag = "command", rename_all = "lowercase")]
enum Command {
    /// Find what a text means: ranked instances, a PLY of the selection, pictures, JSON
    Query(QueryOptions),
    /// Name every instance by a vocabulary: what is there, and how many of each; names.json
    Names(NamesOptions),
    /// Score a scene of LERF-OVS: objects selected in 3D by their names
    Lerf(LerfOptions),
    /// Score a ScanNet scan: classes of its vertices, class-agnostic instances
    Scannet(ScannetOptions),
    /// Bring the metrics of several scenes together in the paper's table
    Table(TableOptions),
    /// Score instances and text queries against the truth of the scene
    Score(ScoreOptions),
    /// Check that labels, texts and masks of a benchmark's scene can be read and fit together
    Check(CheckOptions),
    /// Measure id maps: how many, how large, and how often one view splits or merges what another shows
    Masks(MasksOptions),
    /// Make one self-contained HTML page of a run, and metrics.json beside it
    Report(ReportOptions),
}

impl Program for Args {
    const NAME: &'static str = "eval";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        !matches!(self.command, Command::Table(_) | Command::Check(_) | Command::Masks(_))
    }

    fn check(&self) -> Result<()> {
        match &self.command {
            Command::Query(o) if o.segment && o.text.len() < 2 => Err(Error::new("nothing to choose between")
                .field("--segment")
                .found(format!("{} texts", o.text.len()))
                .expected("at least two --text")),
            // Not a matter for clap: it requires nothing that --text-features excludes.
            Command::Query(o) if !o.image.is_empty() && o.texts.clip.is_none() => {
                Err(Error::new("pictures need an image encoder").field("--image").expected("--clip with image.onnx"))
            }
            Command::Lerf(o) => o.check(),
            Command::Report(_) if self.common.run_dir.is_none() => {
                Err(Error::new("which run").field("--run-dir").expected("the folder of a run, such as OUT of make"))
            }
            _ => Ok(()),
        }
    }

    fn run(mut self, stage: &Stage) -> Result<()> {
        if let (Command::Report(o), Some(dir)) = (&mut self.command, &self.common.run_dir) {
            o.run_dir.clone_from(dir);
        }
        let parameters = serde_json::to_value(&self.command).unwrap_or_default();
        let text = match &self.command {
            Command::Query(o) => query::run(o, parameters, stage, self.common.json)?,
            Command::Names(o) => names::run(o, parameters, stage)?,
            Command::Lerf(o) => protocols::lerf::run(o, parameters, stage)?,
            Command::Scannet(o) => protocols::scannet::run(o, parameters, stage)?,
            Command::Table(o) => protocols::table::run(o, parameters, stage)?,
            Command::Check(o) => check::run(o, stage)?,
            Command::Score(o) => score::run(o, parameters, stage)?,
            Command::Masks(o) => mask_stats::run(o, parameters, stage)?,
            Command::Report(o) => page::run(o, parameters, stage)?,
        };
        if !self.common.quiet && !self.common.json {
            stage.print(&text)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_sound() {
        Args::command().debug_assert();
    }
}
