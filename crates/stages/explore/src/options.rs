//! The command line.

use artifacts::InstanceNames;
use clap::{Parser, Subcommand};
use gs_io::{Error, Result};
use query::{EngineArgs, TextOptions};
use serde::Serialize;
use stage::{CommonArgs, Program, Stage};
use std::net::IpAddr;
use std::path::PathBuf;

/// Look at a scene in a browser, click on things, ask in words, take objects home
#[derive(Debug, Parser)]
#[command(name = "explore", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Subcommand, Serialize)]
#[serde(tag = "command", rename_all = "lowercase")]
enum Command {
    /// Serve the page on this machine until Ctrl-C
    Serve(ServeOptions),
    /// Answer an agent on standard input and output, by the Model Context Protocol
    Mcp(McpOptions),
    /// Write the page as one HTML file that needs no server and no network
    Page(PageOptions),
}

/// The run to look at.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Source {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// The geometry.ply that the instances were made from
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// instances.safetensors of cluster-match; instances.edits.json, what a person changes of them, is kept beside it
    #[arg(long, value_name = "FILE")]
    pub instances: PathBuf,
    /// CLIP folder with text.onnx, for questions in words
    #[arg(long, value_name = "DIR")]
    pub clip: Option<PathBuf>,
    /// Table of text features by name, instead of --clip: JSON, OpenGaussian's text_features.zip, or npz
    #[arg(long, value_name = "FILE", conflicts_with = "clip")]
    pub text_features: Option<PathBuf>,
    /// Bands of spherical harmonics that the page draws: 0 (16 bytes a Gaussian) or 1 (28 bytes, highlights move)
    #[arg(long, value_name = "DEGREE", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=1))]
    pub sh: u8,
    #[command(flatten)]
    #[serde(flatten)]
    pub engine: EngineArgs,
}

impl Source {
    /// The name of the folder that the instances lie in.
    pub fn name(&self) -> Option<String> {
        let path = self.instances.canonicalize().ok()?;
        Some(path.parent()?.file_name()?.to_string_lossy().into_owned())
    }

    /// What a person changed of the instances; need not be there.
    pub fn edits(&self) -> PathBuf {
        self.instances.with_file_name("instances.edits.json")
    }

    /// What instances are called by a vocabulary; need not be there.
    pub fn names(&self) -> PathBuf {
        InstanceNames::path_beside(&self.instances)
    }

    /// The features that the instances were clustered from, where they lie beside them.
    pub fn features(&self) -> Option<PathBuf> {
        Some(self.instances.with_file_name("features.safetensors")).filter(|f| f.is_file())
    }

    /// Where text features come from.
    pub fn texts(&self) -> TextOptions {
        let (clip, text_features) = (self.clip.clone(), self.text_features.clone());
        TextOptions { clip, text_features, engine: self.engine.clone(), ..TextOptions::default() }
    }

    /// All files that are read but those of the dataset.
    pub fn files(&self) -> impl Iterator<Item = PathBuf> {
        [self.instances.clone(), self.geometry.clone(), self.edits(), self.names()].into_iter().chain(self.features())
    }
}

/// `explore serve`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct ServeOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub source: Source,
    /// Port; 0 takes any free one
    #[arg(long, value_name = "NUMBER", default_value_t = 7007)]
    pub port: u16,
    /// Serve other machines too, at this address of this one, such as 0.0.0.0. The URL then holds a secret
    /// [default: this machine only, 127.0.0.1]
    #[arg(long, value_name = "ADDRESS")]
    pub bind: Option<IpAddr>,
    /// Open the page in the browser
    #[arg(long)]
    pub open: bool,
    /// Folder that programs may write objects into (POST tools/export) [default: they may not]
    #[arg(long, value_name = "DIR")]
    pub exports: Option<PathBuf>,
}

/// `explore mcp`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct McpOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub source: Source,
    /// Folder that the agent may write objects into [default: it may not]
    #[arg(long, value_name = "DIR")]
    pub exports: Option<PathBuf>,
}

/// `explore page`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct PageOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub source: Source,
    /// A text that the page can answer; may be given several times. Without a server there is no language model
    #[arg(long, value_name = "WORDS")]
    pub text: Vec<String>,
    /// Output file
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

impl Program for Args {
    const NAME: &'static str = "explore";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        match self.command {
            Command::Mcp(_) if self.common.json => Err(Error::new("standard output is for the agent")
                .field("--json")
                .hint("leave --json out: messages go to standard error")),
            _ => Ok(()),
        }
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let parameters = serde_json::to_value(&self.command).unwrap_or_default();
        match &self.command {
            Command::Serve(o) => crate::serve::run(o, stage),
            Command::Mcp(o) => crate::mcp::run(o, stage),
            Command::Page(o) => crate::page::run(o, parameters, stage),
        }
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
