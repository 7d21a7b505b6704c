//! A coarse closed mesh around an object: the convex hull of its outermost centres.

use crate::mesh::Mesh;
use glam::DVec3;
use objects::ObjectBox;
use robust::{Coord3D, orient3d};
use std::collections::BTreeSet;
use std::f64::consts::TAU;

/// Least thickness of a hull, in its length, and of the box that takes the place of a thinner one: physics needs a volume.
const THINNEST: f32 = 1e-3;

/// A closed convex mesh of at most `vertices` corners around those centres that lie in the box, each of them the outermost in
/// one of so many directions spread over the sphere. Where they span no volume, the box itself, at least a little thick.
/// Whether it is the box comes with it.
pub fn hull(centers: &[[f32; 3]], bounds: &ObjectBox, vertices: usize) -> (Mesh, bool) {
    let inside = within(centers, bounds);
    let outermost = outermost(&inside, vertices);
    let found = convex(&outermost).filter(|mesh| mesh.is_closed() && mesh.volume() > 0.0);
    found.map_or_else(|| (of_box(bounds), true), |mesh| (mesh, false))
}

/// The centres in the box, a little beyond its sides too: it is stored with single precision.
fn within(centers: &[[f32; 3]], b: &ObjectBox) -> Vec<DVec3> {
    let of = |v: &[f32; 3]| DVec3::from(v.map(f64::from));
    let slack = 1e-5 * f64::from(b.half_size.iter().copied().fold(0.0, f32::max)) + 1e-6 * of(&b.center).length();
    let inside =
        |p: &DVec3| (0..3).all(|c| (*p - of(&b.center)).dot(of(&b.axes[c])).abs() <= f64::from(b.half_size[c]) + slack);
    centers.iter().map(of).filter(inside).collect()
}

/// The outermost points in `count` directions, spread over the sphere along a spiral.
fn outermost(points: &[DVec3], count: usize) -> Vec<DVec3> {
    const GOLDEN: f64 = 0.618_033_988_749_894_8;
    let direction = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f64 / count as f64;
        let (sin, cos) = (TAU * GOLDEN * i as f64).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    };
    let farthest = |d: DVec3| (0..points.len()).reduce(|a, b| if points[b].dot(d) > points[a].dot(d) { b } else { a });
    let chosen: BTreeSet<usize> = (0..count).filter_map(|i| farthest(direction(i))).collect();
    let mut chosen: Vec<DVec3> = chosen.into_iter().map(|i| points[i]).collect();
    // Two Gaussians at one place are one corner.
    chosen.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z)));
    chosen.dedup();
    chosen
}

/// The convex hull; none where the points are flat. Grown point by point from a tetrahedron; signs of volumes are exact, so that it is
/// closed wherever the points lie.
fn convex(points: &[DVec3]) -> Option<Mesh> {
    let coord = |i: usize| Coord3D { x: points[i].x, y: points[i].y, z: points[i].z };
    let beyond = |[a, b, c]: [usize; 3], p: usize| -orient3d(coord(a), coord(b), coord(c), coord(p));
    let most = |of: &dyn Fn(usize) -> f64| (0..points.len()).max_by(|&i, &j| of(i).total_cmp(&of(j)));
    let a = most(&|i| -points[i].x)?;
    let b = most(&|i| points[i].distance_squared(points[a]))?;
    let c = most(&|i| (points[i] - points[a]).cross(points[b] - points[a]).length_squared())?;
    let d = most(&|i| beyond([a, b, c], i).abs())?;
    let volume = beyond([a, b, c], d);
    let [ab, ac] = [b, c].map(|i| points[i] - points[a]);
    // Points of a tilted plane, rounded, are not quite in one.
    if volume.abs() <= f64::from(THINNEST) * ab.length() * ab.cross(ac).length() {
        return None;
    }
    let (b, c) = if volume < 0.0 { (b, c) } else { (c, b) };
    // Counterclockwise as seen from outside.
    let mut faces = vec![[a, b, c], [b, a, d], [c, b, d], [a, c, d]];
    for p in 0..points.len() {
        let (seen, hidden): (Vec<_>, Vec<_>) = faces.into_iter().partition(|&face| beyond(face, p) > 0.0);
        let edges = || seen.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
        let rim = edges().filter(|&[a, b]| !edges().any(|edge| edge == [b, a]));
        faces = hidden;
        faces.extend(rim.map(|[a, b]| [a, b, p]));
    }
    let corners: Vec<usize> = faces.iter().flatten().copied().collect::<BTreeSet<_>>().into_iter().collect();
    let number = |i: usize| corners.partition_point(|&c| c < i) as u32;
    Some(Mesh {
        vertices: corners.iter().map(|&i| points[i].as_vec3().to_array()).collect(),
        triangles: faces.iter().map(|face| face.map(number)).collect(),
    })
}

