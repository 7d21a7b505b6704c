//! Numerically hostile scenes: no panic, nothing but finite numbers, and what is dropped is counted. Neither the number of
//! threads nor what is not asked for shows in a single bit.

use glam::DVec3;
use gs_raster::{
    Dropped, PixelGradients, RasterOptions, Rendered, TILE, Workspace, forward, pixel_weights, render_features,
    tile_weights,
};
use gs_scene::{Camera, Gaussians};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// `n` Gaussians of degree 3 in a cube of side 3, of all opacities.
fn random(n: usize, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut roll = |low: f32, high: f32| low + (high - low) * (rng.next_u32() >> 8) as f32 / 16_777_216.0;
    let mut g = Gaussians { sh_degree: 3, ..Gaussians::default() };
    for _ in 0..n {
        g.means.push([roll(-1.5, 1.5), roll(-1.5, 1.5), roll(-1.5, 1.5)]);
        g.log_scales.push([roll(-5.0, -1.0), roll(-5.0, -1.0), roll(-5.0, -1.0)]);
        g.rotations.push([roll(-1.0, 1.0), roll(-1.0, 1.0), roll(-1.0, 1.0), roll(-1.0, 1.0)]);
        g.opacity_logits.push(roll(-5.0, 6.0));
        g.sh.extend((0..48).map(|_| roll(-0.5, 0.5)));
    }
    g
}

/// A camera four units from the origin, which it looks at.
fn camera(width: u32, height: u32) -> Camera {
    Camera::look_at(DVec3::new(1.0, -2.0, -3.3), DVec3::ZERO, DVec3::Z, width, height, 0.9)
}

/// Renders and differentiates by every way there is; all numbers must be finite, alphas within 0 and 1.
fn survives(g: &Gaussians, camera: &Camera, what: &str) -> (Dropped, f64) {
    let options = RasterOptions { background: [0.3, 0.2, 0.1], ..RasterOptions::default() };
    let mut workspace = Workspace::default();
    let f = workspace.forward(g, camera, &options);
    let r = &f.rendered;
    let pixels = camera.width as usize * camera.height as usize;
    let finite = |values: &[f32], name: &str| {
        assert!(values.iter().all(|v| v.is_finite()), "{what}: {name} is not finite");
    };
    assert_eq!((r.rgb.len(), r.alpha.len(), r.depth.len()), (3 * pixels, pixels, pixels), "{what}");
    finite(&r.rgb, "colour");
    finite(&r.depth, "depth");
    assert!(r.alpha.iter().all(|a| (0.0..=1.0).contains(a)), "{what}: alpha");
    assert_eq!(f.visible().len() + f.dropped().total(), g.len(), "{what}: {:?}", f.dropped());
    let covered = r.alpha.iter().map(|a| f64::from(*a)).sum::<f64>() / pixels.max(1) as f64;
    eprintln!("{what}: mean alpha {covered:.4}, drawn {}, {:?}", f.visible().len(), f.dropped());
    let d: Vec<f32> = (0..3 * pixels).map(|i| (i as f32 * 0.7).sin()).collect();
    let of_pixels = PixelGradients { rgb: &d, alpha: Some(&d[..pixels]), depth: Some(&d[pixels..2 * pixels]) };
    let p = workspace.backward(g, camera, &options, of_pixels);
    finite(p.means.as_flattened(), "gradient of the centres");
    finite(p.log_scales.as_flattened(), "gradient of the scales");
    finite(p.rotations.as_flattened(), "gradient of the rotations");
    finite(&p.opacity_logits, "gradient of the opacities");
    finite(&p.sh, "gradient of the harmonics");
    finite(p.mean2d.as_flattened(), "gradient of the projected centres");
    finite(&render_features(g, &vec![1.0; 2 * g.len()], 2, camera, &options), "features");
    for early_stop in [true, false] {
        tile_weights(g, camera, &options, early_stop, |t| {
            finite(t.weights, "weights");
            assert!(t.alphas.iter().chain(t.alpha).all(|a| (0.0..=1.00001).contains(a)), "{what}: tile's alpha");
        });
    }
    (workspace.forward.dropped(), covered)
}

