//! What is known of each instance: size, place, support, language.

use artifacts::{Instances, MaskFeatures, Match, OrientedBox, TreeEdge};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;

/// How the features of an instance's masks become its descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Aggregate {
    /// Mean of unit features (the paper).
    Mean,
    /// Mean weighted by association scores.
    Weighted,
    /// Mean weighted by how many pixels of its silhouette show the instance in the view.
    Visible,
    /// Median of each channel.
    Median,
    /// Geometric median: the direction of least summed distance to all (VALA).
    GeometricMedian,
    /// Mean of those that are not outliers: what is less similar to the mean than the average by more than 3 deviations
    /// is left out (ReLaGS); that takes more than ten matches.
    Inliers,
}

/// Gathers the instances. `labels` are those of all Gaussians, numbered 0 to K - 1 or -1; `features` are mask features by view
/// index.
pub fn describe(
    means: &[[f32; 3]],
    labels: Vec<i32>,
    instances: usize,
    matches: Vec<Match>,
    views: Vec<String>,
    features: &BTreeMap<u32, MaskFeatures>,
    aggregate: Aggregate,
    tree: Vec<TreeEdge>,
) -> Instances {
    let dim = features.values().map(|f| f.dim).next().unwrap_or(0);
    let mut out = Instances {
        dim,
        descriptor: vec![0.0; instances * dim],
        support: vec![0; instances],
        score: vec![0.0; instances],
        count: vec![0; instances],
        bbox_min: vec![[f32::INFINITY; 3]; instances],
        bbox_max: vec![[f32::NEG_INFINITY; 3]; instances],
        views,
        tree,
        ..Instances::default()
    };
    let mut sums = vec![[0.0f64; 3]; instances];
    for (p, &label) in means.iter().zip(&labels) {
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
    out.oriented = oriented_boxes(means, &labels, &out.centroid);
    let mut of_instance: Vec<Vec<Match>> = vec![Vec::new(); instances];
    for m in &matches {
        of_instance[m.instance as usize].push(*m);
    }
    for (k, own) in of_instance.iter().enumerate() {
        out.support[k] = own.len() as u32;
        out.score[k] = own.iter().map(|m| m.score).sum::<f32>() / own.len().max(1) as f32;
        let weight = |m: &Match| if aggregate == Aggregate::Visible { m.visible } else { m.score };
        let rows: Vec<(f32, Vec<f32>)> =
            own.iter().filter_map(|m| Some((weight(m), unit(features.get(&m.view)?.row(m.mask as usize)?)?))).collect();
        if let Some(d) = descriptor(&rows, dim, aggregate) {
            out.descriptor[k * dim..(k + 1) * dim].copy_from_slice(&d);
        }
    }
    let mut matches = matches;
    matches.sort_by_key(|m| (m.instance, m.view));
    Instances { label: labels, matches, ..out }
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

fn unit(row: &[f32]) -> Option<Vec<f32>> {
    let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (norm > 1e-12).then(|| row.iter().map(|v| (f64::from(*v) / norm) as f32).collect())
}

fn descriptor(rows: &[(f32, Vec<f32>)], dim: usize, aggregate: Aggregate) -> Option<Vec<f32>> {
    if rows.is_empty() {
        return None;
    }
    let mean = |rows: &[&Vec<f32>]| -> Vec<f32> {
        (0..dim).map(|c| (rows.iter().map(|r| f64::from(r[c])).sum::<f64>() / rows.len() as f64) as f32).collect()
    };
    let all: Vec<&Vec<f32>> = rows.iter().map(|(_, r)| r).collect();
    match aggregate {
        Aggregate::GeometricMedian => return unit(&geometric_median(&all, mean(&all))),
        Aggregate::Inliers => return unit(&mean(&inliers(&all, &unit(&mean(&all))?))),
        Aggregate::Mean | Aggregate::Weighted | Aggregate::Visible | Aggregate::Median => {}
    }
    let values = (0..dim).map(|c| match aggregate {
        Aggregate::Mean => rows.iter().map(|(_, r)| f64::from(r[c])).sum::<f64>() as f32,
        Aggregate::Weighted | Aggregate::Visible => {
            rows.iter().map(|(w, r)| f64::from(*w) * f64::from(r[c])).sum::<f64>() as f32
        }
        Aggregate::Median => {
            let mut column: Vec<f32> = rows.iter().map(|(_, r)| r[c]).collect();
            column.sort_by(f32::total_cmp);
            let (low, high) = (column[(column.len() - 1) / 2], column[column.len() / 2]);
            0.5 * (low + high)
        }
        Aggregate::GeometricMedian | Aggregate::Inliers => unreachable!("returned above"),
    });
    unit(&values.collect::<Vec<_>>())
}

/// Weiszfeld's iterations from the mean: means weighted by 1 / distance. One that stands on a row would divide by zero;
/// distances are kept above 1e-6.
fn geometric_median(rows: &[&Vec<f32>], start: Vec<f32>) -> Vec<f32> {
    let mut at: Vec<f64> = start.iter().map(|v| f64::from(*v)).collect();
    for _ in 0..100 {
        let (mut sum, mut weights) = (vec![0.0; at.len()], 0.0);
        for row in rows {
            let square: f64 = row.iter().zip(&at).map(|(r, a)| (f64::from(*r) - a).powi(2)).sum();
            let weight = 1.0 / square.sqrt().max(1e-6);
            sum.iter_mut().zip(*row).for_each(|(s, r)| *s += weight * f64::from(*r));
            weights += weight;
        }
        let moved = sum.iter().zip(&at).map(|(s, a)| (s / weights - a).abs()).fold(0.0, f64::max);
        at = sum.iter().map(|s| s / weights).collect();
        if moved < 1e-7 {
            break;
        }
    }
    at.iter().map(|v| *v as f32).collect()
}

/// The rows whose similarity to `mean` is no less than 3 deviations below the average.
fn inliers<'a>(rows: &[&'a Vec<f32>], mean: &[f32]) -> Vec<&'a Vec<f32>> {
    let similarity: Vec<f64> =
        rows.iter().map(|r| r.iter().zip(mean).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()).collect();
    let n = similarity.len() as f64;
    let average = similarity.iter().sum::<f64>() / n;
    let deviation = (similarity.iter().map(|s| (s - average).powi(2)).sum::<f64>() / n).sqrt();
    let least = average - 3.0 * deviation;
    rows.iter().zip(&similarity).filter(|(_, s)| **s >= least).map(|(r, _)| *r).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_unit_means_and_boxes_hold_their_gaussians() {
        let means = [[0.0, 0.0, 0.0], [2.0, 1.0, 0.0], [9.0; 3]];
        let f = MaskFeatures { count: 2, dim: 2, values: vec![3.0, 0.0, 0.0, 1.0] };
        let features = BTreeMap::from([(0, f.clone()), (1, f)]);
        let m = |view, mask, score| Match { instance: 0, view, mask, score, visible: 1.0 - score };
        let cases = [
            (Aggregate::Mean, 0.5f32.sqrt()),
            (Aggregate::Weighted, 0.8 / 0.68f32.sqrt()),
            (Aggregate::Visible, 0.2 / 0.68f32.sqrt()),
        ];
        for (aggregate, x) in cases {
            let i = describe(
                &means,
                vec![0, 0, -1],
                2,
                vec![m(1, 1, 0.2), m(0, 0, 0.8)],
                vec!["a".into(), "b".into()],
                &features,
                aggregate,
                vec![],
            );
            assert_eq!((i.count[0], i.count[1], i.support[0], i.support[1]), (2, 0, 2, 0));
            assert_eq!((i.centroid[0], i.bbox_max[0]), ([1.0, 0.5, 0.0], [2.0, 1.0, 0.0]));
            assert!((i.descriptor_of(0)[0] - x).abs() < 1e-6, "{aggregate:?}");
            assert_eq!(i.descriptor_of(1), [0.0, 0.0]);
            assert_eq!(i.matches[0].view, 0);
        }
    }

    #[test]
    fn oriented_boxes_follow_what_they_hold() {
        // A bar of 8 x 4 x 2, turned.
        let turn = glam::DQuat::from_rotation_z(0.5) * glam::DQuat::from_rotation_x(0.3);
        let corner = |i: i32| {
            DVec3::new([-4.0, 4.0][i as usize & 1], [-2.0, 2.0][i as usize >> 1 & 1], [-1.0, 1.0][i as usize >> 2])
        };
        let means: Vec<[f32; 3]> = (0..8).map(|i| (turn * corner(i) + DVec3::splat(7.0)).as_vec3().into()).collect();
        let b = oriented_boxes(&means, &[0; 8], &[[7.0; 3], [0.0; 3]]);
        for c in 0..3 {
            assert!((b[0].half_size[c] - [4.0, 2.0, 1.0][c]).abs() < 1e-5, "{:?}", b[0]);
            assert!((b[0].center[c] - 7.0).abs() < 1e-5);
            let expected = turn * DVec3::AXES[c];
            assert!(DVec3::from(b[0].axes[c].map(f64::from)).dot(expected).abs() > 1.0 - 1e-6);
        }
        let x = DVec3::from(b[0].axes[0].map(f64::from)).cross(DVec3::from(b[0].axes[1].map(f64::from)));
        assert!(x.dot(DVec3::from(b[0].axes[2].map(f64::from))) > 0.999);
        // Of nothing, nothing.
        assert_eq!(b[1].half_size, [0.0; 3]);
    }

    #[test]
    fn medians_and_inliers_are_not_moved_by_a_stray_view() {
        let stray = 12;
        let rows: Vec<(f32, Vec<f32>)> = (0..=stray)
            .map(|i| if i == stray { vec![0.0, 1.0] } else { unit(&[1.0, 0.01 * (i % 3) as f32]).unwrap() })
            .map(|r| (0.5, r))
            .collect();
        let up = |a: Aggregate| descriptor(&rows, 2, a).unwrap()[1];
        let mean = up(Aggregate::Mean);
        assert!(mean > 0.08);
        for a in [Aggregate::Median, Aggregate::GeometricMedian, Aggregate::Inliers] {
            assert!(up(a) < 0.03, "{a:?}: {}", up(a));
        }
        // One alone is what it is.
        for a in [Aggregate::GeometricMedian, Aggregate::Inliers] {
            assert_eq!(descriptor(&rows[..1], 2, a).unwrap(), rows[0].1);
        }
    }
}
