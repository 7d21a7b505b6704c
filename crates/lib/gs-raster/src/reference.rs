//! The renderer once more, as simple as possible: f64, pixel by pixel, all Gaussians, no tiles. The oracle of the tests
//! and of `bench stress`.
//!
//! It shares no code with the renderer except the types of its inputs; [`backward`] alone goes through the renderer's chain
//! rule, which is in f64, and which the tests hold against central differences of [`render`].

use crate::RasterOptions;
#[cfg(test)]
use crate::project::{Lens, SplatGradient, project, project_backward};
use crate::project::{Parameters, parameters};
#[cfg(test)]
use crate::sh;
use glam::{DMat3, DQuat, DVec2, DVec3};
use gs_scene::{Camera, Gaussians};

/// A Gaussian in f64.
#[derive(Debug, Clone)]
pub(crate) struct Gaussian {
    pub own: Parameters,
    pub sh: Vec<f64>,
}

impl Gaussian {
    fn mean(&self) -> DVec3 {
        DVec3::from_slice(&self.own)
    }

    /// A parameter by its place, those of the harmonics last.
    #[cfg(test)]
    pub fn parameter(&mut self, k: usize) -> &mut f64 {
        if k < self.own.len() { &mut self.own[k] } else { &mut self.sh[k - self.own.len()] }
    }
}

pub(crate) fn widen(g: &Gaussians) -> Vec<Gaussian> {
    let sh = |i: usize| g.sh_of(i).iter().map(|&v| f64::from(v)).collect();
    (0..g.len()).map(|i| Gaussian { own: parameters(g, i).map(f64::from), sh: sh(i) }).collect()
}

/// Whether the 1/255 skip and the early stop apply; without them the picture is a smooth function of the parameters (as long
/// as no alpha reaches 0.99 and no colour zero).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Cuts {
    Hard,
    #[cfg(test)]
    None,
}

/// What a pixel shows.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pixel {
    /// Colour over the background.
    pub rgb: [f64; 3],
    /// Accumulated alpha, 0 to 1.
    pub alpha: f64,
    /// Camera depth, summed with the blending weights.
    pub depth: f64,
    /// Largest change of alpha if every decision that rounding may turn at this pixel (an alpha beside 1/255 or 0.99, a
    /// transmittance beside 1e-4) went the other way; 0 where there is none.
    pub doubt: f64,
    /// What rounding of exponents and depths to single precision may change of alpha, and of a colour of 1, besides.
    pub rounding: f64,
}

/// A Gaussian's ellipse in the image.
struct Ellipse {
    id: usize,
    mean: DVec2,
    /// Inverse of the covariance: xx, xy, yy.
    conic: [f64; 3],
    opacity: f64,
    z: f64,
    color: [f64; 3],
}

/// Roundings to single precision that reach an exponent, each of half a unit in the last place of its terms.
const ROUNDINGS: f64 = 8.0;
/// Relative distance to a cut below which single precision may decide differently.
const DOUBT: f64 = 1e-4;

fn ellipses(scene: &[Gaussian], camera: &Camera, options: &RasterOptions) -> Vec<Ellipse> {
    let mut out = Vec::new();
    for (id, g) in scene.iter().enumerate() {
        let p = camera.to_camera(g.mean());
        if p.z <= f64::from(options.near) {
            continue;
        }
        let [_, _, _, s0, s1, s2, w, x, y, z, opacity_logit] = g.own;
        if [w, x, y, z] == [0.0; 4] {
            continue;
        }
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let spread = DMat3::from_diagonal((2.0 * DVec3::new(s0, s1, s2)).exp());
        let covariance = camera.rotation * axes * spread * axes.transpose() * camera.rotation.transpose();

        // Projection linearised at the centre, which is moved to within 15 % of the image's size around it.
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let u = (camera.fx * p.x / p.z).clamp(-camera.cx - 0.15 * width, width - camera.cx + 0.15 * width);
        let v = (camera.fy * p.y / p.z).clamp(-camera.cy - 0.15 * height, height - camera.cy + 0.15 * height);
        let row_x = DVec3::new(camera.fx, 0.0, -u) / p.z;
        let row_y = DVec3::new(0.0, camera.fy, -v) / p.z;
        let low_pass = f64::from(0.3f32);
        let xx = row_x.dot(covariance * row_x) + low_pass;
        let xy = row_x.dot(covariance * row_y);
        let yy = row_y.dot(covariance * row_y) + low_pass;
        let det = xx * yy - xy * xy;
        let own = (xx - low_pass) * (yy - low_pass) - xy * xy;
        let compensation = if options.antialias { (own.max(0.0) / det).sqrt() } else { 1.0 };
        let (mx, my, z) = camera.project(g.mean());
        out.push(Ellipse {
            id,
            mean: DVec2::new(mx, my),
            conic: [yy / det, -xy / det, xx / det],
            opacity: compensation / (1.0 + (-opacity_logit).exp()),
            z,
            color: color(&g.sh, g.mean() - camera.position(), options.sh_degree).map(|c| c.max(0.0)),
        });
    }
    out.sort_by(|a, b| a.z.total_cmp(&b.z).then(a.id.cmp(&b.id)));
    out
}

