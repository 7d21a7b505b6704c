//! Farthest point sampling, exact.
//!
//! Every kd-tree node keeps the largest distance of a point inside to the anchors chosen so far. A new anchor can only
//! change nodes whose box is nearer to it than that; all others are skipped. The point with the largest distance at
//! the root is the next anchor, and when the sampling ends every point knows its nearest anchor.

use super::kdtree::{KdTree, LANES, distance};
use multiversion::multiversion;
use std::ops::Range;

/// Anchors, and the nearest anchor of every point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sample {
    /// Chosen points, in the order of choice.
    pub anchors: Vec<u32>,
    /// Nearest anchor of every point, as a position in `anchors`; ties go to the anchor chosen first.
    pub nearest: Vec<u32>,
}

/// Chooses `count` of the tree's points: first `start`, then always the point farthest from those chosen, the lowest
/// index among equals. Points that coincide with an anchor come last.
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
    let (mut stack, mut entered) = (Vec::new(), Vec::new());
    let mut anchors = Vec::with_capacity(count);
    let mut next = start;
    for anchor in 0..count as u32 {
        anchors.push(next);
        add(&mut state, anchor, slot_of[next as usize], &mut stack, &mut entered);
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

/// Takes the point in `slot` as `anchor`: updates what is nearer to it than to any anchor before, and the farthest points
/// of the nodes on the way. `stack` and `entered` are scratch.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add(state: &mut State<'_>, anchor: u32, slot: u32, stack: &mut Vec<u32>, entered: &mut Vec<u32>) {
    let q = state.tree.at(slot as usize);
    // A point that coincides with an earlier anchor stays with that.
    if state.nearest_distance[slot as usize] > 0.0 {
        state.nearest[slot as usize] = anchor;
    }
    state.nearest_distance[slot as usize] = -1.0;
    stack.clear();
    entered.clear();
    stack.push(0);
    while let Some(id) = stack.pop() {
        let node = &state.tree.nodes[id as usize];
        let holds_anchor = (node.start..node.end).contains(&slot);
        if !holds_anchor && node.distance(q) >= state.farthest[id as usize].0 {
            continue;
        }
        if node.right == 0 {
            let slots = node.start as usize..node.end as usize;
            state.farthest[id as usize] = update_leaf(state, slots, anchor, q);
        } else {
            entered.push(id);
            stack.push(node.right);
            stack.push(id + 1);
        }
    }
    // Children were entered after their parents.
    for &id in entered.iter().rev() {
        let (left, right) = (id as usize + 1, state.tree.nodes[id as usize].right as usize);
        state.farthest[id as usize] = farther(state.farthest[left], state.farthest[right]);
    }
}

/// Updates the points of a leaf, whose indices ascend; returns the farthest of them.
#[inline(always)]
fn update_leaf(state: &mut State<'_>, slots: Range<usize>, anchor: u32, q: [f32; 3]) -> (f32, u32) {
    let [x, y, z] = [0, 1, 2].map(|a| &state.tree.axes[a][slots.clone()]);
    let distances = &mut state.nearest_distance[slots.clone()];
    let nearest = &mut state.nearest[slots.clone()];
    let n = distances.len();
    assert!(x.len() == n && y.len() == n && z.len() == n && nearest.len() == n);
    // Lane by lane, so that the compiler may use vectors.
    let mut most = [f32::NEG_INFINITY; LANES];
    let mut one = |i: usize, most: &mut f32| {
        let d = distance(q, [x[i], y[i], z[i]]);
        let nearer = d < distances[i];
        distances[i] = if nearer { d } else { distances[i] };
        nearest[i] = if nearer { anchor } else { nearest[i] };
        *most = if distances[i] > *most { distances[i] } else { *most };
    };
    let whole = n - n % LANES;
    for i in (0..whole).step_by(LANES) {
        for (l, most) in most.iter_mut().enumerate() {
            one(i + l, most);
        }
    }
    for i in whole..n {
        one(i, &mut most[i - whole]);
    }
    let most = most.into_iter().fold(f32::NEG_INFINITY, f32::max);
    // Indices ascend within a leaf: the first is the lowest among equals.
    let first = distances.iter().position(|&d| d == most).unwrap_or(0);
    (most, state.tree.index[slots.start + first])
}

/// The farther of two points, the lower index among equals.
fn farther(a: (f32, u32), b: (f32, u32)) -> (f32, u32) {
    if b.0 > a.0 || (b.0 == a.0 && b.1 < a.1) { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::testing::points;
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
