//! What a finished run leaves: Gaussians, curve, exposures and its record.

use super::outputs::{CAMERAS, CURVE, EXPOSURES, PARTIAL, PLOT, check_finite, plan_path};
use crate::densification::{Strategy, drawable};
use crate::memory::Forecast;
use crate::metrics::Means;
use crate::options::{Train, note_shift};
use crate::training::checkpoint::{self, ProgressState, State};
use crate::training::{Timings, Trainer};
use gs_io::{Claim, IoContext, Provenance, Result, with_suffix, write_bytes, write_json};
use gs_scene::dataset::{Dataset, Split, View, refined};
use gs_scene::{Camera, Gaussians, ply};
use gs_sfm::Refine;
use gs_sfm::turn::turned_from;
use report::curve::Panel;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;

/// The plot of the training curve.
const PANELS: [Panel; 3] = [
    ("loss", "training loss", "#1f77b4"),
    ("psnr_heldout", "PSNR on held-out views, dB", "#2ca02c"),
    ("gaussians", "Gaussians", "#d62728"),
];

/// Writes everything a finished run leaves. For its record: `plan` is how the options came about, and `cpu_seconds` the
/// processor time of the iterations.
pub(super) fn finish(
    options: &Train,
    dataset: &Dataset,
    trainer: &mut Trainer<'_>,
    run: &Provenance,
    forecast: &Forecast,
    plan: Value,
    cpu_seconds: Option<f64>,
    claim: &mut Claim,
    stage: &Stage,
) -> Result<()> {
    check_finite(options, &trainer.state)?;
    let Means { psnr, ssim, uncounted } = trainer.heldout()?;
    uncounted.iter().for_each(|why| stage.skipped(why));
    let State { gaussians, progress, .. } = &trainer.state;
    let rows = rows(options, gaussians, stage);
    report(progress, stage);
    let Provenance { mut parameters, inputs, .. } = run.clone();
    // What was chosen, in the place of "auto".
    parameters["refine_poses"] = json!(!trainer.state.poses.views.is_empty());
    if trainer.state.poses.views.is_empty() {
        parameters["poses"] = Value::Null;
    }
    write_beside(options, trainer)?;
    write_cameras(options, dataset, trainer, stage)?;
    let State { gaussians, progress, .. } = &trainer.state;
    ply::write_some_gaussians(&options.out, gaussians, &rows, &comments(&parameters, &inputs))?;
    let [cloned, split, removed, relocated] = progress.densified;
    let heldout = psnr.map_or(String::new(), |p| format!(", {p:.2} dB on held-out views"));
    stage.info(&format!(
        "{} Gaussians ({cloned} cloned, {split} split, {removed} removed, {relocated} relocated){heldout}; {}",
        rows.len(),
        shares(trainer.timings)
    ));
    let mut summary = json!({
        "gaussians": rows.len(),
        "psnr_heldout": psnr,
        "ssim_heldout": ssim,
        "iterations": progress.iteration,
        "dropped_gradients": progress.dropped,
        "most_undrawn": {"not_finite": progress.undrawn[0], "degenerate": progress.undrawn[1]},
        "memory_predicted_bytes": forecast.peak(gaussians.len()),
        "seconds": BTreeMap::from(parts(trainer.timings)),
        "cpu_seconds": stage::cpu_seconds(),
        "iteration_cpu_seconds": cpu_seconds,
        "plan": plan,
    });
    note_shift(&mut summary, dataset.shift);
    stage.record(claim, parameters, inputs, summary)?;
    for leftover in [with_suffix(&options.out, PARTIAL), plan_path(&options.out), checkpoint::path_of(&options.out)] {
        // What cannot be removed does no harm.
        let _ = std::fs::remove_file(leftover);
    }
    Ok(())
}

/// The Gaussians to write. Rows and no copy: the moments are still there, for a checkpoint if the disk is full.
fn rows(options: &Train, gaussians: &Gaussians, stage: &Stage) -> Vec<u32> {
    if options.skip.no_skip || options.densify == Strategy::Fixed {
        return (0..gaussians.len() as u32).collect();
    }
    let rows = drawable(gaussians);
    if rows.len() < gaussians.len() {
        stage.skipped(&format!("{} Gaussians: too faint to be drawn", gaussians.len() - rows.len()));
    }
    rows
}

/// Warns of what went wrong without harm.
fn report(progress: &ProgressState, stage: &Stage) {
    if progress.dropped > 0 {
        stage.warn(&format!("{} gradients of Gaussians were not finite and were not used", progress.dropped));
    }
    let [not_finite, degenerate] = progress.undrawn;
    if not_finite + degenerate > 0 {
        stage.warn(&format!(
            "Gaussians that could not be drawn, in the worst iteration: {not_finite} not finite, {degenerate} of a shape beyond single precision or with a quaternion of length 0"
        ));
    }
}

