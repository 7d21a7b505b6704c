//! What stands on, in, under and next to what, by upright boxes and by where Gaussians lie around and above them.
//! docs/objects.md states the rules and how often they are right.

use crate::near::Near;
use crate::scene::{Object, Relation, RelationKind};
use crate::upright::ObjectBox;
use glam::{DVec2, DVec3};

/// Share of the footprint that must lie over the other's, for `on` by boxes alone, and below the other, for `under`.
const OVER: f64 = 0.5;
/// Distance of foot and what carries it, in heights of the upper one, or in [`FLAT`] of its longest level side if that is more.
const TOUCH: f64 = 0.15;
const FLAT: f64 = 0.3;
/// Sides of the foot, of four, on which what carries it must be seen.
const SIDES: usize = 3;
/// How far beside the foot to look, in shorter level sides of it.
const BESIDE: f64 = 0.5;
/// Largest longest level side of a thing, in those of what carries it.
const LARGER: f64 = 2.0;
/// Directions, of eight, in which what encloses a thing must be seen around its middle.
const AROUND: usize = 7;
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

/// The relations between objects, ascending; `centers` are those of their Gaussians, as many lists as objects. Without
/// upright boxes only `in` and `next to` are told, since nothing says what is up, and then by boxes around the boxes.
pub(crate) fn relations(objects: &[Object], centers: &[Vec<[f32; 3]>]) -> Vec<Relation> {
    let placed: Vec<Placed> = objects.iter().zip(centers).map(|(o, c)| Placed::new(&o.bounds, c)).collect();
    let n = objects.len();
    let mut kinds = vec![None; n * n];
    for a in 0..n {
        let near: Vec<Near> = (0..n).map(|b| Near::new(&placed[a].around(), &placed[b].points)).collect();
        let others = || (0..n).filter(|&b| b != a);
        for b in others().filter(|&b| placed[a].lies_in(&placed[b], &near[b])) {
            kinds[a * n + b] = Some(RelationKind::In);
        }
        let free = |b: &usize| kinds[a * n + b].is_none();
        let on = others().filter(free).filter_map(|b| Some((b, placed[a].lies_on(&placed[b], &near[b])?)));
        if let Some((b, _)) = on.min_by(|x, y| x.1.total_cmp(&y.1)) {
            kinds[a * n + b] = Some(RelationKind::On);
        }
        // What hangs over most of it, lowest first.
        let above =
            |cell: usize| others().filter_map(|b| Some((near[b].above(cell)?, b))).min_by(|x, y| x.0.total_cmp(&y.0));
        let mut votes = vec![0; n];
        (0..Near::CELLS).filter_map(above).for_each(|(_, b)| votes[b] += 1);
        let free = |b: &usize| kinds[a * n + b].is_none() && placed[a].upright && placed[a].area <= placed[*b].area;
        let hangs = |b: &usize| votes[*b] as f64 > OVER * Near::CELLS as f64 || placed[a].lies_below(&placed[*b]);
        let height = |b: &usize| placed[*b].heights.0;
        if let Some(b) = others().filter(free).filter(hangs).min_by(|x, y| height(x).total_cmp(&height(y))) {
            kinds[a * n + b] = Some(RelationKind::Under);
        }
    }
    let mut found = Vec::new();
    for a in 0..n {
        for b in (0..n).filter(|&b| b != a) {
            // What carries or holds another does not lie under it.
            let held = matches!(kinds[b * n + a], Some(RelationKind::On | RelationKind::In));
            let kind = match kinds[a * n + b] {
                Some(RelationKind::Under) if held => None,
                None if a < b && kinds[b * n + a].is_none() && placed[a].is_next_to(&placed[b]) => {
                    Some(RelationKind::NextTo)
                }
                kind => kind,
            };
            found.extend(kind.map(|relation| Relation { subject: objects[a].id, relation, object: objects[b].id }));
        }
    }
    found.sort_unstable();
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
    /// Level axes of the box, with their half sides; and its middle.
    axes: [(DVec2, f64); 2],
    middle: DVec2,
    /// Its Gaussians: two level coordinates and the height. None without up.
    points: Vec<DVec3>,
}

