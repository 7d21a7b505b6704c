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
    let back = options.background;
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
                let (from, to) = (y * TILE, y * w + x0);
                let left = &p.transmittance[from..from + tw];
                let [red, green, blue] = [0, 1, 2].map(|c| &p.rgb[c][from..from + tw]);
                let colors = red.iter().zip(green).zip(blue).zip(left);
                let pixels = rgb[3 * to..3 * (to + tw)].as_chunks_mut::<3>().0;
                for (pixel, (((r, g), b), left)) in pixels.iter_mut().zip(colors) {
                    *pixel = [r + left * back[0], g + left * back[1], b + left * back[2]];
                }
                alpha[to..to + tw].iter_mut().zip(left).for_each(|(alpha, left)| *alpha = 1.0 - left);
                if options.depth {
                    depth[to..to + tw].copy_from_slice(&p.depth[from..from + tw]);
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