/// Harmonics from their definition by associated Legendre functions: band l, order m, with the Condon-Shortley sign, 3DGS's
/// order m = -l..=l.
fn color(sh: &[f64], direction: DVec3, degree: u8) -> [f64; 3] {
    let d = direction.normalize();
    let (sin_theta, phi) = (d.x.hypot(d.y), d.y.atan2(d.x));
    let legendre = |l: usize, m: usize| {
        let c = d.z;
        let s = sin_theta;
        match (l, m) {
            (0, 0) => 1.0,
            (1, 0) => c,
            (1, 1) => -s,
            (2, 0) => 0.5 * (3.0 * c * c - 1.0),
            (2, 1) => -3.0 * c * s,
            (2, 2) => 3.0 * s * s,
            (3, 0) => 0.5 * (5.0 * c * c * c - 3.0 * c),
            (3, 1) => -1.5 * (5.0 * c * c - 1.0) * s,
            (3, 2) => 15.0 * c * s * s,
            (3, 3) => -15.0 * s * s * s,
            _ => unreachable!(),
        }
    };
    let factorial = |n: usize| (1..=n).product::<usize>() as f64;
    let mut out = [0.5; 3];
    let mut k = 0;
    for l in 0..=usize::from(degree) {
        for order in -(l as i32)..=l as i32 {
            if 3 * k >= sh.len() {
                return out;
            }
            let m = order.unsigned_abs() as usize;
            let norm = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - m) / factorial(l + m)).sqrt();
            let angle = m as f64 * phi;
            let azimuth = match order {
                0 => 1.0,
                o if o > 0 => std::f64::consts::SQRT_2 * angle.cos(),
                _ => std::f64::consts::SQRT_2 * angle.sin(),
            };
            let value = norm * legendre(l, m) * azimuth;
            for c in 0..3 {
                out[c] += value * sh[3 * k + c];
            }
            k += 1;
        }
    }
    out
}

/// One Gaussian's part in a pixel.
#[cfg_attr(not(test), expect(dead_code, reason = "some are for the gradients, which only the tests need"))]
struct Layer<'a> {
    ellipse: &'a Ellipse,
    offset: DVec2,
    /// Opacity times the exponential, before the cap at 0.99.
    raw: f64,
    alpha: f64,
    transmittance: f64,
}

/// The layers of a pixel, front to back; [`Pixel::doubt`] and [`Pixel::rounding`].
fn layers(ellipses: &[Ellipse], x: usize, y: usize, cuts: Cuts) -> (Vec<Layer<'_>>, [f64; 2]) {
    let (mut transmittance, mut doubt, mut rounded) = (1.0, 0.0, 0.0);
    let mut out = Vec::new();
    // Single precision adds terms of sigma that may cancel, those of a long and narrow ellipse by orders of magnitude.
    let near = |value: f64, cut: f64, doubt: f64| (value / cut - 1.0).abs() < DOUBT + doubt;
    for e in ellipses {
        let offset = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - e.mean;
        let [a, b, c] = e.conic;
        let sigma = 0.5 * (a * offset.x * offset.x + c * offset.y * offset.y) + b * offset.x * offset.y;
        let terms = 0.5 * (a * offset.x * offset.x + c * offset.y * offset.y) + (b * offset.x * offset.y).abs();
        let rounding = ROUNDINGS * f64::from(f32::EPSILON) * terms;
        let raw = e.opacity * (-sigma).exp();
        let alpha = raw.min(0.99);
        if cuts == Cuts::Hard {
            if near(raw, 1.0 / 255.0, rounding) {
                doubt += transmittance * alpha;
            }
            if near(raw, 0.99, 0.0) {
                doubt += 0.99 * DOUBT * transmittance;
            }
            if raw < 1.0 / 255.0 {
                continue;
            }
            if near(transmittance * (1.0 - alpha), 1e-4, rounded) {
                doubt += transmittance;
            }
            if transmittance * (1.0 - alpha) <= 1e-4 {
                break;
            }
        }
        rounded += transmittance * alpha * rounding;
        // Layers as deep as each other, to single precision, may come in either order.
        let as_deep = |l: &&Layer<'_>| e.z - l.ellipse.z <= 2.0 * f64::from(f32::EPSILON) * e.z;
        rounded += out.iter().rev().take_while(as_deep).map(|l| l.transmittance * l.alpha * alpha).sum::<f64>();
        out.push(Layer { ellipse: e, offset, raw, alpha, transmittance });
        transmittance *= 1.0 - alpha;
    }
    (out, [doubt, rounded])
}

