//! From Gaussians in the world to ellipses in the image (EWA splatting), and back.
//!
//! Follows gsplat's conventions: 0.3 is added to the diagonal of the 2D covariance; in the Jacobian x/z and y/z are clamped to
//! the image's edges plus 0.15 of its size.
//!
//! All in double precision, between parameters and results in single: far-away origins cost no digits, needles do not cancel
//! and sheets do not overflow. Nothing here branches or calls a library, so that loops over many Gaussians become vectors.

use crate::types::RasterOptions;
use glam::{DMat3, DVec3};
use gs_scene::{Camera, Gaussians};

/// Added to the diagonal of the projected covariance, in square pixels.
const LOW_PASS: f64 = 0.3f32 as f64;
/// Contributions below this are skipped.
const ALPHA_MIN: f64 = 1.0 / 255.0;
/// Centres further out than this, in pixels, are not drawn: the square of such a distance nears the end of single precision.
const MEAN_MAX: f64 = 1e15;

/// A Gaussian as the tiles see it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Splat {
    pub mean: [f32; 2],
    /// Inverse of the 2D covariance: xx, xy, yy.
    pub conic: [f32; 3],
    /// Determinant of the conic.
    pub conic_det: f32,
    /// Half extents of the region where alpha >= 1/255, in pixels.
    pub extent: [f32; 2],
    /// sigma at which alpha falls below 1/255: ln(255 opacity).
    pub sigma_max: f32,
    /// The antialiasing's compensation included.
    pub opacity: f32,
    pub log2_opacity: f32,
    pub depth: f32,
    pub color: [f32; 3],
    /// Which colour channels were cut at zero: they pass no gradient.
    pub clamped: [bool; 3],
}

impl Splat {
    /// From [`project`]'s values and the colour before it is cut at zero.
    #[inline(always)]
    pub fn new(values: Projected<f32>, color: [f32; 3]) -> Self {
        let [_, x, y, xx, xy, yy, conic_det, width, height, sigma_max, opacity, log2_opacity, depth] = values;
        let (mean, conic, extent) = ([x, y], [xx, xy, yy], [width, height]);
        let clamped = color.map(|c| c < 0.0);
        let color = color.map(|c| c.max(0.0));
        Self { mean, conic, conic_det, extent, sigma_max, opacity, log2_opacity, depth, color, clamped }
    }
}

/// The parameters of one Gaussian but for its harmonics, or derivatives by them: centre, logarithms of the scales, rotation
/// (w x y z, any length), opacity logit.
pub(crate) type Parameters<T = f64> = [T; 11];

/// The parameters of Gaussian `i`.
#[inline(always)]
pub(crate) fn parameters(g: &Gaussians, i: usize) -> Parameters<f32> {
    let ([x, y, z], [a, b, c], [qw, qx, qy, qz]) = (g.means[i], g.log_scales[i], g.rotations[i]);
    [x, y, z, a, b, c, qw, qx, qy, qz, g.opacity_logits[i]]
}

/// e^x for -700 <= x <= 700 (nearer ones beyond), with a relative error below 1e-13: 2^n by the exponent's bits, the rest by
/// Taylor's polynomial on [-ln 2 / 2, ln 2 / 2].
#[inline(always)]
pub(crate) fn exp(x: f64) -> f64 {
    const INVERSE_FACTORIALS: [f64; 12] = {
        let mut f = [1.0; 12];
        let mut k = 1;
        while k < 12 {
            f[k] = f[k - 1] / k as f64;
            k += 1;
        }
        f
    };
    // Adding this leaves the nearest whole number in the lowest bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    let x = if x > -700.0 { x } else { -700.0 };
    let x = if x < 700.0 { x } else { 700.0 };
    let shifted = x * std::f64::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, the first short enough for exact products.
    let r = (x - n * 0.693_147_180_369_123_8) - n * 1.908_214_929_270_587_7e-10;
    let mut p = INVERSE_FACTORIALS[11];
    let mut k = 11;
    while k > 0 {
        k -= 1;
        p = p * r + INVERSE_FACTORIALS[k];
    }
    f64::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 52))
}

