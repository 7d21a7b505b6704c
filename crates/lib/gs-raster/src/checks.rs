//! The renderer against the f64 reference on random scenes.

use crate::pose::tests::of_reference;
use crate::reference::{Cuts, Gaussian, Pixel, backward as reference_backward, render as reference_render, widen};
use crate::{CameraGradient, PixelGradients, RasterOptions, Workspace, camera_gradient, forward, render_features};
use glam::{DMat3, DQuat, DVec3};
use gs_scene::{Camera, Gaussians};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

struct Dice(ChaCha8Rng);

impl Dice {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Uniform in low..high.
    fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * (self.0.next_u32() >> 8) as f32 / 16_777_216.0
    }

    fn many<const K: usize>(&mut self, low: f32, high: f32) -> [f32; K] {
        std::array::from_fn(|_| self.between(low, high))
    }

    /// A camera of random place, lens and size, looking roughly at the origin.
    fn camera(&mut self) -> Camera {
        let eye = DVec3::from(self.many::<3>(-1.0, 1.0).map(f64::from)).normalize_or(DVec3::X);
        let target = DVec3::from(self.many::<3>(-0.5, 0.5).map(f64::from));
        let eye = eye * f64::from(self.between(0.5, 6.0));
        let size: [u32; 2] = self.many(1.0, 70.0).map(|v| v as u32);
        let fov = f64::from(self.between(0.4, 2.2));
        let up = DVec3::from(self.many::<3>(-1.0, 1.0).map(f64::from));
        let mut c = Camera::look_at(eye, target, up, size[0], size[1], fov);
        c.fy *= f64::from(self.between(0.8, 1.25));
        c.cx += f64::from(self.between(-5.0, 5.0));
        c
    }

    /// `n` Gaussians around the origin, some elongated, some opaque, some faint.
    fn gaussians(&mut self, n: usize, degree: u8) -> Gaussians {
        let mut g = Gaussians { sh_degree: degree, ..Gaussians::default() };
        for _ in 0..n {
            g.means.push(self.many(-1.5, 1.5));
            let size = self.between(-4.5, -0.5);
            g.log_scales.push(self.many::<3>(-1.5, 1.0).map(|s| s + size));
            g.rotations.push(self.many(-1.0, 1.0));
            g.opacity_logits.push(self.between(-6.0, 7.0));
            g.sh.extend(self.many::<3>(-2.0, 2.0));
            for _ in 3..3 * (usize::from(degree) + 1).pow(2) {
                g.sh.push(self.between(-0.4, 0.4));
            }
        }
        g
    }

    /// Gradients for every pixel; none where `quiet`.
    fn pixels(&mut self, quiet: &[bool]) -> Vec<Pixel> {
        let one = |quiet: &bool| {
            let mut roll = || if *quiet { 0.0 } else { f64::from(self.between(-1.0, 1.0)) };
            let rgb = [roll(), roll(), roll()];
            Pixel { rgb, alpha: roll(), depth: roll(), ..Pixel::default() }
        };
        quiet.iter().map(one).collect()
    }
}

/// Deterministic: a test that fails fails for everyone.
fn config(cases: u32, seed: u64) -> ProptestConfig {
    ProptestConfig { cases, rng_seed: RngSeed::Fixed(seed), failure_persistence: None, ..ProptestConfig::default() }
}

/// |a - b| / |b| in the Euclidean norm; the floor keeps groups without gradient comparable.
fn relative(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let difference = a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f64>().sqrt();
    difference / b.iter().map(|y| y * y).sum::<f64>().sqrt().max(1e-9)
}

