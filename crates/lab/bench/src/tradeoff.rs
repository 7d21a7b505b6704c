//! Run time against error: every setting of an approximation, timed in turns, beside the exact one.

use crate::chain::{Cost, Files, Options, Programs, STAGES, Stage, command, read_json, words};
use crate::plan::{Knob, Plan, Scene};
use crate::task::Task;
use artifacts::Instances;
use gs_io::{Error, IoContext, Result, create_dir, write_json};
use hdbscan_exact::adjusted_rand;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// How far a setting is from the exact one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// PSNR of held-out photographs in decibels; for knobs of the geometry.
    pub psnr: Option<f64>,
    /// Adjusted Rand index of the Gaussians' instances with those of the exact setting, where it has the same Gaussians.
    pub agreement: Option<f64>,
    /// 3D instance mIoU, 0 to 1.
    pub instance_miou: Option<f64>,
    /// mIoU of text queries, 0 to 1.
    pub query_miou: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    pub label: String,
    pub options: String,
    pub exact: bool,
    pub default: bool,
    /// Cost of the stage and those after it, a run each. Of the geometry alone where that is what the knob changes.
    pub costs: Vec<Cost>,
    pub quality: Quality,
}

impl Measured {
    /// Median of the processor seconds, with the least and the most.
    pub fn cpu(&self) -> [f64; 3] {
        spread(self.costs.iter().map(|c| c.cpu).collect())
    }

    pub fn wall(&self) -> [f64; 3] {
        spread(self.costs.iter().map(|c| c.wall).collect())
    }
}

/// Median, least and most.
pub fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 { [f64::NAN; 3] } else { [0.5 * (values[(n - 1) / 2] + values[n / 2]), values[0], values[n - 1]] }
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Curve {
    pub knob: String,
    pub title: String,
    pub scene: String,
    /// What [`Self::errors`] means.
    pub measure: String,
    pub points: Vec<Measured>,
    /// Loss of quality against the exact setting: decibels, or points of mIoU (the mean of instances and queries). Below 0
    /// where a setting is better.
    pub errors: Vec<f64>,
    /// Which are not beaten in both time and error.
    pub front: Vec<bool>,
    /// The setting that beats the default, if one does: no slower, no less good, and better in one by more than the noise.
    pub dominated_by: Option<String>,
}

/// Differences of processor time below this share are noise.
const NOISE: f64 = 0.05;
/// So are losses below this many decibels or points.
const SAME: f64 = 0.2;

impl Curve {
    /// Errors, front and warning of measured points.
    pub fn new(knob: &Knob, scene: &str, points: Vec<Measured>) -> Self {
        let quality = |m: &Measured| match m.quality.psnr {
            Some(psnr) if knob.stage == Some(Stage::Geometry) => psnr,
            _ => {
                let figures = [m.quality.instance_miou, m.quality.query_miou];
                let known: Vec<f64> = figures.into_iter().flatten().collect();
                100.0 * known.iter().sum::<f64>() / known.len().max(1) as f64
            }
        };
        let exact = points.iter().find(|p| p.exact).map_or(f64::NAN, quality);
        let errors: Vec<f64> = points.iter().map(|p| exact - quality(p)).collect();
        let times: Vec<f64> = points.iter().map(|p| p.cpu()[0]).collect();
        let measure = if knob.stage == Some(Stage::Geometry) { "PSNR lost, dB" } else { "mIoU lost, points" };
        Self {
            knob: knob.name.clone(),
            title: knob.title.clone(),
            scene: scene.into(),
            measure: measure.into(),
            front: front(&times, &errors),
            dominated_by: points.iter().position(|p| p.default).and_then(|d| {
                let better = |i: usize| {
                    let faster = times[i] < (1.0 - NOISE) * times[d];
                    let finer = errors[i] < errors[d] - SAME;
                    (faster && errors[i] <= errors[d]) || (finer && times[i] <= times[d])
                };
                (0..points.len()).find(|&i| i != d && better(i)).map(|i| points[i].label.clone())
            }),
            points,
            errors,
        }
    }
}

/// Which points no other beats in one of the two without being worse in the other.
pub fn front(times: &[f64], errors: &[f64]) -> Vec<bool> {
    let beats = |a: usize, b: usize| {
        times[a] <= times[b] && errors[a] <= errors[b] && (times[a] < times[b] || errors[a] < errors[b])
    };
    (0..times.len()).map(|i| !(0..times.len()).any(|j| beats(j, i))).collect()
}

