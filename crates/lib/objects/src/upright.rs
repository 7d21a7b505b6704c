//! Boxes around objects that stand upright and that a few floaters don't stretch.

use artifacts::Extents;
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Share of the centres that may lie beyond each side of the box: floaters and wrong labels.
pub(crate) const OUTSIDE: f64 = 0.01;
/// Directions that are tried for the footprint, over a quarter turn.
const TURNS: usize = 90;
/// Most centres that the direction is looked for with.
const SAMPLE: usize = 4096;

/// A box with sides of any direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectBox {
    /// Middle of the box.
    pub center: [f32; 3],
    /// Half the sides, along the axes.
    pub half_size: [f32; 3],
    /// Unit axes, right-handed. Of an upright box the third is up and the first the longer of the other two; of others the
    /// first is the longest.
    pub axes: [[f32; 3]; 3],
    /// Whether the third axis is what is up in the scene.
    pub upright: bool,
}

impl ObjectBox {
    /// Volume, cubic units.
    pub fn volume(&self) -> f32 {
        self.half_size.iter().map(|h| 2.0 * f64::from(*h)).product::<f64>() as f32
    }

    /// The corners: bit c of the number says which end of axis c.
    pub fn corners(&self) -> [[f32; 3]; 8] {
        let [center, x, y, z] =
            [self.center, self.axes[0], self.axes[1], self.axes[2]].map(|v| DVec3::from(v.map(f64::from)));
        let half = self.half_size.map(f64::from);
        std::array::from_fn(|i| {
            let sign = |c: usize| if i >> c & 1 == 1 { half[c] } else { -half[c] };
            (center + x * sign(0) + y * sign(1) + z * sign(2)).as_vec3().into()
        })
    }
}

/// The box around centres of Gaussians: with `up` (a unit vector) it stands upright, with the least footprint; without it
/// lies along their principal axes. Beyond each side lies at most one centre of a hundred. A box of size 0 at the origin for
/// none.
pub fn upright_box(centers: &[[f32; 3]], up: Option<DVec3>) -> ObjectBox {
    let axes = match up {
        Some(up) => upright_axes(centers, up),
        None => {
            let along = Extents::of(centers, &vec![0; centers.len()], 1).oriented[0].axes;
            along.map(|a| DVec3::from(a.map(f64::from)).normalize_or(DVec3::Z))
        }
    };
    let sides = axes.map(|axis| inner(&mut along(centers.iter(), axis)));
    let half = sides.map(|(low, high)| 0.5 * (high - low));
    let mut order = [0, 1, 2];
    let sorted = if up.is_some() { 2 } else { 3 };
    order[..sorted].sort_by(|&a, &b| half[b].total_cmp(&half[a]));
    let center: DVec3 = (0..3).map(|c| axes[c] * 0.5 * (sides[c].0 + sides[c].1)).sum();
    let [x, y, z] = order.map(|c| axes[c]);
    // Right-handed again after the change of order; a box is the same with an axis turned round.
    let y = if x.cross(y).dot(z) < 0.0 { -y } else { y };
    ObjectBox {
        center: center.as_vec3().into(),
        half_size: order.map(|c| half[c] as f32),
        axes: [x, y, z].map(|a| a.as_vec3().into()),
        upright: up.is_some(),
    }
}

/// Coordinates along an axis.
fn along<'a>(centers: impl Iterator<Item = &'a [f32; 3]>, axis: DVec3) -> Vec<f64> {
    centers.map(|p| DVec3::from(p.map(f64::from)).dot(axis)).collect()
}

/// The ends of values without the outermost on each side.
fn inner(values: &mut [f64]) -> (f64, f64) {
    let Some(last) = values.len().checked_sub(1) else { return (0.0, 0.0) };
    let skip = (OUTSIDE * last as f64).floor() as usize;
    let low = *values.select_nth_unstable_by(skip, f64::total_cmp).1;
    let high = *values.select_nth_unstable_by(last - skip, f64::total_cmp).1;
    (low, high)
}