proptest! {
    #![proptest_config(config(150, 1))]

    #[test]
    fn forward_agrees(
        seed in 0u64..u64::MAX, n in 0usize..60, degree in 0u8..=3, active in 0u8..=3, antialias in any::<bool>()
    ) {
        let mut dice = Dice::new(seed);
        let g = dice.gaussians(n, degree);
        let camera = dice.camera();
        let background = dice.many(0.0, 1.0);
        let options = RasterOptions { background, sh_degree: active, antialias, ..RasterOptions::default() };
        let ours = forward(&g, &camera, &options).rendered;
        let truth = reference_render(&widen(&g), &camera, &options, Cuts::Hard);
        prop_assert_eq!(truth.len(), ours.alpha.len());
        // Colours are at most 0.5 + the sum of the coefficients times the largest basis value, depths at most this.
        let brightest = g.sh.chunks(3 * 16).map(|s| s.iter().map(|v| v.abs()).sum::<f32>()).fold(1.0, f32::max) as f64;
        let deepest = g.means.iter().map(|m| camera.to_camera(DVec3::from(m.map(f64::from))).z).fold(0.0, f64::max);
        let mut doubtful = 0;
        for (p, t) in truth.iter().enumerate() {
            // Where rounding may turn a decision, that one decision's effect is allowed, nothing more.
            doubtful += usize::from(t.doubt > 0.0);
            let alpha = (f64::from(ours.alpha[p]) - t.alpha).abs();
            prop_assert!(alpha <= 1e-4 + t.doubt, "alpha of pixel {}: {:e}", p, alpha);
            for c in 0..3 {
                let error = (f64::from(ours.rgb[3 * p + c]) - t.rgb[c]).abs();
                prop_assert!(error <= 1e-4 + t.doubt * brightest, "colour of pixel {}: {:e}", p, error);
            }
            let depth = (f64::from(ours.depth[p]) - t.depth).abs();
            prop_assert!(depth <= 1e-3 * t.depth + t.doubt * deepest, "depth of pixel {}: {:e}", p, depth);
        }
        prop_assert!(doubtful * 20 <= truth.len() + 40, "{doubtful} of {} pixels in doubt", truth.len());
    }
}

/// Names and places of the parameter groups in the order of [`Gaussian::parameter`].
fn groups(degree: u8) -> Vec<(&'static str, std::ops::Range<usize>)> {
    let bands = 11 + 3 * (usize::from(degree) + 1).pow(2);
    vec![
        ("means", 0..3),
        ("log scales", 3..6),
        ("rotations", 6..10),
        ("opacity logits", 10..11),
        ("harmonics", 11..bands),
    ]
}

fn loss(scene: &[Gaussian], camera: &Camera, options: &RasterOptions, cuts: Cuts, d: &[Pixel]) -> f64 {
    let rendered = reference_render(scene, camera, options, cuts);
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    rendered.iter().zip(d).map(|(r, d)| dot(&r.rgb, &d.rgb) + r.alpha * d.alpha + r.depth * d.depth).sum()
}

/// A scene that every pixel sees without any cut: faint, wide Gaussians in front of the camera, colours away from zero.
fn smooth_scene(dice: &mut Dice, degree: u8) -> (Gaussians, Camera) {
    let mut g = dice.gaussians(6, degree);
    let c = Camera::look_at(DVec3::new(0.3, -0.2, -4.0), DVec3::ZERO, -DVec3::Y, 19, 13, 0.6);
    for i in 0..g.len() {
        g.log_scales[i] = dice.many(-0.1, 0.8);
        g.opacity_logits[i] = dice.between(-2.0, -0.5);
        g.means[i] = dice.many(-0.5, 0.5);
    }
    for (k, v) in g.sh.iter_mut().enumerate() {
        // The constant term outweighs the rest: no colour reaches zero.
        *v = if k % (3 * (usize::from(degree) + 1).pow(2)) < 3 { v.abs() + 2.0 } else { 0.2 * *v };
    }
    // One centre beside the image, where the Jacobian is clamped.
    g.means[0] = [2.6, 0.1, 0.2];
    g.log_scales[0] = [1.2, 1.0, 0.9];
    (g, c)
}

