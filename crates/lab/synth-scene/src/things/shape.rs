//! Analytic surfaces in their own frame: where a ray meets them, their normals, and a chart of each.
//!
//! The chart (a face and two coordinates in 0..=1) is what light is stored over; it need not be equal-area.

use glam::{DVec2, DVec3};
use std::f64::consts::{PI, TAU};

/// A surface. Lengths are in metres; solids are centred at the origin of their frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// A box with half extents `half`, rounding included, whose edges are rounded with radius `round`.
    Block { half: DVec3, round: f64 },
    /// An ellipsoid of these semi-axes.
    Ellipsoid { radii: DVec3 },
    /// The line from `from` to `to` (radius, height) turned about z: a cylinder, a cone, a disc or a ring. Its outside
    /// lies to the right of the direction of travel; the normals (radial, vertical) at both ends are given, for smooth
    /// profiles.
    Turned { from: DVec2, to: DVec2, from_normal: DVec2, to_normal: DVec2 },
    /// A piece of a torus about z, from `-arc` to `arc` radians around +x, with round ends.
    Ring { major: f64, minor: f64, arc: f64 },
    /// A cylinder along z with round ends; `half` the distance of their centres.
    Capsule { half: f64, radius: f64 },
}

/// A place in a shape's chart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChartPoint {
    /// Only blocks have more than one.
    pub face: usize,
    /// 0 to 1; goes round for every shape but a block.
    pub u: f64,
    /// 0 to 1.
    pub v: f64,
}

/// Steps after which a marched ray that still creeps along a surface is given up.
const MARCH_STEPS: usize = 96;
/// Distance in metres at which a marched ray has arrived.
const ARRIVED: f64 = 1e-6;

impl Shape {
    /// A profile of (radius, height) pairs turned about z. A closed solid's profile starts on the axis at the bottom and
    /// goes out, up and back to the axis. Corners flatter than about 40 degrees are shaded smoothly.
    pub fn turned(profile: &[(f64, f64)]) -> Vec<Self> {
        let points: Vec<DVec2> = profile.iter().map(|&(r, z)| DVec2::new(r, z)).collect();
        let normals: Vec<DVec2> =
            points.windows(2).map(|w| DVec2::new(w[1].y - w[0].y, w[0].x - w[1].x).normalize_or_zero()).collect();
        let blend = |a: DVec2, b: Option<&DVec2>| match b {
            Some(&b) if a.dot(b) > 0.75 => (a + b).normalize_or_zero(),
            _ => a,
        };
        (0..normals.len())
            .map(|i| Self::Turned {
                from: points[i],
                to: points[i + 1],
                from_normal: blend(normals[i], i.checked_sub(1).and_then(|j| normals.get(j))),
                to_normal: blend(normals[i], normals.get(i + 1)),
            })
            .collect()
    }

    pub fn block(half: [f64; 3], round: f64) -> Self {
        Self::Block { half: DVec3::from_array(half), round }
    }

    pub fn ellipsoid(radii: [f64; 3]) -> Self {
        Self::Ellipsoid { radii: DVec3::from_array(radii) }
    }

    pub fn sphere(radius: f64) -> Self {
        Self::Ellipsoid { radii: DVec3::splat(radius) }
    }

