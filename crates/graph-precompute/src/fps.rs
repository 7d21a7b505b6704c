//! Farthest point sampling, exact.
//!
//! Every kd-tree node keeps the largest distance of a point inside to the anchors chosen so far. A new anchor can only
//! change nodes whose box is nearer to it than that; all others are passed over. The point with the largest distance at
//! the root is the next anchor, and when the sampling ends every point knows its nearest anchor.

use crate::kdtree::{KdTree, distance};

/// Anchors and whom they serve.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sample {
    /// Chosen points, in the order of choice.
    pub anchors: Vec<u32>,
    /// Nearest anchor of every point, as a position in `anchors`; ties go to the anchor chosen first.
    pub nearest: Vec<u32>,
}

/// Chooses `count` of the tree's points: first `start`, then always the point farthest from those chosen, the lowest
/// index among equals. Points that coincide with an anchor come last.
///
/// # Panics
/// When `count` is 0 or more than there are points, or `start` is not a point.
pub fn farthest_points(tree: &KdTree, count: usize, start: u32) -> Sample {
    let n = tree.index.len();
    assert!(count >= 1 && count <= n && (start as usize) < n, "sampling {count} of {n} points from {start}");
    let mut slot_of = vec![0u32; n];
    for (slot, &i) in tree.index.iter().enumerate() {
        slot_of[i as usize] = slot as u32;
    }
    let mut state = State {
        tree,
        nearest_distance: vec![f32::INFINITY; n],
        nearest: vec![0; n],
        farthest: vec![(f32::INFINITY, u32::MAX); tree.nodes.len()],
    };
    let mut anchors = Vec::with_capacity(count);
    let mut next = start;
    for anchor in 0..count as u32 {
        anchors.push(next);
        state.add(anchor, slot_of[next as usize]);
        next = state.farthest[0].1;
    }
    let mut nearest = vec![0; n];
    for (slot, &i) in tree.index.iter().enumerate() {
        nearest[i as usize] = state.nearest[slot];
    }
    Sample { anchors, nearest }
}

struct State<'a> {
    tree: &'a KdTree,
    /// By slot: squared distance to the nearest anchor; -1 for anchors, so that none is chosen twice.
    nearest_distance: Vec<f32>,
    /// By slot.
    nearest: Vec<u32>,
    /// By node: the farthest point inside and its distance.
    farthest: Vec<(f32, u32)>,
}

impl State<'_> {
    fn add(&mut self, anchor: u32, slot: u32) {
        self.visit(0, anchor, slot, self.tree.at(slot as usize));
    }

    fn visit(&mut self, id: usize, anchor: u32, slot: u32, q: [f32; 3]) {
        let node = self.tree.nodes[id];
        let holds_anchor = (node.start..node.end).contains(&slot);
        if !holds_anchor && node.distance(q) >= self.farthest[id].0 {
            return;
        }
        if node.right == 0 {
            self.farthest[id] = self.update_leaf(node.start as usize..node.end as usize, anchor, slot, q);
        } else {
            let (left, right) = (id + 1, node.right as usize);
            self.visit(left, anchor, slot, q);
            self.visit(right, anchor, slot, q);
            self.farthest[id] = farther(self.farthest[left], self.farthest[right]);
        }
    }

    fn update_leaf(&mut self, slots: std::ops::Range<usize>, anchor: u32, slot: u32, q: [f32; 3]) -> (f32, u32) {
        let mut best = (f32::NEG_INFINITY, u32::MAX);
        for s in slots {
            let d = distance(q, self.tree.at(s));
            if d < self.nearest_distance[s] {
                self.nearest_distance[s] = d;
                self.nearest[s] = anchor;
            }
            if s == slot as usize {
                self.nearest_distance[s] = -1.0;
            }
            best = farther(best, (self.nearest_distance[s], self.tree.index[s]));
        }
        best
    }
}

/// The farther of two points, the lower index among equals.
fn farther(a: (f32, u32), b: (f32, u32)) -> (f32, u32) {
    if b.0 > a.0 || (b.0 == a.0 && b.1 < a.1) { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::points;
    use proptest::prelude::*;

    fn brute(points: &[[f32; 3]], count: usize, start: u32) -> Sample {
        let mut nearest_distance = vec![f32::INFINITY; points.len()];
        let mut nearest = vec![0; points.len()];
        let mut anchors = vec![start];
        loop {
            let a = anchors.len() as u32 - 1;
            let q = points[anchors[a as usize] as usize];
            for (i, &p) in points.iter().enumerate() {
                if distance(q, p) < nearest_distance[i] {
                    nearest_distance[i] = distance(q, p);
                    nearest[i] = a;
                }
            }
            if anchors.len() == count {
                return Sample { anchors, nearest };
            }
            let free = (0..points.len() as u32).filter(|i| !anchors.contains(i));
            let next = free.fold(None, |best: Option<u32>, i| match best {
                Some(b) if nearest_distance[i as usize] <= nearest_distance[b as usize] => Some(b),
                _ => Some(i),
            });
            anchors.push(next.unwrap());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(150))]
        #[test]
        fn samples_are_those_of_brute_force(p in points(1..300), share in 0.0f64..1.0, start in 0.0f64..1.0) {
            let count = ((p.len() as f64 * share) as usize).max(1);
            let start = (p.len() as f64 * start) as u32;
            let sample = farthest_points(&KdTree::new(&p), count, start);
            prop_assert_eq!(sample, brute(&p, count, start));
        }
    }
}
