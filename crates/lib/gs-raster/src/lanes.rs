//! Projection and harmonics of many Gaussians side by side, as loops that the compiler may turn into vectors of the processor
//! at hand. They use what IEEE rounds one way only, so that all processors give the same bits.

use crate::dropped::Dropped;
use crate::project::{Lens, Parameters, Projected, Splat, SplatGradient, parameters, project, project_backward};
use crate::sh;
use crate::types::RasterOptions;
use gs_scene::{Gaussians, sh_coefficients};
use multiversion::multiversion;

/// Gaussians side by side. Lanes that are not set hold anything, and give anything.
pub(crate) const LANES: usize = 32;

type Lane = [f32; LANES];

/// Sets lane `l` of each value.
#[inline(always)]
fn set<const N: usize>(lanes: &mut [Lane; N], l: usize, values: [f32; N]) {
    for k in 0..N {
        lanes[k][l] = values[k];
    }
}

/// Lane `l` of each value. (A loop: calls of `from_fn` or `map` keep the loops over lanes from becoming vectors.)
#[inline(always)]
fn get<const N: usize>(lanes: &[Lane; N], l: usize) -> [f32; N] {
    let mut values = [0.0; N];
    for k in 0..N {
        values[k] = lanes[k][l];
    }
    values
}

/// Lane `l` of each value, in double precision.
#[inline(always)]
fn wide<const N: usize>(lanes: &[Lane; N], l: usize) -> [f64; N] {
    let mut values = [0.0; N];
    for k in 0..N {
        values[k] = f64::from(lanes[k][l]);
    }
    values
}

/// Sets lane `l` of each value, rounded to single precision.
#[inline(always)]
fn round<const N: usize>(lanes: &mut [Lane; N], l: usize, values: [f64; N]) {
    for k in 0..N {
        lanes[k][l] = values[k] as f32;
    }
}

/// Projects the Gaussians `range`, in pieces of [`LANES`] at most, and calls `seen` for those that are drawn; the others are
/// counted.
pub(crate) fn project_range(
    g: &Gaussians,
    range: std::ops::Range<usize>,
    lens: &Lens,
    options: &RasterOptions,
    dropped: &mut Dropped,
    mut seen: impl FnMut(usize, Splat),
) {
    let degree = g.sh_degree.min(options.sh_degree);
    let (mut inputs, mut outputs, mut basis) = ([[0.0; LANES]; 11], [[0.0; LANES]; 13], Basis::default());
    for first in range.clone().step_by(LANES) {
        let count = LANES.min(range.end - first);
        for l in 0..count {
            set(&mut inputs, l, parameters(g, first + l));
        }
        project_lanes(&inputs, lens, options, &mut outputs);
        basis_lanes(&inputs, lens, degree, &mut basis);
        for l in 0..count {
            let unseen = outputs[0][l] as usize;
            if unseen > 0 {
                dropped.count(unseen);
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
                seen(first + l, Splat::new(get(&outputs, l), color));
            } else {
                dropped.not_finite += 1;
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn project_lanes(p: &Parameters<Lane>, lens: &Lens, options: &RasterOptions, out: &mut Projected<Lane>) {
    for l in 0..LANES {
        round(out, l, project(&wide(p, l), lens, options));
    }
}

/// Values of the harmonics' basis.
type Basis = [Lane; 16];

fn basis_lanes(p: &Parameters<Lane>, lens: &Lens, degree: u8, out: &mut Basis) {
    // Loops without branches for each degree.
    match degree {
        0 => basis_of::<0>(p, lens, out),
        1 => basis_of::<1>(p, lens, out),
        2 => basis_of::<2>(p, lens, out),
        _ => basis_of::<3>(p, lens, out),
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn basis_of<const DEGREE: u8>(p: &Parameters<Lane>, lens: &Lens, out: &mut Basis) {
    for l in 0..LANES {
        let b = sh::basis(DEGREE, sh::unit(lens.direction(&wide(p, l))).0);
        for k in 0..const { sh_coefficients(DEGREE) } {
            out[k][l] = b[k] as f32;
        }
    }
}

/// d loss / d splats side by side, and what the chain rule makes of them.
#[derive(Default)]
pub(crate) struct Backward {
    inputs: Parameters<Lane>,
    basis: Basis,
    /// Of the splats: mean, conic, opacity, depth.
    ellipse: [Lane; 7],
    color: [Lane; 3],
    /// Per basis function: sum over channels of coefficient times d loss / d colour.
    weights: Basis,
    out: Parameters<Lane>,
}

impl Backward {
    /// Puts Gaussian `i`, drawn as `splat`, into lane `l`.
    pub fn set(&mut self, l: usize, g: &Gaussians, i: usize, degree: u8, splat: &Splat, d: &SplatGradient) {
        set(&mut self.inputs, l, parameters(g, i));
        let ([x, y], [xx, xy, yy]) = (d.mean, d.conic);
        set(&mut self.ellipse, l, [x, y, xx, xy, yy, d.opacity, d.depth]);
        let color = std::array::from_fn(|k| if splat.clamped[k] { 0.0 } else { d.color[k] });
        set(&mut self.color, l, color);
        let sh = g.sh_of(i)[..3 * sh_coefficients(degree)].chunks_exact(3);
        for (lane, s) in self.weights.iter_mut().zip(sh) {
            lane[l] = s[0] * color[0] + s[1] * color[1] + s[2] * color[2];
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

    /// d loss / d parameters of lane `l`; those of the harmonics go to `d_sh`, zeros past `degree`. None where single precision
    /// does not hold them.
    pub fn get(&self, l: usize, degree: u8, d_sh: &mut [f32]) -> Option<Parameters<f32>> {
        let color = get(&self.color, l);
        let (active, rest) = d_sh.split_at_mut(3 * sh_coefficients(degree));
        let mut finite = true;
        for (d, b) in active.chunks_exact_mut(3).zip(&self.basis) {
            for c in 0..3 {
                d[c] = b[l] * color[c];
                finite &= d[c].is_finite();
            }
        }
        rest.fill(0.0);
        let row = get(&self.out, l);
        finite &= row.iter().all(|v| v.is_finite());
        finite.then_some(row)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn backward_of<const DEGREE: u8>(p: &Backward, lens: &Lens, options: &RasterOptions, out: &mut Parameters<Lane>) {
    for l in 0..LANES {
        let [x, y, xx, xy, yy, opacity, depth] = wide(&p.ellipse, l);
        let d = SplatGradient { mean: [x, y], conic: [xx, xy, yy], opacity, depth, color: [0.0; 3] };
        round(out, l, project_backward(&wide(&p.inputs, l), lens, options, &d));
    }
    if DEGREE > 0 {
        for l in 0..LANES {
            let direction = lens.direction(&wide(&p.inputs, l));
            let d = sh::direction_gradient(DEGREE, direction, &wide(&p.weights, l));
            for k in 0..3 {
                out[k][l] += d[k] as f32;
            }
        }
    }
}
