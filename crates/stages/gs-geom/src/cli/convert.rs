//! `gs-geom convert`.

use super::bytes;
use crate::convert::{Choice, Order, arrange, choose};
use crate::init;
use crate::inspect::Bounds;
use crate::memory;
use artifacts::role;
use gs_io::{Error, Result, hash_file, npy};
use gs_scene::ply;
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;

/// Arguments of `gs-geom convert`.
#[derive(Debug, clap::Args)]
pub(super) struct ConvertArgs {
    /// Gaussians, as a 3DGS PLY of any property order and encoding
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// Where to write them: little-endian floats in the property order of the original 3DGS code, 62 properties at SH
    /// degree 3; another file than IN
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// Degree of the spherical harmonics, 0 to 3: higher bands are dropped, missing ones zero [as in IN]
    #[arg(long, value_name = "DEGREE", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: Option<u8>,
    /// Drop Gaussians fainter than this, 0 to 1
    #[arg(long, value_name = "OPACITY", default_value_t = 0.0)]
    min_opacity: f32,
    /// Drop Gaussians whose centre lies outside this box, world units
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    crop: Option<Crop>,
    /// Order of the Gaussians
    #[arg(long, value_enum, default_value_t = Order::None)]
    order: Order,
    /// Also write which Gaussian of IN each Gaussian of OUT was, counted from 0: i32, one a Gaussian
    #[arg(long, value_name = "FILE.npy")]
    keep_map: Option<PathBuf>,
}

/// A box as a person writes it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Crop(Bounds);

impl FromStr for Crop {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let wrong = || {
            Error::new("not a box")
                .found(s)
                .expected("x0,y0,z0,x1,y1,z1: six finite numbers, the low corner before the high one")
        };
        let numbers: Vec<f32> =
            s.split(',').map(|v| v.trim().parse()).collect::<std::result::Result<_, _>>().map_err(|_| wrong())?;
        let [x0, y0, z0, x1, y1, z1] = numbers[..] else { return Err(wrong()) };
        let (low, high) = ([x0, y0, z0], [x1, y1, z1]);
        let fits = (0..3).all(|c| low[c].is_finite() && high[c].is_finite() && low[c] <= high[c]);
        if fits { Ok(Self(Bounds { low, high })) } else { Err(wrong()) }
    }
}

impl ConvertArgs {
    pub(super) fn run(&self, stage: &Stage) -> Result<()> {
        if !(0.0..=1.0).contains(&self.min_opacity) {
            return Err(Error::new("out of range").field("--min-opacity").found(self.min_opacity).expected("0 to 1"));
        }
        let outputs = stage.outputs(&self.output).file(&self.output).files(&self.keep_map).reads([&self.input]);
        let mut claim = outputs.claim()?;
        stage.forecast(memory::of_file(bytes(&self.input)?), "give a smaller file")?;
        let mut g = ply::read_gaussians_as_they_are(&self.input)?;
        let all = g.len();
        let choice = Choice { min_opacity: self.min_opacity, crop: self.crop.map(|c| c.0) };
        let mut chosen = choose(&g, &choice);
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
        g = match self.sh_degree {
            Some(degree) => init::with_degree(g, degree),
            None => g,
        };
        let parameters = json!({"sh_degree": g.sh_degree, "choice": choice, "order": self.order});
        let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash_file(&self.input)?)]);
        let mut comments = vec![format!("made by gs-geom {} convert", env!("CARGO_PKG_VERSION"))];
        comments.extend(inputs.iter().map(|(role, hash)| format!("{role} {hash}")));
        comments.push(format!("parameters {parameters}"));
        if ply::is_antialiased(&self.input)? {
            comments.push(ply::ANTIALIASED.into());
        }
        if let Some(map) = &self.keep_map {
            let indices: Vec<i32> = chosen.kept.iter().map(|&i| i as i32).collect();
            npy::write_i32(map, &[indices.len()], &indices)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_read() {
        let crop: Crop = "-1,0, 2.5,1,0,3".parse().unwrap();
        assert_eq!(crop.0, Bounds { low: [-1.0, 0.0, 2.5], high: [1.0, 0.0, 3.0] });
        for wrong in ["", "1,2,3", "0,0,0,1,1,-1", "0,0,0,1,1,nan", "0,0,0,1,1,inf", "a,0,0,1,1,1", "0,0,0,1,1,1,1"] {
            assert!(wrong.parse::<Crop>().is_err(), "{wrong}");
        }
    }
}
