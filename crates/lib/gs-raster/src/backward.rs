//! The backward pass.

use crate::forward::Forward;
use crate::kernels::{TileGradients, backward_tile};
use crate::lanes::{Backward, LANES};
use crate::project::SplatGradient;
use crate::tiles::{PIXELS, TILE, Tiles};
use crate::types::{Gradients, PixelGradients, RasterOptions};
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Gaussians whose parameters' gradients one task computes.
const CHUNK: usize = 512;

/// d loss / d splat for every splat of every tile, in the order of the tiles' entries.
pub(crate) fn pair_gradients(
    forward: &Forward,
    camera: &Camera,
    options: &RasterOptions,
    d: PixelGradients<'_>,
    pairs: &mut Vec<SplatGradient>,
) {
    let pixels = camera.width as usize * camera.height as usize;
    assert_eq!(d.rgb.len(), 3 * pixels);
    assert!(d.depth.is_none() || options.depth, "the gradient of a depth that was not rendered");
    assert!(d.alpha.is_none_or(|a| a.len() == pixels) && d.depth.is_none_or(|z| z.len() == pixels));
    let tiles = &forward.tiles;
    // One gradient per tile and Gaussian, each tile writing its own slice.
    pairs.resize(tiles.entries.len(), SplatGradient::default());
    let mut slices = Vec::with_capacity(tiles.count());
    let mut rest = &mut pairs[..];
    for t in 0..tiles.count() {
        let (head, tail) = rest.split_at_mut(tiles.tile(t).list.len());
        slices.push(head);
        rest = tail;
    }
    slices.into_par_iter().enumerate().for_each(|(t, out)| {
        if !out.is_empty() {
            let tile = tiles.tile(t);
            let mut of_pixels = pixel_gradients(forward, options, d, tile.rectangle);
            // The kernel does not come to those behind where all pixels have stopped.
            out.fill(SplatGradient::default());
            backward_tile(tile, d.depth.is_some(), &mut of_pixels, out);
        }
    });
}

/// Sums the gradients of each splat over its tiles, in tile order, and takes them to the Gaussians' parameters. `pairs` is in
/// the order of the tiles' entries; every value of `out` is written.
pub(crate) fn gather(
    g: &Gaussians,
    options: &RasterOptions,
    tiles: &Tiles,
    pairs: &[SplatGradient],
    out: &mut Gradients,
) {
    let (all, stride) = (g.len(), g.sh_stride());
    let degree = g.sh_degree.min(options.sh_degree);
    out.means.resize(all, [0.0; 3]);
    out.log_scales.resize(all, [0.0; 3]);
    out.rotations.resize(all, [0.0; 4]);
    out.opacity_logits.resize(all, 0.0);
    out.sh.resize(all * stride, 0.0);
    out.mean2d.resize(all, [0.0; 2]);
    let geometry = out.means.par_chunks_mut(CHUNK).zip(out.log_scales.par_chunks_mut(CHUNK));
    let geometry = geometry.zip(out.rotations.par_chunks_mut(CHUNK));
    let rest = out.opacity_logits.par_chunks_mut(CHUNK).zip(out.sh.par_chunks_mut(CHUNK * stride));
    let centers = out.mean2d.par_chunks_mut(CHUNK);
    let overflowed = geometry.zip(rest).zip(centers).enumerate().map(|(chunk, (of_parameters, mean2d))| {
        let (((means, log_scales), rotations), (opacity_logits, sh)) = of_parameters;
        means.fill([0.0; 3]);
        log_scales.fill([0.0; 3]);
        rotations.fill([0.0; 4]);
        opacity_logits.fill(0.0);
        mean2d.fill([0.0; 2]);
        let begin = chunk * CHUNK;
        let from = tiles.index.partition_point(|&i| (i as usize) < begin);
        let to = from + tiles.index[from..].partition_point(|&i| (i as usize) < begin + means.len());
        let (mut done, mut overflowed) = (0, 0);
        let mut lanes = Box::<Backward>::default();
        let mut sums = [SplatGradient::default(); LANES];
        for first in (from..to).step_by(LANES) {
            let own = first..to.min(first + LANES);
            for (l, i) in own.clone().enumerate() {
                let mut sum = SplatGradient::default();
                for &pair in &tiles.places[tiles.first[i] as usize..tiles.first[i + 1] as usize] {
                    sum.add(&pairs[pair as usize]);
                }
                lanes.set(l, g, tiles.index[i] as usize, degree, &tiles.splats[i], &sum);
                sums[l] = sum;
            }
            lanes.run(&tiles.lens, options, degree);
            for (l, i) in own.enumerate() {
                let k = tiles.index[i] as usize - begin;
                sh[done * stride..k * stride].fill(0.0);
                done = k + 1;
                let d_sh = &mut sh[k * stride..(k + 1) * stride];
                let of_centers = sums[l].mean.iter().all(|v| v.is_finite());
                let Some(p) = lanes.get(l, degree, d_sh).filter(|_| of_centers) else {
                    // Not held by single precision: no gradient rather than NaN in an optimiser's state.
                    d_sh.fill(0.0);
                    overflowed += 1;
                    continue;
                };
                means[k].copy_from_slice(&p[..3]);
                log_scales[k].copy_from_slice(&p[3..6]);
                rotations[k].copy_from_slice(&p[6..10]);
                opacity_logits[k] = p[10];
                mean2d[k] = sums[l].mean;
            }
        }
        sh[done * stride..].fill(0.0);
        overflowed
    });
    out.overflowed = overflowed.sum();
}

fn pixel_gradients(
    forward: &Forward,
    options: &RasterOptions,
    d: PixelGradients<'_>,
    (x0, y0, tw, th): (usize, usize, usize, usize),
) -> Box<TileGradients> {
    let mut tile = Box::new(TileGradients {
        rgb: [[0.0; PIXELS]; 3],
        depth: [0.0; PIXELS],
        alpha: [0.0; PIXELS],
        behind: [0.0; PIXELS],
    });
    let r = &forward.rendered;
    let (w, back) = (r.width as usize, options.background);
    for y in 0..th {
        let (from, to) = ((y0 + y) * w + x0, y * TILE);
        let row = |of: &[f32], at: &mut [f32]| at[to..to + tw].copy_from_slice(&of[from..from + tw]);
        if let Some(alpha) = d.alpha {
            row(alpha, &mut tile.alpha);
        }
        if let Some(depth) = d.depth {
            row(depth, &mut tile.depth);
            let products = depth[from..from + tw].iter().zip(&r.depth[from..from + tw]).map(|(d, z)| d * z);
            tile.behind[to..to + tw].iter_mut().zip(products).for_each(|(behind, v)| *behind = v);
        }
        let own = 3 * from..3 * (from + tw);
        let [of_loss, rendered] = [d.rgb, &r.rgb].map(|all| all[own.clone()].as_chunks::<3>().0);
        for (x, (g, rgb)) in of_loss.iter().zip(rendered).enumerate() {
            let (alpha, at) = (r.alpha[from + x], to + x);
            let left = 1.0 - alpha;
            let (mut d_alpha, mut behind) = (tile.alpha[at], tile.behind[at]);
            for c in 0..3 {
                tile.rgb[c][at] = g[c];
                d_alpha -= back[c] * g[c];
                behind += g[c] * (rgb[c] - left * back[c]);
            }
            tile.alpha[at] = d_alpha;
            tile.behind[at] = behind + d_alpha * alpha;
        }
    }
    tile
}
