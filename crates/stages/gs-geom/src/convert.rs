//! `gs-geom convert`: choosing and trimming Gaussians, and writing them in another format.

use crate::axes;
use crate::bounds::Bounds;
use crate::memory::{self, Pictures};
use crate::options::{Convert, bytes, note_shift};
use artifacts::role;
use gs_io::{Error, IoContext, Result, write_bytes};
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::splat::{self, Extra, Format, Splat};
use gs_scene::{Gaussians, Learnt};
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::Path;

impl Convert {
    pub(crate) fn run(&self, stage: &Stage) -> Result<()> {
        Format::to_write(&self.output)?;
        let load = LoadOptions { resolution: Resolution::Width(240), holdout: 0 };
        let dataset = self.scene.as_ref().map(|scene| dataset::load(scene, &load)).transpose()?;
        let files = dataset.iter().flat_map(|d| d.files.clone());
        let outputs = stage.outputs(&self.output).file(&self.output).reads(splat::files(&self.input)?).reads(files);
        let mut claim = outputs.claim()?;
        let needed = match &dataset {
            Some(dataset) => memory::of_axes(bytes(&self.input)?, &Pictures::of(dataset)?),
            None => memory::of_file(bytes(&self.input)?),
        };
        stage.forecast(needed, "give a smaller file")?;
        let splat = splat::read(&self.input)?;
        let mut inputs = BTreeMap::from([(role::GEOMETRY.to_string(), splat::hash(&self.input)?)]);
        let to = match dataset {
            Some(dataset) => {
                inputs.insert(role::DATASET.into(), dataset.hash()?);
                axes::told(&splat, dataset, &self.input, stage)?
            }
            None => self.axes.unwrap_or(splat.axes),
        };
        let Splat { gaussians: mut g, antialias, axes, kind, left_out } = splat;
        splat::turn(&mut g, axes, to);
        left_out.iter().for_each(|what| stage.skipped(&format!("not read: {what}")));
        let all = g.len();
        let parameters = json!(self);
        let plain = |path: &Path| Ok::<bool, Error>(Format::of_file(path)? == Format::Ply);
        if self.scene.is_some()
            && to == axes
            && self.keeps_all()
            && plain(&self.input)?
            && Format::to_write(&self.output)? == Format::Ply
        {
            write_bytes(&self.output, &std::fs::read(&self.input).at("read", &self.input)?)?;
            stage.info(&format!("{} is a copy of {}", self.output.display(), self.input.display()));
            let mut summary = json!({ "gaussians": all, "of": all, "from": kind, "axes": to.to_string() });
            note_shift(&mut summary, g.shift);
            return stage.record(&mut claim, parameters, inputs, summary);
        }
        let chosen = choose(&g, self.crop);
        let dropped = [
            (chosen.damaged, "damaged: not finite, a centre beyond 1e17, or a rotation of length 0"),
            (chosen.cropped, "outside the box"),
        ];
        for (n, why) in dropped.iter().filter(|d| d.0 > 0) {
            stage.skipped(&format!("{n} of {all} Gaussians: {why}"));
        }
        if chosen.kept.is_empty() {
            return Err(Error::new("no Gaussian is left")
                .file(&self.input)
                .found(format!("{all} Gaussians"))
                .hint(if self.crop.is_some() { "give a larger --crop" } else { "make the file again" }));
        }
        if let Some(degree) = self.sh_degree.filter(|&d| d > g.sh_degree) {
            stage.forecast(memory::of_bands(chosen.kept.len(), g.sh_degree, degree), "give a lower --sh-degree")?;
        }
        g = g.select(&chosen.kept);
        g.bound_opacities();
        let degree = self.sh_degree.unwrap_or(g.sh_degree);
        g = g.with_degree(degree);
        let mut comments = vec![format!("made by gs-geom {} convert", env!("CARGO_PKG_VERSION"))];
        comments.extend(inputs.iter().map(|(role, hash)| format!("{role} {hash}")));
        comments.push(format!("parameters {parameters}"));
        comments.extend(Learnt::read(&self.input)?.iter().flat_map(Learnt::comments));
        splat::write(&self.output, &g, &Extra { comments: &comments, antialias, ids: &[] })?;
        stage.info(&format!("{} of {all} Gaussians, SH degree {}, in {}", g.len(), g.sh_degree, self.output.display()));
        splat::lost(&self.output, &g)?.iter().for_each(|what| stage.warn(what));
        let mut summary = json!({
            "gaussians": g.len(),
            "of": all,
            "from": kind,
            "axes": to.to_string(),
            "damaged": chosen.damaged,
            "cropped": chosen.cropped,
        });
        note_shift(&mut summary, g.shift);
        stage.record(&mut claim, parameters, inputs, summary)
    }
}

/// The Gaussians chosen, and how many were not, by the first reason that applied.
#[derive(Debug, Default, PartialEq, Eq)]
struct Chosen {
    /// Indices, rising.
    kept: Vec<u32>,
    damaged: usize,
    cropped: usize,
}

/// Picks the Gaussians that can be used, and whose centres lie inside the box.
fn choose(g: &Gaussians, crop: Option<Bounds<f64>>) -> Chosen {
    let mut chosen = Chosen::default();
    for i in 0..g.len() {
        if !g.is_whole(i) {
            chosen.damaged += 1;
        } else if crop.is_some_and(|b| !b.contains(g.means[i], g.shift)) {
            chosen.cropped += 1;
        } else {
            chosen.kept.push(i as u32);
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimiser::zeros;

    #[test]
    fn each_reason_is_counted_once() {
        let mut g = zeros(5, 0);
        g.rotations = vec![[1.0, 0.0, 0.0, 0.0]; 5];
        g.means = vec![[0.0; 3], [2.0, 0.0, 0.0], [f32::NAN; 3], [1.0, 1.0, 1.0], [0.5; 3]];
        g.opacity_logits[3] = f32::INFINITY;
        let crop = Some(Bounds { low: [0.0; 3], high: [1.0; 3] });
        assert_eq!(choose(&g, crop), Chosen { kept: vec![0, 3, 4], damaged: 1, cropped: 1 });
        assert_eq!(choose(&g, None).kept, [0, 1, 3, 4]);
    }
}
