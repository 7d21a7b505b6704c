//! The number of threads does not show in a single bit.

mod common;

use gs_raster::{Gradients, PixelGradients, RasterOptions, Rendered, backward, forward, render_features, tile_weights};

/// Floats of a tile's Gaussians, alphas, weights and accumulated alpha.
type Tile = (Vec<u32>, Vec<f32>, Vec<f32>, Vec<f32>);

#[derive(PartialEq)]
struct Everything {
    rendered: Rendered,
    gradients: Gradients,
    features: Vec<f32>,
    weights: [Vec<Tile>; 2],
}

#[test]
fn one_two_three_and_seven_threads_give_the_same_bits() {
    // More Gaussians than one task projects, and an image whose edge cuts tiles.
    let (g, dim) = (common::random(6000, 5), 3);
    let camera = common::camera(203, 117);
    let features: Vec<f32> = g.sh.iter().copied().take(g.len() * dim).collect();
    let options = RasterOptions { background: [0.1, 0.2, 0.3], ..RasterOptions::default() };
    let run = || {
        let f = forward(&g, &camera, &options);
        let d: Vec<f32> = (0..f.rendered.rgb.len()).map(|i| (i as f32 * 0.37).sin()).collect();
        let (alpha, depth) = (&d[..f.rendered.alpha.len()], &d[f.rendered.alpha.len()..2 * f.rendered.alpha.len()]);
        let gradients =
            backward(&g, &camera, &options, &f, PixelGradients { rgb: &d, alpha: Some(alpha), depth: Some(depth) });
        let weights = [true, false].map(|early_stop| {
            tile_weights(&g, &camera, &options, early_stop, |t| {
                (t.gaussians.to_vec(), t.alphas.to_vec(), t.weights.to_vec(), t.alpha.to_vec())
            })
        });
        Everything {
            rendered: f.rendered,
            gradients,
            features: render_features(&g, &features, dim, &camera, &options),
            weights,
        }
    };
    let on = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(run);
    let one = on(1);
    assert!(one.rendered.alpha.iter().any(|a| *a > 0.5) && one.gradients.means.iter().any(|m| m[0] != 0.0));
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
        let f = forward(&g, &camera, options);
        let d = PixelGradients { rgb: &d, alpha: Some(&d[..203 * 117]), depth: None };
        (backward(&g, &camera, options, &f, d), f.rendered)
    };
    let (gradients, rendered) = run(&all);
    assert!(rendered.depth.iter().any(|z| *z > 0.0));
    let (few, picture) = run(&RasterOptions { depth: false, ..all });
    assert!(few == gradients && picture.depth.is_empty());
    assert!(picture == Rendered { depth: Vec::new(), ..rendered });
}