fn columns(all: &[(Vec<f64>, [f64; 2])], range: &std::ops::Range<usize>) -> Vec<f64> {
    all.iter().flat_map(|(v, _)| v[range.clone()].iter().copied()).collect()
}

#[test]
fn gradients_are_the_central_differences() {
    for (degree, antialias) in [(0, false), (1, false), (2, false), (3, false), (0, true), (3, true)] {
        let mut dice = Dice::new(75 + u64::from(degree));
        let (g, mut camera) = smooth_scene(&mut dice, degree);
        if antialias {
            // Large pixels, against which the low-pass and so the compensation matter.
            camera = Camera::look_at(camera.position(), DVec3::ZERO, -DVec3::Y, 3, 2, 0.6);
        }
        let options = RasterOptions { background: [0.2, 0.5, 0.9], antialias, ..RasterOptions::default() };
        let mut scene = widen(&g);
        let d = dice.pixels(&vec![false; (camera.width * camera.height) as usize]);
        let analytic = reference_backward(&scene, &camera, &options, Cuts::None, &d);
        let mut numeric = Vec::new();
        for i in 0..scene.len() {
            let mut row = Vec::new();
            for k in 0..11 + g.sh_stride() {
                let mut shifted = |step: f64| {
                    let before = *scene[i].parameter(k);
                    *scene[i].parameter(k) = before + step;
                    let value = loss(&scene, &camera, &options, Cuts::None, &d);
                    *scene[i].parameter(k) = before;
                    value
                };
                // Fourth order: steps large enough that rounding stays below 1e-10.
                let h = 1e-3;
                let (near, far) = (shifted(h) - shifted(-h), shifted(2.0 * h) - shifted(-2.0 * h));
                row.push((8.0 * near - far) / (12.0 * h));
            }
            numeric.push((row, [0.0; 2]));
        }
        // The renderer itself, on the same scene: no pixel of it is cut.
        let plain = reference_render(&scene, &camera, &options, Cuts::None);
        let cut = reference_render(&scene, &camera, &options, Cuts::Hard);
        assert!(plain.iter().zip(&cut).all(|(a, b)| a.alpha == b.alpha && b.doubt == 0.0), "the scene is smooth");
        let ours = our_gradients(&g, &camera, &options, &d);
        for (name, range) in groups(degree) {
            let exact = relative(&columns(&analytic, &range), &columns(&numeric, &range));
            let single = relative(&columns(&ours, &range), &columns(&numeric, &range));
            eprintln!("degree {degree}, antialias {antialias}, {name}: f64 {exact:e}, f32 {single:e}");
            assert!(exact <= 1e-6, "degree {degree}, {name}: f64 chain rule is off by {exact:e}");
            assert!(single <= 1e-3, "degree {degree}, {name}: f32 gradient is off by {single:e}");
        }
    }
}

proptest! {
    #![proptest_config(config(100, 2))]

    /// On scenes with every cut active; a pixel where rounding may turn a decision passes no gradient.
    #[test]
    fn backward_agrees(
        seed in 0u64..u64::MAX, n in 1usize..40, degree in 0u8..=3, antialias in any::<bool>()
    ) {
        let mut dice = Dice::new(seed);
        let g = dice.gaussians(n, degree);
        let camera = dice.camera();
        let options = RasterOptions { background: dice.many(0.0, 1.0), antialias, ..RasterOptions::default() };
        let scene = widen(&g);
        let truth = reference_render(&scene, &camera, &options, Cuts::Hard);
        let quiet: Vec<bool> = truth.iter().map(|t| t.doubt > 0.0).collect();
        let d = dice.pixels(&quiet);
        let theirs = reference_backward(&scene, &camera, &options, Cuts::Hard, &d);
        let ours = our_gradients(&g, &camera, &options, &d);
        for (name, range) in groups(degree) {
            let error = relative(&columns(&ours, &range), &columns(&theirs, &range));
            prop_assert!(error <= 1e-3, "{}: {:e}", name, error);
        }
        let means = |all: &[(Vec<f64>, [f64; 2])]| all.iter().flat_map(|(_, m)| *m).collect::<Vec<f64>>();
        let error = relative(&means(&ours), &means(&theirs));
        prop_assert!(error <= 1e-3, "projected centres: {:e}", error);
    }
}

