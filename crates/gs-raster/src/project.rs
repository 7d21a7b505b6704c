//! From Gaussians in the world to ellipses in the image (EWA splatting), and back.
//!
//! Follows gsplat's conventions: 0.3 is added to the diagonal of the 2D covariance; in the Jacobian x/z and y/z are clamped to
//! the image's edges plus 0.15 of its size.
//!
//! Compiled in single precision for the renderer and in double for its tests; [`Real`] is whichever it is.

use super::real::{Mat3, Quat, Real, Vec2, Vec3, narrow, narrow_matrix, widen};
use super::sh;
use crate::types::RasterOptions;
use glam::DVec3;
use gs_scene::Camera;

/// Added to the diagonal of the projected covariance, in square pixels.
const LOW_PASS: f32 = 0.3;
/// Contributions below this are skipped.
pub(crate) const ALPHA_MIN: Real = 1.0 / 255.0;
/// Centres further out than this, in pixels, are not drawn: the square of such a distance nears the end of single precision.
const MEAN_MAX: Real = 1e15;

/// A Gaussian as the tiles see it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Splat {
    pub mean: [Real; 2],
    /// Inverse of the 2D covariance: xx, xy, yy.
    pub conic: [Real; 3],
    /// Determinant of the conic.
    pub conic_det: Real,
    /// Half extents of the region where alpha >= 1/255, in pixels.
    pub extent: [Real; 2],
    /// sigma at which alpha falls below 1/255: ln(255 opacity).
    pub sigma_max: Real,
    /// The antialiasing's compensation included.
    pub opacity: Real,
    pub log2_opacity: Real,
    pub depth: Real,
    pub color: [Real; 3],
    /// Which colour channels were cut at zero: they pass no gradient.
    pub clamped: [bool; 3],
}

/// The parameters of one Gaussian, as stored.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parameters<'a> {
    pub mean: [Real; 3],
    pub log_scale: [Real; 3],
    /// w x y z, any length.
    pub rotation: [Real; 4],
    pub opacity_logit: Real,
    /// `[coefficients][rgb]`.
    pub sh: &'a [Real],
    pub sh_degree: u8,
}

/// Why a Gaussian is not drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unseen {
    NotFinite,
    Behind,
    Degenerate,
    Transparent,
    Outside,
}

/// A camera ready for many Gaussians.
pub(crate) struct Lens {
    rotation: Mat3,
    position: DVec3,
    rotation64: glam::DMat3,
    focal: Vec2,
    center: Vec2,
    /// Bounds of x/z and y/z in the Jacobian.
    low: Vec2,
    high: Vec2,
    pub width: u32,
    pub height: u32,
}

impl Lens {
    pub fn new(c: &Camera) -> Self {
        let focal = Vec2::new(c.fx as Real, c.fy as Real);
        let size = Vec2::new(c.width as Real, c.height as Real);
        let center = Vec2::new(c.cx as Real, c.cy as Real);
        let margin = 0.15 * size / focal;
        Self {
            rotation: narrow_matrix(c.rotation),
            rotation64: c.rotation,
            position: c.position(),
            focal,
            center,
            low: -(center / focal) - margin,
            high: (size - center) / focal + margin,
            width: c.width,
            height: c.height,
        }
    }

    /// Camera coordinates; the difference is taken in f64 so that far-away origins do not cost digits.
    fn to_camera(&self, mean: [Real; 3]) -> Vec3 {
        narrow(self.rotation64 * (widen(Vec3::from(mean)) - self.position))
    }

    /// View direction (from the camera to the Gaussian), not normalised.
    fn direction(&self, mean: [Real; 3]) -> Vec3 {
        narrow(widen(Vec3::from(mean)) - self.position)
    }
}

/// Intermediate values that the backward pass needs again.
struct Ellipse {
    t: Vec3,
    clamped: Vec2,
    inside: [bool; 2],
    /// Rows of J * W.
    jw: [Vec3; 2],
    /// Rotation times scale.
    m: Mat3,
    quat: Quat,
    quat_norm: Real,
    scale: Vec3,
    /// Of the projection along x and y, the low-pass included.
    variance: [Real; 2],
    /// Inverse of the projected covariance: xx, xy, yy.
    conic: [Real; 3],
    conic_det: Real,
    /// By how much antialiasing lowers the opacity, and its derivative by the projected covariance: xx, xy (once), yy.
    compensation: Real,
    d_compensation: [Real; 3],
}

