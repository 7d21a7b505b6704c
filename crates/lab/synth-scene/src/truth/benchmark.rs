//! Miniatures of the benchmarks: where the files of a scene lie, and what they are called, in the layout of LERF-OVS, of
//! ScanNet as its tools extract it, and of ScanNet as OpenGaussian converts it.

use crate::scene::Scene;
use crate::truth::named::{self, Named};
use crate::truth::scannet;
use artifacts::{LERF_OVS, LerfScene, TruePoints};
use clap::ValueEnum;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::write_transforms;
use gs_scene::{Camera, PointCloud, colmap};
use serde::{Serialize, Serializer};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The layouts by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LayoutName {
    /// images/ and sparse/0
    Colmap,
    /// One of the four scenes, which the folder's name says: its labelled frames and texts, labels in `../label/<scene>`
    LerfOvs,
    /// A scan by the folder's name: color/, pose/, intrinsic/, and the files of its mesh; frames 0, 20, 40...
    Scannet,
    /// The same as OpenGaussian converts it: color/, transforms_train.json, transforms_test.json, points3d.ply
    Opengaussian,
}

/// A layout with the scene's name in it.
#[derive(Debug, Clone, PartialEq)]
pub enum Layout {
    /// `images/`, `sparse/0/`, labels in `label/`.
    Colmap,
    /// A scene of LERF-OVS: things have the names that are asked for, and the frames that are scored are among the views.
    LerfOvs(&'static LerfScene),
    /// A scan of this name, such as `scene0000_00`, as extracted or as OpenGaussian converts it.
    Scan { name: String, converted: bool },
}

impl Serialize for Layout {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_str(&match self {
            Self::Colmap => "colmap".to_string(),
            Self::LerfOvs(scene) => format!("lerf-ovs {}", scene.name),
            Self::Scan { name, converted } => format!("{} {name}", if *converted { "opengaussian" } else { "scannet" }),
        })
    }
}

/// The folders that a scene of some layout may have, all of which this program owns.
pub const FOLDERS: [&str; 9] =
    ["truth", "label", "language_features", "sparse", "images", "scan", "color", "pose", "intrinsic"];
/// The cameras of a converted scan.
const TRANSFORMS: [&str; 2] = ["transforms_train.json", "transforms_test.json"];
/// Every how many frames of a recording one is used.
const FRAME_STEP: usize = 20;

impl Layout {
    /// The layout of a scene in the folder `out`, whose name must be one of the benchmark's.
    pub fn new(name: LayoutName, out: &Path) -> Result<Self> {
        let folder = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let unnamed = |expected: &str| {
            Error::new("the folder's name is none of the benchmark's").field("--out").found(&folder).expected(expected)
        };
        match name {
            LayoutName::Colmap => Ok(Self::Colmap),
            LayoutName::LerfOvs => LerfScene::named(&folder)
                .map(Self::LerfOvs)
                .ok_or_else(|| unnamed("figurines, ramen, teatime or waldo_kitchen")),
            LayoutName::Scannet | LayoutName::Opengaussian => {
                let digits = folder.strip_prefix("scene").map(|d| d.replacen('_', "", 1)).unwrap_or_default();
                if digits.len() != 6 || !digits.bytes().all(|b| b.is_ascii_digit()) {
                    return Err(unnamed("a scan's, such as scene0000_00"));
                }
                Ok(Self::Scan { name: folder, converted: name == LayoutName::Opengaussian })
            }
        }
    }

