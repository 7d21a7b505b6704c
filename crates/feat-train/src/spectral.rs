//! Features in closed form: leading singular vectors of the matrix of Gaussians and masks ([`crate::evidence`]).
//!
//! Gaussians that share masks over many views get similar rows of the left singular vectors: it is what a spectral
//! contrastive loss converges to. A vector's squared singular value says how well what it separates holds together: how
//! much of a random walk from a Gaussian to a mask that shows it, and back, stays there. Vectors are scaled by a smooth
//! step in their singular values, σ^p / (σ^p + c^p): what holds together counts fully, what only few views separate fades
//! out. The cutoff c is a knob of granularity: low shows parts, high whole things. (A plain power of σ, as in a diffusion
//! map, fades the second vector already, and everything comes to lie near the first, which tells nothing apart.)
//!
//! The vectors come from block subspace iteration with Rayleigh-Ritz on the side of the masks, of which there are few.

use crate::evidence::Matrix;
use crate::linalg::{Columns, cross, multiply, orthonormalise, symmetric_eigen};
use crate::model::normal;
use gs_io::{Error, Result};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use stage::Stage;

/// Vectors carried beyond those asked for: they speed up convergence.
const EXTRA: usize = 16;
/// The iteration ends when no wanted vector's scale changes by more than this share of the first one's: vectors that are
/// faded out need not converge.
const TOLERANCE: f64 = 1e-6;
/// Or after this many products with the matrix and its transpose.
const MOST_PASSES: usize = 200;
/// `--dim auto` keeps vectors whose scale is at least this share of the first one's.
const LEAST_SCALE: f64 = 1e-3;

/// How many vectors, and how they are scaled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectralOptions {
    /// Vectors kept, at most.
    pub most: usize,
    /// Drop those among them whose scale does not matter.
    pub auto: bool,
    /// Singular value c at which a vector's scale is a half.
    pub cutoff: f64,
    /// Steepness p of the step.
    pub power: f64,
    /// Seed of the starting vectors.
    pub seed: u64,
}

impl SpectralOptions {
    /// Scale of a vector of this singular value.
    fn scale(&self, value: f64) -> f64 {
        if value > 0.0 { 1.0 / (1.0 + (self.cutoff / value).powf(self.power)) } else { 0.0 }
    }
}

/// Features of all Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectral {
    /// Numbers per Gaussian.
    pub dim: usize,
    /// `[n][dim]`, of unit length, or zero for Gaussians in no mask.
    pub features: Vec<f32>,
    /// Singular values found, descending; at least `dim`.
    pub singular_values: Vec<f64>,
    /// Products with the matrix and its transpose that it took.
    pub passes: usize,
}

/// Computes the features.
///
/// # Errors
/// When there is no evidence, or the stage was interrupted.
pub fn spectral(matrix: &Matrix, options: &SpectralOptions, stage: &Stage) -> Result<Spectral> {
    let (vectors, values, passes) = right_singular_vectors(matrix, options, stage)?;
    let scale = |j: usize| options.scale(values[j]);
    let mut dim = options.most.min(values.len());
    if options.auto {
        dim = (0..dim).take_while(|&j| scale(j) >= LEAST_SCALE * scale(0)).count();
    }
    // C v = sigma u; the row's own scale cancels when rows are normalised.
    let scaled: Columns = (0..dim)
        .map(|j| vectors[j].iter().map(|v| v * scale(j) / values[j].max(f64::MIN_POSITIVE)).collect())
        .collect();
    let mut features = matrix.apply(&rows(&scaled), dim);
    features.par_chunks_mut(dim).for_each(|row| {
        let length = row.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>().sqrt();
        let inverse = if length > 0.0 { 1.0 / length } else { 0.0 };
        row.iter_mut().for_each(|v| *v = (f64::from(*v) * inverse) as f32);
    });
    Ok(Spectral { dim, features, singular_values: values, passes })
}