/// The camera moved as [`crate::CameraGradient`] has it, by `step` along its number `k`: turn, shift, zoom.
fn moved(camera: &Camera, k: usize, step: f64) -> Camera {
    let mut by = [0.0; 7];
    by[k] = step;
    let (turn, zoom) = (DVec3::new(by[0], by[1], by[2]), by[6].exp());
    let turn = DMat3::from_quat(DQuat::from_scaled_axis(turn));
    Camera {
        rotation: turn * camera.rotation,
        translation: turn * camera.translation + DVec3::new(by[3], by[4], by[5]),
        fx: camera.fx * zoom,
        fy: camera.fy * zoom,
        ..camera.clone()
    }
}

#[test]
fn camera_gradients_are_the_central_differences() {
    for (degree, antialias) in [(0, false), (1, false), (3, false), (3, true)] {
        let mut dice = Dice::new(175 + u64::from(degree));
        let (mut g, mut camera) = smooth_scene(&mut dice, degree);
        if antialias {
            camera = Camera::look_at(camera.position(), DVec3::ZERO, -DVec3::Y, 3, 2, 0.6);
        }
        camera.fy *= 1.1;
        let options = RasterOptions { background: [0.2, 0.5, 0.9], antialias, ..RasterOptions::default() };
        let d = dice.pixels(&vec![false; (camera.width * camera.height) as usize]);
        // With a centre so far beside the image that the Jacobian is clamped, and, for the focal lengths, without.
        for clamped in [true, false] {
            if !clamped {
                g.means[0] = [0.2, 0.1, 0.2];
            }
            let scene = widen(&g);
            let analytic = reference_backward(&scene, &camera, &options, Cuts::None, &d);
            let analytic = of_reference(&scene, &analytic, &camera, &options);
            let numbers = |c: &CameraGradient| [&c.turn[..], &c.shift, &[c.zoom]].concat();
            let numeric: Vec<f64> = (0..7)
                .map(|k| {
                    let at = |step: f64| loss(&scene, &moved(&camera, k, step), &options, Cuts::None, &d);
                    let h = 1e-3;
                    (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)
                })
                .collect();
            let mut workspace = Workspace::default();
            our_pass(&mut workspace, &g, &camera, &options, &d);
            let ours = numbers(&camera_gradient(&g, &workspace.gradients, &camera, &options));
            let analytic = numbers(&analytic);
            for (name, range) in [("turn", 0..3), ("shift", 3..6), ("zoom", 6..7)] {
                if name == "zoom" && clamped {
                    continue;
                }
                let exact = relative(&analytic[range.clone()], &numeric[range.clone()]);
                let single = relative(&ours[range.clone()], &numeric[range.clone()]);
                eprintln!("degree {degree}, antialias {antialias}, {name}: f64 {exact:e}, f32 {single:e}");
                assert!(exact <= 1e-6, "degree {degree}, {name}: f64 is off by {exact:e}");
                assert!(single <= 1e-3, "degree {degree}, {name}: f32 is off by {single:e}");
            }
        }
    }
}

#[test]
fn camera_gradients_do_not_depend_on_threads() {
    let mut dice = Dice::new(31);
    let (g, camera) = (dice.gaussians(3000, 2), dice.camera());
    let options = RasterOptions::default();
    let d = dice.pixels(&vec![false; (camera.width * camera.height) as usize]);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut workspace = Workspace::default();
            our_pass(&mut workspace, &g, &camera, &options, &d);
            camera_gradient(&g, &workspace.gradients, &camera, &options)
        })
    };
    let one = on(1);
    assert!(one.is_finite() && one.zoom != 0.0);
    assert_eq!(one, on(2));
}

