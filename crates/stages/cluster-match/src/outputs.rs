//! What the stage writes: the artifact, and beside it what people and viewers read.

use crate::inputs::Inputs;
use crate::options::{Args, Settings};
use artifacts::{Draft, Health, Instances, instance_color, role};
use gs_io::{Claim, Error, Result, write_bytes};
use gs_scene::Labelled;
use ndarray::aview1;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// What is written beside the output, by extension: Gaussians with their instances, labels, and the instances as text.
pub(crate) const SIDE_FILES: [&str; 3] = ["ply", "labels.npy", "json"];

/// The right to write the instances and what lies beside them.
pub(crate) fn claim(a: &Args, stage: &Stage) -> Result<Claim> {
    let mut maps = Vec::new();
    for suffix in ["_s.npy", "_f.npy"] {
        maps.extend(artifacts::folder_files(&a.masks, suffix)?);
    }
    let read = [&a.geometry, &a.graph, &a.footprints].into_iter().chain(&a.features).chain(&a.from);
    if let Some(draft) = &a.draft {
        return stage.outputs(draft).artifact(draft, Draft::FORMAT).reads(read).reads(maps).claim();
    }
    stage
        .outputs(&a.out)
        .artifact(&a.out, Instances::FORMAT)
        .files(SIDE_FILES.map(|extension| a.out.with_extension(extension)))
        .reads(read)
        .reads(maps)
        .drop_stale()
        .claim()
}

/// What the stage found.
pub(crate) struct Found {
    pub draft: Draft,
    pub health: Health,
    /// Gaussians that the clustering called noise.
    pub noise: usize,
    pub clustering_seconds: f64,
}

/// Roles of the inputs that a draft is made of: all but language.
fn before_language(inputs: &Inputs) -> BTreeMap<String, String> {
    let language = [role::MASK_FEATURES, role::CLIP, role::CLIP_TEXT];
    inputs.hashes.clone().into_iter().filter(|(role, _)| !language.contains(&role.as_str())).collect()
}

/// Writes what is known before language.
pub(crate) fn write_draft(
    path: &Path,
    stage: &Stage,
    inputs: &Inputs,
    found: &Found,
    settings: &Settings,
    claim: &mut Claim,
) -> Result<()> {
    let parameters = serde_json::to_value(settings).map_err(|e| Error::new(e.to_string()))?;
    let hashes = before_language(inputs);
    let masks: usize = found.draft.wanted().values().map(BTreeSet::len).sum();
    let summary = json!({ "instances": found.draft.instances.len(), "masks": masks });
    stage.record(claim, parameters.clone(), hashes.clone(), summary)?;
    let mut provenance = stage.provenance(Draft::FORMAT, 1, parameters, hashes);
    provenance.extra = json!({ "health": found.health, "noise": found.noise });
    found.draft.write(path, provenance)?;
    let (path, instances) = (path.display(), found.draft.instances.len());
    stage.info(&format!("wrote {path}: {instances} instances, {masks} masks that say what they mean"));
    Ok(())
}

/// Reads a draft that these inputs and settings made.
///
/// # Errors
/// When others made it, or it is damaged.
pub(crate) fn read_draft(path: &Path, inputs: &Inputs, settings: &Settings) -> Result<Found> {
    let (draft, file) = Draft::read(path)?;
    for (role, hash) in before_language(inputs) {
        file.expect_input(&role, &hash)?;
    }
    let provenance = file.provenance();
    let fail = |e: serde_json::Error| Error::new(e.to_string()).file(path);
    let parameters = serde_json::to_value(settings).map_err(fail)?;
    if let Some(map) = parameters.as_object()
        && let Some((name, value)) = map.iter().find(|(name, value)| provenance.parameters.get(name) != Some(value))
    {
        let given = provenance.parameters.get(name).cloned().unwrap_or_default();
        return Err(Error::new("the draft was made with another option")
            .file(path)
            .field(name)
            .found(given)
            .expected(value)
            .hint("give the options of --draft again, or make the draft again"));
    }
    let health = serde_json::from_value(provenance.extra["health"].clone()).map_err(fail)?;
    let noise = provenance.extra["noise"].as_u64().unwrap_or(0) as usize;
    Ok(Found { draft, health, noise, clustering_seconds: 0.0 })
}