/// Leading right singular vectors and values, descending; each vector's largest entry is positive.
fn right_singular_vectors(
    matrix: &Matrix,
    options: &SpectralOptions,
    stage: &Stage,
) -> Result<(Columns, Vec<f64>, usize)> {
    let masks = matrix.masks.len();
    let width = (options.most + EXTRA).min(masks).min(matrix.gaussians);
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut v: Columns = (0..width).map(|_| (0..masks).map(|_| normal(&mut rng)).collect()).collect();
    orthonormalise(&mut v);
    let mut values: Vec<f64> = Vec::new();
    let mut progress = stage.progress("passes", MOST_PASSES as u64);
    for pass in 1..=MOST_PASSES {
        if stage.interrupted() {
            return Err(Error::new("interrupted"));
        }
        let p = v.len();
        let w = columns(&matrix.apply_transposed(matrix.apply(&rows(&v), p), p), p);
        // Ritz values and vectors of CᵀC in the space of v.
        let (ritz, rotation) = symmetric_eigen(&cross(&v, &w));
        let found: Vec<f64> = ritz.iter().map(|r| r.max(0.0).sqrt()).collect();
        let wanted = options.most.min(found.len());
        let scale = |values: &[f64], j: usize| values.get(j).map_or(0.0, |v| options.scale(*v));
        let change = (0..wanted).map(|j| (scale(&found, j) - scale(&values, j)).abs()).fold(0.0, f64::max);
        values = found;
        progress.set(pass as u64, &[("change", change)]);
        if change <= TOLERANCE * scale(&values, 0) || p == masks.min(matrix.gaussians) && pass > 1 {
            progress.finish(&[("change", change)]);
            let mut vectors = multiply(&v, &rotation);
            vectors.iter_mut().for_each(|c| make_positive(c));
            if values.first().is_none_or(|v| *v <= 0.0) {
                break;
            }
            return Ok((vectors, values, pass));
        }
        v = multiply(&w, &rotation);
        orthonormalise(&mut v);
        if pass == MOST_PASSES {
            stage.warn(&format!("singular values still change by {change:.1e} after {pass} passes"));
            v.iter_mut().for_each(|c| make_positive(c));
            values.truncate(v.len());
            return Ok((v, values, pass));
        }
    }
    Err(Error::new("the masks say nothing about any Gaussian").field("footprints").hint("check --levels and the masks"))
}

fn make_positive(column: &mut [f64]) {
    let largest = column.iter().fold(0.0f64, |a, &b| if b.abs() > a.abs() { b } else { a });
    if largest < 0.0 {
        column.iter_mut().for_each(|v| *v = -*v);
    }
}

/// Columns to `[rows][columns]`.
fn rows(columns: &Columns) -> Vec<f32> {
    let count = columns.first().map_or(0, Vec::len);
    (0..count).flat_map(|i| columns.iter().map(move |c| c[i] as f32)).collect()
}

/// `[rows][p]` to columns.
fn columns(rows: &[f64], p: usize) -> Columns {
    (0..p).map(|j| rows.iter().skip(j).step_by(p).copied().collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evidence::tests::{dense, random};

    fn options() -> SpectralOptions {
        SpectralOptions { most: 6, auto: false, cutoff: 1e6, power: 1.0, seed: 3 }
    }

    #[test]
    fn agrees_with_a_dense_decomposition() {
        for smooth in [false, true] {
            let m = random(150, 40, smooth);
            let c = dense(&m);
            let (squares, right) = symmetric_eigen(&cross(&c, &c));
            let s = spectral(&m, &options(), &Stage::silent("test")).unwrap();
            for j in 0..6 {
                assert!((s.singular_values[j] - squares[j].sqrt()).abs() < 1e-5, "{j}: {s:?}");
            }
            // Features, up to the signs of vectors, which their scalar products do not know.
            let u = multiply(&c, &right[..6].to_vec());
            let dot = |f: &dyn Fn(usize, usize) -> f64, a, b| (0..6).map(|j| f(a, j) * f(b, j)).sum::<f64>();
            let exact = |i: usize, j: usize| u[j][i];
            let found = |i: usize, j: usize| f64::from(s.features[i * 6 + j]);
            for a in (0..150).step_by(7) {
                let b = (a * 31 + 11) % 150;
                let cosine = dot(&exact, a, b) / (dot(&exact, a, a) * dot(&exact, b, b)).sqrt();
                assert!((dot(&found, a, b) - cosine).abs() < 2e-3, "{a} {b}: {cosine} {}", dot(&found, a, b));
            }
        }
    }

    #[test]
    fn more_vectors_than_masks_and_equal_results_on_any_threads() {
        let m = random(60, 5, true);
        let wide = SpectralOptions { most: 64, auto: true, cutoff: 0.5, power: 16.0, ..options() };
        let s = spectral(&m, &wide, &Stage::silent("test")).unwrap();
        assert!(s.dim <= 5 && s.dim >= 1);
        let big = random(9000, 30, true);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| spectral(&big, &wide, &Stage::silent("test")).unwrap())
        };
        assert!(with(1) == with(3));
    }
}