fn ellipse(p: &Parameters<'_>, lens: &Lens, options: &RasterOptions) -> Result<Ellipse, Unseen> {
    let t = lens.to_camera(p.mean);
    let finite = p.log_scale.iter().chain(&p.rotation).all(|v| v.is_finite());
    if !(t.is_finite() && finite) {
        return Err(Unseen::NotFinite);
    }
    if t.z <= options.near as Real {
        return Err(Unseen::Behind);
    }
    let [w, x, y, z] = p.rotation;
    let raw = Quat::from_xyzw(x, y, z, w);
    let quat_norm = raw.length();
    if !(quat_norm.is_finite() && quat_norm > 1e-12) {
        return Err(Unseen::Degenerate);
    }
    let quat = raw * (1.0 / quat_norm);
    let scale = Vec3::from(p.log_scale.map(Real::exp));
    let m = Mat3::from_quat(quat) * Mat3::from_diagonal(scale);
    let rz = 1.0 / t.z;
    let (u, v) = (t.x * rz, t.y * rz);
    let inside = [(lens.low.x..=lens.high.x).contains(&u), (lens.low.y..=lens.high.y).contains(&v)];
    // Not clamp(), which panics over a camera that is not finite.
    let clamped = Vec2::new(u.max(lens.low.x).min(lens.high.x), v.max(lens.low.y).min(lens.high.y)) * t.z;
    let j0 = Vec3::new(lens.focal.x * rz, 0.0, -lens.focal.x * clamped.x * rz * rz);
    let j1 = Vec3::new(0.0, lens.focal.y * rz, -lens.focal.y * clamped.y * rz * rz);
    let wt = lens.rotation.transpose();
    let jw = [wt * j0, wt * j1];
    let mt = m.transpose();
    let (a, b) = (mt * jw[0], mt * jw[1]);
    // In f64, and |a x b|^2 for the determinant without the low-pass: xx yy - xy^2 would cancel for needles, and the square
    // of a large covariance overflow.
    let (a64, b64) = (widen(a), widen(b));
    let (low_pass, aa, bb) = (f64::from(LOW_PASS), a64.length_squared(), b64.length_squared());
    let own_det = a64.cross(b64).length_squared();
    let det = own_det + low_pass * (aa + bb + low_pass);
    let conic = [(bb + low_pass) / det, -a64.dot(b64) / det, (aa + low_pass) / det].map(|v| v as Real);
    let variance = [aa + low_pass, bb + low_pass].map(|v| v as Real);
    let whole = det.is_finite() && conic.iter().chain(&variance).all(|v| v.is_finite());
    if !(whole && conic[0] > 0.0 && conic[2] > 0.0) {
        return Err(Unseen::Degenerate);
    }
    // c^2 = det(C) / det(C + k I): by Cayley and Hamilton, the derivative of c by C is k / (2 c det(C + k I)) times the
    // product of adj(C) and (C + k I)^-1, which cancels nothing.
    let (mut compensation, mut d_compensation) = (1.0, [0.0; 3]);
    if options.antialias {
        let c = (own_det / det).sqrt();
        let (xx, xy, yy) = ((bb + low_pass) / det, -a64.dot(b64) / det, (aa + low_pass) / det);
        let (adj_xx, adj_xy, adj_yy) = (bb, -a64.dot(b64), aa);
        let k = 0.5 * low_pass / (c * det);
        compensation = c as Real;
        d_compensation =
            [k * (adj_xx * xx + adj_xy * xy), k * (adj_xx * xy + adj_xy * yy), k * (adj_xy * xy + adj_yy * yy)]
                .map(|v| v as Real);
    }
    let conic_det = (1.0 / det) as Real;
    Ok(Ellipse {
        t,
        clamped,
        inside,
        jw,
        m,
        quat,
        quat_norm,
        scale,
        variance,
        conic,
        conic_det,
        compensation,
        d_compensation,
    })
}