    /// Half extents of the axis-aligned box around the shape, and that box's centre.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        match *self {
            Self::Block { half, .. } => (half, DVec3::ZERO),
            Self::Ellipsoid { radii } => (radii, DVec3::ZERO),
            Self::Turned { from, to, .. } => {
                let r = from.x.max(to.x);
                let (low, high) = (from.y.min(to.y), from.y.max(to.y));
                (DVec3::new(r, r, 0.5 * (high - low)), DVec3::new(0.0, 0.0, 0.5 * (high + low)))
            }
            Self::Ring { major, minor, .. } => (DVec3::new(major + minor, major + minor, minor), DVec3::ZERO),
            Self::Capsule { half, radius } => (DVec3::new(radius, radius, half + radius), DVec3::ZERO),
        }
    }

    /// Distance along the ray to the first meeting after `near` and before `far`, if any. `direction` has unit length.
    pub fn intersect(&self, origin: DVec3, direction: DVec3, near: f64, far: f64) -> Option<f64> {
        match *self {
            Self::Block { half, round } => {
                let (enter, exit) = slab(origin, direction, half)?;
                if round > 0.0 {
                    let (start, end) = (enter.max(near), exit.min(far));
                    return march(origin, direction, start, end, |p| block_distance(p, half, round));
                }
                first([enter, exit], near, far)
            }
            Self::Ellipsoid { radii } => {
                let (o, d) = (origin / radii, direction / radii);
                let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - 1.0);
                first(quadratic(a, b, c)?, near, far)
            }
            Self::Turned { from, to, .. } => turned_hit(from, to, origin, direction, near, far),
            Self::Ring { major, minor, arc } => {
                let (half, _) = self.bounds();
                let (enter, exit) = slab(origin, direction, half)?;
                march(origin, direction, enter.max(near), exit.min(far), |p| ring_distance(p, major, minor, arc))
            }
            Self::Capsule { half, radius } => capsule_hit(half, radius, origin, direction, near, far),
        }
    }

    /// Outward unit normal at a point of the surface.
    pub fn normal(&self, p: DVec3) -> DVec3 {
        match *self {
            Self::Block { half, round } => {
                let inner = half - round;
                let n = p - p.clamp(-inner, inner);
                // Of a sharp box, or of a point that lies a rounding error inside: the nearest face's normal.
                if n.length_squared() > 1e-18 && round > 0.0 {
                    n.normalize_or_zero()
                } else {
                    axis(nearest_face(p, half))
                }
            }
            Self::Ellipsoid { radii } => (p / (radii * radii)).normalize_or_zero(),
            Self::Turned { from, to, from_normal, to_normal } => {
                let n = from_normal.lerp(to_normal, along(p, from, to).clamp(0.0, 1.0)).normalize_or_zero();
                let radial = p.truncate().normalize_or_zero();
                (radial * n.x).extend(n.y).normalize_or_zero()
            }
            Self::Ring { major, arc, .. } => {
                let angle = p.y.atan2(p.x).clamp(-arc, arc);
                (p - DVec3::new(major * angle.cos(), major * angle.sin(), 0.0)).normalize_or_zero()
            }
            Self::Capsule { half, .. } => (p - DVec3::new(0.0, 0.0, p.z.clamp(-half, half))).normalize_or_zero(),
        }
    }

    /// Number of faces of the chart.
    pub fn faces(&self) -> usize {
        if matches!(self, Self::Block { .. }) { 6 } else { 1 }
    }

    /// Greatest extents of a face along u and v, in metres.
    pub fn face_size(&self, face: usize) -> (f64, f64) {
        match *self {
            Self::Block { half, .. } => {
                let (a, b) = face_axes(face);
                (2.0 * half[a], 2.0 * half[b])
            }
            Self::Ellipsoid { radii } => (TAU * radii.truncate().max_element(), PI * radii.max_element()),
            Self::Turned { from, to, .. } => (TAU * from.x.max(to.x), (to - from).length()),
            Self::Ring { major, minor, arc } => (TAU * minor, 2.0 * arc * (major + minor)),
            Self::Capsule { half, radius } => (TAU * radius, 2.0 * half + PI * radius),
        }
    }

    /// Where a point of the surface lies in the chart.
    pub fn chart(&self, p: DVec3) -> ChartPoint {
        let turn = |angle: f64| (angle / TAU).rem_euclid(1.0);
        let (u, v) = match *self {
            Self::Block { half, .. } => {
                let face = nearest_face(p, half);
                let (a, b) = face_axes(face);
                let at = |i: usize| (0.5 + 0.5 * p[i] / half[i]).clamp(0.0, 1.0);
                return ChartPoint { face, u: at(a), v: at(b) };
            }
            Self::Ellipsoid { radii } => {
                let q = p / radii;
                (turn(q.y.atan2(q.x)), q.z.clamp(-1.0, 1.0).acos() / PI)
            }
            Self::Turned { from, to, .. } => (turn(p.y.atan2(p.x)), along(p, from, to)),
            Self::Ring { major, arc, .. } => {
                let angle = p.y.atan2(p.x).clamp(-arc, arc);
                let out = p.truncate().dot(DVec2::new(angle.cos(), angle.sin())) - major;
                (turn(p.z.atan2(out)), 0.5 + 0.5 * angle / arc)
            }
            Self::Capsule { half, radius } => {
                let cap = |h: f64| radius * (h / radius).clamp(-1.0, 1.0).asin();
                let middle = p.z.clamp(-half, half);
                let length = middle + cap(p.z - middle);
                (turn(p.y.atan2(p.x)), 0.5 + length / (2.0 * half + PI * radius))
            }
        };
        ChartPoint { face: 0, u, v: v.clamp(0.0, 1.0) }
    }

    /// The point of the surface at a place of the chart, and its normal.
    pub fn surface(&self, at: ChartPoint) -> (DVec3, DVec3) {
        let angle = at.u * TAU;
        let around = |r: f64, z: f64| DVec3::new(r * angle.cos(), r * angle.sin(), z);
        let p = match *self {
            Self::Block { half, round } => {
                let (a, b) = face_axes(at.face);
                let mut q = axis(at.face) * half;
                q[a] = half[a] * (2.0 * at.u - 1.0);
                q[b] = half[b] * (2.0 * at.v - 1.0);
                let inner = half - round;
                let core = q.clamp(-inner, inner);
                if round > 0.0 { core + (q - core).normalize_or_zero() * round } else { q }
            }
            Self::Ellipsoid { radii } => {
                let polar = at.v * PI;
                around(polar.sin(), polar.cos()) * radii
            }
            Self::Turned { from, to, .. } => {
                let q = from.lerp(to, at.v);
                around(q.x, q.y)
            }
            Self::Ring { major, minor, arc } => {
                let along = arc * (2.0 * at.v - 1.0);
                let r = major + minor * angle.cos();
                DVec3::new(r * along.cos(), r * along.sin(), minor * angle.sin())
            }
            Self::Capsule { half, radius } => {
                let length = (at.v - 0.5) * (2.0 * half + PI * radius);
                let middle = length.clamp(-half, half);
                let tilt = (length - middle) / radius;
                around(radius * tilt.cos(), middle + radius * tilt.sin())
            }
        };
        (p, self.normal(p))
    }
}

