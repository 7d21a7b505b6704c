//! Corners without pictures: points of a known place, seen by cameras of a known pose.

use super::*;
use crate::solve;
use crate::turn::{moved, turned_from};
use detect::Code;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

struct World {
    cameras: Vec<Camera>,
    places: Vec<DVec3>,
    rng: ChaCha8Rng,
}

impl World {
    /// `views` cameras around a cloud of `points`.
    fn new(views: usize, points: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut ball = |r: f64| DVec3::new(rng.random_range(-r..r), rng.random_range(-r..r), rng.random_range(-r..r));
        let places = (0..points).map(|_| ball(1.0)).collect();
        let camera = |i: usize| {
            let angle = 0.15 * i as f64;
            let eye = DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 1.0 + 0.2 * (3.0 * angle).sin());
            Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 640, 480, 1.0)
        };
        Self { cameras: (0..views).map(camera).collect(), places, rng }
    }

    fn any(&mut self, size: f64) -> DVec3 {
        let mut one = || self.rng.random_range(-size..size);
        DVec3::new(one(), one(), one())
    }

    /// The cameras turned by up to `degrees` about each axis, shifted by up to as many hundredths.
    fn shaken(&mut self, degrees: f64) -> Vec<Camera> {
        let cameras = self.cameras.clone();
        cameras.iter().map(|c| moved(c, self.any(degrees.to_radians()), self.any(0.01 * degrees), 0.0)).collect()
    }

    /// Every point in every camera.
    fn sightings(&self, point: usize) -> Vec<(Sighting, DVec2)> {
        let one = |(view, c): (usize, &Camera)| {
            let (u, v, _) = c.project(self.places[point]);
            (Sighting { view, corner: point }, DVec2::new(u, v))
        };
        self.cameras.iter().enumerate().map(one).collect()
    }

    fn points(&self, cameras: &[Camera]) -> Vec<Point> {
        let one = |i: usize| place(i, self.sightings(i), cameras, 30.0);
        (0..self.places.len()).filter_map(one).collect()
    }
}

/// Largest error of relative turns in degrees, and of the corners in pixels.
fn errors(world: &World, cameras: &[Camera], points: &[Point]) -> (f64, f64) {
    let between = |c: &[Camera], i: usize| c[i].rotation * c[0].rotation.transpose();
    let turns = (1..cameras.len()).map(|i| turned_from(&between(&world.cameras, i), &between(cameras, i)).length());
    let corners =
        points.iter().flat_map(|p| p.seen.iter().map(|(s, at)| error(&cameras[s.view], p.place, *at).unwrap()));
    (turns.fold(0.0, f64::max).to_degrees(), corners.map(DVec2::length).fold(0.0, f64::max))
}

fn fit(cameras: &mut [Camera], given: &[Camera], points: &mut [Point], slack: Slack, width: f64) {
    let (lenses, free) = (vec![0; given.len()], vec![true; given.len()]);
    Bundle { cameras, given, lenses: &lenses, free: &free, points, slack, all: true }.adjust(width);
}

/// Few points, seen not quite exactly: many poses fit them.
#[test]
fn poses_that_fit_stay_and_a_wrong_one_among_them_comes_back() {
    let mut world = World::new(12, 25);
    let noise: Vec<DVec2> = (0..12 * 25).map(|_| world.any(0.5).truncate()).collect();
    let mut given = world.cameras.clone();
    given[5] = moved(&given[5], world.any(0.03), world.any(0.02), 0.0);
    let fitted = |learn: bool| {
        let (mut cameras, mut slack) = (given.clone(), Slack::widest(4.0));
        for width in [4.0, 2.0, 1.0, 0.5] {
            let mut points = world.points(&cameras);
            for p in &mut points {
                p.seen.iter_mut().for_each(|(s, at)| *at += noise[s.view * 25 + p.track]);
            }
            fit(&mut cameras, &given, &mut points, slack, width);
            if learn {
                slack = slack.learnt(&cameras, &given, &[true; 12]);
            }
        }
        let turn = |v: usize| turned_from(&world.cameras[v].rotation, &cameras[v].rotation).length().to_degrees();
        (turn(5), (0..12).filter(|&v| v != 5).map(turn).fold(0.0, f64::max))
    };
    let (free, learnt) = (fitted(false), fitted(true));
    assert!(learnt.0 < 0.3 && 4.0 * learnt.1 < free.1, "{learnt:?}, {free:?} with the widest slack");
}

