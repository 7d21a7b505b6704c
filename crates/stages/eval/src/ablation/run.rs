//! What the runs of a plan left behind.

use super::plan::{Plan, Row};
use crate::score::Scores;
use gs_io::{Error, IoContext, Result};
use stage::RunRecord;
use std::path::{Path, PathBuf};

/// A number that each run gives.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    /// Name in JSON.
    pub name: &'static str,
    /// Heading in tables.
    pub title: &'static str,
    /// Whether it is a share, shown in percent.
    pub share: bool,
    of: fn(&Scores) -> Option<f64>,
}

/// All metrics, in the order of tables.
pub const METRICS: [Metric; 11] = [
    Metric { name: "instance_miou", title: "instance mIoU", share: true, of: |s| s.instance_miou },
    Metric { name: "ap25", title: "AP25", share: true, of: |s| s.ap25 },
    Metric { name: "ap50", title: "AP50", share: true, of: |s| s.ap50 },
    Metric {
        name: "gaussian_miou",
        title: "mIoU of Gaussians",
        share: true,
        of: |s| s.gaussians.as_ref().map(|g| g.instance_miou),
    },
    Metric {
        name: "gaussian_ap25",
        title: "their AP25",
        share: true,
        of: |s| s.gaussians.as_ref().and_then(|g| g.ap25),
    },
    Metric {
        name: "gaussian_ap50",
        title: "their AP50",
        share: true,
        of: |s| s.gaussians.as_ref().and_then(|g| g.ap50),
    },
    Metric { name: "query_miou", title: "query mIoU", share: true, of: |s| s.query_miou },
    Metric { name: "query_macc25", title: "query mAcc@0.25", share: true, of: |s| s.query_macc25 },
    Metric { name: "query_miou_visible", title: "query mIoU, visible", share: true, of: |s| s.query_miou_visible },
    Metric { name: "fragmentation", title: "fragmentation", share: false, of: |s| s.instances_per_thing },
    Metric { name: "merging", title: "merging", share: false, of: |s| s.things_per_instance },
];

/// One run of a row.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// `scene-seed`.
    pub scene: String,
    /// A value for each of [`METRICS`].
    pub values: Vec<Option<f64>>,
    /// Processor seconds of feat-train and cluster-match; of a training whose record lacks them, those of the clock.
    pub seconds: Option<f64>,
    /// Mean cosine of a mask's Gaussians with its centroid in the last view trained on; none for closed forms.
    pub alignment: Option<f64>,
    /// Bytes of the graph network, and of it per Gaussian.
    pub network: Option<(f64, f64)>,
}

/// Where the runs lie.
pub struct Runs<'a> {
    /// Folder of `scene-seed/pP/features.clustering.score.json`.
    pub folder: &'a Path,
    /// Their plan.
    pub plan: &'a Plan,
}

impl Runs<'_> {
    /// Cells of a row at a p, in the order of scenes and seeds, and the scores that are not there.
    ///
    /// # Errors
    /// When a score is damaged.
    pub fn cells(&self, row: &Row, p: &str) -> Result<(Vec<Cell>, Vec<PathBuf>)> {
        let (mut cells, mut missing) = (Vec::new(), Vec::new());
        for (scene, _) in &self.plan.scenes {
            for seed in &self.plan.seeds {
                let name = format!("{scene}-{seed}");
                let folder = self.folder.join(&name).join(format!("p{p}"));
                let path = folder.join(format!("{}.score.json", row.id()));
                if path.exists() {
                    cells.push(cell(name, &folder, &path, row)?);
                } else {
                    missing.push(path);
                }
            }
        }
        Ok((cells, missing))
    }
}

fn cell(scene: String, folder: &Path, path: &Path, row: &Row) -> Result<Cell> {
    let bytes = std::fs::read(path).at("read", path)?;
    let scores: Scores = serde_json::from_slice(&bytes)
        .map_err(|e| Error::new(format!("not scores: {e}")).file(path).hint("delete it and run make again"))?;
    let record = |name: String| RunRecord::read(folder.join(name)).ok();
    let features = record(format!("{}.features.safetensors", row.features));
    let instances = record(format!("{}.instances.safetensors", row.id()));
    let number = |key: &str| features.as_ref().and_then(|r| r.summary[key].as_f64());
    let network = number("network_bytes").zip(number("gaussians"));
    let alignment = features.as_ref().and_then(|r| r.summary["last"]["alignment"].as_f64());
    Ok(Cell {
        alignment,
        scene,
        values: METRICS.iter().map(|m| (m.of)(&scores)).collect(),
        seconds: features
            .as_ref()
            .zip(instances.as_ref())
            .and_then(|(f, i)| Some(f.cpu_seconds.unwrap_or(f.wall_seconds) + i.cpu_seconds?)),
        network: network.filter(|(_, n)| *n > 0.0).map(|(bytes, n)| (bytes, bytes / n)),
    })
}
