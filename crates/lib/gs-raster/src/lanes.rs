//! Projection and harmonics of many Gaussians side by side, as loops that the compiler may turn into vectors of the processor
//! at hand. They use what IEEE rounds one way only, so that all processors give the same bits.

use crate::dropped::Unseen;
use crate::project::{ParameterGradient, Parameters, Projected, Splat, SplatGradient, project, project_backward};
use crate::sh;
use crate::types::RasterOptions;
use gs_scene::{Gaussians, sh_coefficients};
use multiversion::multiversion;

pub(crate) use crate::project::Lens;

/// Gaussians side by side.
pub(crate) const LANES: usize = 32;

type Lane = [f32; LANES];

/// Parameters, Gaussian after Gaussian within each. Lanes that are not set hold anything, and give anything.
#[derive(Default)]
struct Inputs {
    mean: [Lane; 3],
    log_scale: [Lane; 3],
    rotation: [Lane; 4],
    opacity_logit: Lane,
}

impl Inputs {
    #[inline(always)]
    fn set(&mut self, l: usize, g: &Gaussians, i: usize) {
        for k in 0..3 {
            self.mean[k][l] = g.means[i][k];
            self.log_scale[k][l] = g.log_scales[i][k];
        }
        for k in 0..4 {
            self.rotation[k][l] = g.rotations[i][k];
        }
        self.opacity_logit[l] = g.opacity_logits[i];
    }

    #[inline(always)]
    fn mean(&self, l: usize) -> [f64; 3] {
        [0, 1, 2].map(|k| f64::from(self.mean[k][l]))
    }

    #[inline(always)]
    fn get(&self, l: usize) -> Parameters {
        Parameters {
            mean: self.mean(l),
            log_scale: [0, 1, 2].map(|k| f64::from(self.log_scale[k][l])),
            rotation: [0, 1, 2, 3].map(|k| f64::from(self.rotation[k][l])),
            opacity_logit: f64::from(self.opacity_logit[l]),
        }
    }
}

#[derive(Default)]
struct Outputs {
    unseen: Lane,
    mean: [Lane; 2],
    conic: [Lane; 3],
    conic_det: Lane,
    extent: [Lane; 2],
    sigma_max: Lane,
    opacity: Lane,
    log2_opacity: Lane,
    depth: Lane,
}

impl Outputs {
    fn splat(&self, l: usize) -> Splat {
        Splat {
            mean: [0, 1].map(|k| self.mean[k][l]),
            conic: [0, 1, 2].map(|k| self.conic[k][l]),
            conic_det: self.conic_det[l],
            extent: [0, 1].map(|k| self.extent[k][l]),
            sigma_max: self.sigma_max[l],
            opacity: self.opacity[l],
            log2_opacity: self.log2_opacity[l],
            depth: self.depth[l],
            color: [0.0; 3],
            clamped: [false; 3],
        }
    }
}

