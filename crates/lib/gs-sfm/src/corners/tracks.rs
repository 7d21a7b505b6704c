//! Corners of several photographs that are one point of the scene, and where that point lies.

use super::pairs::EXACT;
use glam::{DMat3, DVec2, DVec3};
use gs_scene::Camera;

/// Least angle between the outermost sights of a point, in degrees: below, its depth is a guess.
const LEAST_ANGLE: f64 = 1.5;

/// A corner in a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Sighting {
    pub view: usize,
    pub corner: usize,
}

/// Joins matches into tracks: sightings of one point, at most one a view, sorted. A view that would have two is left out of that
/// track. `counts` are the corners of each view.
pub(super) fn join(counts: &[usize], pairs: &[([usize; 2], Vec<[usize; 2]>)]) -> Vec<Vec<Sighting>> {
    let mut first = vec![0];
    counts.iter().for_each(|n| first.push(first[first.len() - 1] + n));
    let mut parent: Vec<usize> = (0..first[counts.len()]).collect();
    fn root(parent: &mut [usize], mut i: usize) -> usize {
        while parent[i] != i {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        i
    }
    for ([a, b], matches) in pairs {
        for [i, j] in matches {
            let (x, y) = (root(&mut parent, first[*a] + i), root(&mut parent, first[*b] + j));
            // The least is the root: the order of tracks is that of their first corners.
            parent[x.max(y)] = x.min(y);
        }
    }
    let mut members = vec![Vec::new(); parent.len()];
    for (view, count) in counts.iter().enumerate() {
        for corner in 0..*count {
            members[root(&mut parent, first[view] + corner)].push(Sighting { view, corner });
        }
    }
    let alone = |track: &[Sighting], s: &Sighting| track.iter().filter(|o| o.view == s.view).count() == 1;
    let tracks = members.into_iter().map(|t| t.iter().copied().filter(|s| alone(&t, s)).collect::<Vec<_>>());
    tracks.filter(|t| t.len() > 1).collect()
}

/// A point of the scene with what shows it.
#[derive(Debug, Clone)]
pub(super) struct Point {
    /// Position of its track.
    pub track: usize,
    pub place: DVec3,
    /// The camera and where in it, in pixels.
    pub seen: Vec<(Sighting, DVec2)>,
}

/// The limit of a point's error in a view, in pixels: `share` of the diagonal.
pub(super) fn limit(c: &Camera, share: f64) -> f64 {
    share * f64::from(c.width).hypot(f64::from(c.height))
}

/// Where the sights meet, in the least-squares sense of pixels. Sights farther off than `slack` times [`EXACT`] are dropped, the
/// worst first; none where fewer than two are left, the point is behind a camera, or the angle too small.
pub(super) fn place(track: usize, mut seen: Vec<(Sighting, DVec2)>, cameras: &[Camera], slack: f64) -> Option<Point> {
    while seen.len() > 1 {
        let place = meet(&seen, cameras)?;
        let error = |(s, at): &(Sighting, DVec2)| {
            let c = &cameras[s.view];
            error(c, place, *at).map_or(f64::INFINITY, |e| e.length() / limit(c, slack * EXACT))
        };
        let errors: Vec<f64> = seen.iter().map(error).collect();
        let worst = (0..seen.len()).max_by(|&a, &b| errors[a].total_cmp(&errors[b])).expect("two at least");
        if errors[worst] <= 1.0 {
            let ways: Vec<DVec3> =
                seen.iter().map(|(s, _)| (place - cameras[s.view].position()).normalize_or_zero()).collect();
            let least = LEAST_ANGLE.to_radians().cos();
            let wide = ways.iter().enumerate().any(|(i, a)| ways[i + 1..].iter().any(|b| a.dot(*b) < least));
            return wide.then_some(Point { track, place, seen });
        }
        seen.remove(worst);
    }
    None
}

/// Pixels from where a camera has a point to where it is seen; none behind the camera.
pub(super) fn error(c: &Camera, place: DVec3, at: DVec2) -> Option<DVec2> {
    let (u, v, z) = c.project(place);
    (z > 0.0).then(|| DVec2::new(u, v) - at)
}

/// The point nearest to all sights, then Gauss and Newton's steps on the pixels.
fn meet(seen: &[(Sighting, DVec2)], cameras: &[Camera]) -> Option<DVec3> {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for (s, at) in seen {
        let c = &cameras[s.view];
        let way = DVec3::new((at.x - c.cx) / c.fx, (at.y - c.cy) / c.fy, 1.0);
        let d = (c.rotation.transpose() * way).normalize();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * c.position();
    }
    // Of sights that are parallel to 0.1 degrees.
    if a.determinant() < 1e-6 * (seen.len() as f64).powi(3) {
        return None;
    }
    let mut place = a.inverse() * b;
    for _ in 0..5 {
        let (mut h, mut g) = (DMat3::ZERO, DVec3::ZERO);
        for (s, at) in seen {
            let c = &cameras[s.view];
            let p = c.to_camera(place);
            if p.z <= 0.0 {
                return None;
            }
            let r = error(c, place, *at)?;
            let rows = [
                c.rotation.transpose() * DVec3::new(c.fx / p.z, 0.0, -c.fx * p.x / (p.z * p.z)),
                c.rotation.transpose() * DVec3::new(0.0, c.fy / p.z, -c.fy * p.y / (p.z * p.z)),
            ];
            for (row, r) in rows.iter().zip(r.to_array()) {
                h += DMat3::from_cols(*row * row.x, *row * row.y, *row * row.z);
                g += *row * r;
            }
        }
        let step = h.inverse() * g;
        if !step.is_finite() {
            return None;
        }
        place -= step;
    }
    place.is_finite().then_some(place)
}