/// Two level axes and up, such that the footprint is the least of all directions tried.
fn upright_axes(centers: &[[f32; 3]], up: DVec3) -> [DVec3; 3] {
    let step = centers.len().div_ceil(SAMPLE).max(1);
    let (e, f) = up.any_orthonormal_pair();
    let (u, v) = (along(centers.iter().step_by(step), e), along(centers.iter().step_by(step), f));
    let turned = |turn: usize| {
        let (sin, cos) = (turn as f64 / TURNS as f64 * std::f64::consts::FRAC_PI_2).sin_cos();
        (sin, cos)
    };
    let area = |turn: &usize| {
        let (sin, cos) = turned(*turn);
        let side = |a: f64, b: f64| {
            let mut values: Vec<f64> = u.iter().zip(&v).map(|(u, v)| a * u + b * v).collect();
            let (low, high) = inner(&mut values);
            high - low
        };
        side(cos, sin) * side(-sin, cos)
    };
    let areas: Vec<f64> = (0..TURNS).map(|t| area(&t)).collect();
    let best = (0..TURNS).min_by(|&a, &b| areas[a].total_cmp(&areas[b])).unwrap_or(0);
    let (sin, cos) = turned(best);
    let frame = DMat3::from_cols(e * cos + f * sin, f * cos - e * sin, up);
    [frame.x_axis, frame.y_axis, frame.z_axis]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Points on a grid through a box of these half sides, turned and moved.
    fn filled(half: DVec3, turn: DQuat, to: DVec3) -> Vec<[f32; 3]> {
        let steps = || (0..=20).map(|i| f64::from(i) / 10.0 - 1.0);
        let mut all = Vec::new();
        for x in steps() {
            for y in steps() {
                all.extend(steps().map(|z| (turn * (half * DVec3::new(x, y, z)) + to).as_vec3().to_array()));
            }
        }
        all
    }

    fn close(a: &[f32; 3], b: DVec3, within: f64) -> bool {
        (DVec3::from(a.map(f64::from)) - b).length() < within
    }

    #[test]
    fn an_upright_box_is_that_of_the_turned_thing() {
        let up = DVec3::new(0.1, 0.2, -0.9).normalize();
        let stand = DQuat::from_rotation_arc(DVec3::Z, up);
        for degrees in [0.0f64, 20.0, 45.0, 77.0] {
            let turn = stand * DQuat::from_rotation_z(degrees.to_radians());
            let (half, to) = (DVec3::new(1.0, 2.0, 3.0), DVec3::new(5.0, -6.0, 7.0));
            let b = upright_box(&filled(half, turn, to), Some(up));
            assert!(b.upright && close(&b.center, to, 1e-4), "{b:?}");
            // The longer level side first; the third axis is up.
            assert!(close(&b.half_size, DVec3::new(2.0, 1.0, 3.0), 0.1), "{b:?}");
            assert!(close(&b.axes[2], up, 1e-6));
            let long = DVec3::from(b.axes[0].map(f64::from));
            assert!(long.dot(turn * DVec3::Y).abs() > 0.999, "{b:?}");
            let [x, y, z] = b.axes.map(|a| DVec3::from(a.map(f64::from)));
            assert!(x.cross(y).dot(z) > 0.999);
            assert!((b.volume() - 8.0 * b.half_size.iter().product::<f32>()).abs() < 1e-3);
        }
    }

    #[test]
    fn floaters_do_not_stretch_the_box() {
        let mut points = filled(DVec3::ONE, DQuat::IDENTITY, DVec3::ZERO);
        let clean = upright_box(&points, Some(DVec3::Z));
        // Less than one of a hundred, on one side.
        points.extend((0..80).map(|i| [100.0 + i as f32, 300.0, -50.0]));
        let stretched = upright_box(&points, Some(DVec3::Z));
        for c in 0..3 {
            assert!((stretched.half_size[c] - clean.half_size[c]).abs() < 0.11, "{stretched:?} {clean:?}");
        }
    }

    #[test]
    fn without_up_the_longest_side_is_first() {
        let turn = DQuat::from_rotation_x(0.4) * DQuat::from_rotation_y(1.0);
        let b = upright_box(&filled(DVec3::new(1.0, 3.0, 2.0), turn, DVec3::ZERO), None);
        assert!(!b.upright && close(&b.half_size, DVec3::new(3.0, 2.0, 1.0), 0.05), "{b:?}");
        assert!(DVec3::from(b.axes[0].map(f64::from)).dot(turn * DVec3::Y).abs() > 0.999);
    }

    #[test]
    fn corners_are_where_the_sides_meet() {
        let b = upright_box(&filled(DVec3::new(1.0, 2.0, 3.0), DQuat::IDENTITY, DVec3::ONE), Some(DVec3::Z));
        let corners = b.corners();
        for c in 0..3 {
            let (low, high) = (corners.iter().map(|p| p[c]), corners.iter().map(|p| p[c]));
            let (low, high) = (low.fold(f32::MAX, f32::min), high.fold(f32::MIN, f32::max));
            let half = [1.0, 2.0, 3.0][c];
            assert!((low - (1.0 - half)).abs() < 0.01 && (high - (1.0 + half)).abs() < 0.01, "{corners:?}");
        }
    }

    #[test]
    fn one_centre_or_none_has_a_box_without_size() {
        for up in [None, Some(DVec3::Y)] {
            let one = upright_box(&[[1.0, 2.0, 3.0]], up);
            assert!(close(&one.center, DVec3::new(1.0, 2.0, 3.0), 1e-5), "{one:?}");
            assert_eq!((one.half_size, one.volume()), ([0.0; 3], 0.0));
            assert_eq!(upright_box(&[], up).center, [0.0; 3]);
        }
    }
}