#[test]
fn needles_specks_and_sheets() {
    let view = camera(70, 50);
    let mut g = random(300, 1);
    for s in &mut g.log_scales {
        *s = [1e3f32.ln(), 1e-3f32.ln(), 1e-3f32.ln()];
    }
    let (dropped, covered) = survives(&g, &view, "needles of aspect 1e6");
    assert!(dropped.degenerate == 0 && dropped.not_finite == 0 && covered > 0.0);
    for (scale, least) in [(1e-8f32, 0.01), (1e4, 0.9)] {
        g.log_scales.fill([scale.ln(); 3]);
        let (dropped, covered) = survives(&g, &view, &format!("scales of {scale:e}"));
        assert!(dropped.degenerate == 0 && dropped.not_finite == 0 && covered > least, "{covered}");
    }
    // One axis of each: sheets, and beyond what any scene holds.
    for s in [[1e4f32.ln(), 1e-8f32.ln(), 0.0], [60.0, -60.0, 0.0], [80.0; 3], [-80.0; 3]] {
        g.log_scales.fill(s);
        survives(&g, &view, &format!("log-scales {s:?}"));
    }
    g.log_scales.fill([90.0; 3]);
    assert_eq!(survives(&g, &view, "scales beyond single precision").0.degenerate, g.len());
}

#[test]
fn opacities_of_zero_and_one() {
    let mut g = random(300, 2);
    for logit in [f32::NEG_INFINITY, -1e30, -100.0] {
        g.opacity_logits.fill(logit);
        let (dropped, covered) = survives(&g, &camera(40, 40), &format!("opacity logit {logit}"));
        assert!(dropped.total() == g.len() && dropped.transparent > 250 && covered == 0.0);
    }
    for logit in [f32::INFINITY, 1e30, 100.0] {
        g.opacity_logits.fill(logit);
        let (dropped, covered) = survives(&g, &camera(40, 40), &format!("opacity logit {logit}"));
        assert!(dropped.transparent == 0 && dropped.not_finite == 0 && covered > 0.2);
    }
}

#[test]
fn centres_on_the_camera_plane_and_far_away() {
    let view = camera(64, 48);
    let mut g = random(400, 3);
    let (eye, forward) = (view.position().as_vec3(), view.rotation.row(2).as_vec3());
    for (i, m) in g.means.iter_mut().enumerate() {
        // Around the plane z = 0 of the camera, from exactly on it to a few near planes away.
        let p = glam::Vec3::from(*m);
        let on_plane = p - forward * (p - eye).dot(forward);
        *m = (on_plane + forward * (i as f32 - 200.0) * 1e-4).into();
    }
    let (dropped, _) = survives(&g, &view, "centres on the camera plane");
    assert!(dropped.behind > 150);
    g.means.fill(eye.into());
    assert_eq!(survives(&g, &view, "centres at the camera").0.behind, g.len());

    // A scene moved by 1e6 with its camera: f32 centres have steps of 1/16 there, so only the count must be alike.
    let mut g = random(400, 3);
    let near = survives(&g, &view, "scene at the origin").0;
    let shift = DVec3::new(1e6, -1e6, 1e6);
    for m in &mut g.means {
        *m = (glam::Vec3::from(*m).as_dvec3() + shift).as_vec3().into();
    }
    let moved = Camera { translation: -(view.rotation * (view.position() + shift)), ..view.clone() };
    let far = survives(&g, &moved, "scene at 1e6 from the origin").0;
    assert!(far.total().abs_diff(near.total()) <= 20);
    survives(&g, &view, "centres 1e6 from the camera");
}

#[test]
fn thousands_of_coincident_gaussians() {
    let mut g = random(5000, 4);
    let (mean, scale, rotation) = (g.means[0], [-1.5; 3], g.rotations[0]);
    g.means.fill(mean);
    g.log_scales.fill(scale);
    g.rotations.fill(rotation);
    for logit in [-4.5, 0.0, 20.0] {
        g.opacity_logits.fill(logit);
        let (dropped, covered) = survives(&g, &camera(60, 45), &format!("5000 coincident, logit {logit}"));
        assert!(dropped.total() == 0 && covered > 0.01);
    }
}

#[test]
fn every_field_not_finite_and_zero_quaternions() {
    let view = camera(33, 31);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for field in 0..5 {
            let mut g = random(200, 6);
            // Half of them; the rest must be drawn as if alone.
            for i in (0..g.len()).step_by(2) {
                match field {
                    0 => g.means[i][i % 3] = bad,
                    1 => g.log_scales[i][i % 3] = bad,
                    2 => g.rotations[i][i % 4] = bad,
                    3 => g.opacity_logits[i] = bad,
                    _ => g.sh[i * 48 + i % 48] = bad,
                }
            }
            let (dropped, _) = survives(&g, &view, &format!("{bad} in field {field}"));
            if field == 3 && bad.is_infinite() {
                assert_eq!(dropped.not_finite, 0, "infinite logits are opacities of 0 and 1");
                continue;
            }
            assert!(dropped.not_finite > 50, "{bad} in field {field}: {dropped:?}");
            if field < 4 {
                let odd: Vec<u32> = (1..200).step_by(2).collect();
                let options = RasterOptions::default();
                let (all, alone) = (forward(&g, &view, &options), forward(&g.select(&odd), &view, &options));
                assert!(all.rendered == alone.rendered, "{bad} in field {field}");
            }
        }
    }
    let mut g = random(100, 7);
    g.rotations.fill([0.0; 4]);
    let (dropped, covered) = survives(&g, &view, "zero quaternions");
    assert!(dropped.degenerate + dropped.transparent + dropped.outside == 100 && covered == 0.0);
    g.rotations.fill([1e-5, 1e-5, 0.0, 0.0]);
    assert!(survives(&g, &view, "short quaternions").1 > 0.0);
}

