//! Choosing, ordering and trimming Gaussians.

use crate::bounds::Bounds;
use gs_scene::{Gaussians, morton_order};
use serde::Serialize;

/// In which order Gaussians are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// As in the input
    None,
    /// Along a Morton curve: neighbours in space lie near each other in the file
    Morton,
    /// The most opaque first
    Opacity,
}

/// The Gaussians chosen, and how many were not, by the first reason that applied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chosen {
    /// Indices, rising.
    pub kept: Vec<u32>,
    /// A number was not finite.
    pub not_finite: usize,
    /// Outside the box.
    pub cropped: usize,
    /// Too faint.
    pub faint: usize,
}

/// Picks the Gaussians that can be used, whose centres lie inside the box, and whose opacity is at least `min_opacity`.
pub fn choose(g: &Gaussians, min_opacity: f32, crop: Option<Bounds>) -> Chosen {
    let mut chosen = Chosen { kept: Vec::new(), not_finite: 0, cropped: 0, faint: 0 };
    for i in 0..g.len() {
        if !g.is_whole(i) {
            chosen.not_finite += 1;
        } else if crop.is_some_and(|b| !b.contains(g.means[i])) {
            chosen.cropped += 1;
        } else if g.opacity(i) < min_opacity {
            chosen.faint += 1;
        } else {
            chosen.kept.push(i as u32);
        }
    }
    chosen
}

/// Puts indices in order; equal ones stay as they were.
pub fn arrange(g: &Gaussians, kept: &mut [u32], order: Order) {
    match order {
        Order::None => {}
        Order::Opacity => {
            let logit = |i: u32| g.opacity_logits[i as usize];
            kept.sort_by(|&a, &b| logit(b).total_cmp(&logit(a)));
        }
        Order::Morton => {
            let centres: Vec<[f32; 3]> = kept.iter().map(|&i| g.means[i as usize]).collect();
            let ordered: Vec<u32> = morton_order(&centres).into_iter().map(|k| kept[k as usize]).collect();
            kept.copy_from_slice(&ordered);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimiser::zeros;

    #[test]
    fn each_reason_is_counted_once() {
        let mut g = zeros(5, 0);
        g.means = vec![[0.0; 3], [2.0, 0.0, 0.0], [f32::NAN; 3], [1.0, 1.0, 1.0], [0.5; 3]];
        g.opacity_logits = vec![0.0, -9.0, -9.0, f32::INFINITY, -9.0];
        let crop = Some(Bounds { low: [0.0; 3], high: [1.0; 3] });
        let c = choose(&g, 0.1, crop);
        assert_eq!(c, Chosen { kept: vec![0, 3], not_finite: 1, cropped: 1, faint: 1 });
        assert_eq!(choose(&g, 0.0, None).kept, [0, 1, 3, 4]);
    }

    #[test]
    fn orders_are_stable() {
        let mut g = zeros(4, 0);
        g.means = vec![[1.0, 1.0, 1.0], [0.0; 3], [1.0, 0.0, 0.0], [0.0; 3]];
        g.opacity_logits = vec![0.0, 2.0, 1.0, 2.0];
        let run = |order| {
            let mut all = vec![0, 1, 2, 3];
            arrange(&g, &mut all, order);
            all
        };
        assert_eq!(run(Order::None), [0, 1, 2, 3]);
        assert_eq!(run(Order::Opacity), [1, 3, 2, 0]);
        assert_eq!(run(Order::Morton), [1, 3, 2, 0]);
    }
}