/// Writes the training curve, its plot, and the photographs' exposures.
fn write_beside(options: &Train, trainer: &Trainer<'_>) -> Result<()> {
    let State { progress, exposures, .. } = &trainer.state;
    let lines: String = progress.curve.iter().map(|line| format!("{line}\n")).collect();
    write_bytes(with_suffix(&options.out, CURVE), lines.as_bytes())?;
    write_bytes(with_suffix(&options.out, PLOT), report::curve::svg(&progress.curve, &PANELS).as_bytes())?;
    if exposures.maps.is_empty() {
        return Ok(());
    }
    let maps = trainer.train.names().zip(&exposures.maps);
    let maps: serde_json::Map<String, Value> =
        maps.map(|(name, map)| (name.to_string(), json!(map.chunks(4).collect::<Vec<_>>()))).collect();
    write_json(with_suffix(&options.out, EXPOSURES), &maps)
}

/// Writes the refined cameras, and says how far they moved.
fn write_cameras(options: &Train, dataset: &Dataset, trainer: &mut Trainer<'_>, stage: &Stage) -> Result<()> {
    if trainer.state.poses.views.is_empty() {
        // Those that an earlier run wrote, and this one chose not to, would be taken for this run's.
        let path = with_suffix(&options.out, CAMERAS);
        return match options.refine_poses {
            Refine::Auto if path.exists() => std::fs::remove_file(&path).at("remove", &path),
            _ => Ok(()),
        };
    }
    let cameras = trainer.cameras()?;
    let of = |split: Split| dataset.views_of(split).map(|v| v.name.as_str());
    let by_name: BTreeMap<&str, &Camera> = of(Split::Train).chain(of(Split::Test)).zip(&cameras).collect();
    let cameras: Vec<Camera> = dataset.views.iter().map(|v| by_name[v.name.as_str()].clone()).collect();
    let path = with_suffix(&options.out, CAMERAS);
    refined::write(&path, dataset, &cameras)?;
    let moved = |f: fn(&View, &Camera) -> f64| {
        let mut all: Vec<f64> = dataset.views.iter().zip(&cameras).map(|(v, c)| f(v, c)).collect();
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    };
    let turn = moved(|v, c| turned_from(&v.camera.rotation, &c.rotation).length().to_degrees());
    let shift = moved(|v, c| v.camera.position().distance(c.position()));
    let zoom = moved(|v, c| c.fx / v.camera.fx);
    stage.info(&format!(
        "cameras moved by {turn:.3} degrees and {shift:.4} units, focal lengths by a factor of {zoom:.5} (medians); held-out views were \
         brought to the scene before they were measured; later stages: --scene {}",
        path.display()
    ));
    Ok(())
}

/// Seconds of each part.
fn parts(t: Timings) -> [(&'static str, f64); 5] {
    [("forward", t.forward), ("loss", t.loss), ("backward", t.backward), ("Adam", t.adam), ("rest", t.rest)]
        .map(|(name, time)| (name, time.as_secs_f64()))
}

fn shares(t: Timings) -> String {
    let total = parts(t).iter().map(|p| p.1).sum::<f64>().max(1e-9);
    let all = parts(t).map(|(name, seconds)| format!("{name} {:.0}%", 100.0 * seconds / total));
    format!("{total:.1} s: {}", all.join(", "))
}

/// Provenance as comment lines of the PLY: program, inputs, parameters.
fn comments(parameters: &Value, inputs: &BTreeMap<String, String>) -> Vec<String> {
    fn add(lines: &mut Vec<String>, prefix: &str, value: &Value) {
        for (key, value) in value.as_object().into_iter().flatten() {
            match value {
                Value::Object(_) => add(lines, &format!("{prefix}{key}."), value),
                _ => lines.push(format!("{prefix}{key} {value}")),
            }
        }
    }
    let mut lines = vec![format!("made by gs-geom {}", env!("CARGO_PKG_VERSION"))];
    lines.extend(inputs.iter().map(|(role, hash)| format!("{role} {hash}")));
    add(&mut lines, "", parameters);
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_name_every_parameter_once() {
        let parameters = json!({"resolution": "auto", "seed": 1, "rates": {"opacity": 0.05}});
        let lines = comments(&parameters, &BTreeMap::from([("dataset".into(), "ab".into())]));
        assert_eq!(lines[1..], ["dataset ab", "rates.opacity 0.05", "resolution \"auto\"", "seed 1"]);
    }
}
