//! How the cost of the stages grows with the size of the work.

use crate::chain::{Cost, Options, Programs, STAGES, Stage};
use crate::plan::{Axis, Plan};
use crate::tradeoff::{prepare, spread};
use gs_io::Result;
use serde::Serialize;
use std::path::Path;

/// A stage along an axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Growth {
    pub axis: String,
    pub title: String,
    pub stage: Stage,
    pub sizes: Vec<f64>,
    /// What the size was in the end: Gaussians.
    pub gaussians: Vec<u64>,
    /// Cost at each size: medians.
    pub costs: Vec<Cost>,
    /// Exponent of the processor time, fitted by least squares of logarithms.
    pub time_exponent: f64,
    pub memory_exponent: f64,
}

/// The slope of log y over log x by least squares; NaN for fewer than two sizes.
pub fn exponent(x: &[f64], y: &[f64]) -> f64 {
    let points: Vec<(f64, f64)> =
        x.iter().zip(y).filter(|(a, b)| **a > 0.0 && **b > 0.0).map(|(a, b)| (a.ln(), b.ln())).collect();
    let n = points.len() as f64;
    let (mx, my) = (points.iter().map(|p| p.0).sum::<f64>() / n, points.iter().map(|p| p.1).sum::<f64>() / n);
    let (above, below) =
        points.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + (x - mx) * (y - my), b + (x - mx) * (x - mx)));
    above / below
}

/// Times the stages along an axis, `plan.repeats` times each, in turns.
pub fn measure(programs: &Programs, plan: &Plan, axis: &Axis, folder: &Path) -> Result<Vec<Growth>> {
    let files = axis.sizes.iter().map(|s| prepare(programs, &s.scene, &folder.join(&s.scene.name)));
    let files: Vec<_> = files.collect::<Result<_>>()?;
    // By size, stage and turn.
    let mut costs = vec![vec![Vec::<Cost>::new(); STAGES.len()]; files.len()];
    for _ in 0..plan.repeats {
        for (size, own) in files.iter().enumerate() {
            for (stage, of) in STAGES.into_iter().zip(&mut costs[size]) {
                if stage == Stage::Geometry && !axis.stages.contains(&stage) {
                    continue;
                }
                let options = Options::of(Stage::Geometry, &axis.sizes[size].scene.geometry);
                of.push(own.run(programs, stage, &options)?);
            }
        }
    }
    let gaussians: Vec<u64> = files
        .iter()
        .map(|f| Ok(stage::RunRecord::read(&f.geometry)?.summary["gaussians"].as_u64().unwrap_or(0)))
        .collect::<Result<_>>()?;
    let sizes: Vec<f64> = axis.sizes.iter().map(|s| s.value).collect();
    let median = |of: &[Cost], f: fn(&Cost) -> f64| spread(of.iter().map(f).collect())[0];
    Ok(axis
        .stages
        .iter()
        .map(|&stage| {
            let costs: Vec<Cost> = costs
                .iter()
                .map(|by_stage| {
                    let of = &by_stage[stage as usize];
                    let peak = median(of, |c| c.peak as f64) as u64;
                    Cost { wall: median(of, |c| c.wall), cpu: median(of, |c| c.cpu), peak }
                })
                .collect();
            let fitted = |f: fn(&Cost) -> f64| exponent(&sizes, &costs.iter().map(f).collect::<Vec<_>>());
            Growth {
                axis: axis.name.clone(),
                title: axis.title.clone(),
                stage,
                time_exponent: fitted(|c| c.cpu),
                memory_exponent: fitted(|c| c.peak as f64),
                sizes: sizes.clone(),
                gaussians: gaussians.clone(),
                costs,
            }
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_of_powers() {
        let x = [1.0, 2.0, 4.0, 8.0];
        assert!((exponent(&x, &x.map(|v| 3.0 * v * v)) - 2.0).abs() < 1e-12);
        assert!((exponent(&x, &x.map(f64::sqrt)) - 0.5).abs() < 1e-12);
        assert!(exponent(&[1.0], &[1.0]).is_nan());
    }
}
