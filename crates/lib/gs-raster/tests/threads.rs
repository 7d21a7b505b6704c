//! The number of threads does not show in a single bit.

mod common;

use gs_raster::{PixelGradients, RasterOptions, Rendered, Workspace, render_features, tile_weights};

#[test]
fn one_two_three_and_seven_threads_give_the_same_bits() {
    // More Gaussians than one task projects, and an image whose edge cuts tiles.
    let (g, dim) = (common::random(6000, 5), 3);
    let camera = common::camera(203, 117);
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
    let g = common::random(3000, 6);
    let camera = common::camera(203, 117);
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
