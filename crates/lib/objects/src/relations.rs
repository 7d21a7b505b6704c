//! What stands on, in, under and next to what, by upright boxes. docs/objects.md states the rules.

use crate::scene::{Object, Relation, RelationKind};
use crate::upright::ObjectBox;
use glam::{DVec2, DVec3};

/// Share of the footprint that must lie over the other's, for `on` and `under`.
const OVER: f64 = 0.5;
/// Distance of bottom and top of things that touch, in heights of the upper one.
const TOUCH: f64 = 0.15;
/// Share of the volume that must lie in the other's box, for `in`.
const INSIDE: f64 = 0.8;
/// Largest volume of what is in a box, in volumes of the box.
const FITS: f64 = 0.5;
/// Largest distance of footprints of neighbours, in longest level sides of the smaller one.
const NEAR: f64 = 1.0;
/// Share of the lower one's height at which neighbours must be side by side.
const LEVEL: f64 = 0.5;
/// Largest longest side of a neighbour, in longest sides of the other.
const ALIKE: f64 = 4.0;

/// The relations between objects, ascending. Without upright boxes only `in` and `next to` are told, since nothing says what
/// is up, and then by boxes around the boxes.
pub fn relations(objects: &[Object]) -> Vec<Relation> {
    let placed: Vec<Placed> = objects.iter().map(|o| Placed::new(&o.bounds)).collect();
    let mut found = Vec::new();
    let mut say = |a: usize, relation: RelationKind, b: usize| {
        found.push(Relation { subject: objects[a].id, relation, object: objects[b].id });
    };
    let mut related = vec![false; objects.len() * objects.len()];
    for a in 0..objects.len() {
        let others = (0..objects.len()).filter(|&b| b != a);
        let on = others.clone().filter_map(|b| Some((b, placed[a].lies_on(&placed[b])?)));
        let on = on.min_by(|x, y| x.1.total_cmp(&y.1)).map(|(b, _)| b);
        for b in others {
            let kind = if on == Some(b) {
                RelationKind::On
            } else if placed[a].lies_in(&placed[b]) {
                RelationKind::In
            } else if placed[a].lies_under(&placed[b]) {
                RelationKind::Under
            } else {
                continue;
            };
            say(a, kind, b);
            related[a * objects.len() + b] = true;
        }
    }
    for a in 0..objects.len() {
        for b in a + 1..objects.len() {
            let told = related[a * objects.len() + b] || related[b * objects.len() + a];
            if !told && placed[a].is_next_to(&placed[b]) {
                say(a, RelationKind::NextTo, b);
            }
        }
    }
    found.sort_unstable();
    // What lies on something lies under nothing that it carries.
    let on: Vec<Relation> = found.iter().filter(|r| r.relation == RelationKind::On).copied().collect();
    let carries = |r: &Relation| on.iter().any(|o| (o.subject, o.object) == (r.object, r.subject));
    found.retain(|r| r.relation != RelationKind::Under || !carries(r));
    found
}

/// A box as footprint and heights.
struct Placed {
    upright: bool,
    /// Bottom and top, along the third axis.
    heights: (f64, f64),
    /// Corners of the footprint, counter-clockwise, in level coordinates that all boxes share.
    footprint: [DVec2; 4],
    area: f64,
    /// The longest level side, and the longest of all.
    level_side: f64,
    side: f64,
}

impl Placed {
    fn new(b: &ObjectBox) -> Self {
        let of = |v: [f32; 3]| DVec3::from(v.map(f64::from));
        let half = of(b.half_size);
        let side = 2.0 * half.max_element();
        if !b.upright {
            // Without up: the box along the world's axes around it.
            let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            for corner in b.corners() {
                (low, high) = (low.min(of(corner)), high.max(of(corner)));
            }
            let footprint = [(low.x, low.y), (high.x, low.y), (high.x, high.y), (low.x, high.y)];
            let (size, heights) = (high - low, (low.z, high.z));
            let level_side = size.x.max(size.y);
            let footprint = footprint.map(DVec2::from);
            return Self { upright: false, heights, footprint, area: size.x * size.y, level_side, side };
        }
        let up = of(b.axes[2]);
        let (e, f) = up.any_orthonormal_pair();
        let level = |v: DVec3| DVec2::new(v.dot(e), v.dot(f));
        let (center, x, y) = (level(of(b.center)), level(of(b.axes[0])) * half.x, level(of(b.axes[1])) * half.y);
        let mut footprint = [center - x - y, center + x - y, center + x + y, center - x + y];
        if x.perp_dot(y) < 0.0 {
            footprint.reverse();
        }
        let middle = of(b.center).dot(up);
        Self {
            upright: true,
            heights: (middle - half.z, middle + half.z),
            footprint,
            area: 4.0 * half.x * half.y,
            level_side: 2.0 * half.x.max(half.y),
            side,
        }
    }

