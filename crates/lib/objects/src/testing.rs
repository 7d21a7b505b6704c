//! A small scene for tests.

use artifacts::{Extents, Instances, Match, TreeEdge};
use gs_scene::Gaussians;
use ndarray::Array2;

/// Gaussians on a grid through upright boxes, given by lower and upper corner; label k for box k. One Gaussian of no
/// instance comes first.
pub fn boxes(boxes: &[([f32; 3], [f32; 3])]) -> (Instances, Gaussians) {
    let (mut means, mut label) = (vec![[50.0; 3]], vec![-1]);
    for (k, (low, high)) in boxes.iter().enumerate() {
        for i in 0..9 * 9 * 9 {
            let at = [i % 9, i / 9 % 9, i / 81];
            means.push([0, 1, 2].map(|c| low[c] + (high[c] - low[c]) * at[c] as f32 / 8.0));
            label.push(k as i32);
        }
    }
    let (n, k) = (means.len(), boxes.len());
    let extents = Extents::of(&means, &label, k);
    let gaussians = Gaussians {
        log_scales: vec![[-4.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![3.0; n],
        sh: (0..3 * n).map(|i| i as f32 * 0.001).collect(),
        sh_degree: 0,
        means,
        ..Gaussians::default()
    };
    let instances = Instances {
        node: label.iter().map(|&l| if l < 0 { -1 } else { n as i32 + 2 + l }).collect(),
        label,
        descriptor: Array2::default((k, 0)),
        support: vec![2; k],
        score: (0..k).map(|k| 1.0 / (1.0 + k as f32)).collect(),
        count: extents.count,
        centroid: extents.centroid,
        bbox_min: extents.bbox_min,
        bbox_max: extents.bbox_max,
        oriented: extents.oriented,
        views: vec!["a".into(), "b".into()],
        matches: (0..2 * k as u32)
            .map(|m| Match { instance: m / 2, view: m % 2, mask: 7 * m, score: 0.5, visible: (1 + m % 2) as f32 })
            .collect(),
        // A cluster of the first and the second below the root; the others below the root.
        tree: std::iter::once(TreeEdge { parent: n as u32, child: n as u32 + 1, lambda: 1.0, size: 2, instance: -1 })
            .chain((0..k).map(|i| TreeEdge {
                parent: n as u32 + u32::from(i < 2),
                child: (n + 2 + i) as u32,
                lambda: 2.0,
                size: 9,
                instance: i as i32,
            }))
            .collect(),
        ..Instances::default()
    };
    (instances, gaussians)
}