/// How far along the line that is turned a point of the surface lies, 0 to 1.
fn along(p: DVec3, from: DVec2, to: DVec2) -> f64 {
    (DVec2::new(p.truncate().length(), p.z) - from).dot(to - from) / (to - from).length_squared()
}

/// Outward direction of face 0..6 of a block: +x -x +y -y +z -z.
fn axis(face: usize) -> DVec3 {
    let mut n = DVec3::ZERO;
    n[face / 2] = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
    n
}

fn face_axes(face: usize) -> (usize, usize) {
    [(1, 2), (2, 0), (0, 1)][face / 2]
}

fn nearest_face(p: DVec3, half: DVec3) -> usize {
    let excess = p.abs() - half;
    let i = (0..3).max_by(|&a, &b| excess[a].total_cmp(&excess[b])).unwrap_or(0);
    2 * i + usize::from(p[i] < 0.0)
}

/// Where the ray enters and leaves the box of half extents `half` around the origin.
fn slab(origin: DVec3, direction: DVec3, half: DVec3) -> Option<(f64, f64)> {
    let (mut enter, mut exit) = (f64::NEG_INFINITY, f64::INFINITY);
    for i in 0..3 {
        if direction[i].abs() < 1e-15 {
            if origin[i].abs() > half[i] {
                return None;
            }
            continue;
        }
        let (a, b) = ((-half[i] - origin[i]) / direction[i], (half[i] - origin[i]) / direction[i]);
        enter = enter.max(a.min(b));
        exit = exit.min(a.max(b));
    }
    (enter <= exit).then_some((enter, exit))
}

fn first(of: [f64; 2], near: f64, far: f64) -> Option<f64> {
    of.into_iter().find(|&t| t > near && t < far)
}

/// Roots of a t^2 + 2 b t + c, ascending.
fn quadratic(a: f64, b: f64, c: f64) -> Option<[f64; 2]> {
    let disc = b * b - a * c;
    if disc < 0.0 || a == 0.0 {
        return None;
    }
    // The root without cancellation first.
    let q = -(b + disc.sqrt().copysign(b));
    let (r, s) = (q / a, if q == 0.0 { 0.0 } else { c / q });
    Some([r.min(s), r.max(s)])
}

fn turned_hit(from: DVec2, to: DVec2, o: DVec3, d: DVec3, near: f64, far: f64) -> Option<f64> {
    let rise = to.y - from.y;
    if rise.abs() < 1e-12 {
        let t = (from.y - o.z) / d.z;
        let r = (o + d * t).truncate().length();
        return (t > near && t < far && r >= from.x.min(to.x) && r <= from.x.max(to.x)).then_some(t);
    }
    // x^2 + y^2 = (slope (z - apex))^2 written with w = r(z) along the ray.
    let slope = (to.x - from.x) / rise;
    let (w, dw) = (from.x + slope * (o.z - from.y), slope * d.z);
    let a = d.truncate().length_squared() - dw * dw;
    let b = o.truncate().dot(d.truncate()) - w * dw;
    let c = o.truncate().length_squared() - w * w;
    let (low, high) = (from.y.min(to.y), from.y.max(to.y));
    let on = |t: f64| {
        let z = o.z + t * d.z;
        t > near && t < far && z >= low && z <= high && w + t * dw >= 0.0
    };
    if a.abs() < 1e-14 {
        let t = -c / (2.0 * b);
        return on(t).then_some(t);
    }
    quadratic(a, b, c)?.into_iter().find(|&t| on(t))
}

