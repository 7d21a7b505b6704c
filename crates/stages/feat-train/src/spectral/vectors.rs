//! Features in closed form: leading singular vectors of the matrix of Gaussians and masks ([`super::evidence`]).
//!
//! Gaussians that share masks over many views get similar rows of the left singular vectors: it is what a spectral
//! contrastive loss converges to. The squared singular value of a vector says how many views agree with the parts that it
//! separates: it is the probability that a random walk, from a Gaussian to a mask that shows it and back, stays in its part.
//! Vectors are scaled by a smooth step in their singular values, σ^p / (σ^p + c^p): a separation that most views show counts
//! fully, one that few views show fades out. The cutoff c sets the granularity: a low one shows parts, a high one whole
//! things. (A plain power of σ, as in a diffusion map, already fades the second vector, so that all features come close to
//! the first vector, which separates nothing.)
//!
//! The vectors are computed for the masks, of which there are few: CᵀC is formed once ([`Gram`]), and its leading
//! eigenvectors come from block subspace iteration, filtered by Chebyshev polynomials (Zhou, Saad, Tiago and Chelikowsky
//! 2006), with Rayleigh-Ritz. One product with C itself then gives all Gaussians.

use super::gram::{GRAM_ENTRIES, Gram, Panel, WIDTH};
use super::linalg::{Columns, cross, multiply, orthonormalise, symmetric_eigen};
use super::sparse::Matrix;
use crate::random::normal;
use gs_io::{Error, Result};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use stage::Stage;

/// Least number of additional vectors in the iteration: they speed up convergence.
const EXTRA: usize = 16;
/// The iteration ends when the residual |CᵀC v - σ² v| of every vector, times its scale, is below this. The vectors are then
/// exact for a matrix that differs from CᵀC by no more. Singular values that are closer together than this have no unique
/// vectors.
const TOLERANCE: f64 = 1e-5;
/// The iteration also ends after this many products with CᵀC.
const MOST_PASSES: usize = 400;
/// Without `--dim`, vectors are kept whose scale is at least this share of the first one's.
const LEAST_SCALE: f64 = 1e-3;
/// A filter raises the first vector over the last by this factor at most: both must fit into the digits of f32.
const MOST_GAIN: f64 = 1e4;
/// Highest degree of a filter.
const MOST_DEGREE: f64 = 24.0;
/// Exponent p of the step that scales vectors at the cutoff: steep, but smooth.
const POWER: f64 = 16.0;

/// How many vectors, and how they are scaled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectralOptions {
    /// Vectors kept, at most.
    pub most: usize,
    /// Drop those among them whose scale does not matter.
    pub auto: bool,
    /// Singular value c at which a vector's scale is a half.
    pub cutoff: f64,
    pub seed: u64,
}

impl SpectralOptions {
    /// Scale of a vector of this singular value.
    fn scale(&self, value: f64) -> f64 {
        if value > 0.0 { 1.0 / (1.0 + (self.cutoff / value).powf(POWER)) } else { 0.0 }
    }
}

/// Features of all Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectral {
    pub dim: usize,
    /// `[n][dim]`, of unit length, or zero for Gaussians in no mask.
    pub features: Vec<f32>,
    pub found: Found,
    /// Entries of CᵀC, where it was formed.
    pub gram_entries: Option<usize>,
}

pub fn spectral(matrix: &Matrix, options: &SpectralOptions, stage: &Stage) -> Result<Spectral> {
    let gram = Gram::new(matrix, GRAM_ENTRIES.0 * matrix.entries() + GRAM_ENTRIES.1)?;
    let product = gram.as_ref().map_or(Product::Factors(matrix), Product::Formed);
    let mut found = singular_vectors(&product, matrix, options, stage)?;
    let gram_entries = gram.as_ref().map(Gram::entries);
    drop(gram);
    let scale = |j: usize| options.scale(found.values[j]);
    let mut dim = options.most.min(found.values.len());
    if options.auto {
        dim = (0..dim).take_while(|&j| scale(j) >= LEAST_SCALE * scale(0)).count();
    }
    // C v = sigma u; the row's own scale cancels when rows are normalised.
    let mut scaled = std::mem::take(&mut found.vectors);
    scaled.truncate(dim);
    for (j, vector) in scaled.iter_mut().enumerate() {
        let by = scale(j) / found.values[j].max(f64::MIN_POSITIVE);
        vector.iter_mut().for_each(|v| *v *= by);
    }
    let mut features = matrix.apply(&rows(&scaled), dim)?;
    features.par_chunks_mut(dim).with_min_len(4096).for_each(|row| {
        let length = row.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>().sqrt();
        let inverse = if length > 0.0 { 1.0 / length } else { 0.0 };
        row.iter_mut().for_each(|v| *v = (f64::from(*v) * inverse) as f32);
    });
    Ok(Spectral { dim, features, found, gram_entries })
}

