//! Bounding volume hierarchy over axis-aligned boxes.

use glam::DVec3;

/// An axis-aligned box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aabb {
    pub min: DVec3,
    pub max: DVec3,
}

impl Aabb {
    pub const EMPTY: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    fn half_area(self) -> f64 {
        let d = self.max - self.min;
        d.x * d.y + d.y * d.z + d.z * d.x
    }

    /// Where a ray enters the box, if it does between 0 and `far`.
    fn enter(self, origin: DVec3, inverse: DVec3, far: f64) -> Option<f64> {
        let (a, b) = ((self.min - origin) * inverse, (self.max - origin) * inverse);
        let enter = a.min(b).max_element().max(0.0);
        let exit = a.max(b).min_element().min(far);
        // Rounding must not lose a box as thin as a disc.
        (enter <= exit * (1.0 + 1e-12) + 1e-12).then_some(enter)
    }
}

struct Node {
    bounds: Aabb,
    /// First item of a leaf, or the right child; the left child follows its parent.
    next: u32,
    /// Items of a leaf; 0 for an inner node.
    count: u32,
}

/// The hierarchy. Items are numbered as the boxes were given.
#[derive(Default)]
pub struct Bvh {
    nodes: Vec<Node>,
    items: Vec<u32>,
}

const LEAF: usize = 2;

impl Bvh {
    /// Builds it by the surface-area heuristic over sorted centres.
    pub fn new(boxes: &[Aabb]) -> Self {
        let mut bvh = Self { nodes: Vec::new(), items: (0..boxes.len() as u32).collect() };
        if !boxes.is_empty() {
            bvh.split(boxes, 0, boxes.len());
        }
        bvh
    }

    fn split(&mut self, boxes: &[Aabb], start: usize, end: usize) {
        let around = |items: &[u32]| items.iter().fold(Aabb::EMPTY, |b, &i| b.union(boxes[i as usize]));
        let bounds = around(&self.items[start..end]);
        let node = self.nodes.len();
        self.nodes.push(Node { bounds, next: start as u32, count: (end - start) as u32 });
        if end - start <= LEAF {
            return;
        }
        let centre = |i: u32| boxes[i as usize].min + boxes[i as usize].max;
        let mut best: Option<(f64, usize, Vec<u32>)> = None;
        for axis in 0..3 {
            let mut sorted = self.items[start..end].to_vec();
            sorted.sort_by(|&a, &b| centre(a)[axis].total_cmp(&centre(b)[axis]).then(a.cmp(&b)));
            let n = sorted.len();
            let mut right = vec![Aabb::EMPTY; n + 1];
            for k in (0..n).rev() {
                right[k] = right[k + 1].union(boxes[sorted[k] as usize]);
            }
            let mut left = Aabb::EMPTY;
            for k in 1..n {
                left = left.union(boxes[sorted[k - 1] as usize]);
                let cost = left.half_area() * k as f64 + right[k].half_area() * (n - k) as f64;
                if best.as_ref().is_none_or(|b| cost < b.0) {
                    best = Some((cost, k, sorted.clone()));
                }
            }
        }
        let Some((_, k, sorted)) = best else { return };
        self.items[start..end].copy_from_slice(&sorted);
        self.split(boxes, start, start + k);
        self.nodes[node].next = self.nodes.len() as u32;
        self.nodes[node].count = 0;
        self.split(boxes, start + k, end);
    }

    /// Visits the items whose boxes the ray meets before `far`, nearer boxes first. `visit` gets an item and the present
    /// limit, and returns the new limit; a negative limit ends the search.
    pub fn visit(&self, origin: DVec3, direction: DVec3, far: f64, mut visit: impl FnMut(usize, f64) -> f64) {
        let inverse = direction.recip();
        let mut far = far;
        let mut stack = [(0u32, 0.0f64); 64];
        let mut depth = 0;
        if let Some(root) = self.nodes.first()
            && let Some(t) = root.bounds.enter(origin, inverse, far)
        {
            stack[0] = (0, t);
            depth = 1;
        }
        while depth > 0 {
            depth -= 1;
            let (index, t) = stack[depth];
            if t > far {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for &item in &self.items[node.next as usize..(node.next + node.count) as usize] {
                    far = visit(item as usize, far);
                    if far < 0.0 {
                        return;
                    }
                }
                continue;
            }
            let (left, right) = (index + 1, node.next);
            let meet = |i: u32| self.nodes[i as usize].bounds.enter(origin, inverse, far).map(|t| (i, t));
            let (mut near, mut other) = (meet(left), meet(right));
            if near.zip(other).is_some_and(|(a, b)| b.1 < a.1) {
                std::mem::swap(&mut near, &mut other);
            }
            for entry in [other, near].into_iter().flatten() {
                stack[depth] = entry;
                depth += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn every_box_that_a_ray_meets_is_visited() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let mut v = |s: f64| DVec3::new(rng.random(), rng.random(), rng.random()) * s;
        let boxes: Vec<Aabb> = (0..300)
            .map(|_| {
                let min = v(10.0);
                Aabb { min, max: min + v(0.8) }
            })
            .collect();
        let bvh = Bvh::new(&boxes);
        for _ in 0..300 {
            let (o, d) = (v(10.0), (v(2.0) - 1.0).normalize());
            let mut seen = Vec::new();
            bvh.visit(o, d, f64::INFINITY, |i, far| {
                seen.push(i);
                far
            });
            for (i, b) in boxes.iter().enumerate() {
                if b.enter(o, d.recip(), f64::INFINITY).is_some() {
                    assert!(seen.contains(&i));
                }
            }
        }
    }
}
