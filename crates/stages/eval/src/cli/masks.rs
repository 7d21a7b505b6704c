//! `eval masks` on the command line.

use crate::mask_stats;
use artifacts::Footprints;
use gs_io::{Error, Result, write_bytes};
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::PathBuf;

#[derive(Debug, clap::Args)]
pub(super) struct MasksArgs {
    /// Folder of id maps (*_s.npy)
    #[arg(long, value_name = "DIR")]
    masks: PathBuf,
    /// footprints.safetensors of graph-precompute for these masks: also say how many masks are split or merged in the
    /// view that shares most Gaussians
    #[arg(long, value_name = "FILE")]
    footprints: Option<PathBuf>,
    /// Output JSON
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

pub(super) fn run(a: &MasksArgs, stage: &Stage) -> Result<String> {
    let maps = artifacts::folder_files(&a.masks, "_s.npy")?;
    let mut claim = stage.outputs(&a.out).file(&a.out).reads(maps).reads(&a.footprints).claim()?;
    let footprints = a.footprints.as_deref().map(Footprints::read).transpose()?;
    let mut inputs = BTreeMap::new();
    let masks = artifacts::hash_folder(&a.masks, "_s.npy")?;
    if let Some(f) = &footprints {
        f.artifact().expect_input(artifacts::role::MASKS, &masks)?;
        inputs.insert("footprints".to_string(), f.artifact().hash().to_string());
    }
    inputs.insert(artifacts::role::MASKS.to_string(), masks);
    let stats = mask_stats::measure(&a.masks, footprints.as_ref())?;
    let json = serde_json::to_vec_pretty(&stats).map_err(|e| Error::new(e.to_string()).file(&a.out))?;
    write_bytes(&a.out, &json)?;
    stage.record(&mut claim, json!({"command": "masks"}), inputs, json!({"views": stats.views}))?;
    Ok(mask_stats::table(&stats))
}
