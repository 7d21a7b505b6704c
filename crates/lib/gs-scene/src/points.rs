//! Points in space: the nearest of them, and those farthest from each other.

mod farthest;
mod kdtree;

pub use farthest::{Sample, farthest_points};
pub use kdtree::{KdTree, distance};

#[cfg(test)]
mod testing {
    use proptest::prelude::{Strategy, prop};
    use std::ops::Range;

    /// Random, planar, gridded, duplicated, collinear and far-flung point sets.
    pub(super) fn points(size: Range<usize>) -> impl Strategy<Value = Vec<[f32; 3]>> {
        let coordinates = prop::collection::vec(prop::array::uniform3(-2f32..2.0), size);
        (coordinates, 0u8..6).prop_map(|(mut points, kind)| {
            for (i, p) in points.iter_mut().enumerate() {
                match kind {
                    1 => p[2] = 0.5,
                    2 => *p = p.map(|v| (v * 2.0).round()),
                    3 => *p = p.map(f32::round),
                    4 => *p = [p[0], 2.0 * p[0], -p[0]],
                    5 if i % 7 == 0 => *p = p.map(|v| v * 1e15),
                    5 => *p = p.map(|v| v * 1e-12),
                    _ => {}
                }
            }
            points
        })
    }
}
