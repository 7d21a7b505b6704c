//! The hostile scenes and settings.

use super::world::{Shot, World};
use crate::chain::{Options, Stage};
use glam::{DQuat, DVec3};
use gs_scene::Gaussians;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// What may change, by stage; None: it need only survive.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Tolerances {
    pub render: Option<f64>,
    pub geometry: Option<f64>,
    pub graph: Option<f64>,
    pub instances: Option<f64>,
}

/// Nothing but rounding may change.
const ROUNDING: Tolerances =
    Tolerances { render: Some(1e-4), geometry: Some(1.0), graph: Some(1e-3), instances: Some(0.05) };
/// Sums may come in another order.
const LOOSE: Tolerances = Tolerances { geometry: Some(1.5), graph: Some(0.02), instances: Some(0.1), ..ROUNDING };
/// The result may be another, but the renderer must be right.
const SURVIVE: Tolerances = Tolerances { render: Some(1e-4), geometry: None, graph: None, instances: None };

/// A hostile scene, or a hostile setting on an ordinary one.
pub(super) struct Case {
    pub name: &'static str,
    pub note: &'static str,
    pub world: World,
    /// Gaussian of the undisturbed world that each one is.
    pub origin: Option<Vec<u32>>,
    pub tolerances: Tolerances,
    pub options: Options,
    pub from: From,
}

/// Where a case begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum From {
    /// Stage 1 learns from the world's points.
    Points,
    /// Stage 1 goes on from the world's Gaussians, which are what is hostile.
    Gaussians,
    /// Training of features, on what was made of the undisturbed world.
    Features,
}

/// Options enough to see whether a hostile scene can be learnt.
const GEOMETRY: &str = "--iterations 80 --sh-degree 0 --max-gaussians 3000 --densify-every 20";

/// The options of ordinary cases.
pub(super) fn options(geometry: &str) -> Options {
    let graph = ["--holdout", "0", "--min-mask-pixels", "10"].map(String::from).to_vec();
    Options::of(Stage::Geometry, &format!("{GEOMETRY} {geometry}")).with(Stage::Graph, graph)
}

impl Case {
    /// One that need only survive.
    fn new(name: &'static str, note: &'static str, world: World) -> Self {
        let (tolerances, options) = (SURVIVE, options(""));
        Self { name, note, world, origin: None, tolerances, options, from: From::Points }
    }

    /// One whose result must stay.
    fn keeps(self, origin: &[u32], tolerances: Tolerances) -> Self {
        Self { origin: Some(origin.to_vec()), tolerances, ..self }
    }

    /// One whose Gaussians are hostile: stage 1 goes on from all of them.
    fn learnt(self) -> Self {
        let roomy = Options::of(Stage::Geometry, &GEOMETRY.replace("3000", "9000"));
        let options = self.options.clone().with(Stage::Geometry, roomy.get(Stage::Geometry).to_vec());
        Self { from: From::Gaussians, options, ..self }
    }
}

/// All of them, of an ordinary world.
pub(super) fn cases(world: &World) -> Vec<Case> {
    let mut all = metamorphic(world);
    all.extend(gaussians(world));
    all.extend(photographs(world));
    all.extend(settings(world));
    all
}

/// Changes of a scene that must not change the result.
fn metamorphic(world: &World) -> Vec<Case> {
    let n = world.gaussians.len() as u32;
    let same: Vec<u32> = (0..n).collect();
    let mut shuffled = same.clone();
    shuffled.shuffle(&mut ChaCha8Rng::seed_from_u64(1));
    let twice: Vec<u32> = (0..n).flat_map(|i| [i, i]).collect();
    let moved = |scale: f64, turn: DQuat, shift: DVec3| world.clone().moved(scale, turn, shift);
    let scaled = |scale: f64| moved(scale, DQuat::IDENTITY, DVec3::ZERO);
    let shifted = |shift: DVec3| moved(1.0, DQuat::IDENTITY, shift);
    let turn = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1);
    let still = |t: Tolerances| Tolerances { geometry: Some(0.0), ..t };
    let pixels = Tolerances { graph: Some(0.15), instances: Some(0.25), geometry: None, ..ROUNDING };
    let far = Tolerances { render: Some(1e-4), ..Tolerances::default() };
    let w = || world.clone();
    vec![
        Case::new("metamorphic unit 1e-6", "the scene a millionth as large", scaled(1e-6)).keeps(&same, ROUNDING),
        Case::new("metamorphic unit 1e6", "the scene a million times as large", scaled(1e6)).keeps(&same, ROUNDING),
        Case::new("metamorphic scaled", "the scene 3 times as large", scaled(3.0)).keeps(&same, ROUNDING),
        Case::new("metamorphic turned", "the scene turned by 63 degrees", moved(1.0, turn, DVec3::ZERO))
            .keeps(&same, LOOSE),
        Case::new("metamorphic moved", "the scene moved by 36 units", shifted(DVec3::new(30.0, -20.0, 5.0)))
            .keeps(&same, LOOSE),
        Case::new("origin 1e4", "10,000 units from the origin: centres keep 3 digits", shifted(DVec3::splat(1e4)))
            .keeps(&same, far),
        Case::new("origin 1e7", "1e7 units from the origin: centres are whole units", shifted(DVec3::X * 1e7)),
        Case::new("metamorphic Gaussians permuted", "Gaussians in another order", w().with_gaussians(&shuffled))
            .keeps(&shuffled, still(LOOSE)),
        Case::new("metamorphic views reversed", "views in another order", w().with_views_reversed())
            .keeps(&same, LOOSE),
        Case::new("metamorphic mask ids reversed", "masks with other numbers", w().with_mask_ids_reversed())
            .keeps(&same, still(ROUNDING)),
        Case::new("metamorphic twice the pixels", "photographs and masks of twice the size", w().at_twice_the_size())
            .keeps(&same, pixels),
        Case::new(
            "metamorphic Gaussians halved",
            "each Gaussian as two half-opaque ones: of faint ones neither reaches 1/255",
            w().with_gaussians_halved(),
        )
        .keeps(&twice, still(pixels)),
    ]
}