/// A box as a mesh.
fn of_box(bounds: &ObjectBox) -> Mesh {
    let longest = bounds.half_size.iter().copied().fold(0.0, f32::max);
    // And never so thin that single precision cannot tell its corners apart.
    let place = bounds.center.iter().fold(1.0f32, |most, v| most.max(v.abs()));
    let least = (THINNEST * longest).max(1e-5 * place);
    let thick = ObjectBox { half_size: bounds.half_size.map(|h| h.max(least)), ..*bounds };
    // Corner numbers: bit c says which end of axis c.
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    Mesh { vertices: thick.corners().to_vec(), triangles }
}

#[cfg(test)]
mod tests {
    use super::*;
    use objects::upright_box;
    use proptest::prelude::*;

    fn grid(size: [f32; 3], at: [f32; 3]) -> Vec<[f32; 3]> {
        let steps = || (0..=10).map(|i| i as f32 / 10.0);
        steps()
            .flat_map(|x| steps().flat_map(move |y| steps().map(move |z| [x, y, z])))
            .map(|p| std::array::from_fn(|c| p[c] * size[c] + at[c]))
            .collect()
    }

    fn of(points: &[[f32; 3]]) -> (Mesh, bool) {
        hull(points, &upright_box(points, Some(DVec3::Z)), 64)
    }

    #[test]
    fn the_hull_of_a_box_is_the_box() {
        for (size, at) in
            [([1.0, 2.0, 3.0], [0.0; 3]), ([0.01, 0.02, 0.04], [50.0, -80.0, 3.0]), ([900.0; 3], [0.0; 3])]
        {
            let (mesh, is_box) = of(&grid(size, at));
            assert!(!is_box && mesh.is_closed(), "{mesh:?}");
            let volume = f64::from(size[0] * size[1] * size[2]);
            assert!((mesh.volume() / volume - 1.0).abs() < 1e-3, "{} of {volume}", mesh.volume());
            assert_eq!(mesh.vertices.len(), 8);
        }
    }

    #[test]
    fn a_ball_has_a_closed_hull_of_few_corners() {
        let spread = outermost_of_a_ball();
        let (mesh, is_box) = of(&spread);
        assert!(!is_box && mesh.is_closed() && mesh.vertices.len() <= 64);
        let volume = 4.0 / 3.0 * std::f64::consts::PI;
        assert!(mesh.volume() < volume && mesh.volume() > 0.75 * volume, "{}", mesh.volume());
        // Corners are centres of the object.
        assert!(mesh.vertices.iter().all(|v| spread.iter().any(|p| (0..3).all(|c| (p[c] - v[c]).abs() < 1e-5))));
    }

    proptest! {
        #[test]
        fn hulls_are_closed_and_hold_all_points(
            points in prop::collection::vec(prop::array::uniform3(-3i8..4), 4..40),
            scale in 1e-3f32..1e3,
            jitter in prop::array::uniform3(-1e-6f32..1e-6),
        ) {
            // Many of a grid lie in one plane or on one line; some no more quite.
            let place = |(i, p): (usize, &[i8; 3])| {
                DVec3::from([0, 1, 2].map(|c| f64::from(f32::from(p[c]) * scale + if i % 3 == 0 { jitter[c] } else { 0.0 })))
            };
            let points: Vec<DVec3> = points.iter().enumerate().map(place).collect();
            let Some(mesh) = convex(&points) else { return Ok(()) };
            prop_assert!(mesh.is_closed() && mesh.volume() > 0.0);
            let coord = |p: DVec3| Coord3D { x: p.x, y: p.y, z: p.z };
            for t in &mesh.triangles {
                let [a, b, c] = t.map(|i| coord(DVec3::from(mesh.vertices[i as usize].map(f64::from))));
                prop_assert!(points.iter().all(|&p| orient3d(a, b, c, coord(p)) >= 0.0));
            }
        }
    }

    fn outermost_of_a_ball() -> Vec<[f32; 3]> {
        (0..4000u32)
            .map(|i| {
                let z = 1.0 - (2.0 * f64::from(i) + 1.0) / 4000.0;
                let (sin, cos) = (f64::from(i) * 2.4).sin_cos();
                let r = (1.0 - z * z).sqrt();
                [r * cos, r * sin, z].map(|v| v as f32)
            })
            .collect()
    }

    #[test]
    fn what_has_no_volume_gets_its_box() {
        let flat: Vec<[f32; 3]> = (0..100).map(|i| [(i % 10) as f32, (i / 10) as f32, 2.0]).collect();
        let line: Vec<[f32; 3]> = (0..100).map(|i| [i as f32, i as f32, 2.0]).collect();
        let tilted: Vec<[f32; 3]> = flat.iter().map(|&[x, y, _]| [x, y, 0.3 * x + 0.7 * y + 50.0]).collect();
        for points in [flat, tilted, line, vec![[1.0, 2.0, 3.0]; 30], vec![[1.0; 3]]] {
            let (mesh, is_box) = of(&points);
            assert!(is_box && mesh.is_closed() && mesh.volume() > 0.0, "{mesh:?}");
        }
    }

    #[test]
    fn floaters_are_left_out() {
        let mut points = grid([1.0; 3], [0.0; 3]);
        points.push([40.0, 0.5, 0.5]);
        assert!((of(&points).0.volume() - 1.0).abs() < 1e-3);
    }
}
