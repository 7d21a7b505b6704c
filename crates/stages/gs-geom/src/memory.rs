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
        Self {
            photographs: sizes.photographs,
            decoding: sizes.threads as u64 * decoding(sizes.pixels, sizes.width, sizes.file),
            decodes_again: sizes.decodes_again,
            pictures: PER_PIXEL * sizes.pixels,
            tiles: 0,
            per_gaussian: state + step,
        }
    }

    /// The same where the Gaussians of a view touch so many tiles, all told.
    #[must_use]
    pub fn with_tiles(self, entries: u64) -> Self {
        Self { tiles: PER_TILE * entries, ..self }
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

/// What a photograph of a file of `size` takes on its way to a view of `pixels` and `width`.
fn decoding(pixels: u64, width: u64, size: (u32, u32)) -> u64 {
    let (w, h) = (u64::from(size.0), u64::from(size.1));
    PER_DECODED_PIXEL * w * h + PER_SHRUNK_PIXEL * (width * h + 2 * pixels)
}

/// What the program takes for itself where it does not train.
const PROGRAM: u64 = 5_000_000;

/// Peak in bytes of `inspect` and `convert`, for a file of so many bytes: it and its Gaussians at the same time.
pub fn of_file(geometry: u64) -> u64 {
    PROGRAM + 23 * geometry / 10
}

/// Peak in bytes of `convert` that gives so many Gaussians bands that they did not have.
pub fn of_bands(gaussians: usize, from: u8, to: u8) -> u64 {
    let numbers = |degree: u8| PLAIN_NUMBERS + 3 * sh_coefficients(degree) as u64;
    PROGRAM + 4 * gaussians as u64 * (numbers(from) + numbers(to))
}

/// Peak in bytes of `render` with views of `pixels`.
pub fn of_renders(geometry: u64, pixels: u64, exr: bool) -> u64 {
    let pictures = if exr { 74 * pixels } else { 28 * pixels };
    of_file(geometry).max(PROGRAM + 9 * geometry / 5 + pictures)
}

/// Peak in bytes of `eval` with views of `pixels` and `width`, from photographs of `size`.
pub fn of_figures(geometry: u64, pixels: u64, width: u64, size: (u32, u32)) -> u64 {
    let measuring = PROGRAM + 9 * geometry / 5 + 50 * pixels;
    of_file(geometry).max(PROGRAM + geometry + decoding(pixels, width, size)).max(measuring)
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
        let densifying = Sizes { densifies: true, ..sizes };
        assert_eq!(Forecast::new(&densifying).per_gaussian, Forecast::new(&sizes).per_gaussian + 354);
        let training = 38_000_000 + 56 * 5_000_000;
        assert_eq!(
            Forecast::new(&sizes).with_tiles(5_000_000).peak(1000),
            Bytes(BASE + 6_000_000 + training + decoding / 2 + gaussians)
        );
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
                threads: 1,
                decodes_again: false,
                sh_degree,
                densifies: false,
            };
            let told = Forecast::new(&sizes).per_gaussian * n as u64;
            assert!(told >= known as u64 && told < 2 * known as u64, "degree {sh_degree}: {told} of {known}");
        }
    }
    #[test]
    fn the_other_commands_are_within_a_fifth_of_measured_peaks() {
        let within = |told: u64, peak: u64| {
            let ratio = told as f64 / peak as f64;
            assert!((0.8..1.2).contains(&ratio), "{told} for {peak}: {ratio}");
        };
        // The desk of photographs with 57,000 Gaussians, eight and twenty times as many; at an eighth, 640 and all pixels.
        let (file, [eighth, half, full]) = ((1906, 1070), [31_892, 229_760, 2_039_420]);
        for (geometry, peak) in [(14_222_243, 33_587_200), (113_757_540, 231_055_360), (284_389_477, 569_585_664)] {
            within(of_file(geometry), peak);
        }
        for (geometry, pixels, exr, peak) in [
            (14_222_243, eighth, false, 35_328_000),
            (14_222_243, half, true, 44_998_656),
            (14_222_243, full, false, 86_933_504),
            (14_222_243, full, true, 181_792_768),
            (113_757_540, full, true, 308_899_840),
            (284_389_477, full, false, 601_141_248),
        ] {
            within(of_renders(geometry, pixels, exr), peak);
        }
        for (geometry, (pixels, width), peak) in [
            (14_222_243, (eighth, 238), 57_516_032),
            (14_222_243, (half, 640), 60_440_576),
            (14_222_243, (full, 1906), 117_760_000),
            (113_757_540, (full, 1906), 291_893_248),
            (284_389_477, (full, 1906), 581_943_296),
        ] {
            within(of_figures(geometry, pixels, width, file), peak);
        }
        within(of_bands(908_540, 0, 3), 271_938_000);
    }
}
