//! Size and place of instances, from the centres of their Gaussians.

use crate::instances::OrientedBox;
use glam::{DMat3, DVec3};

/// Size and place of all instances; K of them. Those without a Gaussian have zeros.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Extents {
    /// Number of Gaussians; K.
    pub count: Vec<u32>,
    /// Mean of their centres; K.
    pub centroid: Vec<[f32; 3]>,
    /// Lower corner of the axis-aligned box around their centres; K.
    pub bbox_min: Vec<[f32; 3]>,
    /// Upper corner of that box; K.
    pub bbox_max: Vec<[f32; 3]>,
    /// Box around their centres along their principal axes; K.
    pub oriented: Vec<OrientedBox>,
}

impl Extents {
    /// Measures `instances` instances from the centres of all Gaussians, `[N][3]`, and the instance of each, -1 for none.
    pub fn of(means: &[[f32; 3]], labels: &[i32], instances: usize) -> Self {
        let mut out = Self {
            count: vec![0; instances],
            bbox_min: vec![[f32::INFINITY; 3]; instances],
            bbox_max: vec![[f32::NEG_INFINITY; 3]; instances],
            ..Self::default()
        };
        let mut sums = vec![[0.0f64; 3]; instances];
        for (p, &label) in means.iter().zip(labels) {
            let Ok(k) = usize::try_from(label) else { continue };
            out.count[k] += 1;
            for c in 0..3 {
                sums[k][c] += f64::from(p[c]);
                out.bbox_min[k][c] = out.bbox_min[k][c].min(p[c]);
                out.bbox_max[k][c] = out.bbox_max[k][c].max(p[c]);
            }
        }
        out.centroid = sums.iter().zip(&out.count).map(|(s, &n)| s.map(|v| (v / f64::from(n.max(1))) as f32)).collect();
        for k in (0..instances).filter(|&k| out.count[k] == 0) {
            (out.bbox_min[k], out.bbox_max[k]) = ([0.0; 3], [0.0; 3]);
        }
        out.oriented = oriented_boxes(means, labels, &out.centroid);
        out
    }
}

/// Boxes along the principal axes of the centres of each instance.
fn oriented_boxes(means: &[[f32; 3]], labels: &[i32], centroid: &[[f32; 3]]) -> Vec<OrientedBox> {
    let k = centroid.len();
    let offset = |p: &[f32; 3], k: usize| DVec3::from(p.map(f64::from)) - DVec3::from(centroid[k].map(f64::from));
    let members = || means.iter().zip(labels).filter_map(|(p, &l)| Some((p, usize::try_from(l).ok()?)));
    let mut spread = vec![DMat3::ZERO; k];
    for (p, label) in members() {
        let d = offset(p, label);
        spread[label] += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let axes: Vec<DMat3> = spread.into_iter().map(principal_axes).collect();
    let (mut low, mut high) = (vec![DVec3::INFINITY; k], vec![DVec3::NEG_INFINITY; k]);
    for (p, label) in members() {
        let along = axes[label].transpose() * offset(p, label);
        low[label] = low[label].min(along);
        high[label] = high[label].max(along);
    }
    (0..k)
        .map(|i| {
            let (low, high) = if low[i].x <= high[i].x { (low[i], high[i]) } else { (DVec3::ZERO, DVec3::ZERO) };
            let center = DVec3::from(centroid[i].map(f64::from)) + axes[i] * (low + high) * 0.5;
            // The longest side first, and right-handed.
            let half = (high - low) * 0.5;
            let mut order = [0, 1, 2];
            order.sort_by(|&a, &b| half[b].total_cmp(&half[a]));
            let [x, y] = [axes[i].col(order[0]), axes[i].col(order[1])];
            OrientedBox {
                center: center.as_vec3().into(),
                axes: [x, y, x.cross(y)].map(|a| a.as_vec3().into()),
                half_size: order.map(|c| half[c] as f32),
            }
        })
        .collect()
}

/// Eigenvectors of a symmetric matrix, as columns, by Jacobi's rotations.
fn principal_axes(mut m: DMat3) -> DMat3 {
    let mut axes = DMat3::IDENTITY;
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = m.col(q)[p];
            if off.abs() <= 1e-15 * (m.col(p)[p].abs() + m.col(q)[q].abs()) {
                continue;
            }
            let theta = 0.5 * (2.0 * off).atan2(m.col(q)[q] - m.col(p)[p]);
            let (sin, cos) = theta.sin_cos();
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = cos;
            turn.col_mut(q)[q] = cos;
            turn.col_mut(p)[q] = -sin;
            turn.col_mut(q)[p] = sin;
            m = turn.transpose() * m * turn;
            axes *= turn;
        }
    }
    axes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oriented_boxes_follow_what_they_hold() {
        // A bar of 8 x 4 x 2, turned.
        let turn = glam::DQuat::from_rotation_z(0.5) * glam::DQuat::from_rotation_x(0.3);
        let corner = |i: i32| {
            DVec3::new([-4.0, 4.0][i as usize & 1], [-2.0, 2.0][i as usize >> 1 & 1], [-1.0, 1.0][i as usize >> 2])
        };
        let means: Vec<[f32; 3]> = (0..8).map(|i| (turn * corner(i) + DVec3::splat(7.0)).as_vec3().into()).collect();
        let b = Extents::of(&means, &[0; 8], 2).oriented;
        for c in 0..3 {
            assert!((b[0].half_size[c] - [4.0, 2.0, 1.0][c]).abs() < 1e-5, "{:?}", b[0]);
            assert!((b[0].center[c] - 7.0).abs() < 1e-5);
            let expected = turn * DVec3::AXES[c];
            assert!(DVec3::from(b[0].axes[c].map(f64::from)).dot(expected).abs() > 1.0 - 1e-6);
        }
        let x = DVec3::from(b[0].axes[0].map(f64::from)).cross(DVec3::from(b[0].axes[1].map(f64::from)));
        assert!(x.dot(DVec3::from(b[0].axes[2].map(f64::from))) > 0.999);
        // An empty instance has an empty box.
        assert_eq!(b[1].half_size, [0.0; 3]);
    }
}
