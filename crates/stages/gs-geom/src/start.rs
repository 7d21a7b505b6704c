//! Where Gaussians start: at the dataset's points, at those of its depth images, at random in front of the cameras, or as a PLY
//! says.

pub mod depths;

use crate::training::optimiser::zeros;
use crate::training::schedule::{Purpose, generator};
use glam::{DMat3, DVec3};
use gs_io::{Error, Result};
use gs_scene::{Camera, Gaussians, PointCloud, SH_C0, logit, points::KdTree};
use gs_sfm::sweep::Swept;
use rand::RngExt;
use rand::seq::index::sample;
use rayon::prelude::*;

/// Opacity of a new Gaussian.
const START_OPACITY: f32 = 0.1;
/// That of a pixel of a depth map: more, because these are fewer for what they cover.
const SWEPT_OPACITY: f32 = 0.2;
/// Neighbours whose distances set a new Gaussian's size.
const NEIGHBOURS: usize = 3;
/// Smallest size of a new Gaussian, as a share of the scene's extent: points may coincide.
const LEAST_SCALE: f32 = 1e-5;
/// Largest size of a new Gaussian, as a share of the scene's extent: a lone stray point must not cover the scene.
const MOST_SCALE: f32 = 1.0;

/// Size of the scene by its cameras, world units: 1.1 times the largest distance of a camera from their mean (3DGS's
/// `cameras_extent`). Where the cameras coincide, the median distance of the points from them, or else 1.
pub fn extent(cameras: &[&Camera], points: &[[f32; 3]]) -> f64 {
    let centres: Vec<DVec3> = cameras.iter().map(|c| c.position()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let radius = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
    let mut distances: Vec<f64> = points.iter().map(|p| mean.distance(DVec3::from(p.map(f64::from)))).collect();
    distances.sort_by(f64::total_cmp);
    let median = distances.get(distances.len() / 2).copied().filter(|&d| d > 0.0).unwrap_or(1.0);
    if radius > 1e-6 * median { 1.1 * radius } else { median }
}

/// One Gaussian per point, in the points' order: round, as large as the root mean squared distance to the three nearest
/// other places, opacity 0.1, the point's colour.
pub fn from_points(points: &PointCloud, sh_degree: u8, extent: f64) -> Result<Gaussians> {
    let bad = points.positions.iter().position(|p| p.iter().any(|v| !v.is_finite()));
    if let Some(i) = bad {
        return Err(Error::new("a point's position is not finite")
            .field(format!("point {i}"))
            .found(format!("{:?}", points.positions[i]))
            .hint("remove it from the dataset"));
    }
    if points.is_empty() {
        return Err(Error::new("no points to start from").hint("give another --init"));
    }
    let n = points.len();
    let mut g = zeros(n, sh_degree);
    let stride = g.sh_stride();
    let limits = [LEAST_SCALE, MOST_SCALE].map(|s| (f64::from(s) * extent).max(f64::MIN_POSITIVE) as f32);
    for (i, size) in spacing(&points.positions, limits[1]).into_iter().enumerate() {
        g.means[i] = points.positions[i];
        g.log_scales[i] = [size.clamp(limits[0], limits[1]).ln(); 3];
        g.rotations[i] = [1.0, 0.0, 0.0, 0.0];
        g.opacity_logits[i] = logit(START_OPACITY);
        for c in 0..3 {
            g.sh[i * stride + c] = (f32::from(points.colors[i][c]) / 255.0 - 0.5) / SH_C0;
        }
    }
    Ok(g)
}

/// One Gaussian for each point of a plane sweep.
pub fn from_sweep(swept: &Swept, sh_degree: u8, extent: f64) -> Result<Gaussians> {
    let mut g = from_points(&swept.points, sh_degree, extent)?;
    for (scales, most) in g.log_scales.iter_mut().zip(&swept.most_sizes) {
        *scales = scales.map(|s| s.min(most.ln() as f32));
    }
    g.opacity_logits[swept.corners..].fill(logit(SWEPT_OPACITY));
    Ok(g)
}

/// `count` of the points, drawn at random, in their order; all where there are no more.
pub fn some_points(points: &PointCloud, count: usize, seed: u64) -> PointCloud {
    let n = points.len();
    let mut chosen = sample(&mut generator(seed, Purpose::Start, 1), n, count.min(n)).into_vec();
    chosen.sort_unstable();
    PointCloud {
        positions: chosen.iter().map(|&i| points.positions[i]).collect(),
        colors: chosen.iter().map(|&i| points.colors[i]).collect(),
        ..PointCloud::default()
    }
}

/// Root mean squared distance of each position to its three nearest other places; `alone` where there is no other.
///
/// Coinciding positions count as one place: they would make sizes zero.
fn spacing(positions: &[[f32; 3]], alone: f32) -> Vec<f32> {
    let mut order: Vec<u32> = (0..positions.len() as u32).collect();
    let key = |i: u32| positions[i as usize].map(|v| v + 0.0);
    order.sort_unstable_by(|&a, &b| key(a).partial_cmp(&key(b)).expect("positions are finite"));
    let mut places: Vec<[f32; 3]> = Vec::new();
    let mut place_of = vec![0u32; positions.len()];
    for i in order {
        if places.last() != Some(&key(i)) {
            places.push(key(i));
        }
        place_of[i as usize] = places.len() as u32 - 1;
    }
    let tree = KdTree::new(&places);
    let sizes: Vec<f32> = places
        .par_iter()
        .map_init(Vec::new, |found, &p| {
            // One more, because each place finds itself.
            tree.nearest(p, NEIGHBOURS + 1, found);
            let others = found.get(1..).unwrap_or_default();
            let mean = others.iter().map(|f| f64::from(f.0)).sum::<f64>() / others.len() as f64;
            if mean.is_finite() { mean.sqrt() as f32 } else { alone }
        })
        .collect();
    place_of.iter().map(|&p| sizes[p as usize]).collect()
}

/// `count` grey points in front of the cameras, for datasets without points: at a random pixel of a random camera, at a
/// depth from 0.3 to 1.7 times the distance to where the cameras look.
pub fn random_points(cameras: &[&Camera], count: usize, seed: u64) -> PointCloud {
    let mut rng = generator(seed, Purpose::Start, 0);
    let target = focus(cameras);
    let positions = (0..if cameras.is_empty() { 0 } else { count })
        .map(|_| {
            let c = cameras[rng.random_range(0..cameras.len())];
            let (u, v) = (rng.random_range(0.0..f64::from(c.width)), rng.random_range(0.0..f64::from(c.height)));
            let depth = c.to_camera(target).length().max(1e-6) * rng.random_range(0.3..1.7);
            let p = DVec3::new((u - c.cx) / c.fx * depth, (v - c.cy) / c.fy * depth, depth);
            let world = c.rotation.transpose() * (p - c.translation);
            world.as_vec3().to_array()
        })
        .collect::<Vec<_>>();
    PointCloud { colors: vec![[128; 3]; positions.len()], positions, ..PointCloud::default() }
}

/// The point nearest to all optical axes in the least-squares sense; one unit ahead of the cameras where that is
/// undetermined or behind them.
fn focus(cameras: &[&Camera]) -> DVec3 {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    let (mut mean, mut ahead) = (DVec3::ZERO, DVec3::ZERO);
    for c in cameras {
        let d = c.rotation.transpose() * DVec3::Z;
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * c.position();
        mean += c.position() / cameras.len() as f64;
        ahead += d;
    }
    let fallback = mean + ahead.normalize_or(DVec3::Z);
    // The determinant of a sum of n projections is at most n^3; small means nearly parallel axes.
    if a.determinant() < 1e-3 * (cameras.len() as f64).powi(3) {
        return fallback;
    }
    let point = a.inverse() * b;
    let in_front = cameras.iter().filter(|c| c.to_camera(point).z > 0.0).count();
    if point.is_finite() && 2 * in_front > cameras.len() { point } else { fallback }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cloud(positions: Vec<[f32; 3]>) -> PointCloud {
        PointCloud { colors: vec![[255, 0, 51]; positions.len()], positions, ..PointCloud::default() }
    }

    #[test]
    fn a_gaussian_has_its_points_place_and_colour() {
        let g = from_points(&cloud(vec![[1.0, 2.0, 3.0], [1.0, 2.0, 5.0]]), 2, 10.0).unwrap();
        assert_eq!(g.means[0], [1.0, 2.0, 3.0]);
        assert!((g.log_scales[1][2] - 2.0f32.ln()).abs() < 1e-6, "one neighbour, two away");
        assert!((g.opacity(0) - 0.1).abs() < 1e-6);
        assert!(g.base_color(0).iter().zip([1.0, 0.0, 0.2]).all(|(a, b)| (a - b).abs() < 1e-6));
        assert!(g.check().is_ok());
    }

    #[test]
    fn some_of_the_points_are_different_points() {
        let all = cloud((0..100).map(|i| [i as f32, 0.0, 0.0]).collect());
        let some = some_points(&all, 30, 1);
        assert!(some.len() == 30 && some.positions.is_sorted() && some.colors.len() == 30);
        assert!(some.positions.windows(2).all(|w| w[0] != w[1]));
        assert_ne!(some, some_points(&all, 30, 2));
        assert_eq!(some_points(&all, 200, 1), all);
    }

    #[test]
    fn lone_and_coinciding_points_have_a_size() {
        for positions in [vec![[5.0; 3]], vec![[5.0; 3]; 100]] {
            let g = from_points(&cloud(positions), 0, 2.0).unwrap();
            assert!(g.log_scales.iter().flatten().all(|s| (s.exp() - 2.0).abs() < 1e-5));
        }
        let mut twice = vec![[0.0; 3]; 50];
        twice.extend([[1.0, 0.0, 0.0], [-0.0, 0.0, -0.0]]);
        let g = from_points(&cloud(twice), 0, 2.0).unwrap();
        assert!(g.log_scales.iter().flatten().all(|s| s.abs() < 1e-6));
        assert!(from_points(&cloud(vec![]), 0, 1.0).is_err());
        let e = from_points(&cloud(vec![[0.0; 3], [0.0, f32::NAN, 0.0]]), 0, 1.0).unwrap_err().to_string();
        assert!(e.contains("point 1"), "{e}");
    }

    #[test]
    fn cameras_give_the_extent() {
        let at = |x: f64| Camera::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 5.0, 0.0), DVec3::Z, 64, 48, 1.0);
        let (a, b) = (at(0.0), at(4.0));
        assert!((extent(&[&a, &b], &[]) - 2.2).abs() < 1e-9);
        assert!((extent(&[&a], &[[0.0, 3.0, 0.0]]) - 3.0).abs() < 1e-9);
        assert_eq!(extent(&[&a], &[]), 1.0);
    }

    #[test]
    fn random_points_are_seen() {
        let eyes = [[3.0, 0.0, 0.0], [0.0, 3.0, 0.5], [-3.0, 0.0, 1.0]].map(DVec3::from);
        let cameras = eyes.map(|e| Camera::look_at(e, DVec3::new(0.5, 0.5, 0.0), DVec3::Z, 64, 48, 1.0));
        let cameras: Vec<&Camera> = cameras.iter().collect();
        assert!(focus(&cameras).distance(DVec3::new(0.5, 0.5, 0.0)) < 1e-9);
        let points = random_points(&cameras, 500, 7);
        assert_eq!(points.len(), 500);
        assert_eq!(points, random_points(&cameras, 500, 7));
        for p in &points.positions {
            let seen = cameras.iter().any(|c| {
                let (u, v, z) = c.project(DVec3::from(p.map(f64::from)));
                z > 0.0 && (-0.01..64.01).contains(&u) && (-0.01..48.01).contains(&v)
            });
            assert!(seen);
        }
        assert!(focus(&cameras[..1]).distance(cameras[0].position()) - 1.0 < 1e-9);
    }

    #[test]
    fn degrees_are_cut_and_filled() {
        let mut g = zeros(2, 1);
        g.sh = (0..24).map(|v| v as f32).collect();
        let up = g.clone().with_degree(3);
        assert_eq!(up.sh_of(1)[..12], g.sh[12..]);
        assert!(up.sh_of(1)[12..].iter().all(|&v| v == 0.0) && up.check().is_ok());
        assert_eq!(up.with_degree(1), g);
    }

    proptest! {
        #[test]
        fn sizes_are_those_of_brute_force(
            cells in prop::collection::vec((0i8..6, 0i8..6, -1i8..2), 2..80),
        ) {
            // On a grid, with coinciding points and many equal distances.
            let positions: Vec<[f32; 3]> = cells.iter().map(|&(x, y, z)| [f32::from(x), f32::from(y), f32::from(z)]).collect();
            let mut places = positions.clone();
            places.sort_by(|a, b| a.partial_cmp(b).unwrap());
            places.dedup();
            for (p, size) in positions.iter().zip(spacing(&positions, 77.0)) {
                let mut d: Vec<f32> = places.iter().map(|q| (0..3).map(|c| (p[c] - q[c]).powi(2)).sum()).collect();
                d.sort_by(f32::total_cmp);
                let others = &d[1..d.len().min(4)];
                let wanted = if others.is_empty() { 77.0 } else { (others.iter().sum::<f32>() / others.len() as f32).sqrt() };
                prop_assert!((size - wanted).abs() < 1e-5);
            }
        }
    }
}