/// Renders Gaussians plainly in f64, `[height][width]` pixels: what [`crate::render`] is held against. For N Gaussians and
/// P pixels it takes N P steps.
pub fn render_gaussians(gaussians: &Gaussians, camera: &Camera, options: &RasterOptions) -> Vec<Pixel> {
    render(&widen(gaussians), camera, options, Cuts::Hard)
}

/// `[height][width]` pixels.
pub(crate) fn render(scene: &[Gaussian], camera: &Camera, options: &RasterOptions, cuts: Cuts) -> Vec<Pixel> {
    let ellipses = ellipses(scene, camera, options);
    let mut out = Vec::new();
    for y in 0..camera.height as usize {
        for x in 0..camera.width as usize {
            let (layers, [doubt, rounding]) = layers(&ellipses, x, y, cuts);
            let mut p = Pixel { doubt, rounding, ..Pixel::default() };
            for l in &layers {
                let weight = l.transmittance * l.alpha;
                p.alpha += weight;
                p.depth += weight * l.ellipse.z;
                for c in 0..3 {
                    p.rgb[c] += weight * l.ellipse.color[c];
                }
            }
            for c in 0..3 {
                p.rgb[c] += (1.0 - p.alpha) * f64::from(options.background[c]);
            }
            out.push(p);
        }
    }
    out
}

/// d loss / d parameters, given d loss / d pixels (whose `doubt` is not read): for each Gaussian, those of the harmonics last,
/// and the gradient of its projected centre.
#[cfg(test)]
pub(crate) fn backward(
    scene: &[Gaussian],
    camera: &Camera,
    options: &RasterOptions,
    cuts: Cuts,
    d: &[Pixel],
) -> Vec<(Vec<f64>, [f64; 2])> {
    let ellipses = ellipses(scene, camera, options);
    let mut splats = vec![SplatGradient::<f64>::default(); scene.len()];
    for (at, d) in d.iter().enumerate() {
        let (x, y) = (at % camera.width as usize, at / camera.width as usize);
        let (layers, _) = layers(&ellipses, x, y, cuts);
        // d loss / d transmittance behind the layer at hand, going back to front.
        let mut d_behind: f64 = (0..3).map(|c| d.rgb[c] * f64::from(options.background[c])).sum();
        for l in layers.iter().rev() {
            let (e, out) = (l.ellipse, &mut splats[l.ellipse.id]);
            let weight = l.transmittance * l.alpha;
            let mut value = d.alpha + d.depth * e.z;
            for c in 0..3 {
                value += d.rgb[c] * e.color[c];
                out.color[c] += weight * d.rgb[c];
            }
            out.depth += weight * d.depth;
            let d_alpha = l.transmittance * (value - d_behind);
            d_behind = l.alpha * value + (1.0 - l.alpha) * d_behind;
            if l.raw > 0.99 {
                continue;
            }
            // raw = opacity exp(-sigma).
            out.opacity += d_alpha * l.raw / e.opacity;
            let d_sigma = -d_alpha * l.raw;
            let [a, b, c] = e.conic;
            let DVec2 { x, y } = l.offset;
            out.conic[0] += d_sigma * 0.5 * x * x;
            out.conic[1] += d_sigma * x * y;
            out.conic[2] += d_sigma * 0.5 * y * y;
            out.mean[0] -= d_sigma * (a * x + b * y);
            out.mean[1] -= d_sigma * (b * x + c * y);
        }
    }
    let lens = Lens::new(camera);
    let mut out = Vec::new();
    for (i, g) in scene.iter().enumerate() {
        let d = &splats[i];
        let mut all = vec![0.0; 11];
        let mut d_sh = vec![0.0; g.sh.len()];
        if project(&g.own, &lens, options)[0] == 0.0 {
            let mut p = project_backward(&g.own, &lens, options, d);
            let stored = (g.sh.len() as f64 / 3.0).sqrt() as u8 - 1;
            let (degree, direction) = (stored.min(options.sh_degree), lens.direction(&g.own));
            let seen = color(&g.sh, direction, degree);
            let d_color = [0, 1, 2].map(|c| if seen[c] < 0.0 { 0.0 } else { d.color[c] });
            let basis = sh::basis(degree, sh::unit(direction).0);
            let mut weights = [0.0; 16];
            for (k, (d_sh, sh)) in d_sh.chunks_exact_mut(3).zip(g.sh.chunks_exact(3)).enumerate() {
                for c in 0..3 {
                    d_sh[c] = basis[k] * d_color[c];
                    weights[k] += sh[c] * d_color[c];
                }
            }
            let through_direction = sh::direction_gradient(degree, direction, &weights);
            p.iter_mut().zip(through_direction.to_array()).for_each(|(sum, v)| *sum += v);
            all = p.to_vec();
        }
        all.extend(d_sh);
        out.push((all, d.mean));
    }
    out
}