/// Hostile Gaussians.
fn gaussians(world: &World) -> Vec<Case> {
    let with = |name, note, change: &dyn Fn(&mut Gaussians)| {
        let mut w = world.clone();
        change(&mut w.gaussians);
        Case::new(name, note, w).learnt()
    };
    let some = |name, note, step: usize, change: &dyn Fn(usize, &mut Gaussians)| {
        with(name, note, &|g| (0..g.len()).step_by(step).for_each(|i| change(i, g)))
    };
    vec![
        some("needles", "every third Gaussian a million times as long as wide", 3, &|i, g| {
            g.log_scales[i] = [0.0, -13.8, -13.8];
        }),
        some("huge and tiny scales", "scales from 1e-8 to 1e4", 50, &|i, g| {
            g.log_scales[i] = [[-18.4; 3], [9.2; 3]][(i / 50) % 2];
        }),
        some("denormals", "scales and colours below the smallest normal number", 4, &|i, g| {
            g.log_scales[i] = [-95.0; 3];
            g.sh[3 * i..3 * i + 3].fill(1e-40);
        }),
        some("duplicates", "every Gaussian where one of ten is", 1, &|i, g| g.means[i] = g.means[i % 10]),
        some("a plane", "all centres in a plane", 1, &|i, g| g.means[i][2] = 0.1),
        some("a line", "all centres on a line", 1, &|i, g| (g.means[i][1], g.means[i][2]) = (0.0, 0.1)),
        some("a point", "all centres in a point", 1, &|i, g| g.means[i] = [0.0, 0.0, 0.1]),
        with("transparent", "all opacities 0", &|g| g.opacity_logits.fill(-50.0)),
        with("opaque", "all opacities 1", &|g| g.opacity_logits.fill(50.0)),
        with("one Gaussian", "nothing but one", &|g| *g = g.select(&[0])),
        some("zero quaternions", "every fifth rotation zero", 5, &|i, g| g.rotations[i] = [0.0; 4]),
    ]
}

/// Hostile photographs, cameras and masks.
fn photographs(world: &World) -> Vec<Case> {
    let with = |name, note, change: &dyn Fn(&mut Shot)| {
        let mut w = world.clone();
        w.shots.iter_mut().for_each(change);
        Case::new(name, note, w)
    };
    let middle = DVec3::from(world.gaussians.means[0].map(f64::from));
    let one_view = World { shots: world.shots[..1].to_vec(), ..world.clone() };
    vec![
        with("black photographs", "every pixel 0", &|s| s.image.rgb.fill(0.0)),
        with("white photographs", "every pixel 1", &|s| s.image.rgb.fill(1.0)),
        Case { options: options("--holdout 0"), ..Case::new("one view", "a single photograph", one_view) },
        with("one mask", "the same single mask everywhere", &|s| s.masks.ids.fill(0)),
        with("no masks", "no mask anywhere", &|s| s.masks.ids.fill(-1)),
        with("thousands of masks", "every four by four pixels a mask of their own", &|s| {
            let (w, n) = (s.masks.width(), s.masks.width() * s.masks.height());
            for ((level, y, x), id) in s.masks.ids.indexed_iter_mut() {
                *id = (level * n.div_ceil(4) + y / 4 * w.div_ceil(4) + x / 4) as i32;
            }
        }),
        with("camera inside a thing", "every camera at the middle of the Gaussians", &|s| {
            s.camera.translation = -(s.camera.rotation * middle);
        }),
        with("focal length 1", "cameras that see half the world", &|s| (s.camera.fx, s.camera.fy) = (1.0, 1.0)),
        with("focal length 1e5", "cameras that see a few points", &|s| (s.camera.fx, s.camera.fy) = (1e5, 1e5)),
    ]
}

/// Hostile settings of contrastive training.
fn settings(world: &World) -> Vec<Case> {
    let settings = [
        ("100,000 iterations", "ten times the paper's", "--iterations 100000"),
        ("one dimension", "contrastive features of dimension 1", "--iterations 300 --dim 1"),
    ];
    let case = |(name, note, options)| Case {
        options: Options::of(Stage::Features, &format!("--preset literal {options}")),
        tolerances: Tolerances::default(),
        from: From::Features,
        ..Case::new(name, note, world.clone())
    };
    settings.into_iter().map(case).collect()
}