#[test]
fn shaken_cameras_come_back() {
    let mut world = World::new(12, 150);
    let given = world.shaken(1.5);
    let mut cameras = given.clone();
    // A focal length that is 1 % off, too.
    cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (1.01 * c.fx, 1.01 * c.fy));
    let given: Vec<Camera> = cameras.clone();
    let before = errors(&world, &cameras, &world.points(&cameras));
    for width in [4.0, 1.0, 0.5] {
        let mut points = world.points(&cameras);
        fit(&mut cameras, &given, &mut points, Slack::widest(4.0), width);
    }
    let after = errors(&world, &cameras, &world.points(&cameras));
    assert!(before.0 > 1.0 && before.1 > 5.0, "{before:?}");
    // The expectation that the poses are about as given bends them a little.
    assert!(after.0 < 0.05 && after.1 < 0.3, "{after:?}");
    assert!((cameras[0].fx / world.cameras[0].fx - 1.0).abs() < 0.004, "{}", cameras[0].fx / world.cameras[0].fx);
    // The scene stays where the given poses have it.
    let middle = |c: &[Camera]| c.iter().map(Camera::position).sum::<DVec3>() / 12.0;
    assert!(middle(&cameras).distance(middle(&given)) < 0.01);
}

#[test]
fn poses_are_refined_where_corners_say_that_it_pays() {
    let mut world = World::new(12, 150);
    let corners: Vec<Corners> = (0..12)
        .map(|view| {
            let at = (0..150).map(|i| (world.sightings(i)[view].1 + world.any(0.4).truncate()).to_array()).collect();
            Corners { at, ..Corners::default() }
        })
        .collect();
    let track = |i: usize| (0..12).map(|view| Sighting { view, corner: i }).collect::<Vec<_>>();
    let (all, few) = ((0..150).map(track).collect::<Vec<_>>(), (0..60).map(track).collect());
    let decide = |given: &[Camera], tracks: Vec<Vec<Sighting>>| {
        let (sights, learns) = (Sights { views: &[], corners: corners.clone(), tracks }, [true; 12]);
        let (fitted, _) = sights.fitted(given, &learns, &Stage::silent("gs-geom")).unwrap();
        sights.pays(given, &fitted, &learns)
    };
    let (exact, shaken) = (world.cameras.clone(), world.shaken(0.5));
    let (refined, said) = decide(&shaken, all.clone());
    assert!(refined && said.starts_with("150 corners") && said.ends_with(": poses are refined"), "{said}");
    let (refined, said) = decide(&exact, all);
    assert!(!refined && said.ends_with(": poses stay as they are given"), "{said}");
    // 60 points are too few to say.
    let (refined, said) = decide(&shaken, few);
    assert!(!refined && said.contains("too few"), "{said}");
}

#[test]
fn a_camera_is_found_by_known_points_alone() {
    let mut world = World::new(4, 60);
    let mut points = world.points(&world.cameras);
    let (places, turn) = (points.clone(), world.any(0.03));
    let mut given = world.cameras.clone();
    given[3] = moved(&given[3], turn, DVec3::new(0.02, -0.03, 0.01), 0.0);
    let mut cameras = given.clone();
    let free = [false, false, false, true];
    Bundle {
        cameras: &mut cameras,
        given: &given,
        lenses: &[0, 0, 0, 0],
        free: &free,
        points: &mut points,
        slack: Slack::widest(4.0),
        all: false,
    }
    .adjust(2.0);
    assert_eq!(cameras[..3], given[..3]);
    assert!(points.iter().zip(&places).all(|(a, b)| a.place == b.place));
    let off = turned_from(&world.cameras[3].rotation, &cameras[3].rotation).length().to_degrees();
    assert!(off < 0.02, "{off}");
}

