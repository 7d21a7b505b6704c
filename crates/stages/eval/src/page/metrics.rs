//! The figures of a run.

use artifacts::Health;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `metrics.json`: the figures of a run in one place. Null where the run has none.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Mean PSNR over held-out views, dB.
    pub psnr_heldout: Option<f64>,
    /// Mean SSIM over held-out views.
    pub ssim_heldout: Option<f64>,
    /// Class-agnostic instance mIoU over all true things.
    pub instance_miou: Option<f64>,
    /// The same over objects only.
    pub object_miou: Option<f64>,
    /// Mean IoU of text queries over (frame, category) pairs.
    pub query_miou: Option<f64>,
    /// The same when only what a view shows of a selection counts (occlusion-aware).
    pub query_miou_visible: Option<f64>,
    /// Fraction of those pairs above IoU 0.25.
    pub query_macc25: Option<f64>,
    /// Number of different queries that were scored.
    pub query_count: usize,
    /// Each scored query, its mean IoU over frames and the cosine of its best instance.
    pub queries: Vec<QueryFigure>,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of instances.
    pub instances: Option<usize>,
    /// How far masks and instances agree; null where an older cluster-match made them.
    pub health: Option<Health>,
    /// Wall-clock seconds by stage.
    pub seconds: BTreeMap<String, f64>,
    /// Peak memory in bytes by stage, where the system tells.
    pub peak_bytes: BTreeMap<String, u64>,
    /// What was left out, and why.
    pub skipped: Vec<String>,
}

/// A scored query in `metrics.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryFigure {
    /// The text.
    pub text: String,
    /// Mean IoU over labelled frames.
    pub iou: f64,
    /// Cosine of the best instance.
    pub score: Option<f32>,
}

impl Metrics {
    /// The figures as a table for the terminal.
    pub fn table(&self) -> String {
        let mut s = String::new();
        let mut line = |name: &str, value: Option<String>| {
            s += &format!("{name:<16} {}\n", value.unwrap_or_else(|| "–".into()));
        };
        let number = |v: Option<f64>| v.map(|v| format!("{v:.4}"));
        line("psnr_heldout", self.psnr_heldout.map(|v| format!("{v:.2} dB")));
        line("ssim_heldout", number(self.ssim_heldout));
        line("instance_miou", number(self.instance_miou));
        line("query_miou", number(self.query_miou));
        line("  visible only", number(self.query_miou_visible));
        line("queries scored", Some(self.query_count.to_string()));
        line("gaussians", Some(self.gaussians.to_string()));
        line("instances", self.instances.map(|n| n.to_string()));
        for (stage, seconds) in &self.seconds {
            line(stage, Some(format!("{seconds:.1} s")));
        }
        for reason in &self.skipped {
            s += &format!("left out         {reason}\n");
        }
        s
    }
}