/// Projects the Gaussians `range`, in pieces of [`LANES`] at most, and calls `seen` for those that are drawn, `unseen` for the
/// others.
pub(crate) fn project_range(
    g: &Gaussians,
    range: std::ops::Range<usize>,
    lens: &Lens,
    options: &RasterOptions,
    mut seen: impl FnMut(usize, Splat),
    mut unseen: impl FnMut(Unseen),
) {
    let degree = g.sh_degree.min(options.sh_degree);
    let (mut inputs, mut outputs, mut basis) = (Inputs::default(), Outputs::default(), Basis::default());
    let mut first = range.start;
    while first < range.end {
        let count = LANES.min(range.end - first);
        for l in 0..count {
            inputs.set(l, g, first + l);
        }
        project_lanes(&inputs, lens, options, &mut outputs);
        basis_lanes(&inputs, lens, degree, &mut basis);
        for l in 0..count {
            if let Some(reason) = Unseen::of(f64::from(outputs.unseen[l])) {
                unseen(reason);
                continue;
            }
            let sh = g.sh_of(first + l);
            let mut color = [0.5f32; 3];
            for (b, sh) in basis[..sh_coefficients(degree)].iter().zip(sh.chunks_exact(3)) {
                for c in 0..3 {
                    color[c] += b[l] * sh[c];
                }
            }
            if color.iter().all(|c| c.is_finite()) {
                let splat = outputs.splat(l);
                seen(first + l, Splat { color: color.map(|c| c.max(0.0)), clamped: color.map(|c| c < 0.0), ..splat });
            } else {
                unseen(Unseen::NotFinite);
            }
        }
        first += count;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn project_lanes(p: &Inputs, lens: &Lens, options: &RasterOptions, out: &mut Outputs) {
    for l in 0..LANES {
        let Projected { unseen, mean, conic, conic_det, extent, sigma_max, opacity, log2_opacity, depth } =
            project(&p.get(l), lens, options);
        out.unseen[l] = unseen as f32;
        for k in 0..2 {
            out.mean[k][l] = mean[k] as f32;
            out.extent[k][l] = extent[k] as f32;
        }
        for k in 0..3 {
            out.conic[k][l] = conic[k] as f32;
        }
        out.conic_det[l] = conic_det as f32;
        out.sigma_max[l] = sigma_max as f32;
        out.opacity[l] = opacity as f32;
        out.log2_opacity[l] = log2_opacity as f32;
        out.depth[l] = depth as f32;
    }
}

/// Values of the harmonics' basis.
type Basis = [Lane; 16];

fn basis_lanes(p: &Inputs, lens: &Lens, degree: u8, out: &mut Basis) {
    // Loops without branches for each degree.
    match degree {
        0 => basis_of::<0>(p, lens, out),
        1 => basis_of::<1>(p, lens, out),
        2 => basis_of::<2>(p, lens, out),
        _ => basis_of::<3>(p, lens, out),
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn basis_of<const DEGREE: u8>(p: &Inputs, lens: &Lens, out: &mut Basis) {
    for l in 0..LANES {
        let b = sh::basis(DEGREE, sh::unit(lens.direction(p.mean(l))).0);
        for k in 0..const { sh_coefficients(DEGREE) } {
            out[k][l] = b[k] as f32;
        }
    }
}

/// d loss / d splats side by side, and what the chain rule makes of them.
#[derive(Default)]
pub(crate) struct Backward {
    inputs: Inputs,
    basis: Basis,
    mean2d: [Lane; 2],
    conic: [Lane; 3],
    opacity: Lane,
    depth: Lane,
    color: [Lane; 3],
    /// Per basis function: sum over channels of coefficient times d loss / d colour.
    weights: Basis,
    out: ParameterLanes,
}

#[derive(Default)]
struct ParameterLanes {
    mean: [Lane; 3],
    log_scale: [Lane; 3],
    rotation: [Lane; 4],
    opacity_logit: Lane,
}

/// d loss / d parameters of one Gaussian, but for its harmonics.
pub(crate) struct Row {
    pub mean: [f32; 3],
    pub log_scale: [f32; 3],
    pub rotation: [f32; 4],
    pub opacity_logit: f32,
}

impl Backward {
    /// Puts Gaussian `i`, drawn as `splat`, into lane `l`.
    pub fn set(&mut self, l: usize, g: &Gaussians, i: usize, degree: u8, splat: &Splat, d: &SplatGradient) {
        self.inputs.set(l, g, i);
        for k in 0..2 {
            self.mean2d[k][l] = d.mean[k];
        }
        for k in 0..3 {
            self.conic[k][l] = d.conic[k];
            self.color[k][l] = if splat.clamped[k] { 0.0 } else { d.color[k] };
        }
        self.opacity[l] = d.opacity;
        self.depth[l] = d.depth;
        let color = [0, 1, 2].map(|k| self.color[k][l]);
        let mut weights = [0.0f32; 16];
        for (w, s) in weights.iter_mut().zip(g.sh_of(i)[..3 * sh_coefficients(degree)].chunks_exact(3)) {
            *w = s[0] * color[0] + s[1] * color[1] + s[2] * color[2];
        }
        for (lane, w) in self.weights.iter_mut().zip(weights) {
            lane[l] = w;
        }
    }

    /// The chain rule for all lanes.
    pub fn run(&mut self, lens: &Lens, options: &RasterOptions, degree: u8) {
        basis_lanes(&self.inputs, lens, degree, &mut self.basis);
        let mut out = std::mem::take(&mut self.out);
        match degree {
            0 => backward_of::<0>(self, lens, options, &mut out),
            1 => backward_of::<1>(self, lens, options, &mut out),
            2 => backward_of::<2>(self, lens, options, &mut out),
            _ => backward_of::<3>(self, lens, options, &mut out),
        }
        self.out = out;
    }

    /// The gradient of lane `l`; that of the harmonics goes to `d_sh`, zeros past `degree`. None where single precision does
    /// not hold it.
    pub fn get(&self, l: usize, degree: u8, d_sh: &mut [f32]) -> Option<Row> {
        let color = [0, 1, 2].map(|k| self.color[k][l]);
        let (active, rest) = d_sh.split_at_mut(3 * sh_coefficients(degree));
        let mut finite = true;
        for (d, b) in active.chunks_exact_mut(3).zip(&self.basis) {
            for c in 0..3 {
                d[c] = b[l] * color[c];
                finite &= d[c].is_finite();
            }
        }
        rest.fill(0.0);
        let o = &self.out;
        let row = Row {
            mean: [0, 1, 2].map(|k| o.mean[k][l]),
            log_scale: [0, 1, 2].map(|k| o.log_scale[k][l]),
            rotation: [0, 1, 2, 3].map(|k| o.rotation[k][l]),
            opacity_logit: o.opacity_logit[l],
        };
        let groups = [&row.mean[..], &row.log_scale, &row.rotation, &[row.opacity_logit]];
        finite &= groups.iter().all(|group| group.iter().all(|v| v.is_finite()));
        finite.then_some(row)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn backward_of<const DEGREE: u8>(p: &Backward, lens: &Lens, options: &RasterOptions, out: &mut ParameterLanes) {
    for l in 0..LANES {
        let d = SplatGradient {
            mean: [0, 1].map(|k| f64::from(p.mean2d[k][l])),
            conic: [0, 1, 2].map(|k| f64::from(p.conic[k][l])),
            opacity: f64::from(p.opacity[l]),
            depth: f64::from(p.depth[l]),
            color: [0.0; 3],
        };
        let ParameterGradient { mean, log_scale, rotation, opacity_logit } =
            project_backward(&p.inputs.get(l), lens, options, &d);
        for k in 0..3 {
            out.mean[k][l] = mean[k] as f32;
            out.log_scale[k][l] = log_scale[k] as f32;
        }
        for k in 0..4 {
            out.rotation[k][l] = rotation[k] as f32;
        }
        out.opacity_logit[l] = opacity_logit as f32;
    }
    if DEGREE > 0 {
        for l in 0..LANES {
            let weights = std::array::from_fn(|k| f64::from(p.weights[k][l]));
            let d = sh::direction_gradient(DEGREE, lens.direction(p.inputs.mean(l)), &weights);
            for k in 0..3 {
                out.mean[k][l] += d[k] as f32;
            }
        }
    }
}
