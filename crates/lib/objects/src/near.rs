//! What is seen of one thing around, under and over another.

use glam::{DVec2, DVec3};

/// Where to look: a footprint and heights.
pub(crate) struct Around {
    /// Level axes of the footprint, with their half sides.
    pub axes: [(DVec2, f64); 2],
    /// Its middle.
    pub middle: DVec2,
    /// Bottom and top.
    pub heights: (f64, f64),
    /// Distance within which things touch.
    pub touch: f64,
    /// How far around the footprint to look.
    pub margin: f64,
}

/// Cells along a side of the footprint.
const GRID: usize = 3;
/// Fewest Gaussians on a side or in a direction.
const FEWEST: u32 = 2;

/// What is there of another thing.
pub(crate) struct Near {
    /// Gaussians at the height of the foot in each quarter of the footprint and around it.
    foot: [u32; 4],
    /// Sum of their distances from that height.
    foot_gaps: f64,
    /// Gaussians at the height of the middle in each of eight directions.
    level: [u32; 8],
    /// Lowest Gaussian above each cell of the footprint.
    above: [f64; Near::CELLS],
}

impl Near {
    /// Cells of a footprint.
    pub const CELLS: usize = GRID * GRID;

    /// Looks through the Gaussians of the other: two level coordinates and the height of each.
    pub fn new(a: &Around, points: &[DVec3]) -> Self {
        let mut near = Self { foot: [0; 4], foot_gaps: 0.0, level: [0; 8], above: [f64::INFINITY; Self::CELLS] };
        let (low, high) = a.heights;
        let (middle, band) = (0.5 * (low + high), 0.25 * (high - low));
        let [(x, width), (y, depth)] = a.axes;
        for p in points {
            let offset = p.truncate() - a.middle;
            let (u, v) = (offset.dot(x), offset.dot(y));
            let (beyond_u, beyond_v) = (u.abs() - width, v.abs() - depth);
            if (p.z - low).abs() <= a.touch && beyond_u.max(beyond_v) <= a.margin {
                near.foot[usize::from(u > 0.0) + 2 * usize::from(v > 0.0)] += 1;
                near.foot_gaps += (p.z - low).abs();
            }
            if (p.z - middle).abs() <= band {
                let turn = v.atan2(u) / std::f64::consts::TAU + 0.5;
                near.level[(8.0 * turn) as usize % 8] += 1;
            }
            if p.z > high + a.touch && beyond_u.max(beyond_v) < 0.0 {
                let cell = |at: f64, half: f64| ((0.5 * (at / half + 1.0) * GRID as f64) as usize).min(GRID - 1);
                let lowest = &mut near.above[cell(u, width) + GRID * cell(v, depth)];
                *lowest = lowest.min(p.z);
            }
        }
        near
    }

    /// Quarters of the foot's surroundings, of four, in which the other is seen at the height of the foot.
    pub fn foot_sides(&self) -> usize {
        self.foot.iter().filter(|n| **n >= FEWEST).count()
    }

    /// Mean distance of what is seen there from that height.
    pub fn foot_gap(&self) -> f64 {
        self.foot_gaps / f64::from(self.foot.iter().sum::<u32>().max(1))
    }

    /// Directions, of eight, in which the other is seen at the height of the middle.
    pub fn directions(&self) -> usize {
        self.level.iter().filter(|n| **n >= FEWEST).count()
    }

    /// Height of the other above a cell of the footprint.
    pub fn above(&self, cell: usize) -> Option<f64> {
        Some(self.above[cell]).filter(|h| h.is_finite())
    }
}
