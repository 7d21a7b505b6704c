//! The options of every command: one struct each, with defaults and ranges. What shapes the result is serialised whole into
//! the provenance; paths, and options that change no byte, are not.

use crate::bounds::Bounds;
use crate::densification::Strategy;
use crate::photographs::masks::Masks;
use crate::views::Views;
use clap::{Parser, Subcommand, ValueEnum};
use gs_io::{Error, Result};
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, Dataset, HOLDOUT, LoadOptions, Resolution};
use gs_scene::splat::System;
use gs_scene::{Gaussians, Geometry, HoldOut, say_shift};
use gs_sfm::Refine;
use serde::{Serialize, Serializer};
use serde_json::Value;
use stage::{Bytes, CommonArgs, Stage, within};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Train 3D Gaussians on posed photographs, render them, measure them
#[derive(Debug, Parser)]
#[command(name = "gs-geom", version)]
pub struct Args {
    #[command(subcommand)]
    pub(crate) command: Command,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Train Gaussians until they look like the photographs
    Train(Box<Train>),
    /// Render views of a dataset as PNG
    Render(Render),
    /// PSNR and SSIM on held-out views
    Eval(Eval),
    /// Make a dataset of renders, with cameras that see all of the scene, from Gaussians alone
    Views(Views),
    /// Describe a file of Gaussians (counts, bounds, histograms, faults), or list the files of a dataset
    Inspect(Inspect),
    /// Write a file of Gaussians in another format, cropped, with other harmonics or axes
    Convert(Convert),
}

/// Which photographs, and at which size.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct SceneOptions {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes), or the refined cameras OUT.cameras.json of a training
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub scene: PathBuf,
    /// Size of the photographs: a divisor, a width in pixels that wider ones are shrunk to such as 640px, or auto for 1600px
    #[arg(long, value_name = "auto|WIDTHpx|DIVISOR", default_value = "auto")]
    pub resolution: Resolution,
    #[command(flatten)]
    #[serde(flatten)]
    pub held: stage::HoldoutArgs,
    /// Colour behind the scene, and behind transparent pixels of the photographs
    #[arg(long, value_enum, default_value_t = Background::Black)]
    pub background: Background,
}

/// Which pixels of the photographs count.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct MaskOptions {
    /// Folder of masks with the names of the photographs, instead of the mask_path of a transforms.json. Black pixels, and
    /// transparent ones of masks and photographs, do not count. Without masks a photograph's transparent pixels (alpha below 1)
    /// show --background
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub masks: Option<PathBuf>,
}

#[derive(Debug, Clone, clap::Args)]
pub(crate) struct GeometryOptions {
    /// Gaussians: a PLY of 3DGS, or another format of docs/splats.md
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
}