/// ln x for normal positive x, with an absolute error below 1e-12: the exponent's bits, and the area tangent's series.
#[inline(always)]
pub(crate) fn ln(x: f64) -> f64 {
    const EXPONENT_AS_INTEGER: f64 = 4_503_599_627_370_496.0;
    let bits = x.to_bits();
    let exponent = f64::from_bits((bits >> 52) | EXPONENT_AS_INTEGER.to_bits()) - EXPONENT_AS_INTEGER - 1023.0;
    let mantissa = f64::from_bits((bits & ((1 << 52) - 1)) | 1f64.to_bits());
    let high = mantissa > std::f64::consts::SQRT_2;
    let mantissa = if high { 0.5 * mantissa } else { mantissa };
    let exponent = if high { exponent + 1.0 } else { exponent };
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let z = s * s;
    let mut p = 1.0 / 15.0;
    let mut k = 13.0;
    while k > 0.0 {
        p = p * z + 1.0 / k;
        k -= 2.0;
    }
    exponent * std::f64::consts::LN_2 + 2.0 * s * p
}

/// A camera ready for many Gaussians.
#[derive(Default)]
pub(crate) struct Lens {
    /// Camera from world, and its transpose.
    rotation: DMat3,
    back: DMat3,
    position: DVec3,
    focal: [f64; 2],
    center: [f64; 2],
    /// Bounds of x/z and y/z in the Jacobian.
    low: [f64; 2],
    high: [f64; 2],
    /// Corners of what is looked at, in pixels: Gaussians beside it are not drawn.
    window: [[f64; 2]; 2],
    pub width: u32,
    pub height: u32,
}

impl Lens {
    pub fn new(c: &Camera) -> Self {
        let (focal, center) = ([c.fx, c.fy], [c.cx, c.cy]);
        let size = [f64::from(c.width), f64::from(c.height)];
        let margin = [0, 1].map(|k| 0.15 * size[k] / focal[k]);
        Self {
            rotation: c.rotation,
            back: c.rotation.transpose(),
            position: c.position(),
            focal,
            center,
            low: [0, 1].map(|k| -center[k] / focal[k] - margin[k]),
            high: [0, 1].map(|k| (size[k] - center[k]) / focal[k] + margin[k]),
            window: [[0.0; 2], size],
            width: c.width,
            height: c.height,
        }
    }

    /// The same lens, where nothing is looked at but what lies between two corners, in pixels.
    pub fn within(self, window: [[f64; 2]; 2]) -> Self {
        Self { window, ..self }
    }

    /// View direction (from the camera to the Gaussian), not normalised.
    #[inline(always)]
    pub fn direction(&self, p: &Parameters) -> DVec3 {
        DVec3::new(p[0], p[1], p[2]) - self.position
    }
}

/// Intermediate values that the backward pass needs again.
struct Ellipse {
    t: DVec3,
    clamped: [f64; 2],
    inside: [bool; 2],
    /// Rows of J * W.
    jw: [DVec3; 2],
    /// Transposed.
    rotation: DMat3,
    quat: [f64; 4],
    quat_norm: f64,
    scale: DVec3,
    /// Scale times rotation, transposed, times the rows of J * W.
    a: DVec3,
    b: DVec3,
    /// Of the projection along x and y, the low-pass included.
    variance: [f64; 2],
    /// Inverse of the projected covariance: xx, xy, yy.
    conic: [f64; 3],
    conic_det: f64,
    own_opacity: f64,
    /// By how much antialiasing lowers the opacity.
    compensation: f64,
}