    /// Folder of the photographs.
    pub fn images(&self) -> &'static str {
        if matches!(self, Self::Scan { .. }) { "color" } else { "images" }
    }

    /// Folder of the labels of a scene in `out`.
    pub fn labels(&self, out: &Path) -> PathBuf {
        match self {
            Self::LerfOvs(s) => out.parent().unwrap_or(Path::new("")).join("label").join(s.name),
            _ => out.join("label"),
        }
    }

    /// What of a scene has labels besides things, by the folder in that of the labels: its parts and groups, classes of which there are
    /// several, and what is absent. The benchmarks know things alone.
    pub fn finer(&self, scene: &Scene) -> Vec<(&'static str, Vec<Named>)> {
        match self {
            Self::Colmap => vec![
                ("parts", named::parts(scene)),
                ("groups", named::groups(scene)),
                ("several", named::several(scene)),
                ("absent", named::absent(scene)),
            ],
            Self::LerfOvs(_) | Self::Scan { .. } => Vec::new(),
        }
    }

    /// Stems of the files of `views` views, ascending.
    pub fn stems(&self, views: usize) -> Vec<String> {
        match self {
            Self::Colmap => (1..=views).map(|v| format!("frame_{v:05}")).collect(),
            Self::LerfOvs(s) => frames(s, views).into_iter().map(|v| format!("frame_{v:05}")).collect(),
            Self::Scan { .. } => (0..views).map(|v| (FRAME_STEP * v).to_string()).collect(),
        }
    }

    /// Whether a view has labels, where every `every`-th has (0: none).
    pub fn is_labelled(&self, view: usize, stem: &str, every: usize) -> bool {
        match self {
            Self::LerfOvs(s) => every > 0 && s.scores_frame(stem),
            Self::Colmap => every > 0 && view.is_multiple_of(every),
            Self::Scan { .. } => false,
        }
    }

    /// Calls the things of a scene of LERF-OVS what is asked for there, one after the other while there are texts. They are
    /// classes of their own then, whose features depend on the text alone: one table serves all scenes.
    pub fn rename(&self, scene: &mut Scene) {
        if let Self::LerfOvs(s) = self {
            for (thing, query) in scene.things.iter_mut().filter(|t| !t.background).zip(s.queries) {
                thing.name = (*query).to_string();
                thing.class = query;
            }
        }
    }

    /// The texts of the benchmark, which a table of text features should have.
    pub fn texts(&self) -> Vec<&'static str> {
        match self {
            Self::LerfOvs(_) => LERF_OVS.iter().flat_map(|s| s.queries).copied().collect(),
            Self::Colmap | Self::Scan { .. } => Vec::new(),
        }
    }

    /// Writes poses, intrinsics and points. `views` are the file names of the photographs and their cameras.
    pub fn write_cameras(&self, out: &Path, views: &[(String, Camera)], sparse: &PointCloud) -> Result<()> {
        match self {
            Self::Colmap | Self::LerfOvs(_) => colmap::write_model(&out.join("sparse/0"), views, sparse),
            Self::Scan { converted: false, .. } => write_poses(out, views),
            Self::Scan { converted: true, .. } => write_opengaussian(out, views),
        }
    }

    /// Names of the files that lie beside the folders.
    pub fn root_files(&self) -> Vec<String> {
        let Self::Scan { name, converted } = self else { return Vec::new() };
        let transforms = TRANSFORMS.iter().filter(|_| *converted).map(ToString::to_string);
        scannet::files(name, *converted).into_iter().chain(transforms).collect()
    }

    /// Writes the files of the scan's mesh, if the layout has one.
    pub fn write_scan(&self, out: &Path, scene: &Scene, points: &TruePoints, colors: &[[u8; 3]]) -> Result<()> {
        let Self::Scan { name, converted } = self else { return Ok(()) };
        scannet::write(out, name, *converted, scene, points, colors)
    }
}

/// Numbers of the frames of `views` photographs: those that are scored, as many as there is room for, and others between.
fn frames(scene: &LerfScene, views: usize) -> BTreeSet<u32> {
    let mut chosen: BTreeSet<u32> = scene.frames.iter().take(views).copied().collect();
    let last = scene.frames.last().copied().unwrap_or(0).max(2 * views as u32);
    let free: Vec<u32> = (1..=last).filter(|f| !scene.frames.contains(f)).collect();
    let more = views - chosen.len();
    chosen.extend((0..more).map(|k| free[k * free.len() / more]));
    chosen
}

fn text(rows: &[[f64; 4]; 4]) -> String {
    rows.iter().map(|r| r.map(|v| format!("{v:.9}")).join(" ") + "\n").collect()
}

fn write_poses(out: &Path, views: &[(String, Camera)]) -> Result<()> {
    for (name, camera) in views {
        let path = out.join("pose").join(name).with_extension("txt");
        write_bytes(&path, text(&camera.pose()).as_bytes())?;
    }
    let Some((_, k)) = views.first() else { return Ok(()) };
    let intrinsic = [[k.fx, 0.0, k.cx, 0.0], [0.0, k.fy, k.cy, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    write_bytes(out.join("intrinsic/intrinsic_color.txt"), text(&intrinsic).as_bytes())
}

/// OpenGaussian lists all frames in both files, cameras in OpenGL's axes, names without extension.
fn write_opengaussian(out: &Path, views: &[(String, Camera)]) -> Result<()> {
    let names = views.iter().map(|(name, camera)| (format!("color/{}", name.trim_end_matches(".png")), camera.clone()));
    let views: Vec<_> = names.collect();
    TRANSFORMS.iter().try_for_each(|name| write_transforms(&out.join(name), &views, [0.0; 3]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_hold_those_that_are_scored() {
        for scene in &LERF_OVS {
            for views in [1, 4, 9, 30, 120, 400] {
                let f = frames(scene, views);
                assert_eq!(f.len(), views, "{}", scene.name);
                assert_eq!(scene.frames.iter().filter(|n| f.contains(n)).count(), views.min(scene.frames.len()));
            }
        }
    }

    #[test]
    fn folders_are_named_as_the_benchmarks_scenes() {
        let layout = |name, out: &str| Layout::new(name, Path::new(out));
        assert_eq!(
            layout(LayoutName::LerfOvs, "a/ramen").unwrap().labels(Path::new("a/ramen")),
            Path::new("a/label/ramen")
        );
        assert!(layout(LayoutName::Scannet, "a/scene0062_00").is_ok());
        assert!(layout(LayoutName::Colmap, "anything").is_ok());
        for (name, out) in [
            (LayoutName::LerfOvs, "a/kitchen"),
            (LayoutName::Scannet, "scene62_00"),
            (LayoutName::Scannet, "a/scene"),
            (LayoutName::Opengaussian, ".."),
        ] {
            let e = layout(name, out).unwrap_err().to_string();
            assert!(e.contains("--out: the folder's name is none of the benchmark's"), "{e}");
        }
    }
}
