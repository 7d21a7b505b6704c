//! A coarse closed mesh around an object: the convex hull of its outermost centres.

use crate::mesh::Mesh;
use glam::DVec3;
use objects::ObjectBox;
use parry3d_f64::math::Vector;
use parry3d_f64::transformation::try_convex_hull;
use std::collections::BTreeSet;
use std::f64::consts::TAU;

/// Least half side of the box that takes the place of a hull, in half its longest side: physics needs a volume.
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

/// The convex hull; none where the points span no volume.
fn convex(points: &[DVec3]) -> Option<Mesh> {
    if points.len() < 4 {
        return None;
    }
    // Around their middle and of size 1: the library's tolerances are absolute.
    let middle = points.iter().sum::<DVec3>() / points.len() as f64;
    let size = points.iter().map(|p| p.distance(middle)).fold(0.0, f64::max);
    if !(size > 0.0 && size.is_finite()) {
        return None;
    }
    let scaled: Vec<Vector> = points.iter().map(|p| ((*p - middle) / size).to_array().into()).collect();
    let (corners, triangles) = try_convex_hull(&scaled).ok()?;
    let place = |v: &Vector| (DVec3::new(v.x, v.y, v.z) * size + middle).as_vec3().to_array();
    Some(Mesh { vertices: corners.iter().map(place).collect(), triangles })
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
        for points in [flat, line, vec![[1.0, 2.0, 3.0]; 30], vec![[1.0; 3]]] {
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