fn sigmoid(logit: Real) -> Real {
    1.0 / (1.0 + (-logit).exp())
}

/// Projects a Gaussian; the error says why it cannot touch the image.
pub(crate) fn project(p: &Parameters<'_>, lens: &Lens, options: &RasterOptions) -> Result<Splat, Unseen> {
    // Infinite logits are opacities of 0 and 1.
    if p.opacity_logit.is_nan() {
        return Err(Unseen::NotFinite);
    }
    let e = ellipse(p, lens, options)?;
    let opacity = sigmoid(p.opacity_logit) * e.compensation;
    if opacity < ALPHA_MIN {
        return Err(Unseen::Transparent);
    }
    let mean = [lens.focal.x * e.t.x / e.t.z + lens.center.x, lens.focal.y * e.t.y / e.t.z + lens.center.y];
    if mean.iter().any(|m| m.abs().is_nan() || m.abs() > MEAN_MAX) {
        return Err(Unseen::Outside);
    }
    let sigma_max = (255.0 * opacity).ln();
    let extent = e.variance.map(|v| (2.0 * sigma_max * v).sqrt());
    let (w, h) = (lens.width as Real, lens.height as Real);
    let touches =
        mean[0] + extent[0] > 0.0 && mean[0] - extent[0] < w && mean[1] + extent[1] > 0.0 && mean[1] - extent[1] < h;
    if !touches {
        return Err(Unseen::Outside);
    }
    let raw = sh::color(p.sh, p.sh_degree.min(options.sh_degree), lens.direction(p.mean));
    if raw.iter().any(|c| !c.is_finite()) {
        return Err(Unseen::NotFinite);
    }
    Ok(Splat {
        mean,
        conic: e.conic,
        conic_det: e.conic_det,
        extent,
        sigma_max,
        opacity,
        log2_opacity: opacity.log2(),
        depth: e.t.z,
        color: raw.map(|c| c.max(0.0)),
        clamped: raw.map(|c| c < 0.0),
    })
}

/// d loss / d splat, summed over pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct SplatGradient {
    pub mean: [Real; 2],
    pub mean_abs: [Real; 2],
    pub conic: [Real; 3],
    pub opacity: Real,
    pub depth: Real,
    pub color: [Real; 3],
}

impl SplatGradient {
    pub fn add(&mut self, o: &Self) {
        for c in 0..2 {
            self.mean[c] += o.mean[c];
            self.mean_abs[c] += o.mean_abs[c];
        }
        for c in 0..3 {
            self.conic[c] += o.conic[c];
            self.color[c] += o.color[c];
        }
        self.opacity += o.opacity;
        self.depth += o.depth;
    }
}

/// d loss / d parameters of one Gaussian.
pub(crate) struct ParameterGradient {
    pub mean: [Real; 3],
    pub log_scale: [Real; 3],
    pub rotation: [Real; 4],
    pub opacity_logit: Real,
}

