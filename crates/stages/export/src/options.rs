//! The command line.

use clap::{Parser, Subcommand, ValueEnum};
use gs_io::Result;
use gs_scene::splat::Format;
use objects::Up;
use serde::{Serialize, Serializer};
use stage::{CommonArgs, Program, Stage};
use std::path::PathBuf;

/// Take the objects of a scene to other programs: scene.json, splats, points, meshes, USD
#[derive(Debug, Parser)]
#[command(name = "export", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Subcommand, Serialize)]
#[serde(tag = "command", rename_all = "lowercase")]
enum Command {
    /// Write scene.json: the objects with names, boxes and best views, and what stands on, in, under and next to what
    Scene(SceneOptions),
    /// Write a splat for each object, object_<id>, into a folder
    Objects(ObjectsOptions),
    /// Write one splat of the scene, of some objects, or of all but some, with the ids of objects
    Splats(SplatsOptions),
    /// Write the centres of the Gaussians as a point cloud with colours and ids, LAS or PLY
    Points(PointsOptions),
    /// Write a closed convex mesh around each object, object_<id>, into a folder: for physics
    Meshes(MeshesOptions),
    /// Write a USD stage as text (.usda): for each object its Gaussians and a convex collider
    Usd(UsdOptions),
    /// Print the JSON schema of scene.json
    Schema,
}

/// The scene.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Inputs {
    /// The Gaussians that the instances were made from
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE")]
    pub instances: PathBuf,
    /// instances.edits.json of explore: corrections, names, notes and scale [default: none]
    #[arg(long, value_name = "FILE")]
    pub edits: Option<PathBuf>,
}

/// What is up.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct UpOptions {
    /// Dataset folder that the instances were made from: its cameras say what is up [default: nothing does]
    #[arg(long, value_name = "DIR")]
    pub scene: Option<PathBuf>,
    /// What is up in the geometry: x, -x, y, -y, z, -z, or three numbers such as 0,-1,0
    #[arg(long, value_name = "DIRECTION", conflicts_with = "scene", allow_hyphen_values = true)]
    #[serde(serialize_with = "direction")]
    pub up: Option<Up>,
}

/// `export scene`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct SceneOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    #[command(flatten)]
    #[serde(flatten)]
    pub up: UpOptions,
    /// query.json of eval query about these instances: the best instance of each text is called so, unless a person named it
    /// [default: none]
    #[arg(long, value_name = "FILE")]
    pub query: Option<PathBuf>,
    /// names.json of eval names about these instances: what neither a person nor a query named is called so
    /// [default: none; with --run-dir that of the run]
    #[arg(long, value_name = "FILE")]
    pub names: Option<PathBuf>,
    /// Output file
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// File formats of splats, by their extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SplatFormat {
    /// PLY with all properties of the geometry and `instance`
    Ply,
    /// PLY as PlayCanvas compresses it
    #[value(name = "compressed.ply")]
    CompressedPly,
    /// SPZ version 3
    Spz,
    /// SOG version 2, a zip
    Sog,
    /// 32 bytes a Gaussian, no harmonics
    Splat,
    /// glTF with KHR_gaussian_splatting
    Glb,
}

impl SplatFormat {
    /// The extension, without its dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::CompressedPly => "compressed.ply",
            Self::Spz => "spz",
            Self::Sog => "sog",
            Self::Splat => "splat",
            Self::Glb => "glb",
        }
    }
}

/// `export objects`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct ObjectsOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    /// Ids of objects, with commas [default: all]
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    pub only: Vec<u32>,
    /// File format
    #[arg(long, value_enum, default_value_t = SplatFormat::Ply)]
    pub format: SplatFormat,
    /// Output folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// `export splats`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct SplatsOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    /// Only these objects: ids, with commas [default: everything]
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    pub only: Vec<u32>,
    /// Everything but these objects: ids, with commas
    #[arg(long, value_name = "IDS", value_delimiter = ',', conflicts_with = "only")]
    pub without: Vec<u32>,
    /// Also write <name>.ids.json: the ids by the order of the Gaussians, for programs that drop unknown properties, and what each object
    /// is called. A PLY then has instance_id and class_id, too
    #[arg(long)]
    pub ids: bool,
    /// names.json of eval names about these instances, for the classes of --ids
    /// [default: none; with --run-dir that of the run]
    #[arg(long, value_name = "FILE")]
    pub names: Option<PathBuf>,
    /// Output file; its extension is the format: .ply, .compressed.ply, .spz, .sog, .splat or .glb. Ids are in PLYs alone; others take --ids
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// `export points`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct PointsOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    /// Least opacity of a Gaussian to be a point, 0 to 1: fainter ones are no surface
    #[arg(long, value_name = "OPACITY", default_value_t = 0.1, value_parser = stage::within(0.0f32..=1.0))]
    pub min_opacity: f32,
    /// Output file; its extension is the format: .las or .ply
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// File formats of meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFormat {
    /// Wavefront OBJ
    Obj,
    /// PLY with faces
    Ply,
}

/// `export meshes`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct MeshesOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    /// Ids of objects, with commas [default: all]
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    pub only: Vec<u32>,
    /// File format
    #[arg(long, value_enum, default_value_t = MeshFormat::Obj)]
    pub format: MeshFormat,
    /// Most vertices of a mesh, 8 to 1024
    #[arg(long, value_name = "COUNT", default_value_t = 64, value_parser = stage::within(8usize..=1024))]
    pub vertices: usize,
    /// Output folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// `export usd`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct UsdOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    #[command(flatten)]
    #[serde(flatten)]
    pub up: UpOptions,
    /// Most bands of spherical harmonics, 0 to 3: text with all of them takes about 830 bytes a Gaussian, with none 180
    #[arg(long, value_name = "DEGREE", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    pub sh: u8,
    /// Most vertices of a collider, 8 to 1024
    #[arg(long, value_name = "COUNT", default_value_t = 64, value_parser = stage::within(8usize..=1024))]
    pub vertices: usize,
    /// Output file, .usda
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

fn direction<S: Serializer>(up: &Option<Up>, s: S) -> Result<S::Ok, S::Error> {
    up.map(|u| u.direction).serialize(s)
}

impl Program for Args {
    const NAME: &'static str = "export";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        false
    }

    fn check(&self) -> Result<()> {
        match &self.command {
            Command::Splats(o) => Format::to_write(&o.out).map(drop),
            Command::Points(o) => crate::points::PointFormat::of(&o.out).map(drop),
            Command::Usd(o) => crate::usd::check_name(&o.out),
            _ => Ok(()),
        }
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let parameters = serde_json::to_value(&self.command).unwrap_or_default();
        match &self.command {
            Command::Scene(o) => crate::run::scene(o, parameters, stage),
            Command::Objects(o) => crate::run::objects(o, parameters, stage),
            Command::Splats(o) => crate::run::splats(o, parameters, stage),
            Command::Points(o) => crate::run::points(o, parameters, stage),
            Command::Meshes(o) => crate::run::meshes(o, parameters, stage),
            Command::Usd(o) => crate::run::usd(o, parameters, stage),
            Command::Schema => stage.print(objects::SCHEMA).map(drop),
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