fn capsule_hit(half: f64, radius: f64, o: DVec3, d: DVec3, near: f64, far: f64) -> Option<f64> {
    let (od, dd) = (o.truncate(), d.truncate());
    let side = quadratic(dd.length_squared(), od.dot(dd), od.length_squared() - radius * radius);
    let side = side.into_iter().flatten().filter(|t| (o.z + t * d.z).abs() <= half);
    let ends = [-half, half].into_iter().flat_map(|end| {
        let q = o - DVec3::new(0.0, 0.0, end);
        let cap = quadratic(1.0, q.dot(d), q.length_squared() - radius * radius);
        cap.into_iter().flatten().filter(move |t| (q.z + t * d.z) * end.signum() >= 0.0)
    });
    side.chain(ends).filter(|&t| t > near && t < far).min_by(f64::total_cmp)
}

/// Sphere tracing between `start` and `end` with an exact distance.
fn march(o: DVec3, d: DVec3, start: f64, end: f64, distance: impl Fn(DVec3) -> f64) -> Option<f64> {
    let mut t = start;
    for _ in 0..MARCH_STEPS {
        if t > end {
            return None;
        }
        let step = distance(o + d * t).abs();
        if step < ARRIVED {
            return Some(t);
        }
        t += step;
    }
    None
}

fn block_distance(p: DVec3, half: DVec3, round: f64) -> f64 {
    let q = p.abs() - (half - round);
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0) - round
}

fn ring_distance(p: DVec3, major: f64, minor: f64, arc: f64) -> f64 {
    if p.y.atan2(p.x).abs() <= arc {
        return DVec2::new(p.truncate().length() - major, p.z).length() - minor;
    }
    let end = DVec3::new(major * arc.cos(), (major * arc.sin()).copysign(p.y), 0.0);
    (p - end).length() - minor
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::chart_points;

    fn samples() -> Vec<Shape> {
        let mut all = Shape::turned(&[(0.0, 0.0), (0.3, 0.0), (0.5, 0.8), (0.4, 0.8), (0.2, 0.1), (0.0, 0.1)]);
        all.extend([
            Shape::block([0.5, 0.3, 0.2], 0.0),
            Shape::block([0.5, 0.3, 0.2], 0.05),
            Shape::ellipsoid([0.5, 0.3, 0.2]),
            Shape::Ring { major: 0.5, minor: 0.1, arc: PI },
            Shape::Ring { major: 0.5, minor: 0.1, arc: 1.2 },
            Shape::Capsule { half: 0.4, radius: 0.2 },
        ]);
        all
    }

    #[test]
    fn rays_the_chart_and_the_bounds_agree_with_the_surface() {
        for shape in samples() {
            let (half, centre) = shape.bounds();
            for at in chart_points(&shape, 8) {
                let (p, n) = shape.surface(at);
                assert!((n.length() - 1.0).abs() < 1e-9, "{shape:?} {at:?}");
                let height = 0.02;
                let t = shape.intersect(p + n * height, -n, 1e-9, 0.1).unwrap_or_else(|| panic!("{shape:?} {at:?}"));
                assert!((t - height).abs() < 1e-3, "{shape:?} {at:?} {t}");
                assert!((shape.normal(p + n * (height - t)) - n).length() < 0.05);
                assert!(((p - centre).abs() - half).max_element() < 1e-9, "{shape:?}");
                // Of a rounded box the chart is that of the box around it.
                let back = shape.chart(p);
                let near = back.face == at.face && (back.u - at.u).abs() < 1e-6 && (back.v - at.v).abs() < 1e-6;
                assert!(
                    near || matches!(shape, Shape::Block { round, .. } if round > 0.0),
                    "{shape:?} {at:?} {back:?}"
                );
            }
        }
    }

    #[test]
    fn rays_through_the_middle_meet_a_solid_on_both_sides() {
        let solids = [
            Shape::block([0.3; 3], 0.0),
            Shape::block([0.3; 3], 0.1),
            Shape::sphere(0.3),
            Shape::Capsule { half: 0.2, radius: 0.3 },
        ];
        for shape in solids {
            let t = shape.intersect(DVec3::new(-1.0, 0.0, 0.0), DVec3::X, 0.0, 9.0).unwrap();
            assert!((t - 0.7).abs() < 1e-5, "{shape:?} {t}");
            assert!(shape.intersect(DVec3::new(-1.0, 0.9, 0.0), DVec3::X, 0.0, 9.0).is_none());
            let t = shape.intersect(DVec3::new(0.0, 0.0, -0.9), DVec3::Z, 0.0, 0.05);
            assert!(t.is_none(), "nothing within reach");
        }
    }
}