/// Makes a synthetic scene and its geometry in a folder, unless they are there and made the same way.
pub fn prepare(programs: &Programs, scene: &Scene, folder: &Path) -> Result<Files> {
    let files = Files::of(folder);
    let mut photographs = command(&["synth-scene", "--features"], &[("--out", &files.scene)]);
    photographs.extend(words(&scene.scene));
    let photographs = Task::new(files.scene.join("truth/scene.json"), photographs, &[]);
    let geometry = [files.command(Stage::Geometry), words(&scene.geometry)].concat();
    let geometry = Task::new(files.geometry.clone(), geometry, &[&photographs]);
    [photographs, geometry].iter().try_for_each(|task| task.run(programs).map(|_| ()))?;
    Ok(files)
}

/// Runs the stages from `first` on, and says what they cost together.
fn from(files: &Files, programs: &Programs, first: Stage, options: &Options) -> Result<Cost> {
    STAGES.into_iter().filter(|s| *s >= first).try_fold(Cost::default(), |sum, s| {
        let own = files.run(programs, s, options)?;
        Ok(Cost { wall: sum.wall + own.wall, cpu: sum.cpu + own.cpu, peak: sum.peak.max(own.peak) })
    })
}

/// Measures a knob on a scene whose earlier stages have run. What was measured before with the same options is kept.
pub fn measure(
    programs: &Programs,
    plan: &Plan,
    knob: &Knob,
    scene: &Scene,
    base: &Files,
    folder: &Path,
) -> Result<Curve> {
    let known = folder.join(format!("{}.json", knob.name));
    let how = format!("{} | {} | {:?} | {} threads", scene.scene, scene.geometry, knob.stage, programs.threads);
    let kept = read_json(&known).ok().filter(|kept| kept["how"] == how.as_str());
    let old: Vec<Measured> =
        kept.and_then(|kept| serde_json::from_value(kept["points"].clone()).ok()).unwrap_or_default();
    let mut points: Vec<Measured> = knob
        .points
        .iter()
        .map(|p| {
            let options = p.options.text();
            let same = old.iter().find(|o| o.label == p.label && o.options == options && o.exact == p.exact);
            let (costs, quality) = same.map(|o| (o.costs.clone(), o.quality)).unwrap_or_default();
            Measured { label: p.label.clone(), options, exact: p.exact, default: p.default, costs, quality }
        })
        .collect();
    let files: Vec<Files> = knob
        .points
        .iter()
        .map(|p| {
            let out = folder.join(format!("{}-{}", knob.name, p.label.replace(['/', ' '], "-")));
            let geometry = match knob.stage {
                Some(Stage::Geometry) | None => out.join("geometry.ply"),
                _ => base.geometry.clone(),
            };
            Files { geometry, ..base.within(&out) }
        })
        .collect();
    let all = points.iter().all(|p| p.costs.len() >= plan.repeats);
    for turn in 0..plan.repeats {
        for (i, point) in points.iter_mut().enumerate().filter(|(_, p)| p.costs.len() <= turn) {
            let (stage, options, own) = (knob.stage, &knob.points[i].options, &files[i]);
            let scale = Options::of(Stage::Geometry, &scene.geometry);
            let cost = match stage {
                Some(Stage::Geometry) => own.run(programs, Stage::Geometry, &merged(&scale, options))?,
                Some(first) => {
                    inherit(base, own, first)?;
                    from(own, programs, first, options)?
                }
                None => from(own, programs, Stage::Geometry, &merged(&scale, options))?,
            };
            point.costs.push(cost);
        }
    }
    if !all {
        let exact = points.iter().position(|p| p.exact).unwrap_or(0);
        for i in 0..points.len() {
            points[i].quality = quality(programs, knob, &files[i], &files[exact])?;
        }
        write_json(&known, &serde_json::json!({"how": how, "points": points}))?;
    }
    Ok(Curve::new(knob, &scene.name, points))
}

