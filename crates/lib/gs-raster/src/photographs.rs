//! Whether Gaussians show the photographs that they are said to be of.

use crate::{RasterOptions, render};
use gs_io::{Error, Result};
use gs_scene::dataset::View;
use gs_scene::{Gaussians, Image, size_within};
use std::path::Path;

/// Photographs that are looked at at most, and their longer side.
const MOST: usize = 8;
const LONGEST: u32 = 240;
/// A step of 8 bits.
const STEP: f32 = 1.0 / 255.0;

/// Some photographs of a scene, small.
#[derive(Debug)]
pub struct Photographs {
    images: Vec<Image>,
    /// Whether they have more than one colour. Pictures that only stand for photographs have one.
    tell: bool,
    /// Of the views, every so many is looked at.
    apart: usize,
}

/// How far renders and one plain colour are from photographs, where the renders are opaque.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likeness {
    /// Photographs that were compared.
    pub photographs: usize,
    /// Whether they have more than one colour.
    tell: bool,
    /// Sum of the pixels' weights: squares of the render's alpha times the photograph's.
    weight: f64,
    /// Weighted sums of squared errors over pixels and channels: of the renders, and of the photographs' mean colour.
    renders: f64,
    plain: f64,
}

impl Photographs {
    /// Decodes up to 8 of the photographs, evenly apart, at up to 240 pixels.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn of(views: &[&View]) -> Result<Self> {
        let apart = views.len().div_ceil(MOST).max(1);
        let images = views.iter().step_by(apart).map(|v| small(v).load_image()).collect::<Result<Vec<_>>>()?;
        let mut pixels = images.iter().flat_map(|i| i.rgb.as_chunks::<3>().0);
        let first = pixels.next().copied().unwrap_or_default();
        let tell = pixels.any(|p| (0..3).any(|c| (p[c] - first[c]).abs() > STEP));
        Ok(Self { images, tell, apart })
    }

    /// How near renders of the Gaussians come. `views` are those that the photographs are of; their cameras may have changed.
    pub fn likeness(&self, g: &Gaussians, antialias: bool, views: &[&View]) -> Likeness {
        let options = RasterOptions { antialias, depth: false, ..RasterOptions::fit(g) };
        // Of the photographs' pixels: the weights, and for each channel the sums of weighted values and squares.
        let (mut renders, mut weight, mut sums) = (0.0, 0.0, [[0.0; 2]; 3]);
        for (view, photograph) in views.iter().step_by(self.apart).zip(&self.images) {
            let r = render(g, &small(view).camera, &options);
            for (i, (wanted, drawn)) in
                photograph.rgb.as_chunks::<3>().0.iter().zip(r.rgb.as_chunks::<3>().0).enumerate()
            {
                let (opaque, known) = (r.alpha[i], photograph.alpha.as_ref().map_or(1.0, |a| a[i]));
                let w = f64::from(opaque * known).powi(2);
                weight += w;
                for c in 0..3 {
                    renders += f64::from(known * (drawn[c] - opaque * wanted[c])).powi(2);
                    let v = f64::from(wanted[c]);
                    sums[c] = [sums[c][0] + w * v, sums[c][1] + w * v * v];
                }
            }
        }
        let plain = sums.iter().map(|[v, squares]| squares - v * v / weight.max(f64::MIN_POSITIVE)).sum();
        Likeness { photographs: self.images.len(), tell: self.tell, weight, renders, plain }
    }
}

impl Likeness {
    /// By how much the renders are nearer than a plain colour; 0 or less where the Gaussians do not show the photographs.
    pub fn gain(&self) -> f64 {
        self.plain - self.renders
    }

    /// Whether a Gaussian is drawn in any of the photographs: a small thing may be in others only.
    pub fn is_drawn(&self) -> bool {
        self.weight > 0.0
    }

    /// Refuses Gaussians of the file `path` whose renders are no nearer than a plain colour; `found` says so in words.
    /// Photographs of one colour tell nothing.
    ///
    /// # Errors
    /// When they are of other photographs, or of other coordinates than the cameras.
    pub fn expect_same(&self, path: &Path, found: &str) -> Result<()> {
        let same = self.renders <= 3.0 * self.weight * f64::from(STEP).powi(2);
        if !self.tell || self.gain() > 0.0 || (self.is_drawn() && same) {
            return Ok(());
        }
        Err(Error::new("the Gaussians do not show these photographs").file(path).found(found).hint(
            "give the photographs that they were made from, with cameras in the same coordinates; gs-geom convert --scene tells whether only the \
             axes differ",
        ))
    }

    fn decibels(&self, error: f64) -> f64 {
        -10.0 * (error / (3.0 * self.weight)).max(1e-10).log10()
    }
}

/// As `12.3 dB; one plain colour has 14.0 dB`: the PSNR where the renders are opaque.
impl std::fmt::Display for Likeness {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if !self.is_drawn() {
            return write!(f, "no Gaussian in any of {} photographs", self.photographs);
        }
        let [renders, plain] = [self.renders, self.plain].map(|e| self.decibels(e));
        write!(f, "{renders:.1} dB, where one plain colour has {plain:.1} dB, on {} photographs", self.photographs)
    }
}

fn small(view: &View) -> View {
    let mut view = view.clone();
    let (width, height) = size_within((view.camera.width, view.camera.height), LONGEST);
    view.camera = view.camera.resized(width, height);
    view
}
