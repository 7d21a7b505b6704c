//! One iteration by rendering and averaging, as without footprints: features are rasterised, averaged over the masks'
//! pixels, and the gradient goes back from the pixels to the Gaussians.

use feat_train::contrastive::adam::{Adam, Rates};
use feat_train::contrastive::context::Context;
use feat_train::contrastive::engine::Engine;
use feat_train::contrastive::loss;
use feat_train::contrastive::masks::MaskSet;
use feat_train::contrastive::model::Model;
use feat_train::options::Loss;
use glam::DVec3;
use gs_raster::{RasterOptions, TILE, TileWeights, render_features, tile_weights};
use gs_scene::{Camera, Gaussians};
use std::time::Instant;

/// A pixel counts where more than this is accumulated.
const GATE: f32 = 0.7;
/// Masks along a row of the grid, and rows.
const GRID: (usize, usize) = (10, 8);
/// No mask.
const NOWHERE: u16 = u16::MAX;

/// A view of Gaussians and its masks.
pub struct View {
    gaussians: Gaussians,
    camera: Camera,
    options: RasterOptions,
    /// Mask of each pixel that counts, or [`NOWHERE`].
    mask: Vec<u16>,
    /// Pixels of each mask that count.
    pixels: Vec<f64>,
}

/// Both ways on one view.
#[derive(Debug, Clone, Copy)]
pub struct Compared {
    /// Seconds of rendering and averaging, there and back, and nothing else of an iteration.
    pub rendering: f64,
    /// Seconds of the engine's whole iteration.
    pub engine: f64,
    /// Largest difference of centroids, as a share of the largest.
    pub centroids: f64,
    /// Difference of the loss, as a share of it.
    pub loss: f64,
    /// Largest difference of the features' gradients, as a share of the largest.
    pub gradients: f64,
}

impl View {
    /// Looks straight down on a surface whose Gaussians are about 1 apart in x and y and reach to `side`.
    pub fn new(positions: &[[f32; 3]], side: f64, width: u32, height: u32) -> Self {
        let n = positions.len();
        let gaussians = Gaussians {
            means: positions.to_vec(),
            log_scales: (0..n).map(|i| [-0.4 + 0.1 * (i % 5) as f32, -0.5, -0.6]).collect(),
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: (0..n).map(|i| 1.0 + 0.3 * (i % 7) as f32).collect(),
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
        };
        let target = DVec3::new(side / 2.0, side / 2.0, 0.0);
        let eye = target + DVec3::new(0.0, 0.0, -side);
        let camera = Camera::look_at(eye, target, DVec3::Y, width, height, 0.9);
        let mut view = Self {
            gaussians,
            camera,
            options: RasterOptions::default(),
            mask: vec![NOWHERE; (width * height) as usize],
            pixels: vec![0.0; GRID.0 * GRID.1],
        };
        let opaque = tile_weights(&view.gaussians, &view.camera, &view.options, true, |t| {
            let gated = pixels(t, width as usize).filter(|&(at, _)| t.alpha[at] > GATE);
            gated.map(|(_, pixel)| pixel).collect::<Vec<_>>()
        });
        for pixel in opaque.into_iter().flatten() {
            let (x, y) = (pixel % width as usize, pixel / width as usize);
            let mask = y * GRID.1 / height as usize * GRID.0 + x * GRID.0 / width as usize;
            view.mask[pixel] = mask as u16;
            view.pixels[mask] += 1.0;
        }
        view
    }

    /// The footprints of the masks.
    pub fn masks(&self, context: &Context) -> MaskSet {
        let width = self.camera.width as usize;
        let mut weight = std::collections::BTreeMap::<(u32, u16), f64>::new();
        let tiles = tile_weights(&self.gaussians, &self.camera, &self.options, true, |t| {
            let mut found = Vec::new();
            for (&i, w) in t.gaussians.iter().zip(t.weights.chunks_exact(TILE * TILE)) {
                let seen = pixels(t, width).map(|(at, pixel)| (i, self.mask[pixel], w[at]));
                found.extend(seen.filter(|(_, k, w)| *k != NOWHERE && *w > 0.0));
            }
            found
        });
        for (i, k, w) in tiles.into_iter().flatten() {
            *weight.entry((i, k)).or_default() += f64::from(w);
        }
        let mut place = vec![0u32; context.order.len()];
        for (p, &i) in context.order.iter().enumerate() {
            place[i as usize] = p as u32;
        }
        let entries =
            weight.iter().map(|(&(i, k), w)| (place[i as usize], k, (w / self.pixels[k as usize]) as f32)).collect();
        MaskSet::from_entries((0..self.pixels.len() as u32).collect(), self.pixels.clone(), entries, context)
    }