/// Writes everything, the artifact last: where it is new, so is everything beside it.
pub(crate) fn write(
    a: &Args,
    stage: &Stage,
    inputs: &Inputs,
    found: &Found,
    settings: &Settings,
    claim: &mut Claim,
) -> Result<()> {
    let Found { draft: Draft { instances, .. }, health, noise, clustering_seconds } = found;
    let fail = |e: serde_json::Error| Error::new(e.to_string());
    let parameters = serde_json::to_value(settings).map_err(fail)?;
    let own = vec![format!("made by cluster-match {}", env!("CARGO_PKG_VERSION")), format!("parameters {parameters}")];
    let [labelled, list, table] = SIDE_FILES.map(|extension| a.out.with_extension(extension));
    let all: Vec<u32> = (0..instances.label.len() as u32).collect();
    Labelled::new(&inputs.geometry, &a.geometry, &instances.label, own)?.write(&labelled, &all)?;
    gs_io::npy::write_i32(list, &aview1(&instances.label))?;
    stage.info(&health.figures().map(|(name, found)| format!("{found} {name}")).join("; "));
    let text = as_text(instances, health, &parameters);
    write_bytes(table, &serde_json::to_vec_pretty(&text).map_err(fail)?)?;
    let matched = instances.support.iter().filter(|&&s| s > 0).count();
    let summary = json!({
        "largest_share": health.largest, "mask_purity": health.purity,
        "instances": instances.len(), "noise": noise, "matched": matched, "matches": instances.matches.len(),
        "clustering_seconds": clustering_seconds,
    });
    stage.record(claim, parameters.clone(), inputs.hashes.clone(), summary)?;
    let mut provenance = stage.provenance(Instances::FORMAT, 1, parameters, inputs.hashes.clone());
    provenance.extra = json!({ "health": health });
    instances.write(&a.out, provenance)?;
    stage.info(&format!("wrote {}: {} instances, {matched} matched with masks", a.out.display(), instances.len()));
    Ok(())
}

/// The instances as JSON: where they are, how large, and as which masks they were seen.
fn as_text(instances: &Instances, health: &Health, parameters: &Value) -> Value {
    let sizes = instances.cluster_sizes();
    let gaussians = |cluster: u32| sizes.get(&cluster).copied().unwrap_or(0);
    let part = |&p: &u32| json!({"cluster": p, "gaussians": gaussians(p)});
    let list: Vec<Value> = (0..instances.len())
        .map(|k| {
            let own = instances.matches.iter().filter(|m| m.instance as usize == k);
            let matches: Vec<Value> = own
                .map(|m| json!({"view": instances.views[m.view as usize], "mask": m.mask, "score": m.score}))
                .collect();
            let family = instances.family(k);
            let parent = family.as_ref().and_then(|f| f.parent).map(
                |p| json!({"cluster": p, "gaussians": gaussians(p), "instances": instances.instances_of_cluster(p)}),
            );
            let parts: Vec<Value> = family.iter().flat_map(|f| &f.parts).map(part).collect();
            let b = &instances.oriented[k];
            json!({
                "oriented_box": {"center": b.center, "axes": b.axes, "half_size": b.half_size},
                "clusters": family.map(|f| f.own), "parent": parent, "parts": parts,
                "instance": k, "gaussians": instances.count[k], "support": instances.support[k],
                "score": instances.score[k], "centroid": instances.centroid[k],
                "bbox_min": instances.bbox_min[k], "bbox_max": instances.bbox_max[k],
                "color": instance_color(k as u32), "matches": matches,
            })
        })
        .collect();
    let unlabelled = instances.label.iter().filter(|&&l| l < 0).count();
    json!({
        "gaussians": instances.label.len(), "without_instance": unlabelled, "descriptor_dim": instances.dim(),
        "health": health, "parameters": parameters, "instances": list,
    })
}