/// One scene that has every reason for which a Gaussian is not drawn, in known numbers.
#[test]
fn every_reason_not_to_draw_is_counted() {
    let view = camera(60, 40);
    let ahead = |distance: f32, aside: f32| {
        let (eye, rotation) = (view.position().as_vec3(), view.rotation);
        let (right, forward) = (rotation.row(0).as_vec3(), rotation.row(2).as_vec3());
        (eye + forward * distance + right * aside).into()
    };
    let mut g = Gaussians::default();
    let mut add = |count: usize, mean: [f32; 3], log_scale: f32, quaternion: [f32; 4], logit: f32| {
        for _ in 0..count {
            g.means.push(mean);
            g.log_scales.push([log_scale; 3]);
            g.rotations.push(quaternion);
            g.opacity_logits.push(logit);
            g.sh.extend([0.5; 3]);
        }
    };
    let straight = [1.0, 0.0, 0.0, 0.0];
    add(7, ahead(3.0, 0.0), -3.0, straight, 1.0);
    add(1, [f32::NAN; 3], -3.0, straight, 1.0);
    add(2, ahead(-3.0, 0.0), -3.0, straight, 1.0);
    add(3, ahead(3.0, 0.0), 90.0, straight, 1.0);
    add(1, ahead(3.0, 0.0), -3.0, [0.0; 4], 1.0);
    add(5, ahead(3.0, 0.0), -3.0, straight, -9.0);
    add(6, ahead(3.0, 500.0), -3.0, straight, 1.0);
    let (dropped, covered) = survives(&g, &view, "every reason");
    assert_eq!(dropped, Dropped { not_finite: 1, behind: 2, degenerate: 4, transparent: 5, outside: 6 });
    assert!(dropped.total() == g.len() - 7 && covered > 0.0);
}

/// Pixel gradients at the end of single precision: those of which the sums do not fit are counted and are zero, and only
/// those.
#[test]
fn gradients_that_overflow_are_counted() {
    let (g, view, options) = (random(100, 9), camera(40, 30), RasterOptions::default());
    let mut workspace = Workspace::default();
    let visible = workspace.forward(&g, &view, &options).visible().to_vec();
    let mut with = |d: f32| {
        let d = PixelGradients { rgb: &[d; 3 * 40 * 30], alpha: None, depth: None };
        workspace.backward(&g, &view, &options, d).clone()
    };
    let (usual, huge) = (with(1.0), with(1e38));
    assert_eq!(usual.overflowed, 0);
    assert!(huge.overflowed > 0 && huge.overflowed <= visible.len(), "{}", huge.overflowed);
    assert!(huge.means.as_flattened().iter().chain(&huge.sh).chain(&huge.opacity_logits).all(|v| v.is_finite()));
    let none = |p: &gs_raster::Gradients| {
        visible.iter().filter(|&&i| p.sh[48 * i as usize..48 * (i as usize + 1)].iter().all(|v| *v == 0.0)).count()
    };
    assert_eq!(none(&huge) - none(&usual), huge.overflowed, "an overflowed Gaussian has no gradient at all");
}

#[test]
fn focal_lengths_and_sizes_of_image() {
    let g = random(300, 8);
    for focal in [1.0, 10.0, 1e3, 1e5] {
        let wide = Camera { fx: focal, fy: focal, ..camera(50, 40) };
        survives(&g, &wide, &format!("focal length {focal}"));
    }
    for (w, h) in [(1, 1), (1, 100), (100, 1), (16, 16), (17, 15), (0, 0), (0, 5)] {
        let view = camera(w, h);
        survives(&g, &Camera { fx: 50.0, fy: 50.0, ..view }, &format!("image of {w}x{h}"));
    }
    let none = Gaussians { sh_degree: 3, ..Gaussians::default() };
    let (dropped, covered) = survives(&none, &camera(30, 20), "empty scene");
    assert!(dropped == Dropped::default() && covered == 0.0);
    // Cameras that are not.
    for bad in [0.0, f64::NAN, f64::INFINITY] {
        survives(&g, &Camera { fx: bad, ..camera(20, 20) }, &format!("focal length {bad}"));
        survives(&g, &Camera { cx: bad, ..camera(20, 20) }, &format!("principal point {bad}"));
        survives(&g, &Camera { translation: DVec3::splat(bad), ..camera(20, 20) }, &format!("pose {bad}"));
    }
}