/// CᵀC, to multiply by.
enum Product<'a> {
    Formed(&'a Gram),
    Factors(&'a Matrix),
}

impl Product<'_> {
    fn apply(&self, x: &[Panel]) -> Result<Vec<Panel>> {
        let one = |x: &Panel| match self {
            Self::Formed(gram) => Ok(gram.apply(x)),
            Self::Factors(matrix) => {
                let out = matrix.normal(x.as_flattened(), WIDTH)?;
                Ok(out.chunks_exact(WIDTH).map(|row| std::array::from_fn(|c| row[c] as f32)).collect())
            }
        };
        x.iter().map(one).collect()
    }
}

/// Leading right singular vectors and values, descending; each vector's largest entry is positive.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    vectors: Columns,
    pub values: Vec<f64>,
    /// Products with CᵀC that it took.
    pub passes: usize,
    /// Largest scaled residual of a vector ([`SpectralOptions`]' scale times |CᵀC v - σ² v|).
    pub residual: f64,
}

fn singular_vectors(product: &Product<'_>, matrix: &Matrix, options: &SpectralOptions, stage: &Stage) -> Result<Found> {
    let masks = matrix.masks.len();
    let all = masks.min(matrix.gaussians);
    // Whole panels: columns that fill one up cost nothing.
    let width = (options.most + EXTRA).next_multiple_of(WIDTH).min(all);
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut v: Columns = (0..width).map(|_| (0..masks).map(|_| normal(&mut rng)).collect()).collect();
    orthonormalise(&mut v);
    let mut progress = stage.progress("passes", MOST_PASSES as u64);
    let mut passes = 0;
    loop {
        stage.go_on()?;
        let (x, mut columns) = (panels(&v), v.len());
        let w = product.apply(&x)?;
        passes += 1;
        // Ritz values and vectors of CᵀC in the space of v.
        let w = from_panels(&w, columns);
        let (ritz, rotation) = symmetric_eigen(&cross(&v, &w));
        let (vectors, w) = (multiply(&v, &rotation), multiply(&w, &rotation));
        let values: Vec<f64> = ritz.iter().map(|r| r.max(0.0).sqrt()).collect();
        if values.first().is_none_or(|v| *v <= 0.0) {
            return Err(Error::new("no mask has weight on any Gaussian")
                .field("footprints")
                .hint("check --levels and the masks"));
        }
        let wanted = options.most.min(values.len());
        let residuals: Vec<f64> = (0..wanted)
            .into_par_iter()
            .map(|j| {
                let squares = vectors[j].iter().zip(&w[j]).map(|(v, w)| (w - ritz[j] * v).powi(2));
                options.scale(values[j]) * squares.sum::<f64>().sqrt()
            })
            .collect();
        let residual = residuals.into_iter().fold(0.0, f64::max);
        progress.set(passes as u64, &[("residual", residual)]);
        // Vectors of the whole space are found at once.
        let done = residual <= TOLERANCE * options.scale(values[0]) * ritz[0] || columns == all;
        if done || passes >= MOST_PASSES {
            progress.finish(&[("residual", residual)]);
            if !done {
                stage.warn(&format!("singular vectors are only good to {residual:.1e} after {passes} passes"));
            }
            let mut vectors = vectors;
            vectors.iter_mut().for_each(|c| make_positive(c));
            return Ok(Found { vectors, values, passes, residual });
        }
        columns = vectors.len();
        let (filtered, degree) = filter(product, &panels(&vectors), &panels(&w), ritz[0], ritz[columns - 1].max(0.0))?;
        passes += degree - 1;
        v = from_panels(&filtered, columns);
        orthonormalise(&mut v);
    }
}

/// A Chebyshev polynomial of CᵀC times X, small on the eigenvalues up to `low` and scaled to one at `high`; `w` is CᵀC X.
/// Also its degree.
fn filter(product: &Product<'_>, x: &[Panel], w: &[Panel], high: f64, low: f64) -> Result<(Vec<Panel>, usize)> {
    // The unwanted interval, 0 to low, is mapped to -1 to 1.
    let half = (0.5 * low).max(1e-6 * high);
    let outside = (high - half) / half;
    let degree = (MOST_GAIN.acosh() / outside.max(1.0 + 1e-9).acosh()).clamp(1.0, MOST_DEGREE) as usize;
    let first = half / (high - half);
    let mut sigma = first;
    let scaled = |w: &[Panel], x: &[Panel], by: f64, before: Option<(&[Panel], f64)>| -> Vec<Panel> {
        let (a, b) = ((by / half) as f32, by as f32);
        let mut out = w.to_vec();
        for (p, panel) in out.iter_mut().enumerate() {
            for (r, row) in panel.iter_mut().enumerate() {
                for c in 0..WIDTH {
                    let old = before.map_or(0.0, |(y, s)| s as f32 * y[p][r][c]);
                    row[c] = a * row[c] - b * x[p][r][c] - old;
                }
            }
        }
        out
    };
    let mut before = x.to_vec();
    let mut now = scaled(w, x, first, None);
    for _ in 1..degree {
        let next = 1.0 / (2.0 / first - sigma);
        let after = scaled(&product.apply(&now)?, &now, 2.0 * next, Some((&before, sigma * next)));
        (before, now, sigma) = (now, after, next);
    }
    Ok((now, degree))
}