/// The chain rule through [`project`]; the gradient of the spherical harmonics is written to `d_sh`. `None` when single
/// precision does not hold the result: such a Gaussian passes no gradient.
pub(crate) fn project_backward(
    p: &Parameters<'_>,
    lens: &Lens,
    options: &RasterOptions,
    splat: &Splat,
    d: &SplatGradient,
    d_sh: &mut [Real],
) -> Option<ParameterGradient> {
    let e = ellipse(p, lens, options).ok()?;
    let mut d_color = d.color;
    for c in 0..3 {
        if splat.clamped[c] {
            d_color[c] = 0.0;
        }
    }
    let degree = p.sh_degree.min(options.sh_degree);
    let mut d_mean = sh::color_backward(p.sh, degree, lens.direction(p.mean), d_color, d_sh);

    // conic = cov^-1:  d cov = -conic^T (d conic) conic, with the off-diagonal counted once in d.conic[1].
    let [a, b, c] = splat.conic;
    let (da, db, dc) = (d.conic[0], 0.5 * d.conic[1], d.conic[2]);
    let (p00, p01) = (a * da + b * db, a * db + b * dc);
    let (p10, p11) = (b * da + c * db, b * db + c * dc);
    let mut d_cov = [-(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)];
    let own_opacity = sigmoid(p.opacity_logit);
    for (d_cov, by) in d_cov.iter_mut().zip(e.d_compensation) {
        *d_cov += d.opacity * own_opacity * by;
    }

    // cov2d = (JW) Sigma (JW)^T, Sigma = M M^T.
    let mt = e.m.transpose();
    let (ma, mb) = (mt * e.jw[0], mt * e.jw[1]);
    let (d_ma, d_mb) = (2.0 * d_cov[0] * ma + 2.0 * d_cov[1] * mb, 2.0 * d_cov[1] * ma + 2.0 * d_cov[2] * mb);
    // ma = M^T jw0: d jw0 = M d_ma; d M = jw0 d_ma^T + jw1 d_mb^T.
    let (d_jw0, d_jw1) = (e.m * d_ma, e.m * d_mb);
    let outer = |u: Vec3, v: Vec3| Mat3::from_cols(u * v.x, u * v.y, u * v.z);
    let d_m = outer(e.jw[0], d_ma) + outer(e.jw[1], d_mb);

    // jw = W^T j: d j = W d_jw.
    let (d_j0, d_j1) = (lens.rotation * d_jw0, lens.rotation * d_jw1);
    let rz = 1.0 / e.t.z;
    let (rz2, rz3) = (rz * rz, rz * rz * rz);
    let (fx, fy) = (lens.focal.x, lens.focal.y);
    let mut d_t = Vec3::ZERO;
    d_t.z += -fx * rz2 * d_j0.x - fy * rz2 * d_j1.y;
    d_t.z += 2.0 * fx * e.clamped.x * rz3 * d_j0.z + 2.0 * fy * e.clamped.y * rz3 * d_j1.z;
    if e.inside[0] {
        d_t.x -= fx * rz2 * d_j0.z;
    } else {
        d_t.z -= fx * e.clamped.x * rz3 * d_j0.z;
    }
    if e.inside[1] {
        d_t.y -= fy * rz2 * d_j1.z;
    } else {
        d_t.z -= fy * e.clamped.y * rz3 * d_j1.z;
    }
    // mean2d and depth.
    d_t.x += fx * rz * d.mean[0];
    d_t.y += fy * rz * d.mean[1];
    d_t.z += -rz2 * (fx * e.t.x * d.mean[0] + fy * e.t.y * d.mean[1]) + d.depth;
    d_mean += lens.rotation.transpose() * d_t;

    // M = R S.
    let r = Mat3::from_quat(e.quat);
    let d_scale = Vec3::new(r.x_axis.dot(d_m.x_axis), r.y_axis.dot(d_m.y_axis), r.z_axis.dot(d_m.z_axis));
    let d_r = Mat3::from_cols(d_m.x_axis * e.scale.x, d_m.y_axis * e.scale.y, d_m.z_axis * e.scale.z);
    let d_quat = quat_backward(e.quat, &d_r);
    // q / |q|: the part along q drops out.
    let q = [e.quat.w, e.quat.x, e.quat.y, e.quat.z];
    let along: Real = q.iter().zip(&d_quat).map(|(a, b)| a * b).sum();
    let rotation = [0, 1, 2, 3].map(|k| (d_quat[k] - along * q[k]) / e.quat_norm);
    let log_scale = d_scale * e.scale;
    let gradient = ParameterGradient {
        mean: d_mean.into(),
        log_scale: log_scale.into(),
        rotation,
        opacity_logit: d.opacity * splat.opacity * (1.0 - own_opacity),
    };
    let ParameterGradient { mean, log_scale, rotation, opacity_logit } = &gradient;
    let groups = [&mean[..], log_scale, rotation, &[*opacity_logit], d_sh, &d.mean, &d.mean_abs];
    let finite = groups.iter().all(|group| group.iter().all(|v| v.is_finite()));
    finite.then_some(gradient)
}

/// d loss / d (w, x, y, z) of a unit quaternion from d loss / d its rotation matrix.
fn quat_backward(q: Quat, d: &Mat3) -> [Real; 4] {
    let (w, x, y, z) = (q.w, q.x, q.y, q.z);
    // d.col(c)[r] is the gradient of R[r][c].
    let g = |r: usize, c: usize| d.col(c)[r];
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