#[test]
fn one_two_three_and_seven_threads_give_the_same_bits() {
    // More Gaussians than one task projects, and an image whose edge cuts tiles.
    let (g, dim) = (random(6000, 5), 3);
    let camera = camera(203, 117);
    let features: Vec<f32> = g.sh.iter().copied().take(g.len() * dim).collect();
    let options = RasterOptions { background: [0.1, 0.2, 0.3], ..RasterOptions::default() };
    let run = || {
        let mut workspace = Workspace::default();
        let pixels = workspace.forward(&g, &camera, &options).rendered.alpha.len();
        let d: Vec<f32> = (0..3 * pixels).map(|i| (i as f32 * 0.37).sin()).collect();
        let d = PixelGradients { rgb: &d, alpha: Some(&d[..pixels]), depth: Some(&d[pixels..2 * pixels]) };
        workspace.backward(&g, &camera, &options, d);
        let weights = [true, false].map(|early_stop| {
            tile_weights(&g, &camera, &options, early_stop, |t| {
                (t.gaussians.to_vec(), t.alphas.to_vec(), t.weights.to_vec(), t.alpha.to_vec())
            })
        });
        let features = render_features(&g, &features, dim, &camera, &options);
        (workspace.forward.rendered, workspace.gradients, features, weights)
    };
    let on = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(run);
    let one = on(1);
    assert!(one.0.alpha.iter().any(|a| *a > 0.5) && one.1.means.iter().any(|m| m[0] != 0.0));
    for threads in [2, 3, 7] {
        // Equality of floats is equality of bits here: nothing is NaN, and a zero's sign has nowhere to come from.
        assert!(on(threads) == one, "{threads} threads");
    }
}

#[test]
fn what_is_not_asked_for_changes_nothing_else() {
    let g = random(3000, 6);
    let camera = camera(203, 117);
    let all = RasterOptions { background: [0.1, 0.2, 0.3], ..RasterOptions::default() };
    let d: Vec<f32> = (0..3 * 203 * 117).map(|i| (i as f32 * 0.37).sin()).collect();
    let run = |options: &RasterOptions| {
        let mut workspace = Workspace::default();
        workspace.forward(&g, &camera, options);
        let d = PixelGradients { rgb: &d, alpha: Some(&d[..203 * 117]), depth: None };
        workspace.backward(&g, &camera, options, d);
        (workspace.gradients, workspace.forward.rendered)
    };
    let (gradients, rendered) = run(&all);
    assert!(rendered.depth.iter().any(|z| *z > 0.0));
    let (few, picture) = run(&RasterOptions { depth: false, ..all });
    assert!(few == gradients && picture.depth.is_empty());
    assert!(picture == Rendered { depth: Vec::new(), ..rendered });
}

#[test]
fn a_pixel_alone_has_the_weights_that_it_has_in_the_view() {
    let mut g = random(3000, 7);
    // Some much larger than a tile, some far outside of the view, where the Jacobian is clamped to the image's edges.
    for i in 0..100 {
        g.log_scales[i] = [0.5, -1.0, -3.0];
        g.means[100 + i] = g.means[100 + i].map(|v| 3.0 * v);
    }
    for camera in [camera(203, 117), Camera { cx: -40.0, fx: 90.0, ..camera(90, 60) }] {
        let options = RasterOptions { antialias: true, ..RasterOptions::default() };
        let size = [camera.width, camera.height];
        let mut shown = 0;
        for pixel in
            [[0, 0], [15, 16], [100, 58], [size[0] - 1, size[1] - 1], [45, 30]].map(|[x, y]| [x % size[0], y % size[1]])
        {
            let [x, y] = pixel.map(|v| v as usize);
            let of_view = tile_weights(&g, &camera, &options, true, |t| {
                let inside = (t.x0..t.x0 + t.width).contains(&x) && (t.y0..t.y0 + t.height).contains(&y);
                let weight = |k: usize| f64::from(t.weights[k * TILE * TILE + (y - t.y0) * TILE + x - t.x0]);
                let all = t.gaussians.iter().enumerate().filter(|_| inside).map(|(k, &i)| (i, weight(k)));
                all.filter(|w| w.1 > 0.0).collect::<Vec<_>>()
            });
            let alone = pixel_weights(&g, &camera, &options, pixel);
            assert!(alone == of_view.concat(), "{pixel:?}");
            shown += alone.len();
        }
        assert!(shown > 20, "{shown}");
        assert!(pixel_weights(&g, &camera, &options, [size[0], 0]).is_empty(), "outside the view");
    }
}