fn make_positive(column: &mut [f64]) {
    let largest = column.iter().fold(0.0f64, |a, &b| if b.abs() > a.abs() { b } else { a });
    if largest < 0.0 {
        column.iter_mut().for_each(|v| *v = -*v);
    }
}

/// Columns to panels; what is left of the last one is zero.
fn panels(columns: &Columns) -> Vec<Panel> {
    let panel = |columns: &[Vec<f64>]| {
        let mut out = vec![[0.0; WIDTH]; columns[0].len()];
        for (c, column) in columns.iter().enumerate() {
            out.iter_mut().zip(column).for_each(|(row, &v)| row[c] = v as f32);
        }
        out
    };
    columns.par_chunks(WIDTH).map(panel).collect()
}

/// The first `count` columns of panels.
fn from_panels(panels: &[Panel], count: usize) -> Columns {
    (0..count)
        .into_par_iter()
        .map(|j| panels[j / WIDTH].iter().map(|row| f64::from(row[j % WIDTH])).collect())
        .collect()
}

/// Columns to `[rows][columns]`.
fn rows(columns: &Columns) -> Vec<f32> {
    let count = columns.first().map_or(0, Vec::len);
    (0..count).flat_map(|i| columns.iter().map(move |c| c[i] as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectral::testing::{dense, random};

    fn options() -> SpectralOptions {
        SpectralOptions { most: 6, auto: false, cutoff: 1e-6, seed: 3 }
    }

    #[test]
    fn agrees_with_a_dense_decomposition() {
        let m = random(150, 40);
        let c = dense(&m);
        let (squares, right) = symmetric_eigen(&cross(&c, &c));
        let s = spectral(&m, &options(), &Stage::silent("test")).unwrap();
        assert_eq!(s.gram_entries, Some(1600));
        for j in 0..6 {
            assert!((s.found.values[j] - squares[j].sqrt()).abs() < 1e-5, "{j}: {s:?}");
        }
        // Features, up to the signs of vectors, which their scalar products do not know.
        let u = multiply(&c, &right[..6].to_vec());
        let dot = |f: &dyn Fn(usize, usize) -> f64, a, b| (0..6).map(|j| f(a, j) * f(b, j)).sum::<f64>();
        let exact = |i: usize, j: usize| u[j][i] / squares[j].sqrt();
        let found = |i: usize, j: usize| f64::from(s.features[i * 6 + j]);
        for a in (0..150).step_by(7) {
            let b = (a * 31 + 11) % 150;
            let cosine = dot(&exact, a, b) / (dot(&exact, a, a) * dot(&exact, b, b)).sqrt();
            assert!((dot(&found, a, b) - cosine).abs() < 2e-3, "{a} {b}: {cosine} {}", dot(&found, a, b));
        }
    }

    #[test]
    fn more_vectors_than_masks_and_equal_results_on_any_threads() {
        let m = random(60, 5);
        let wide = SpectralOptions { most: 64, auto: true, cutoff: 0.5, ..options() };
        let s = spectral(&m, &wide, &Stage::silent("test")).unwrap();
        assert!(s.dim <= 5 && s.dim >= 1);
        let big = random(9000, 30);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| spectral(&big, &wide, &Stage::silent("test")).unwrap())
        };
        assert!(with(1) == with(3));
    }

    #[test]
    fn the_formed_product_and_its_factors_find_the_same() {
        let m = random(3000, 200);
        let o = SpectralOptions { most: 20, auto: false, cutoff: 0.05, seed: 1 };
        let silent = Stage::silent("test");
        let gram = Gram::new(&m, usize::MAX).unwrap().unwrap();
        let formed = singular_vectors(&Product::Formed(&gram), &m, &o, &silent).unwrap();
        let factors = singular_vectors(&Product::Factors(&m), &m, &o, &silent).unwrap();
        let c = dense(&m);
        let (squares, right) = symmetric_eigen(&cross(&c, &c));
        for found in [formed, factors] {
            assert!(found.vectors.len() < 200 && found.residual <= TOLERANCE && found.passes < 100);
            for j in 0..20 {
                assert!((found.values[j] - squares[j].sqrt()).abs() < 1e-5, "{j}");
                let cosine: f64 = found.vectors[j].iter().zip(&right[j]).map(|(a, b)| a * b).sum();
                assert!(cosine.abs() > 0.99, "{j}: {cosine}");
            }
        }
    }
}