impl Placed {
    fn new(b: &ObjectBox, centers: &[[f32; 3]]) -> Self {
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
            return Self {
                upright: false,
                heights,
                footprint: footprint.map(DVec2::from),
                area: size.x * size.y,
                level_side: size.x.max(size.y),
                side,
                axes: [(DVec2::X, 0.5 * size.x), (DVec2::Y, 0.5 * size.y)],
                middle: (0.5 * (low + high)).truncate(),
                points: Vec::new(),
            };
        }
        let up = of(b.axes[2]);
        let (e, f) = up.any_orthonormal_pair();
        let level = |v: DVec3| DVec2::new(v.dot(e), v.dot(f));
        let (center, x, y) = (level(of(b.center)), level(of(b.axes[0])) * half.x, level(of(b.axes[1])) * half.y);
        let mut footprint = [center - x - y, center + x - y, center + x + y, center - x + y];
        if x.perp_dot(y) < 0.0 {
            footprint.reverse();
        }
        let height = of(b.center).dot(up);
        Self {
            upright: true,
            heights: (height - half.z, height + half.z),
            footprint,
            area: 4.0 * half.x * half.y,
            level_side: 2.0 * half.x.max(half.y),
            side,
            axes: [(level(of(b.axes[0])), half.x), (level(of(b.axes[1])), half.y)],
            middle: center,
            points: centers.iter().map(|p| level(of(*p)).extend(of(*p).dot(up))).collect(),
        }
    }

    /// Where to look for what carries, encloses or covers it.
    fn around(&self) -> crate::near::Around {
        let Self { axes, middle, heights, .. } = *self;
        let margin = BESIDE * 2.0 * axes[0].1.min(axes[1].1) + self.touch();
        crate::near::Around { axes, middle, heights, touch: self.touch(), margin }
    }

    /// How far apart things may seem that touch.
    fn touch(&self) -> f64 {
        TOUCH * self.height().max(FLAT * self.level_side)
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

    /// How far the other's top, or what is seen of it around the foot, is from the foot, where the other carries this.
    fn lies_on(&self, other: &Self, near: &Near) -> Option<f64> {
        if !self.upright {
            return None;
        }
        let gap = (self.heights.0 - other.heights.1).abs();
        let on_top = gap <= self.touch() && self.over(other) >= OVER;
        let around = near.foot_sides() >= SIDES && self.level_side <= LARGER * other.level_side;
        (on_top || around).then(|| if around { near.foot_gap().min(gap) } else { gap })
    }

    fn lies_in(&self, other: &Self, near: &Near) -> bool {
        let (own, room) = (self.area * self.height(), other.area * other.height());
        let within = own <= FITS * room && self.over(other) * self.beside(other) >= INSIDE;
        within && (!self.upright || near.directions() >= AROUND)
    }

    fn lies_below(&self, other: &Self) -> bool {
        self.heights.1 <= other.heights.0 + self.touch() && self.over(other) >= OVER
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
    // The edges of a point, such as an object of one Gaussian has, would cut nothing off.
    if b.iter().all(|p| *p == b[0]) {
        return 0.0;
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Names, describe, testing};
    use RelationKind::{In, NextTo, On, Under};
    use artifacts::Remarks;
    use glam::DQuat;
    use std::collections::BTreeMap;

    type Corners = ([f32; 3], [f32; 3]);

    /// What is told of boxes of Gaussians that are turned from z to `up`, but for those Gaussians that are `hidden`.
    fn told(boxes: &[Corners], up: DVec3, hidden: impl Fn(usize, [f32; 3]) -> bool) -> Vec<(u32, RelationKind, u32)> {
        let (mut instances, mut gaussians) = testing::boxes(boxes);
        let turn = DQuat::from_rotation_arc(DVec3::Z, up);
        for (label, mean) in instances.label.iter_mut().zip(&mut gaussians.means) {
            if *label >= 0 && hidden(*label as usize, *mean) {
                *label = -1;
            }
            *mean = (turn * DVec3::from(mean.map(f64::from))).as_vec3().into();
        }
        let up = crate::Up::given(up.into());
        let scene = describe(&instances, &gaussians, &Remarks::default(), &Names::new(), up, BTreeMap::new());
        scene.relations.iter().map(|r| (r.subject, r.relation, r.object)).collect()
    }

    const TOP: Corners = ([0.0, 0.0, 0.7], [1.2, 1.0, 0.75]);
    const MUG: Corners = ([0.5, 0.4, 0.75], [0.6, 0.5, 0.85]);
    const CHEST: Corners = ([0.6, 0.3, 0.0], [1.0, 0.7, 0.4]);

    #[test]
    fn a_mug_is_on_the_table_and_a_chest_under_it_whatever_is_up() {
        for up in [DVec3::Z, DVec3::NEG_Y, DVec3::new(0.3, -0.8, 0.2).normalize()] {
            assert_eq!(told(&[TOP, MUG, CHEST], up, |_, _| false), [(1, On, 0), (2, Under, 0)], "{up}");
        }
        // An object of one place carries nothing and lies on nothing that is elsewhere.
        let point = [40.0, 40.0, TOP.1[2]];
        assert_eq!(told(&[TOP, (point, point)], DVec3::Z, |_, _| false), []);
        // Held a hand above the table it is on nothing.
        let held = ([0.5, 0.4, 0.85], [0.6, 0.5, 0.95]);
        let on = |t: &(u32, RelationKind, u32)| t.1 == On;
        assert!(!told(&[TOP, held], DVec3::Z, |_, _| false).iter().any(on));
    }

    #[test]
    fn a_book_is_in_the_box_that_is_larger_than_it() {
        let (book, case) = (([0.4, 0.4, 0.1], [0.6, 0.6, 0.2]), ([0.3, 0.3, 0.0], [0.8, 0.8, 0.4]));
        assert_eq!(told(&[book, case], DVec3::Z, |_, _| false), [(0, In, 1)]);
        // Where only the walls of the box are seen, too; where it is open on one side, it is beside it.
        let wall = |p: [f32; 3]| [p[0], p[1]].iter().any(|v| (*v - 0.3).abs() < 0.01 || (*v - 0.8).abs() < 0.01);
        assert_eq!(told(&[book, case], DVec3::Z, |k, p| k == 1 && !wall(p)), [(0, In, 1)]);
        let open = |k: usize, p: [f32; 3]| k == 1 && (!wall(p) || p[0] < 0.32);
        assert_eq!(told(&[book, case], DVec3::Z, open), [(0, NextTo, 1)]);
    }

    #[test]
    fn a_lamp_is_next_to_the_monitor_but_not_to_what_is_far_or_far_below() {
        let (lamp, monitor) = (([0.0, 0.0, 0.7], [0.2, 0.2, 1.2]), ([0.3, 0.0, 0.7], [0.9, 0.2, 1.1]));
        assert_eq!(told(&[lamp, monitor], DVec3::Z, |_, _| false), [(0, NextTo, 1)]);
        let far = ([0.45, 0.0, 0.7], [1.0, 0.2, 1.1]);
        assert_eq!(told(&[lamp, far], DVec3::Z, |_, _| false), []);
        let below = ([0.3, 0.0, 0.1], [0.9, 0.2, 0.5]);
        assert_eq!(told(&[lamp, below], DVec3::Z, |_, _| false), []);
    }

    #[test]
    fn a_cup_is_on_the_board_of_a_shelf_that_goes_on_above_it() {
        // A back, a board at a third of the height, and a cup on it; nobody sees the board below the cup.
        let shelf = ([0.0, 0.0, 0.0], [0.8, 0.4, 1.6]);
        let cup = ([0.35, 0.15, 0.6], [0.45, 0.25, 0.72]);
        let gone = |k: usize, p: [f32; 3]| {
            let board = (p[2] - 0.6).abs() < 0.01;
            let below_cup = (0.34..0.46).contains(&p[0]) && (0.14..0.26).contains(&p[1]);
            k == 0 && !(p[1] > 0.39 || board && !below_cup)
        };
        assert_eq!(told(&[shelf, cup], DVec3::Z, gone), [(1, On, 0)]);
    }

    #[test]
    fn areas_and_distances_of_footprints_are_exact() {
        let square = |x: f64, y: f64, half: f64| {
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(a, b)| DVec2::new(x + a * half, y + b * half))
        };
        let turned = square(0.0, 0.0, 1.0).map(|p| DVec2::from_angle(std::f64::consts::FRAC_PI_4).rotate(p));
        assert!((overlap(&square(0.0, 0.0, 1.0), &square(1.5, 1.0, 1.0)) - 0.5).abs() < 1e-12);
        // A square in one turned by an eighth: what is left is a regular octagon.
        assert!((overlap(&square(0.0, 0.0, 1.0), &turned) - 8.0 * (2f64.sqrt() - 1.0)).abs() < 1e-12);
        assert_eq!(overlap(&square(0.0, 0.0, 1.0), &square(5.0, 0.0, 1.0)), 0.0);
        assert!((distance(&square(0.0, 0.0, 1.0), &square(5.0, 6.0, 1.0)) - 5.0).abs() < 1e-12);
        assert_eq!(distance(&square(0.0, 0.0, 1.0), &square(0.5, 0.0, 3.0)), 0.0);
    }
}
