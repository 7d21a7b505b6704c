//! The order in which points are best kept in memory.

/// Bits of a coordinate in a code: 2,097,152 cells along the longest side, so a stray point far outside costs the others little.
const BITS: u32 = 21;

/// Indices of the points along a Morton curve over the bounding box of the finite ones; ties by index. Points that are near
/// in it are near in space, so a pass over what lies together touches memory that lies together.
pub fn morton_order(points: &[[f32; 3]]) -> Vec<u32> {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    for p in points.iter().filter(|p| p.iter().all(|v| v.is_finite())) {
        for c in 0..3 {
            low[c] = low[c].min(f64::from(p[c]));
            high[c] = high[c].max(f64::from(p[c]));
        }
    }
    let extent = (0..3).map(|c| high[c] - low[c]).fold(0.0, f64::max);
    let scale = if extent > 0.0 { f64::from((1u32 << BITS) - 1) / extent } else { 0.0 };
    let code = |p: &[f32; 3]| {
        (0..3).fold(0, |code, c| {
            // A number that is not finite is cut to the nearest cell.
            let cell = (((f64::from(p[c]) - low[c]) * scale) as u64).min((1 << BITS) - 1);
            code | spread(cell) << c
        })
    };
    let mut order: Vec<(u64, u32)> = points.iter().map(code).zip(0..).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// Moves bit k of a number below 2^21 to bit 3k.
fn spread(cell: u64) -> u64 {
    let mut x = cell;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn equal_points_stay_and_corners_come_in_turn() {
        let points = [[1.0, 1.0, 1.0], [0.0; 3], [1.0, 0.0, 0.0], [0.0; 3]];
        assert_eq!(morton_order(&points), [1, 3, 2, 0]);
        assert_eq!(morton_order(&[]), [0u32; 0]);
        assert_eq!(morton_order(&[[3.0; 3]; 3]), [0, 1, 2]);
        let odd = [[f32::NAN; 3], [f32::INFINITY; 3], [0.0; 3], [1.0, 0.0, 0.0]];
        let mut all = morton_order(&odd);
        all.sort_unstable();
        assert_eq!(all, [0, 1, 2, 3]);
    }

    proptest! {
        #[test]
        fn bits_are_spread_one_by_one(cell in 0u64..1 << BITS) {
            let slow = (0..BITS).fold(0, |code, bit| code | (cell >> bit & 1) << (3 * bit));
            prop_assert_eq!(spread(cell), slow);
        }

        #[test]
        fn the_order_permutes_and_brings_neighbours_together(
            points in proptest::collection::vec(proptest::array::uniform3(-3f32..5.0), 400)
        ) {
            let mut order = morton_order(&points);
            let path = |order: &[u32]| -> f32 {
                let at = |i: u32| glam::Vec3::from(points[i as usize]);
                order.windows(2).map(|w| at(w[0]).distance(at(w[1]))).sum()
            };
            let as_given: Vec<u32> = (0..400).collect();
            prop_assert!(path(&order) < 0.5 * path(&as_given));
            order.sort_unstable();
            prop_assert_eq!(order, as_given);
        }
    }
}