    /// Averages of the rendered features over masks `[K][d]`.
    fn averages(&self, features: &[f32], d: usize) -> Vec<f64> {
        let image = render_features(&self.gaussians, features, d, &self.camera, &self.options);
        let mut sums = vec![0.0; self.pixels.len() * d];
        for (pixel, &k) in image.chunks_exact(d).zip(&self.mask).filter(|(_, k)| **k != NOWHERE) {
            let sum = &mut sums[k as usize * d..(k as usize + 1) * d];
            sum.iter_mut().zip(pixel).for_each(|(s, v)| *s += f64::from(*v));
        }
        sums.chunks_exact_mut(d).zip(&self.pixels).for_each(|(s, n)| s.iter_mut().for_each(|s| *s /= n.max(1.0)));
        sums
    }

    /// Gradient of the features `[n][d]`, given that of the masks' averages: through every pixel.
    fn backward(&self, averages: &[f64], d: usize) -> Vec<f64> {
        let mut image = vec![0.0f32; self.mask.len() * d];
        for (pixel, &k) in image.chunks_exact_mut(d).zip(&self.mask).filter(|(_, k)| **k != NOWHERE) {
            let k = k as usize;
            pixel.iter_mut().zip(&averages[k * d..]).for_each(|(p, g)| *p = (g / self.pixels[k]) as f32);
        }
        let width = self.camera.width as usize;
        let tiles = tile_weights(&self.gaussians, &self.camera, &self.options, true, |t| {
            let mut sums = vec![0.0f32; t.gaussians.len() * d];
            for (sum, w) in sums.chunks_exact_mut(d).zip(t.weights.chunks_exact(TILE * TILE)) {
                for (at, pixel) in pixels(t, width).filter(|&(at, _)| w[at] > 0.0) {
                    sum.iter_mut().zip(&image[pixel * d..]).for_each(|(s, g)| *s += w[at] * g);
                }
            }
            (t.gaussians.to_vec(), sums)
        });
        let mut out = vec![0.0f64; self.gaussians.means.len() * d];
        for (gaussians, sums) in tiles {
            for (&i, sum) in gaussians.iter().zip(sums.chunks_exact(d)) {
                out[i as usize * d..].iter_mut().zip(sum).for_each(|(o, s)| *o += f64::from(*s));
            }
        }
        out
    }

    /// One iteration of `model` both ways; times are medians of `runs`.
    pub fn compare(&self, context: &Context, model: &Model<f32>, runs: usize) -> Compared {
        let (d, tau) = (model.dim, model.options.tau);
        let set = self.masks(context);
        let mut engine = Engine::new(context, model);
        engine.propagate(model);
        let found = engine.evaluate(model, &set, 0, None);
        let centroids = engine.centroids(model, &set);
        let mut adam = Adam::new(model.features.len());
        engine.backward(&mut model.clone(), &mut adam, &set, &found, 0, &Rates::none());
        let features = engine.final_features(model);
        let averages = self.averages(&features, d);
        let rendered = loss::evaluate(Loss::Printed, &averages, None, d, tau);
        let exact = self.backward(&rendered.centroids, d);
        let mut gradients = vec![0.0; exact.len()];
        for (g, &i) in adam.mean.chunks_exact(d).zip(&context.order) {
            gradients[i as usize * d..].iter_mut().zip(g).for_each(|(o, g)| *o = f64::from(*g));
        }
        let rendering = || {
            let averages = self.averages(&features, d);
            let rendered = loss::evaluate(Loss::Printed, &averages, None, d, tau);
            assert!(!self.backward(&rendered.centroids, d).is_empty());
        };
        let rendering = median(runs, rendering);
        let (mut model, mut i) = (model.clone(), 0);
        let engine = median(runs, || {
            i += 1;
            engine.propagate(&model);
            let found = engine.evaluate(&model, &set, i, None);
            engine.backward(&mut model, &mut adam, &set, &found, i, &Rates::at(1e-3, i));
        });
        Compared {
            rendering,
            engine,
            centroids: apart(&centroids, &averages),
            loss: ((found.loss - rendered.loss) / rendered.loss).abs(),
            gradients: apart(&gradients, &exact),
        }
    }
}

/// Index within the tile and within the image of each of its pixels.
fn pixels(t: &TileWeights<'_>, width: usize) -> impl Iterator<Item = (usize, usize)> {
    let (x0, y0, w, h) = (t.x0, t.y0, t.width, t.height);
    (0..h).flat_map(move |y| (0..w).map(move |x| (y * TILE + x, (y0 + y) * width + x0 + x)))
}

/// Largest difference as a share of the largest value.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    let largest = b.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / largest
}

/// Median seconds of `runs` calls.
fn median(runs: usize, mut f: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