#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct Train {
    #[command(flatten)]
    #[serde(flatten)]
    pub scene: SceneOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub masks: MaskOptions,
    /// Where to write the Gaussians, as a 3DGS PLY; checkpoint, training curve and record of the run lie beside it
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub out: PathBuf,
    /// Number of iterations, 1 to 1e8; each renders one view. With --time-budget, the largest number
    #[arg(long, value_name = "COUNT", default_value_t = 30_000, value_parser = clap::value_parser!(u32).range(1..=100_000_000))]
    pub iterations: u32,
    /// Plan iterations, picture size and --max-gaussians so that the run ends within this time, such as 90s, 10m or 1h. The
    /// plan depends on the machine's speed. It is printed as options that give the same bytes on any machine
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    #[serde(skip)]
    pub time_budget: Option<f64>,
    /// Degree of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "DEGREE", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    pub sh_degree: u8,
    /// What to start from: the dataset's points (where it has none, those of its depth images, else what the photographs have in
    /// common, else random ones), random points in front of the cameras, or a file of Gaussians (docs/splats.md) or a PLY of points
    #[arg(long, value_name = "points|random|FILE.ply", default_value = "points")]
    pub init: Init,
    /// Number of random points to start from, and the most from depth images and from depths by plane sweep (of these not more than
    /// half of --max-gaussians), 1 to 1e9
    #[arg(long, value_name = "COUNT", default_value_t = 20_000, value_parser = within(1..=MOST_GAUSSIANS))]
    pub init_points: usize,
    /// What is skipped.
    #[command(flatten)]
    #[serde(flatten)]
    pub skip: stage::SkipArgs,
    /// Options that go together [default: none]
    #[arg(long, value_enum)]
    pub preset: Option<Preset>,
    /// How the number of Gaussians changes
    #[arg(long, value_enum, default_value_t = Strategy::default())]
    pub densify: Strategy,
    /// Largest number of Gaussians, 1 to 1e9. With --densify mcmc it is their number at the end, if there are enough
    /// iterations [one for 100 pixels of the training photographs, but at least 10,000 and twice the dataset's points; no
    /// limit with --preset 3dgs]
    #[arg(long, value_name = "COUNT", value_parser = within(1..=MOST_GAUSSIANS))]
    pub max_gaussians: Option<usize>,
    /// Iterations between densifications [a thirtieth of --iterations, 50 to 100]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    pub densify_every: Option<u32>,
    /// Lower the opacity of Gaussians smaller than a pixel (the 2D filter of Mip-Splatting), so that renders of other sizes
    /// than the photographs look alike. The PLY says so, and all commands that render it do the same
    #[arg(long)]
    pub antialias: bool,
    /// Train an affine map of colours for each training photograph, for cameras with automatic exposure or white balance.
    /// Held-out views are rendered at the photographs' mean
    #[arg(long)]
    pub exposure: bool,
    /// Refine poses and focal lengths: first by corners that photographs have in common, then with the scene, by what renders and
    /// photographs differ in. Held-out views are brought to the scene before they are measured. OUT.cameras.json holds the
    /// refined cameras; later stages take it as their --scene. auto: where other poses fit the corners much better than those given
    #[arg(long, value_name = "off|on|auto", value_enum, num_args = 0..=1, default_value = "off", default_missing_value = "on")]
    pub refine_poses: Refine,
    /// Picture sizes in the course of the run; with --preset 3dgs the default is full
    #[arg(long, value_enum, default_value = "coarse", default_value_if("preset", "3dgs", "full"))]
    pub schedule: PictureSizes,
    /// Memory for decoded photographs, such as 512M or 2G; the others are decoded each time. 0 keeps none
    #[arg(long, value_name = "BYTES", default_value_t = Bytes(2 << 30))]
    #[serde(skip)]
    pub image_cache: Bytes,
    /// Iterations (500) or seconds (60s) between checkpoints; more seconds where saving would take over a twentieth of the time.
    /// The same command goes on from the last checkpoint
    #[arg(long, value_name = "COUNT|SECONDS", default_value = "20s")]
    #[serde(skip)]
    pub checkpoint_every: Every,
}

/// A set of defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
pub(crate) enum Preset {
    /// As 3DGS trains: pictures of full size from the start, no limit on the number of Gaussians, and after the first reset
    /// of opacities no Gaussian larger than a tenth of the scene. (3DGS forgets the sizes on screen before it looks at them,
    /// so its pruning by them never removes any.)
    #[value(name = "3dgs")]
    #[serde(rename = "3dgs")]
    Stock,
}

/// More Gaussians fit into no machine.
const MOST_GAUSSIANS: usize = 1_000_000_000;

#[derive(Debug, clap::Args)]
pub(crate) struct Render {
    #[command(flatten)]
    pub scene: SceneOptions,
    #[command(flatten)]
    pub geometry: GeometryOptions,
    /// Folder for the pictures, named after the photographs
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// test (held-out), train, all, or names of photographs separated by commas
    #[arg(long, value_name = "VIEWS", default_value = "test")]
    pub views: String,
    /// Also write NAME.exr: R, G, B, A (accumulated alpha) and Z (mean depth along the optical axis) as 32-bit floats
    #[arg(long)]
    pub exr: bool,
}

#[derive(Debug, clap::Args, Serialize)]
pub(crate) struct Eval {
    #[command(flatten)]
    #[serde(flatten)]
    pub scene: SceneOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub masks: MaskOptions,
    #[command(flatten)]
    #[serde(skip)]
    pub geometry: GeometryOptions,
    /// Where to write the figures, as JSON
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub out: PathBuf,
}

#[derive(Debug, clap::Args)]
pub(crate) struct Inspect {
    /// Gaussians, in any format of docs/splats.md; or the folder of a dataset, of which all files are listed, each with its bytes
    /// and the time of its last change in seconds since 1970
    #[arg(value_name = "FILE|FOLDER")]
    pub file: PathBuf,
}

