//! `gs-geom convert`.

pub mod choice;

use crate::memory;
use crate::options::{Convert, bytes};
use crate::start;
use artifacts::role;
use choice::{arrange, choose};
use gs_io::{Error, Result, hash_file};
use gs_scene::ply;
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;

impl Convert {
    pub(crate) fn run(&self, stage: &Stage) -> Result<()> {
        let outputs = stage.outputs(&self.output).file(&self.output).reads([&self.input]);
        let mut claim = outputs.claim()?;
        stage.forecast(memory::of_file(bytes(&self.input)?), "give a smaller file")?;
        let mut g = ply::read_gaussians_as_they_are(&self.input)?;
        let all = g.len();
        let mut chosen = choose(&g, self.min_opacity, self.crop);
        let dropped =
            [(chosen.not_finite, "not finite"), (chosen.cropped, "outside the box"), (chosen.faint, "too faint")];
        for (n, why) in dropped.iter().filter(|d| d.0 > 0) {
            stage.skipped(&format!("{n} of {all} Gaussians: {why}"));
        }
        if chosen.kept.is_empty() {
            return Err(Error::new("no Gaussian is left")
                .file(&self.input)
                .found(format!("{all} Gaussians"))
                .hint("give a lower --min-opacity or a larger --crop"));
        }
        if let Some(degree) = self.sh_degree.filter(|&d| d > g.sh_degree) {
            stage.forecast(memory::of_bands(chosen.kept.len(), g.sh_degree, degree), "give a lower --sh-degree")?;
        }
        arrange(&g, &mut chosen.kept, self.order);
        g = g.select(&chosen.kept);
        g.bound_opacities();
        let degree = self.sh_degree.unwrap_or(g.sh_degree);
        g = start::with_degree(g, degree);
        let parameters = json!(self);
        let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash_file(&self.input)?)]);
        let mut comments = vec![format!("made by gs-geom {} convert", env!("CARGO_PKG_VERSION"))];
        comments.extend(inputs.iter().map(|(role, hash)| format!("{role} {hash}")));
        comments.push(format!("parameters {parameters}"));
        if ply::is_antialiased(&self.input)? {
            comments.push(ply::ANTIALIASED.into());
        }
        ply::write_gaussians(&self.output, &g, &comments)?;
        stage.info(&format!("{} of {all} Gaussians, SH degree {}, in {}", g.len(), g.sh_degree, self.output.display()));
        let summary = json!({
            "gaussians": g.len(),
            "of": all,
            "not_finite": chosen.not_finite,
            "cropped": chosen.cropped,
            "faint": chosen.faint,
        });
        stage.record(&mut claim, parameters, inputs, summary)
    }
}
