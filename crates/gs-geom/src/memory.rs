//! How much memory a run will take, told before it does.
//!
//! The terms are counted from the sizes of the arrays that live at the same time; docs/geometry-memory.md holds them
//! against measured peaks.

use gs_scene::sh_coefficients;
use serde::Serialize;
use stage::Bytes;

/// The program itself, its threads' stacks and the allocator's slack.
const BASE: u64 = 10 << 20;
/// Per pixel in training: render with alpha 16, target 12, gradient 12, three maps of SSIM 36.
const PER_PIXEL: u64 = 76;
/// Per pixel of a photograph's file while it is decoded: 8-bit and f32 RGB.
const PER_DECODED_PIXEL: u64 = 15;
/// Per pixel while it is shrunk: f32 RGB, once for the pixels of new width and old height, twice for the result.
const PER_SHRUNK_PIXEL: u64 = 12;
/// Per tile that a drawn Gaussian touches: its entry in the tile's list and in the Gaussian's, and its gradient.
const PER_TILE: u64 = 56;
/// Per Gaussian in a step, besides its gradient: what the renderer keeps of those it draws, and their lists.
const PER_DRAWN: u64 = 200;
/// Numbers of a Gaussian besides its spherical harmonics: centre, scales, quaternion, opacity.
const PLAIN_NUMBERS: u64 = 11;

/// What a run's peak memory is made of, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Forecast {
    /// Photographs kept decoded.
    pub photographs: u64,
    /// Photographs on their way from the file into memory.
    pub decoding: u64,
    /// Whether that happens in training too, and not only before it.
    pub decodes_again: bool,
    /// Pictures of one iteration.
    pub pictures: u64,
    /// Lists of the tiles' Gaussians and their gradients, of the views tried.
    pub tiles: u64,
    /// Per Gaussian.
    pub per_gaussian: u64,
}

/// What is known before a run of how large it will be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sizes {
    /// Photographs that are kept decoded, bytes.
    pub photographs: u64,
    /// Pixels of the largest view.
    pub pixels: u64,
    /// Width of the widest view.
    pub width: u64,
    /// Width and height of the largest photograph's file.
    pub file: (u32, u32),
    /// How many tiles the Gaussians of a view touch, all told.
    pub tile_entries: u64,
    /// Photographs decoded at once.
    pub threads: usize,
    /// Whether some photographs are not kept and decoded again in training.
    pub decodes_again: bool,
    /// Degree of the spherical harmonics.
    pub sh_degree: u8,
    /// Whether the number of Gaussians may change.
    pub densifies: bool,
}

impl Forecast {
    /// For a run of these sizes.
    pub fn new(sizes: &Sizes) -> Self {
        let numbers = 4 * (PLAIN_NUMBERS + 3 * sh_coefficients(sizes.sh_degree) as u64);
        // Parameters, two moments and pulls. Beside them in a step: the gradient with that of the projected centre, and
        // the drawn Gaussians. Densification, at the end of a step, copies the parameters and each moment in turn, and the
        // allocator does not give all of it back: half as much again was measured.
        let copy = if sizes.densifies { numbers * 3 / 2 } else { 0 };
        let (state, step) = (3 * numbers + 8, numbers + 16 + PER_DRAWN + copy);
        let (w, h) = (u64::from(sizes.file.0), u64::from(sizes.file.1));
        let shrunk = PER_SHRUNK_PIXEL * (sizes.width * h + 2 * sizes.pixels);
        Self {
            photographs: sizes.photographs,
            decoding: sizes.threads as u64 * (PER_DECODED_PIXEL * w * h + shrunk),
            decodes_again: sizes.decodes_again,
            pictures: PER_PIXEL * sizes.pixels,
            tiles: PER_TILE * sizes.tile_entries,
            per_gaussian: state + step,
        }
    }

    /// What comes and goes. The allocator keeps what decoding took, in pieces into which the pictures and tiles of training
    /// fit only in part: half of the lesser comes on top, as measured.
    pub fn scratch(&self) -> u64 {
        let training = self.pictures + self.tiles;
        if self.decodes_again {
            return self.decoding + training;
        }
        self.decoding.max(training) + self.decoding.min(training) / 2
    }

    /// Peak memory with so many Gaussians, bytes.
    pub fn peak(&self, gaussians: usize) -> Bytes {
        Bytes(
            (BASE + self.photographs + self.scratch())
                .saturating_add(self.per_gaussian.saturating_mul(gaussians as u64)),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_terms_are_those_of_the_arrays() {
        let sizes = Sizes {
            photographs: 6_000_000,
            pixels: 500_000,
            width: 1000,
            file: (2000, 1000),
            tile_entries: 0,
            threads: 2,
            decodes_again: false,
            sh_degree: 3,
            densifies: false,
        };
        let decoding = 2 * (15 * 2_000_000 + 12 * (1_000_000 + 2 * 500_000));
        assert_eq!(Forecast::new(&sizes).decoding, decoding);
        // Few tiles: decoding needs more at once; many: training does. Of the lesser, half counts.
        let gaussians = 1000 * (3 * 236 + 8 + 236 + 16 + PER_DRAWN);
        assert_eq!(Forecast::new(&sizes).peak(1000), Bytes(BASE + 6_000_000 + decoding + 19_000_000 + gaussians));
        let again = Sizes { decodes_again: true, ..sizes };
        assert_eq!(Forecast::new(&again).scratch(), decoding + 38_000_000);
        let many = Sizes { tile_entries: 5_000_000, ..sizes };
        let densifying = Sizes { densifies: true, ..sizes };
        assert_eq!(Forecast::new(&densifying).per_gaussian, Forecast::new(&sizes).per_gaussian + 354);
        let training = 38_000_000 + 56 * 5_000_000;
        assert_eq!(Forecast::new(&many).peak(1000), Bytes(BASE + 6_000_000 + training + decoding / 2 + gaussians));
    }

    #[test]
    fn a_gaussian_costs_at_least_its_arrays() {
        use crate::checkpoint::start;
        use crate::optimiser::zeros;
        for sh_degree in 0..=3 {
            let n = 1000;
            let state = start(zeros(n, sh_degree), 0);
            let bytes = |g: &gs_scene::Gaussians| {
                size_of_val(&g.means[..])
                    + size_of_val(&g.log_scales[..])
                    + size_of_val(&g.rotations[..])
                    + size_of_val(&g.opacity_logits[..])
                    + size_of_val(&g.sh[..])
            };
            let pull = size_of_val(&state.pull.sum[..]) + size_of_val(&state.pull.views[..]);
            // Parameters, moments, pulls, and the gradient of a step.
            let known = bytes(&state.gaussians) * 2 + bytes(&state.adam.first) + bytes(&state.adam.second) + pull;
            let sizes = Sizes {
                photographs: 0,
                pixels: 0,
                width: 0,
                file: (0, 0),
                tile_entries: 0,
                threads: 1,
                decodes_again: false,
                sh_degree,
                densifies: false,
            };
            let told = Forecast::new(&sizes).per_gaussian * n as u64;
            assert!(told >= known as u64 && told < 2 * known as u64, "degree {sh_degree}: {told} of {known}");
        }
    }
}