/// The scene's options of the geometry with those of a setting after them; where both set one, the setting's.
fn merged(scene: &Options, setting: &Options) -> Options {
    let own = setting.get(Stage::Geometry);
    let mut kept = Vec::new();
    let mut rest = scene.get(Stage::Geometry).iter().peekable();
    while let Some(option) = rest.next() {
        let value = rest.next_if(|v| !v.starts_with("--"));
        if !own.contains(option) {
            kept.push(option.clone());
            kept.extend(value.cloned());
        }
    }
    kept.extend(own.iter().cloned());
    setting.clone().with(Stage::Geometry, kept)
}

/// Gives `own` what the stages before `first` made in `base`.
pub fn inherit(base: &Files, own: &Files, first: Stage) -> Result<()> {
    let made = [
        (Stage::Graph, &base.graph, &own.graph),
        (Stage::Graph, &base.footprints, &own.footprints),
        (Stage::Features, &base.features, &own.features),
    ];
    made.into_iter().filter(|(stage, ..)| *stage < first).try_for_each(|(_, from, to)| {
        create_dir(to.parent().unwrap_or(Path::new(".")))?;
        std::fs::copy(from, to).map(|_| ()).at("copy", from)
    })
}

fn quality(programs: &Programs, knob: &Knob, own: &Files, exact: &Files) -> Result<Quality> {
    let psnr = match knob.stage {
        Some(Stage::Geometry) | None => stage::RunRecord::read(&own.geometry)?.summary["psnr_heldout"].as_f64(),
        _ => None,
    };
    if knob.stage == Some(Stage::Geometry) {
        return Ok(Quality { psnr, ..Quality::default() });
    }
    let labels = |f: &Files| Ok::<_, Error>(Instances::read(&f.instances)?.0.label);
    let agreement = match knob.stage {
        Some(_) => Some(adjusted_rand(&labels(own)?, &labels(exact)?)),
        None => None,
    };
    let score: Value = own.evaluate(programs)?;
    let figure = |name: &str| score[name].as_f64();
    Ok(Quality { psnr, agreement, instance_miou: figure("instance_miou"), query_miou: figure("query_miou") })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_is_what_nothing_beats() {
        assert_eq!(front(&[3.0, 2.0, 1.0, 2.5], &[0.0, 1.0, 3.0, 2.0]), [true, true, true, false]);
        assert_eq!(front(&[1.0, 1.0], &[0.0, 0.0]), [true, true]);
    }

    #[test]
    fn a_dominated_default_is_told() {
        let plan = Plan::parse(
            "knob k | graph | K\npoint k | a | | exact\npoint k | b | --cut 1 | default\npoint k | c | --cut 2 |",
        )
        .unwrap();
        let measured = |i: usize, cpu: f64, miou: f64| {
            let p = &plan.knobs[0].points[i];
            let quality = Quality { instance_miou: Some(miou), query_miou: Some(miou), ..Quality::default() };
            let costs = vec![Cost { wall: cpu, cpu, peak: 0 }; 3];
            let (label, options) = (p.label.clone(), p.options.text());
            Measured { label, options, exact: p.exact, default: p.default, costs, quality }
        };
        let c = Curve::new(
            &plan.knobs[0],
            "s",
            vec![measured(0, 3.0, 0.8), measured(1, 2.0, 0.78), measured(2, 1.0, 0.78)],
        );
        assert_eq!(c.dominated_by.as_deref(), Some("c"));
        assert!((c.errors[1] - 2.0).abs() < 1e-9 && c.front == [true, false, true]);
        let c =
            Curve::new(&plan.knobs[0], "s", vec![measured(0, 3.0, 0.8), measured(1, 2.0, 0.79), measured(2, 1.0, 0.7)]);
        assert_eq!(c.dominated_by, None);
    }

    #[test]
    fn medians_and_spreads() {
        assert_eq!(spread(vec![3.0, 1.0, 2.0]), [2.0, 1.0, 3.0]);
        assert_eq!(spread(vec![4.0, 1.0]), [2.5, 1.0, 4.0]);
    }

    #[test]
    fn a_setting_replaces_the_scenes_options() {
        let scene = Options::of(Stage::Geometry, "--iterations 100 --antialias --max-gaussians 5");
        let setting = Options::parse("geometry: --iterations 7; graph: --cut 0").unwrap();
        let m = merged(&scene, &setting);
        assert_eq!(m.get(Stage::Geometry).join(" "), "--antialias --max-gaussians 5 --iterations 7");
        assert_eq!(m.get(Stage::Graph), ["--cut", "0"]);
    }
}
