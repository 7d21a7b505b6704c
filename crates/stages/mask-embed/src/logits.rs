//! How sure a mask is of each pixel, kept where it matters.

use crate::regions::Patch;
use crate::sam::{Embedded, Sam};

/// The part of the decoder's square that shows the photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Width and height of the photograph in these pixels; up to a pixel less.
    pub extent: [f64; 2],
}

impl Grid {
    /// That of an encoded photograph.
    pub fn of(embedded: &Embedded) -> Self {
        let [w, h] = embedded.extent.map(|e| (e.ceil() as usize).clamp(1, Sam::MASK_SIDE));
        Self { width: w, height: h, extent: embedded.extent }
    }

    /// The pixel at a point, `x` and `y` in 0..1 of width and height.
    pub fn index(&self, [x, y]: [f64; 2]) -> usize {
        let column = ((x * self.extent[0]) as usize).min(self.width - 1);
        let row = ((y * self.extent[1]) as usize).min(self.height - 1);
        row * self.width + column
    }
}

/// Logits of a mask within the box of its pixels and one pixel around. Further out no logit is positive, nor is any
/// number interpolated between two of them, so that [`Self::enlarge`] needs no more; most masks are much smaller than
/// the picture, and there are thousands.
#[derive(Debug, Clone)]
pub struct Logits {
    /// First column and row, one past the last column and row.
    bounds: [usize; 4],
    values: Vec<f32>,
}

impl Logits {
    /// Keeps what is needed of `row(y)`, the logits of each row of the grid. `bounds` is the box of the positive ones: first
    /// column and row, one past the last column and row.
    pub fn new<'a>(row: impl Fn(usize) -> &'a [f32], grid: &Grid, bounds: [usize; 4]) -> Self {
        let [x0, y0, x1, y1] = bounds;
        let (left, top) = (x0.saturating_sub(1), y0.saturating_sub(1));
        let (right, bottom) = ((x1 + 1).min(grid.width), (y1 + 1).min(grid.height));
        // No more room than that: there are thousands of masks.
        let mut values = Vec::with_capacity((right - left) * bottom.saturating_sub(top));
        (top..bottom).for_each(|y| values.extend_from_slice(&row(y)[left..right]));
        Self { bounds: [left, top, right, bottom], values }
    }

    /// The mask in a picture of another size: pixels where the linearly interpolated logits are positive.
    pub fn enlarge(&self, grid: &Grid, width: usize, height: usize) -> Patch {
        let [left, top, right, bottom] = self.bounds;
        let within = |taps: Vec<Taps>, first: usize, end: usize| {
            let skipped = taps.iter().take_while(|t| t.0 < first).count();
            (skipped, taps.into_iter().skip(skipped).take_while(|t| t.1 < end).collect::<Vec<_>>())
        };
        let (x, columns) = within(taps(width, grid.extent[0], grid.width), left, right);
        let (y, rows) = within(taps(height, grid.extent[1], grid.height), top, bottom);
        let mut mask = Vec::with_capacity(columns.len() * rows.len());
        for (y0, y1, fy) in rows {
            let row = |y: usize| &self.values[(y - top) * (right - left)..][..right - left];
            let (above, below) = (row(y0), row(y1));
            mask.extend(columns.iter().map(|&(x0, x1, fx)| {
                let (x0, x1) = (x0 - left, x1 - left);
                let a = above[x0] + (above[x1] - above[x0]) * fx;
                let b = below[x0] + (below[x1] - below[x0]) * fx;
                a + (b - a) * fy > 0.0
            }));
        }
        Patch { x, y, width: columns.len(), mask }
    }
}

/// Two neighbours and the weight of the second.
pub(crate) type Taps = (usize, usize, f32);

/// Those of each of `n` pixels that `extent` pixels of the grid are enlarged to; the grid has `last` pixels.
pub(crate) fn taps(n: usize, extent: f64, last: usize) -> Vec<Taps> {
    (0..n)
        .map(|i| {
            let at = ((i as f64 + 0.5) / n as f64 * extent - 0.5).clamp(0.0, (last - 1) as f64);
            let low = at.floor() as usize;
            (low, (low + 1).min(last - 1), (at - low as f64) as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nms::Pixels;
    use proptest::prelude::*;

    /// [`Logits::enlarge`] with all logits at hand.
    fn enlarge_whole(logits: &[f32], grid: &Grid, width: usize, height: usize) -> Vec<bool> {
        let columns = taps(width, grid.extent[0], grid.width);
        let rows = taps(height, grid.extent[1], grid.height);
        let at = |x: usize, y: usize| logits[y * grid.width + x];
        let mix = |a: f32, b: f32, f: f32| a + (b - a) * f;
        rows.iter()
            .flat_map(|&(y0, y1, fy)| {
                columns.iter().map(move |&(x0, x1, fx)| {
                    mix(mix(at(x0, y0), at(x1, y0), fx), mix(at(x0, y1), at(x1, y1), fx), fy) > 0.0
                })
            })
            .collect()
    }

    proptest! {
        #[test]
        fn nothing_is_lost_beyond_the_box(
            (w, h) in (1usize..12, 1usize..9),
            (width, height) in (1usize..40, 1usize..30),
            shift in 0.0f32..3.0,
            noise in prop::collection::vec(-4.0f32..3.0, 12 * 9),
            short in 0.0f64..0.9,
        ) {
            let grid = Grid { width: w, height: h, extent: [w as f64 - short, h as f64 - short] };
            let logits: Vec<f32> = noise[..w * h].iter().map(|v| v - shift).collect();
            let pixels = Pixels::new(w, logits.iter().map(|&l| l > 0.0));
            let cut = Logits::new(|y| &logits[y * w..(y + 1) * w], &grid, pixels.bounds);
            prop_assert!(cut.values.len() <= logits.len());
            let patch = cut.enlarge(&grid, width, height);
            let mut whole = vec![false; width * height];
            patch.pixels().for_each(|(x, y)| whole[y * width + x] = true);
            prop_assert_eq!(whole, enlarge_whole(&logits, &grid, width, height));
        }
    }
}
