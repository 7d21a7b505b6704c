//! The forward pass.

use crate::dropped::Dropped;
use crate::kernels::forward_tile;
use crate::tiles::{TILE, Tiles};
use crate::types::{RasterOptions, Rendered};
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// A rendered view with what the backward pass needs.
#[derive(Default)]
pub struct Forward {
    /// The picture.
    pub rendered: Rendered,
    pub(crate) tiles: Tiles,
}

impl Forward {
    /// Original indices of the Gaussians that were drawn, ascending.
    pub fn visible(&self) -> &[u32] {
        &self.tiles.index
    }

    /// How many Gaussians were not drawn, and why.
    pub fn dropped(&self) -> Dropped {
        self.tiles.dropped
    }

    /// Pixel-Gaussian pairs in the tiles' lists, an upper bound of what the kernels evaluate.
    pub fn pairs(&self) -> usize {
        self.tiles.entries.len() * TILE * TILE
    }
}

/// Indices of the Gaussians that a view draws, ascending: those before the near plane that reach an alpha of 1/255 somewhere
/// in the image.
pub fn drawn(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Vec<u32> {
    Tiles::new(g, camera, options).index
}

/// Renders a view and keeps what [`crate::Workspace::backward`] needs.
pub fn forward(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Forward {
    let mut forward = Forward::default();
    forward.again(g, camera, options);
    forward
}

impl Forward {
    /// Renders another view, in the memory of the last.
    pub(crate) fn again(&mut self, g: &Gaussians, camera: &Camera, options: &RasterOptions) {
        self.tiles.build(g, camera, options);
        composite(&self.tiles, options, &mut self.rendered);
    }
}

/// Composites all tiles and returns how many pixel-Gaussian pairs the kernels evaluated.
pub(crate) fn composite(tiles: &Tiles, options: &RasterOptions, rendered: &mut Rendered) -> usize {
    let (w, h) = (tiles.lens.width as usize, tiles.lens.height as usize);
    (rendered.width, rendered.height) = (tiles.lens.width, tiles.lens.height);
    // Every pixel is written below.
    rendered.rgb.resize(w * h * 3, 0.0);
    rendered.alpha.resize(w * h, 0.0);
    rendered.depth.resize(if options.depth { w * h } else { 0 }, 0.0);
    // A band of tiles owns whole image rows, so bands can be written side by side.
    let bands = rendered
        .rgb
        .par_chunks_mut((w * TILE * 3).max(1))
        .zip(rendered.alpha.par_chunks_mut((w * TILE).max(1)))
        .enumerate();
    let mut depths: Vec<&mut [f32]> = rendered.depth.chunks_mut((w * TILE).max(1)).collect();
    depths.resize_with(h.div_ceil(TILE), Default::default);
    let evaluated = bands.zip(depths).map(|((band, (rgb, alpha)), depth)| {
        let mut evaluated = 0;
        for column in 0..tiles.columns {
            let t = band * tiles.columns + column;
            let tile = tiles.tile(t);
            let (x0, _, tw, th) = tile.rectangle;
            let p = forward_tile(tile, options.depth);
            evaluated += p.evaluated;
            for y in 0..th {
                for x in 0..tw {
                    let (from, to) = (y * TILE + x, y * w + x0 + x);
                    let left = p.transmittance[from];
                    for c in 0..3 {
                        rgb[3 * to + c] = p.rgb[c][from] + left * options.background[c];
                    }
                    alpha[to] = 1.0 - left;
                    if options.depth {
                        depth[to] = p.depth[from];
                    }
                }
            }
        }
        evaluated
    });
    evaluated.sum()
}

/// Renders a view: colour, accumulated alpha, alpha-weighted depth.
pub fn render(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Rendered {
    forward(g, camera, options).rendered
}