fn code(rng: &mut ChaCha8Rng) -> Code {
    std::array::from_fn(|_| rng.random_range(0..180))
}

/// Two views of a world along shaken poses: as many matches as there are points, and none of the strangers.
#[test]
fn matches_agree_on_a_pose_and_strangers_are_refused() {
    let mut world = World::new(3, 200);
    let given = world.shaken(1.0);
    let mut views = [0, 2].map(|v| {
        let at = world.places.iter().map(|p| world.cameras[v].project(*p)).map(|(u, v, _)| [u, v]).collect();
        Corners { at, colors: vec![[0; 3]; 200], codes: Vec::new() }
    });
    let codes: Vec<Code> = (0..200).map(|_| code(&mut world.rng)).collect();
    views.iter_mut().for_each(|v| v.codes.clone_from(&codes));
    // A quarter looks like another point of the second view.
    for i in 0..50 {
        views[1].codes[i] = codes[(i + 1) % 50];
    }
    let found = matches([&views[0], &views[1]], [&given[0], &given[2]]);
    let right = found.iter().filter(|[i, j]| i == j).count();
    assert!(right >= 140 && found.len() - right <= 4, "{right} of {}", found.len());
    // Of nothing in common, nothing is said.
    views[1].codes = (0..200).map(|_| code(&mut world.rng)).collect();
    assert!(matches([&views[0], &views[1]], [&given[0], &given[2]]).is_empty());
}

#[test]
fn tracks_have_one_corner_a_view() {
    let s = |view, corner| Sighting { view, corner };
    let pairs = [([0, 1], vec![[0, 0], [1, 1]]), ([1, 2], vec![[0, 0], [1, 2]]), ([0, 2], vec![[1, 3]])];
    let tracks = join(&[2, 2, 4], &pairs);
    // View 2 shows the second track twice, and is not believed.
    assert_eq!(tracks, [vec![s(0, 0), s(1, 0), s(2, 0)], vec![s(0, 1), s(1, 1)]]);
}

#[test]
fn points_are_placed_and_bad_sightings_dropped() {
    let world = World::new(5, 20);
    for i in 0..20 {
        let mut seen = world.sightings(i);
        assert!(place(i, seen.clone(), &world.cameras, 1.0).unwrap().place.distance(world.places[i]) < 1e-9);
        seen[2].1 += DVec2::new(25.0, -14.0);
        let p = place(i, seen.clone(), &world.cameras, 1.0).unwrap();
        assert!(p.seen.len() == 4 && p.place.distance(world.places[i]) < 1e-9);
        assert!(place(i, seen[..1].to_vec(), &world.cameras, 1.0).is_none());
        // Two views from one place say nothing of depth.
        let twice = [world.cameras[0].clone(), world.cameras[0].clone()];
        assert!(
            place(i, world.sightings(i)[..2].iter().map(|(s, _)| (*s, seen[0].1)).collect(), &twice, 1.0).is_none()
        );
    }
}

#[test]
fn pairs_look_the_same_way() {
    let mut cameras = World::new(20, 0).cameras;
    cameras.push(Camera::look_at(DVec3::new(-4.0, 0.0, 1.0), DVec3::new(-8.0, 0.0, 1.0), DVec3::Z, 64, 48, 1.0));
    let pairs = partners(&cameras);
    assert!(pairs.iter().all(|[i, j]| i < j) && pairs.is_sorted());
    assert!((0..19).all(|i| pairs.contains(&[i, i + 1])));
    assert!(!pairs.contains(&[0, 19]), "163 degrees apart");
}

#[test]
fn small_systems_are_solved() {
    let x = solve::<3>([[4.0, 1.0, 0.0], [1.0, 3.0, -1.0], [0.0, -1.0, 2.0]], [6.0, 4.0, 4.0]).unwrap();
    assert!(x.iter().zip([1.0, 2.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-12), "{x:?}");
    assert!(solve::<2>([[1.0, 2.0], [2.0, 1.0]], [1.0, 1.0]).is_none());
}