    fn height(&self) -> f64 {
        self.heights.1 - self.heights.0
    }

    /// Share of this footprint that lies in the other's.
    fn over(&self, other: &Self) -> f64 {
        if self.area > 0.0 { overlap(&self.footprint, &other.footprint) / self.area } else { 0.0 }
    }

    /// Share of this height that the other has too.
    fn beside(&self, other: &Self) -> f64 {
        let common = self.heights.1.min(other.heights.1) - self.heights.0.max(other.heights.0);
        (common / self.height().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
    }

    /// How far this bottom is from the other's top, where the other carries this.
    fn lies_on(&self, other: &Self) -> Option<f64> {
        let gap = (self.heights.0 - other.heights.1).abs();
        (self.upright && gap <= TOUCH * self.height() && self.over(other) >= OVER).then_some(gap)
    }

    fn lies_in(&self, other: &Self) -> bool {
        let (own, room) = (self.area * self.height(), other.area * other.height());
        own <= FITS * room && self.over(other) * self.beside(other) >= INSIDE
    }

    fn lies_under(&self, other: &Self) -> bool {
        let below = self.heights.1 <= other.heights.0 + TOUCH * self.height();
        self.upright && below && self.over(other) >= OVER
    }

    fn is_next_to(&self, other: &Self) -> bool {
        let (small, large) = if self.level_side <= other.level_side { (self, other) } else { (other, self) };
        let low = if self.height() <= other.height() { (self, other) } else { (other, self) };
        large.side <= ALIKE * small.side
            && low.0.beside(low.1) >= LEVEL
            && distance(&self.footprint, &other.footprint) <= NEAR * small.level_side
    }
}

/// Area that two convex polygons share, corners counter-clockwise.
fn overlap(a: &[DVec2], b: &[DVec2]) -> f64 {
    let mut left = a.to_vec();
    for (i, &from) in b.iter().enumerate() {
        let edge = b[(i + 1) % b.len()] - from;
        let inside = |p: DVec2| edge.perp_dot(p - from);
        let mut cut = Vec::with_capacity(left.len() + 1);
        for (j, &p) in left.iter().enumerate() {
            let q = left[(j + 1) % left.len()];
            let (dp, dq) = (inside(p), inside(q));
            if dp >= 0.0 {
                cut.push(p);
            }
            if (dp >= 0.0) != (dq >= 0.0) {
                cut.push(p + (q - p) * (dp / (dp - dq)));
            }
        }
        left = cut;
    }
    let next = |i: usize| left[(i + 1) % left.len()];
    0.5 * left.iter().enumerate().map(|(i, p)| p.perp_dot(next(i))).sum::<f64>()
}

/// Distance of two convex polygons; 0 where they overlap.
fn distance(a: &[DVec2], b: &[DVec2]) -> f64 {
    if overlap(a, b) > 0.0 {
        return 0.0;
    }
    let to_edges = |points: &[DVec2], of: &[DVec2]| {
        let of_point = |p: &DVec2| {
            let edge = |i: usize| {
                let (from, to) = (of[i], of[(i + 1) % of.len()]);
                let t =
                    ((*p - from).dot(to - from) / (to - from).length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
                p.distance(from + (to - from) * t)
            };
            (0..of.len()).map(edge).fold(f64::INFINITY, f64::min)
        };
        points.iter().map(of_point).fold(f64::INFINITY, f64::min)
    };
    to_edges(a, b).min(to_edges(b, a))
}
