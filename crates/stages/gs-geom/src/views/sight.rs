//! What a camera sees.

use super::grid::scales;
use super::matter::Matter;
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
/// A Gaussian is seen well where a pixel at its distance is at most this share of the box's diagonal, over the picture's
/// shorter side in pixels: as if the box were 3.3 times as large as the picture. Or where its own middle standard deviation is
/// this many pixels of a picture of 480 lines: what was learnt from far is large. On scenes of this project photographs show a
/// box 1.5 to 8 times as large as they are, and the median Gaussian as 1 to 6 pixels.
const COARSEST: f64 = 0.3;
const LARGE: f64 = 3.0;
const LINES: f64 = 480.0;

/// Sets of the Gaussians that count, one bit each.
pub type Bits = Vec<u64>;

/// The scene as cameras look at it.
pub struct Eye<'a> {
    pub gaussians: &'a Gaussians,
    pub options: &'a RasterOptions,
    pub matter: &'a Matter,
    /// Centres of the Gaussians that count.
    pub centres: &'a [DVec3],
}

/// A camera that may be chosen.
pub struct Candidate {
    pub camera: Camera,
    pub sight: Sight,
}

/// What a picture shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Sight {
    /// The Gaussians that count and that it shows well.
    pub seen: Bits,
    /// How many of those that count it shows, well or from too far.
    pub shown: usize,
}

impl Eye<'_> {
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
        let (mut seen, mut shown) = (vec![0u64; self.centres.len().div_ceil(64)], 0);
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        let coarsest = COARSEST * self.matter.diagonal();
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
            shown += 1;
            let size = middle(scales(self.gaussians, self.matter.counted[i] as usize));
            let farthest = coarsest.max(size * LINES / LARGE) * camera.fx / w.min(h);
            if z <= farthest {
                seen[i / 64] |= 1 << (i % 64);
            }
        }
        Sight { seen, shown }
    }
}

/// The second of three numbers by size.
fn middle(v: DVec3) -> f64 {
    v.element_sum() - v.max_element() - v.min_element()
}

/// The members of a set, ascending.
pub fn members(bits: &[u64]) -> impl Iterator<Item = usize> {
    bits.iter().enumerate().flat_map(|(word, &bits)| {
        std::iter::successors((bits != 0).then_some(bits), |b| Some(b & (b - 1)).filter(|b| *b != 0))
            .map(move |b| 64 * word + b.trailing_zeros() as usize)
    })
}