/// Both passes of the renderer.
fn our_pass(w: &mut Workspace, g: &Gaussians, camera: &Camera, options: &RasterOptions, d: &[Pixel]) {
    let rgb: Vec<f32> = d.iter().flat_map(|p| p.rgb.map(|v| v as f32)).collect();
    let alpha: Vec<f32> = d.iter().map(|p| p.alpha as f32).collect();
    let depth: Vec<f32> = d.iter().map(|p| p.depth as f32).collect();
    w.forward(g, camera, options);
    w.backward(g, camera, options, PixelGradients { rgb: &rgb, alpha: Some(&alpha), depth: Some(&depth) });
}

/// The renderer's gradients, in the layout of the reference's.
fn our_gradients(g: &Gaussians, camera: &Camera, options: &RasterOptions, d: &[Pixel]) -> Vec<(Vec<f64>, [f64; 2])> {
    let mut workspace = Workspace::default();
    our_pass(&mut workspace, g, camera, options, d);
    let p = &workspace.gradients;
    let stride = g.sh_stride();
    let one = |i: usize| {
        let [m, s, q] = [&p.means[i][..], &p.log_scales[i], &p.rotations[i]];
        let own = m.iter().chain(s).chain(q).chain(&p.opacity_logits[i..=i]);
        let own = own.chain(&p.sh[i * stride..(i + 1) * stride]);
        (own.map(|&v| f64::from(v)).collect(), p.mean2d[i].map(f64::from))
    };
    (0..g.len()).map(one).collect()
}

/// Bands of harmonics that are zero are left out of later stages' renders, to the same bytes.
#[test]
fn zero_bands_are_skipped_without_a_trace() {
    let mut dice = Dice::new(11);
    for used in 0..3u8 {
        let mut gaussians = dice.gaussians(60, 3);
        let first = 3 * gs_scene::sh_coefficients(used);
        (0..gaussians.len()).for_each(|i| gaussians.sh[48 * i + first..48 * (i + 1)].fill(0.0));
        let geometry = gs_scene::Geometry { gaussians, ..gs_scene::Geometry::default() };
        let skipping = RasterOptions::of(&geometry);
        assert_eq!(skipping.sh_degree, used);
        let camera = dice.camera();
        let whole = crate::render(&geometry.gaussians, &camera, &RasterOptions::default());
        assert_eq!(crate::render(&geometry.gaussians, &camera, &skipping), whole);
    }
}

#[test]
fn features_are_blended_like_colours_and_depths() {
    let mut dice = Dice::new(12);
    for antialias in [false, true] {
        let (g, camera) = (dice.gaussians(80, 0), dice.camera());
        let options = RasterOptions { antialias, ..RasterOptions::default() };
        let feature = |i: usize| {
            let z = camera.to_camera(DVec3::from(g.means[i].map(f64::from))).z as f32;
            let [red, green, blue] = g.base_color(i).map(|c| c.max(0.0));
            [red, green, blue, 1.0, z]
        };
        let features: Vec<f32> = (0..g.len()).flat_map(feature).collect();
        let rendered = forward(&g, &camera, &options).rendered;
        let found = render_features(&g, &features, 5, &camera, &options);
        assert_eq!(found.len(), 5 * rendered.alpha.len());
        for (p, own) in found.chunks_exact(5).enumerate() {
            let expected = [&rendered.rgb[3 * p..3 * p + 3], &[rendered.alpha[p], rendered.depth[p]]].concat();
            assert!(own.iter().zip(&expected).all(|(a, b)| (a - b).abs() <= 1e-5 * b.max(1.0)), "{own:?} {expected:?}");
        }
    }
}