#[inline(always)]
fn ellipse(p: &Parameters, lens: &Lens, antialias: bool) -> Ellipse {
    let t = lens.rotation * lens.direction(p);
    let [_, _, _, s0, s1, s2, w, x, y, z, opacity_logit] = *p;
    let quat_norm = (w * w + x * x + y * y + z * z).sqrt();
    let inverse = 1.0 / quat_norm;
    let quat = [w * inverse, x * inverse, y * inverse, z * inverse];
    let [w, x, y, z] = quat;
    let rotation = DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        DVec3::new(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        DVec3::new(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    let scale = DVec3::new(exp(s0), exp(s1), exp(s2));
    let rz = 1.0 / t[2];
    let (u, v) = (t[0] * rz, t[1] * rz);
    let inside = [lens.low[0] <= u && u <= lens.high[0], lens.low[1] <= v && v <= lens.high[1]];
    let clamp = |v: f64, low: f64, high: f64| {
        let v = if v > low { v } else { low };
        if v < high { v } else { high }
    };
    let clamped = [clamp(u, lens.low[0], lens.high[0]), clamp(v, lens.low[1], lens.high[1])];
    let [fx, fy] = lens.focal;
    let jw = [
        lens.back * DVec3::new(fx * rz, 0.0, -fx * clamped[0] * rz),
        lens.back * DVec3::new(0.0, fy * rz, -fy * clamped[1] * rz),
    ];
    let (a, b) = (rotation * jw[0] * scale, rotation * jw[1] * scale);
    // |a x b|^2 for the determinant without the low-pass: xx yy - xy^2 would cancel for needles.
    let (aa, ab, bb, normal) = (a.dot(a), a.dot(b), b.dot(b), a.cross(b));
    let own_det = normal.dot(normal);
    let conic_det = 1.0 / (own_det + LOW_PASS * (aa + bb + LOW_PASS));
    Ellipse {
        t,
        clamped,
        inside,
        jw,
        rotation,
        quat,
        quat_norm,
        scale,
        a,
        b,
        variance: [aa + LOW_PASS, bb + LOW_PASS],
        conic: [(bb + LOW_PASS) * conic_det, -ab * conic_det, (aa + LOW_PASS) * conic_det],
        conic_det,
        own_opacity: 1.0 / (1.0 + exp(-opacity_logit)),
        compensation: if antialias { (own_det * conic_det).sqrt() } else { 1.0 },
    }
}

/// A Gaussian in the image: 0 where it is drawn, else the position of the reason in [`crate::Dropped`], from 1; then the
/// fields of [`Splat`] before its colour, in order.
pub(crate) type Projected<T = f64> = [T; 13];

/// Whether single precision holds a value.
#[inline(always)]
fn held(v: f64) -> bool {
    v.abs() < 3.4e38
}

/// Projects a Gaussian.
#[inline(always)]
pub(crate) fn project(p: &Parameters, lens: &Lens, options: &RasterOptions) -> Projected {
    let e = ellipse(p, lens, options.antialias);
    let opacity = e.own_opacity * e.compensation;
    let rz = 1.0 / e.t[2];
    let mean = [lens.focal[0] * e.t[0] * rz + lens.center[0], lens.focal[1] * e.t[1] * rz + lens.center[1]];
    let log = ln(opacity);
    let sigma_max = log - ln(ALPHA_MIN);
    let reach = |variance: f64| (2.0 * sigma_max * variance).sqrt();
    let extent = [reach(e.variance[0]), reach(e.variance[1])];
    let [low, high] = lens.window;

    let finite = held(e.t[0]) & held(e.t[1]) & held(e.t[2]) & held(p[3]) & held(p[4]) & held(p[5]);
    // Infinite logits are opacities of 0 and 1.
    let finite = finite & held(p[6]) & held(p[7]) & held(p[8]) & held(p[9]) & !p[10].is_nan();
    let whole = (e.quat_norm > 1e-12) & held(e.variance[0]) & held(e.variance[1]) & held(e.conic[1]);
    let whole = whole & (e.conic[0] > 1e-38) & (e.conic[2] > 1e-38) & held(e.conic[0]) & held(e.conic[2]);
    let near = (mean[0].abs() <= MEAN_MAX) & (mean[1].abs() <= MEAN_MAX);
    let touches = (mean[0] + extent[0] > low[0]) & (mean[0] - extent[0] < high[0]);
    let touches = touches & (mean[1] + extent[1] > low[1]) & (mean[1] - extent[1] < high[1]);
    // The first reason that holds.
    let unseen = if near & touches { 0.0 } else { 5.0 };
    let unseen = if opacity >= ALPHA_MIN { unseen } else { 4.0 };
    let unseen = if whole { unseen } else { 3.0 };
    let unseen = if e.t[2] > f64::from(options.near) { unseen } else { 2.0 };
    let unseen = if finite { unseen } else { 1.0 };
    let log2_opacity = log * std::f64::consts::LOG2_E;
    let ([x, y], [xx, xy, yy], [width, height]) = (mean, e.conic, extent);
    [unseen, x, y, xx, xy, yy, e.conic_det, width, height, sigma_max, opacity, log2_opacity, e.t[2]]
}

/// d loss / d splat, summed over pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct SplatGradient<T = f32> {
    pub mean: [T; 2],
    pub conic: [T; 3],
    pub opacity: T,
    pub depth: T,
    pub color: [T; 3],
}

impl SplatGradient {
    pub fn add(&mut self, o: &Self) {
        for c in 0..2 {
            self.mean[c] += o.mean[c];
        }
        for c in 0..3 {
            self.conic[c] += o.conic[c];
            self.color[c] += o.color[c];
        }
        self.opacity += o.opacity;
        self.depth += o.depth;
    }
}

/// d loss / d parameters by the chain rule through [`project`], for a Gaussian that is drawn; what reaches the centre through the view direction is not
/// in it, nor is the colour looked at.
#[inline(always)]
pub(crate) fn project_backward(
    p: &Parameters,
    lens: &Lens,
    options: &RasterOptions,
    d: &SplatGradient<f64>,
) -> Parameters {
    let e = ellipse(p, lens, options.antialias);
    // conic = cov^-1:  d cov = -conic^T (d conic) conic, with the off-diagonal counted once in d.conic[1].
    let [a, b, c] = e.conic;
    let (da, db, dc) = (d.conic[0], 0.5 * d.conic[1], d.conic[2]);
    let (p00, p01) = (a * da + b * db, a * db + b * dc);
    let (p10, p11) = (b * da + c * db, b * db + c * dc);
    let mut d_cov = [-(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)];
    if options.antialias {
        // c^2 = det(C) / det(C + k I): by Cayley and Hamilton, the derivative of c by C is k / (2 c det(C + k I)) times the
        // product of adj(C) and (C + k I)^-1, which cancels nothing.
        let by = d.opacity * e.own_opacity * 0.5 * LOW_PASS / e.compensation * e.conic_det;
        let adj = [e.variance[1] - LOW_PASS, -e.a.dot(e.b), e.variance[0] - LOW_PASS];
        d_cov[0] += by * (adj[0] * a + adj[1] * b);
        d_cov[1] += by * (adj[0] * b + adj[1] * c);
        d_cov[2] += by * (adj[1] * b + adj[2] * c);
    }

    // cov2d = (JW) Sigma (JW)^T, Sigma = M M^T, M = R S.
    let d_ma = e.a * (2.0 * d_cov[0]) + e.b * (2.0 * d_cov[1]);
    let d_mb = e.a * (2.0 * d_cov[1]) + e.b * (2.0 * d_cov[2]);
    // ma = S R^T jw0: d jw0 = R S d_ma; d M = jw0 d_ma^T + jw1 d_mb^T.
    let (d_ma_s, d_mb_s) = (d_ma * e.scale, d_mb * e.scale);
    let (d_jw0, d_jw1) = (e.rotation.transpose() * d_ma_s, e.rotation.transpose() * d_mb_s);

    // jw = W^T j: d j = W d_jw.
    let (d_j0, d_j1) = (lens.rotation * d_jw0, lens.rotation * d_jw1);
    let rz = 1.0 / e.t[2];
    let rz2 = rz * rz;
    let [fx, fy] = lens.focal;
    let (jx, jy) = (fx * rz2 * d_j0[2], fy * rz2 * d_j1[2]);
    let (cx, cy) = (e.clamped[0] * jx, e.clamped[1] * jy);
    let mut d_t = DVec3::new(if e.inside[0] { -jx } else { 0.0 }, if e.inside[1] { -jy } else { 0.0 }, 0.0);
    d_t[2] += -fx * rz2 * d_j0[0] - fy * rz2 * d_j1[1];
    d_t[2] += if e.inside[0] { 2.0 * cx } else { cx };
    d_t[2] += if e.inside[1] { 2.0 * cy } else { cy };
    // mean2d and depth.
    d_t[0] += fx * rz * d.mean[0];
    d_t[1] += fy * rz * d.mean[1];
    d_t[2] += -rz2 * (fx * e.t[0] * d.mean[0] + fy * e.t[1] * d.mean[1]) + d.depth;

    // ma = S (R^T jw0): d S is d_ma times what it stretches, which is ma / S; and d S S the gradient of log S.
    let DVec3 { x: a, y: b, z: c } = d_ma * e.a + d_mb * e.b;
    // d R = jw0 (S d_ma)^T + jw1 (S d_mb)^T.
    let row = |r: usize| d_ma_s * e.jw[0][r] + d_mb_s * e.jw[1][r];
    let d_quat = quat_backward(e.quat, &[row(0), row(1), row(2)]);
    // q / |q|: the part along q drops out.
    let q = e.quat;
    let along = q[0] * d_quat[0] + q[1] * d_quat[1] + q[2] * d_quat[2] + q[3] * d_quat[3];
    let DVec3 { x, y, z } = lens.back * d_t;
    let across = |k: usize| (d_quat[k] - along * q[k]) / e.quat_norm;
    let [qw, qx, qy, qz] = [across(0), across(1), across(2), across(3)];
    let opacity_logit = d.opacity * e.own_opacity * e.compensation * (1.0 - e.own_opacity);
    [x, y, z, a, b, c, qw, qx, qy, qz, opacity_logit]
}

/// d loss / d (w, x, y, z) of a unit quaternion from d loss / d its rotation matrix, by rows.
#[inline(always)]
fn quat_backward([w, x, y, z]: [f64; 4], d: &[DVec3; 3]) -> [f64; 4] {
    let g = |r: usize, c: usize| d[r][c];
    [
        2.0 * (-z * g(0, 1) + y * g(0, 2) + z * g(1, 0) - x * g(1, 2) - y * g(2, 0) + x * g(2, 1)),
        2.0 * (y * g(0, 1) + z * g(0, 2) + y * g(1, 0) - 2.0 * x * g(1, 1) - w * g(1, 2) + z * g(2, 0) + w * g(2, 1)
            - 2.0 * x * g(2, 2)),
        2.0 * (-2.0 * y * g(0, 0) + x * g(0, 1) + w * g(0, 2) + x * g(1, 0) + z * g(1, 2) - w * g(2, 0) + z * g(2, 1)
            - 2.0 * y * g(2, 2)),
        2.0 * (-2.0 * z * g(0, 0) - w * g(0, 1) + x * g(0, 2) + w * g(1, 0) - 2.0 * z * g(1, 1)
            + y * g(1, 2)
            + x * g(2, 0)
            + y * g(2, 1)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_logarithm_keep_their_bounds() {
        let (mut of_exp, mut of_ln) = (0f64, 0f64);
        for i in -699_999..=699_999 {
            let x = f64::from(i) * 1e-3;
            let (own, true_value) = (exp(x), x.exp());
            of_exp = of_exp.max((own / true_value - 1.0).abs());
            of_ln = of_ln.max((ln(true_value) - x).abs() / x.abs().max(1.0));
        }
        eprintln!("largest errors: exp {of_exp:e}, ln {of_ln:e}");
        assert!(of_exp < 1e-13 && of_ln < 1e-12);
        assert_eq!((exp(0.0), ln(1.0)), (1.0, 0.0));
        assert!(exp(f64::NEG_INFINITY) < 1e-300 && exp(f64::INFINITY) > 1e300);
    }
}
