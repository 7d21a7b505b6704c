//! What is known of each instance: size, place, support, language.

use artifacts::{Instances, MaskFeatures, Match, TreeEdge};
use std::collections::BTreeMap;

/// How the features of an instance's masks become its descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Aggregate {
    /// Mean of unit features (the paper).
    Mean,
    /// Mean weighted by association scores.
    Weighted,
    /// Median of each channel.
    Median,
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
    let mut of_instance: Vec<Vec<Match>> = vec![Vec::new(); instances];
    for m in &matches {
        of_instance[m.instance as usize].push(*m);
    }
    for (k, own) in of_instance.iter().enumerate() {
        out.support[k] = own.len() as u32;
        out.score[k] = own.iter().map(|m| m.score).sum::<f32>() / own.len().max(1) as f32;
        let rows: Vec<(f32, Vec<f32>)> =
            own.iter().filter_map(|m| Some((m.score, unit(features.get(&m.view)?.row(m.mask as usize)?)?))).collect();
        if let Some(d) = descriptor(&rows, dim, aggregate) {
            out.descriptor[k * dim..(k + 1) * dim].copy_from_slice(&d);
        }
    }
    let mut matches = matches;
    matches.sort_by_key(|m| (m.instance, m.view));
    Instances { label: labels, matches, ..out }
}

fn unit(row: &[f32]) -> Option<Vec<f32>> {
    let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (norm > 1e-12).then(|| row.iter().map(|v| (f64::from(*v) / norm) as f32).collect())
}

fn descriptor(rows: &[(f32, Vec<f32>)], dim: usize, aggregate: Aggregate) -> Option<Vec<f32>> {
    if rows.is_empty() {
        return None;
    }
    let values = (0..dim).map(|c| match aggregate {
        Aggregate::Mean => rows.iter().map(|(_, r)| f64::from(r[c])).sum::<f64>() as f32,
        Aggregate::Weighted => rows.iter().map(|(w, r)| f64::from(*w) * f64::from(r[c])).sum::<f64>() as f32,
        Aggregate::Median => {
            let mut column: Vec<f32> = rows.iter().map(|(_, r)| r[c]).collect();
            column.sort_by(f32::total_cmp);
            let (low, high) = (column[(column.len() - 1) / 2], column[column.len() / 2]);
            0.5 * (low + high)
        }
    });
    unit(&values.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_unit_means_and_boxes_hold_their_gaussians() {
        let means = [[0.0, 0.0, 0.0], [2.0, 1.0, 0.0], [9.0; 3]];
        let f = MaskFeatures { count: 2, dim: 2, values: vec![3.0, 0.0, 0.0, 1.0] };
        let features = BTreeMap::from([(0, f.clone()), (1, f)]);
        let m = |view, mask, score| Match { instance: 0, view, mask, score };
        for (aggregate, x) in [(Aggregate::Mean, 0.5f32.sqrt()), (Aggregate::Weighted, 0.8 / 0.68f32.sqrt())] {
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
}
