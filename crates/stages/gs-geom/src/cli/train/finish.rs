//! What a finished run leaves: Gaussians, curve, exposures and its record.

use super::{CURVE, EXPOSURES, PARTIAL, PLOT, TrainArgs, remove_if_there};
use crate::checkpoint::{self, State};
use crate::cli::budget::plan_path;
use crate::curve;
use crate::densify::drawable;
use crate::memory::Forecast;
use crate::metrics::Means;
use crate::train::{Timings, Trainer};
use gs_io::{Claim, Error, Provenance, Result, with_suffix, write_bytes};
use gs_scene::ply;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::time::Duration;

impl TrainArgs {
    /// Writes everything a finished run leaves.
    pub(super) fn finish(
        &self,
        trainer: &mut Trainer<'_>,
        run: &Provenance,
        forecast: &Forecast,
        (plan, iteration_cpu_seconds): (Value, Option<f64>),
        claim: &mut Claim,
        stage: &Stage,
    ) -> Result<()> {
        self.check_finite(&trainer.state().gaussians, trainer.state().progress.iteration)?;
        let Means { psnr, ssim, uncounted } = trainer.heldout()?;
        uncounted.iter().for_each(|why| stage.skipped(why));
        let trainer = &*trainer;
        let timings = trainer.timings();
        let (parameters, inputs) = (&run.parameters, &run.inputs);
        let State { gaussians, progress, .. } = trainer.state();
        let predicted = forecast.peak(gaussians.len());
        // Rows to write and no copy: the moments are still there, for a checkpoint if the disk is full.
        let keep_all = self.fixed_points || self.no_skip;
        let rows = if keep_all { (0..gaussians.len() as u32).collect() } else { drawable(gaussians) };
        if rows.len() < gaussians.len() {
            stage.skipped(&format!("{} Gaussians: too faint to be drawn", gaussians.len() - rows.len()));
        }
        if progress.dropped > 0 {
            stage.warn(&format!("{} gradients of Gaussians were not finite and were not used", progress.dropped));
        }
        let [not_finite, degenerate] = progress.undrawn;
        if not_finite + degenerate > 0 {
            stage.warn(&format!(
                "Gaussians that could not be drawn, in the worst iteration: {not_finite} not finite, {degenerate} of a shape beyond single precision or with a quaternion of length 0"
            ));
        }
        let curve: String = progress.curve.iter().map(|line| format!("{line}\n")).collect();
        write_bytes(with_suffix(&self.out, CURVE), curve.as_bytes())?;
        write_bytes(with_suffix(&self.out, PLOT), curve::svg(&progress.curve).as_bytes())?;
        if !trainer.state().exposures.is_off() {
            let names = trainer.train_names();
            let maps: serde_json::Map<String, Value> = names
                .zip(&trainer.state().exposures.maps)
                .map(|(name, map)| (name.to_string(), json!(map.chunks(4).collect::<Vec<_>>())))
                .collect();
            let text = serde_json::to_vec_pretty(&maps).map_err(|e| Error::new(e.to_string()))?;
            write_bytes(with_suffix(&self.out, EXPOSURES), &text)?;
        }
        let mut comments = comments(parameters, inputs);
        comments.extend(progress.extended.iter().map(|i| format!("extended after iteration {i}")));
        ply::write_some_gaussians(&self.out, gaussians, &rows, &comments)?;
        let [cloned, split, removed, relocated] = progress.densified;
        let heldout = psnr.map_or(String::new(), |p| format!(", {p:.2} dB on held-out views"));
        stage.info(&format!(
            "{} Gaussians ({cloned} cloned, {split} split, {removed} removed, {relocated} relocated){heldout}; {}",
            rows.len(),
            shares(timings)
        ));
        let summary = json!({
            "gaussians": rows.len(),
            "psnr_heldout": psnr,
            "ssim_heldout": ssim,
            "iterations": progress.iteration,
            "dropped_gradients": progress.dropped,
            "most_undrawn": {"not_finite": progress.undrawn[0], "degenerate": progress.undrawn[1]},
            "memory_predicted_bytes": predicted,
            "extended_after": progress.extended,
            "seconds": seconds(timings),
            "cpu_seconds": stage::cpu_seconds(),
            "iteration_cpu_seconds": iteration_cpu_seconds,
            "plan": plan,
        });
        if self.keep_state {
            self.save(trainer, run)?;
        }
        stage.record(claim, parameters.clone(), inputs.clone(), summary)?;
        let state = Some(checkpoint::path_of(&self.out)).filter(|_| !self.keep_state);
        for leftover in [with_suffix(&self.out, PARTIAL), plan_path(&self.out)].into_iter().chain(state) {
            remove_if_there(&leftover);
        }
        Ok(())
    }
}

/// Processor time since a moment at which it was `before`.
pub(super) fn spent_since(before: Option<f64>) -> Option<f64> {
    Some(stage::cpu_seconds()? - before?)
}

fn parts(t: Timings) -> [(&'static str, Duration); 5] {
    [("forward", t.forward), ("loss", t.loss), ("backward", t.backward), ("Adam", t.adam), ("rest", t.rest)]
}

fn seconds(t: Timings) -> Value {
    Value::Object(parts(t).into_iter().map(|(name, d)| (name.into(), json!(d.as_secs_f64()))).collect())
}

fn shares(t: Timings) -> String {
    let total = parts(t).iter().map(|(_, d)| d.as_secs_f64()).sum::<f64>().max(1e-9);
    let all: Vec<String> =
        parts(t).iter().map(|(name, d)| format!("{name} {:.0}%", 100.0 * d.as_secs_f64() / total)).collect();
    format!("{total:.1} s: {}", all.join(", "))
}

/// Provenance as comment lines of the PLY: program, inputs, parameters.
fn comments(parameters: &Value, inputs: &BTreeMap<String, String>) -> Vec<String> {
    let mut lines = vec![format!("made by gs-geom {}", env!("CARGO_PKG_VERSION"))];
    lines.extend(inputs.iter().map(|(role, hash)| format!("{role} {hash}")));
    let mut add = |prefix: &str, value: &Value| {
        if let Value::Object(map) = value {
            lines.extend(map.iter().filter(|(_, v)| !v.is_object()).map(|(k, v)| format!("{prefix}{k} {v}")));
        }
    };
    add("", parameters);
    add("", &parameters["options"]);
    for group in ["schedule", "rates", "densify", "mcmc"] {
        add(&format!("{group}."), &parameters["options"][group]);
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_name_every_parameter_once() {
        let parameters = json!({"resolution": "auto", "options": {"seed": 1, "rates": {"opacity": 0.05}}});
        let lines = comments(&parameters, &BTreeMap::from([("dataset".into(), "ab".into())]));
        assert_eq!(lines[1..], ["dataset ab", "resolution \"auto\"", "seed 1", "rates.opacity 0.05"]);
    }
}
