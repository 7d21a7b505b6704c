//! What a camera sees.

use super::grid::scales;
use super::matter::{Matter, median};
use glam::DVec3;
use gs_raster::{RasterOptions, Rendered, render};
use gs_scene::{Camera, Gaussians};

/// Accumulated alpha from which a pixel shows matter.
const SHOWN: f32 = 0.5;
/// Nearer than this share of the box's diagonal is before the lens, not in the scene; and how many of the pixels may be.
const BEFORE_LENS: f64 = 0.04;
const MOST_BEFORE_LENS: f64 = 0.02;
/// Least share of the pixels that show matter.
const LEAST_SHOWN: f64 = 0.02;
/// A Gaussian is hidden where its centre lies behind the mean depth of its pixel by more than this share of that depth, and
/// this many cubes.
const BEHIND: (f64, f64) = (0.02, 1.0);
/// A Gaussian is seen well where the picture's shorter side shows no more than this at its distance, in diagonals of the box, if
/// its middle standard deviation is the median one; of others in proportion to theirs, but from the first to the second of these
/// limits. Gaussians are small where photographs were near and there was much to see, so renders go near there too.
const WIDEST: f64 = 0.5;
const LIMITS: (f64, f64) = (0.1, 2.0);

/// Sets of the Gaussians that count, one bit each.
pub type Bits = Vec<u64>;

/// The scene as cameras look at it.
pub struct Eye<'a> {
    pub gaussians: &'a Gaussians,
    pub options: &'a RasterOptions,
    pub matter: &'a Matter,
    /// Centres of the Gaussians that count.
    pub centres: &'a [DVec3],
    /// How much the picture's shorter side may show at the distance of each of them, world units.
    pub widest: Vec<f64>,
}

/// A camera that may be chosen.
pub struct Candidate {
    pub camera: Camera,
    pub sight: Sight,
}

/// What a picture shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Sight {
    /// The Gaussians that count and that it shows, well or from too far.
    pub shown: Bits,
    /// Those that it shows well.
    pub seen: Bits,
}

impl<'a> Eye<'a> {
    /// The scene of Gaussians of which these centres count.
    pub fn new(gaussians: &'a Gaussians, options: &'a RasterOptions, matter: &'a Matter, centres: &'a [DVec3]) -> Self {
        let sizes: Vec<f64> = matter.counted.iter().map(|&i| middle(scales(gaussians, i as usize))).collect();
        let (median, diagonal) = (median(sizes.clone()), matter.diagonal());
        let widest = |size: f64| (WIDEST * size / median).clamp(LIMITS.0, LIMITS.1) * diagonal;
        Self { gaussians, options, matter, centres, widest: sizes.into_iter().map(widest).collect() }
    }

    /// What a camera sees, judged by a picture of a quarter of its size; none where something is before the lens or next to
    /// nothing is to be seen.
    pub fn look(&self, camera: Camera) -> Option<Candidate> {
        let small = camera.resized((camera.width / 4).max(1), (camera.height / 4).max(1));
        let rendered =
            render(self.gaussians, &small, &RasterOptions { sh_degree: 0, depth: true, ..self.options.clone() });
        if !self.is_good(&rendered) {
            return None;
        }
        let sight = self.sight(&small, &rendered);
        Some(Candidate { camera, sight })
    }

    /// Whether a picture shows the scene and nothing is before the lens.
    pub fn is_good(&self, rendered: &Rendered) -> bool {
        let pixels = rendered.alpha.len() as f64;
        let near = BEFORE_LENS * self.matter.diagonal();
        let (mut shown, mut before) = (0, 0);
        for (&a, &d) in rendered.alpha.iter().zip(&rendered.depth) {
            shown += usize::from(a >= SHOWN);
            before += usize::from(a >= SHOWN && f64::from(d / a) < near);
        }
        shown as f64 >= LEAST_SHOWN * pixels && before as f64 <= MOST_BEFORE_LENS * pixels
    }

    /// What a picture shows: Gaussians that are in it and not hidden; well, those that are near enough.
    pub fn sight(&self, camera: &Camera, rendered: &Rendered) -> Sight {
        let [mut shown, mut seen] = [(); 2].map(|()| vec![0u64; self.centres.len().div_ceil(64)]);
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        for (i, &centre) in self.centres.iter().enumerate() {
            let (u, v, z) = camera.project(centre);
            if z < f64::from(self.options.near) || u < 0.0 || v < 0.0 || u >= w || v >= h {
                continue;
            }
            let pixel = v as usize * camera.width as usize + u as usize;
            let alpha = rendered.alpha[pixel];
            let depth = f64::from(rendered.depth[pixel] / alpha);
            let hidden = alpha >= SHOWN && z > depth * (1.0 + BEHIND.0) + BEHIND.1 * self.matter.grid.side;
            if hidden {
                continue;
            }
            shown[i / 64] |= 1 << (i % 64);
            if z <= self.widest[i] * camera.fx / w.min(h) {
                seen[i / 64] |= 1 << (i % 64);
            }
        }
        Sight { shown, seen }
    }
}

/// The second of three numbers by size.
fn middle(v: DVec3) -> f64 {
    v.element_sum() - v.max_element() - v.min_element()
}

/// How many members a set has.
pub fn count(bits: &[u64]) -> usize {
    bits.iter().map(|b| b.count_ones() as usize).sum()
}

/// The members of a set, ascending.
pub fn members(bits: &[u64]) -> impl Iterator<Item = usize> {
    bits.iter().enumerate().flat_map(|(word, &bits)| {
        std::iter::successors((bits != 0).then_some(bits), |b| Some(b & (b - 1)).filter(|b| *b != 0))
            .map(move |b| 64 * word + b.trailing_zeros() as usize)
    })
}