#[derive(Debug, clap::Args, Serialize)]
pub(crate) struct Convert {
    /// Gaussians: PLY of any property order and encoding, compressed PLY, SPZ, SOG (.sog, or its folder), .splat, .glb or .gltf
    #[arg(value_name = "IN")]
    #[serde(skip)]
    pub input: PathBuf,
    /// Where to write them, in the format of the name: .ply (little-endian floats in the property order of the original 3DGS
    /// code, 62 properties at SH degree 3), .compressed.ply, .spz, .sog, .splat (no harmonics beyond the constant one) or .glb;
    /// another file than IN
    #[arg(value_name = "OUT")]
    #[serde(skip)]
    pub output: PathBuf,
    /// Where the axes x, y, z of IN point, whatever its format says: R or L, U or D, F or B, such as RUB. An SPZ whose packer kept the numbers
    /// of a PLY as they lie has RDF [as the format says: SPZ RUB, glTF LUF, all others RDF]
    #[arg(long, value_name = "AXES", conflicts_with = "scene")]
    #[serde(serialize_with = "some_as_text", skip_serializing_if = "Option::is_none")]
    pub axes: Option<System>,
    /// Photographs with poses that IN shows, which tell its axes: those are taken in which renders come nearer to a few of them. IN is refused
    /// where one plain colour comes as near. A PLY that fits as it is, with none of the options below, is copied byte for byte
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub scene: Option<PathBuf>,
    /// Degree of the spherical harmonics, 0 to 3: higher bands are dropped, missing ones zero [as in IN]
    #[arg(long, value_name = "DEGREE", value_parser = clap::value_parser!(u8).range(0..=3))]
    pub sh_degree: Option<u8>,
    /// Drop Gaussians whose centre lies outside this box, world units
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    pub crop: Option<Bounds<f64>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Background {
    Black,
    White,
    /// Training only: another colour in every iteration; renders are over black
    Random,
}

impl Background {
    pub fn color(self) -> [f32; 3] {
        if self == Self::White { [1.0; 3] } else { [0.0; 3] }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PictureSizes {
    /// A quarter for a sixth of the iterations, at most 500; half up to a third, at most 1,000; then full
    Coarse,
    /// Full from the start
    Full,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Init {
    Points,
    Random,
    /// Its content is among the hashes of the inputs.
    File(#[serde(skip)] PathBuf),
}

impl Init {
    pub fn file(&self) -> Option<&Path> {
        if let Self::File(path) = self { Some(path) } else { None }
    }
}

impl FromStr for Init {
    type Err = std::convert::Infallible;

    fn from_str(s: &str) -> std::result::Result<Self, Self::Err> {
        Ok(match s {
            "points" => Self::Points,
            "random" => Self::Random,
            file => Self::File(file.into()),
        })
    }
}

/// How often to write a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Every {
    Iterations(u32),
    Seconds(f64),
}

impl FromStr for Every {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let every = match s.strip_suffix('s') {
            Some(t) => t.parse().ok().filter(|t: &f64| *t >= 0.0).map(Self::Seconds),
            None => s.parse().ok().filter(|n: &u32| *n > 0).map(Self::Iterations),
        };
        let expected = "iterations such as 500, or seconds such as 60s";
        every.ok_or_else(|| Error::new("not a period").found(s).expected(expected))
    }
}

/// Reads `90`, `90s`, `10m` or `1.5h` as seconds.
fn seconds(text: &str) -> Result<f64> {
    let units = [("s", 1.0), ("m", 60.0), ("h", 3600.0)];
    let (number, unit) =
        units.iter().find_map(|(suffix, unit)| Some((text.strip_suffix(suffix)?, *unit))).unwrap_or((text, 1.0));
    let seconds = number.parse::<f64>().ok().map(|n| n * unit).filter(|s| *s > 0.0 && s.is_finite());
    seconds.ok_or_else(|| Error::new("not a time").found(text).expected("a time such as 90s, 10m or 1.5h"))
}

fn some_as_text<S: Serializer>(value: &Option<impl Display>, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.collect_str(&value.as_ref().map_or(String::new(), ToString::to_string))
}

impl Convert {
    /// Whether no option does anything to the Gaussians.
    pub fn keeps_all(&self) -> bool {
        self.sh_degree.is_none() && self.crop.is_none()
    }
}

impl SceneOptions {
    /// The dataset, without its warnings.
    pub fn load_quietly(&self) -> Result<Dataset> {
        let holdout = self.held.holdout.unwrap_or(HOLDOUT);
        dataset::load(&self.scene, &LoadOptions { resolution: self.resolution, holdout })
    }

    /// These with the views held out that are so for the Gaussians of a file, and what is known of them.
    pub fn for_geometry(&self, geometry: &GeometryOptions) -> Result<(Self, HoldOut)> {
        let held = HoldOut::of(&geometry.geometry, self.held.holdout)?;
        let every = stage::HoldoutArgs { holdout: Some(held.every) };
        Ok((Self { held: every, ..self.clone() }, held))
    }

    /// The dataset.
    pub fn load(&self, stage: &Stage) -> Result<Dataset> {
        let dataset = self.load_quietly()?;
        dataset.warnings.iter().for_each(|w| stage.warn(w));
        if dataset.shift != [0.0; 3] {
            stage.info(&format!(
                "the scene is far from the origin: {} is subtracted from it, and what is written says so",
                say_shift(dataset.shift)
            ));
        }
        Ok(dataset)
    }
}

impl MaskOptions {
    /// The masks of a dataset's views, each of which has been read once: nothing is wrong with them.
    pub fn load(&self, dataset: &Dataset, stage: &Stage) -> Result<Masks> {
        let masks = match &self.masks {
            Some(folder) => Masks::find(folder, &dataset.views)?,
            None => Masks::of_dataset(&dataset.views),
        };
        let (count, views) = (masks.len(), dataset.views.len());
        if (1..views).contains(&count) {
            stage.warn(&format!("{} of {views} photographs have no mask: all their pixels count", views - count));
        }
        for (odd, names) in masks.odd(&dataset.views)? {
            stage.warn(&format!("{} of {count} masks, {} first, {odd}", names.len(), names[0]));
        }
        masks.with_borders(dataset, stage)
    }
}

impl GeometryOptions {
    /// The Gaussians, and how they are drawn over `background`. Bands of spherical harmonics that are zero in every
    /// Gaussian are not evaluated: the pictures are the same.
    pub fn read(&self, background: Background, stage: &Stage) -> Result<(Gaussians, RasterOptions)> {
        let geometry = Geometry::read(&self.geometry)?;
        if let Some(damage) = geometry.damage() {
            stage.skipped(&damage);
        }
        let options = RasterOptions { background: background.color(), ..RasterOptions::of(&geometry) };
        let gaussians = geometry.gaussians;
        check_some(&gaussians, &self.geometry)?;
        let (used, degree) = (options.sh_degree, gaussians.sh_degree);
        if used < degree {
            stage.skipped(&format!("spherical harmonics of degrees {} to {degree}: zero in every Gaussian", used + 1));
        }
        Ok((gaussians, options))
    }
}

/// Notes in a record what was subtracted from the world's coordinates, where something was.
pub(crate) fn note_shift(record: &mut Value, shift: [f64; 3]) {
    if shift != [0.0; 3] {
        record["shift"] = shift.to_vec().into();
    }
}

/// Refuses an empty file of Gaussians.
pub(crate) fn check_some(gaussians: &Gaussians, path: &Path) -> Result<()> {
    if gaussians.is_empty() {
        return Err(Error::new("no Gaussians").file(path).field("element vertex").hint("train the geometry again"));
    }
    Ok(())
}

/// Bytes that the Gaussians of a file would take as a PLY.
pub(crate) fn bytes(path: &Path) -> Result<u64> {
    gs_scene::splat::bytes_as_ply(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_and_times_are_read() {
        let typed = ["gs-geom", "train", "--scene", "s", "--out", "o"];
        let Command::Train(train) = Args::parse_from(typed).command else { panic!("train") };
        assert_eq!(train.checkpoint_every, Every::Seconds(20.0));
        assert_eq!("40".parse::<Every>().unwrap(), Every::Iterations(40));
        assert_eq!("2.5s".parse::<Every>().unwrap(), Every::Seconds(2.5));
        for wrong in ["0", "-1", "s", "x", "-3s", ""] {
            assert!(wrong.parse::<Every>().is_err(), "{wrong}");
        }
        for (text, wanted) in [("90", 90.0), ("90s", 90.0), ("10m", 600.0), ("1.5h", 5400.0)] {
            assert_eq!(seconds(text).unwrap(), wanted);
        }
        for wrong in ["", "m", "-1s", "0", "1d", "infs"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }

    /// A path in the provenance would make the bytes of a result depend on the machine.
    #[test]
    fn the_provenance_has_every_choice_and_no_path() {
        let typed =
            ["gs-geom", "train", "--scene", "/s", "--out", "/o", "--masks", "/m", "--init", "/i.ply", "--holdout=3"];
        let Command::Train(train) = Args::parse_from(typed).command else { panic!("train") };
        let text = serde_json::to_string(&train).unwrap();
        assert!(
            !text.contains('/') && text.contains("\"holdout\":3") && text.contains("\"resolution\":\"auto\""),
            "{text}"
        );
    }
}
