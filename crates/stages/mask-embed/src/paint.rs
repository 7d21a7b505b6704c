//! From chosen masks to an id map.

use crate::automatic::{Proposals, SAM_LEVELS};
use crate::regions::Patch;
use artifacts::MaskMaps;
use ndarray::Array3;
use onnx_models::RgbImage;
use rayon::prelude::*;

/// Size of an id map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapSize {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Pixels of the smallest island, hole and mask.
    pub min_area: usize,
}

impl MapSize {
    /// The longest side is `longest`, but no longer than the photograph's; 0 for its own size. `min_area` is in pixels of
    /// the photograph.
    pub fn of(image: &RgbImage, longest: usize, min_area: usize) -> Self {
        let side = image.width.max(image.height);
        let scale = if longest == 0 { 1.0 } else { (longest as f64 / side as f64).min(1.0) };
        let [width, height] = [image.width, image.height].map(|n| ((n as f64 * scale).round() as usize).max(1));
        let share = (width * height) as f64 / (image.width * image.height) as f64;
        Self { width, height, min_area: (min_area as f64 * share).ceil() as usize }
    }
}

/// Paints the chosen masks of each level into an id map.
///
/// A mask is cut where its logits, linearly interpolated, pass 0; islands and holes of fewer than `min_area` pixels of
/// the map are cleaned. Within a level the masks are painted from large to small, ids ascending: a later mask owns the
/// pixels that it shares with an earlier one. A mask left with fewer than `min_area` pixels is not painted at all. Ids
/// count on from level to level, and every id owns pixels, so that LangSplat's readers, which take the highest id of a
/// level for its number of masks, agree.
pub fn paint(proposals: &Proposals, chosen: &[Vec<usize>; SAM_LEVELS], size: MapSize) -> MaskMaps {
    let MapSize { width, height, min_area } = size;
    let min_area = min_area.max(1);
    let mut ids = vec![-1i32; SAM_LEVELS * width * height];
    let mut first = 0;
    for (level, indices) in chosen.iter().enumerate() {
        let whole = |&i: &usize| {
            let mut mask = proposals.masks[i].logits.enlarge(&proposals.grid, width, height);
            mask.clean([width, height], min_area);
            (mask.pixels().count(), i, mask)
        };
        let mut masks: Vec<(usize, usize, Patch)> = indices.par_iter().map(whole).collect();
        // From large to small; equal areas by order of prompts.
        masks.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
        let map = &mut ids[level * width * height..(level + 1) * width * height];
        loop {
            map.fill(-1);
            for (id, (_, _, mask)) in masks.iter().enumerate() {
                mask.pixels().for_each(|(x, y)| map[y * width + x] = id as i32);
            }
            let mut owned = vec![0usize; masks.len()];
            for id in map.iter().filter_map(|&id| usize::try_from(id).ok()) {
                owned[id] += 1;
            }
            let before = masks.len();
            let mut owned = owned.into_iter();
            masks.retain(|_| owned.next().is_some_and(|n| n >= min_area));
            if masks.len() == before {
                break;
            }
        }
        for id in map.iter_mut().filter(|id| **id >= 0) {
            *id += first;
        }
        first += masks.len() as i32;
    }
    MaskMaps { ids: Array3::from_shape_vec((SAM_LEVELS, height, width), ids).expect("four maps") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::automatic::Proposal;
    use crate::logits::{Grid, Logits};
    use crate::nms::Pixels;
    use artifacts::Level;

    fn size(width: usize, height: usize, min_area: usize) -> MapSize {
        MapSize { width, height, min_area }
    }

    #[test]
    fn maps_keep_the_shape_and_never_grow() {
        let image = |width, height| RgbImage { width, height, pixels: Vec::new() };
        assert_eq!(MapSize::of(&image(1600, 898), 800, 200), size(800, 449, 50));
        assert_eq!(MapSize::of(&image(600, 900), 300, 0), size(200, 300, 0));
        assert_eq!(MapSize::of(&image(320, 200), 800, 7), size(320, 200, 7));
        assert_eq!(MapSize::of(&image(320, 200), 0, 7), size(320, 200, 7));
        assert_eq!(MapSize::of(&image(5000, 2), 800, 0), size(800, 1, 0));
    }

    /// Proposals on a 20 x 10 grid, each a rectangle x0..x1, y0..y1.
    fn proposals(rects: &[[usize; 4]]) -> Proposals {
        let grid = Grid { width: 20, height: 10, extent: [20.0, 10.0] };
        let mask = |r: &[usize; 4]| {
            let inside = |i: usize| (r[0]..r[2]).contains(&(i % 20)) && (r[1]..r[3]).contains(&(i / 20));
            let pixels = Pixels::new(20, (0..200).map(inside));
            let logits: Vec<f32> = (0..200).map(|i| if inside(i) { 5.0 } else { -5.0 }).collect();
            let logits = Logits::new(|y| &logits[20 * y..20 * (y + 1)], &grid, pixels.bounds);
            Proposal { level: 1, quality: 1.0, score: 1.0, pixels, logits }
        };
        Proposals { grid, masks: rects.iter().map(mask).collect(), asked: 0, points: 0 }
    }

    #[test]
    fn ids_count_on_and_small_masks_lie_on_top() {
        let p = proposals(&[[2, 2, 5, 5], [0, 0, 10, 10], [12, 0, 20, 10]]);
        let m = paint(&p, &[vec![0, 1, 2], vec![0], vec![], vec![1, 2]], size(20, 10, 1));
        let at = |level: usize, x: usize, y: usize| m.ids[[level, y, x]];
        // By area: 1 (100), 2 (80), 0 (9).
        assert_eq!((at(0, 0, 0), at(0, 13, 5), at(0, 3, 3), at(0, 11, 5)), (0, 1, 2, -1));
        assert_eq!((at(1, 3, 3), at(1, 0, 0)), (3, -1));
        assert!(m.level(Level::MEDIUM).iter().all(|&i| i == -1));
        assert_eq!((at(3, 3, 3), at(3, 13, 3)), (4, 5));
        assert_eq!(m.id_count(), 6);
        // The same at twice the size: the straight edges fall half way between logits of equal size.
        let big = paint(&p, &[vec![0, 1, 2], vec![], vec![], vec![]], size(40, 20, 1));
        for y in 0..20 {
            for x in 0..40 {
                assert_eq!(big.ids[[0, y, x]], at(0, x / 2, y / 2), "at {x}, {y}");
            }
        }
    }

    #[test]
    fn masks_that_others_cover_are_left_out_and_every_id_owns_pixels() {
        // The large mask is covered up to a strip of 10 pixels; the small one has 4.
        let p = proposals(&[[0, 0, 10, 10], [0, 0, 5, 10], [5, 0, 9, 10], [15, 5, 17, 7]]);
        let chosen = [vec![0, 1, 2, 3], vec![], vec![], vec![]];
        let count = |min: usize| paint(&p, &chosen, size(20, 10, min)).id_count();
        assert_eq!((count(1), count(5), count(11)), (4, 3, 2));
        let m = paint(&p, &chosen, size(20, 10, 11));
        let mut owned = vec![0; 2];
        m.ids.iter().filter(|&&i| i >= 0).for_each(|&i| owned[i as usize] += 1);
        assert_eq!(owned, [50, 40]);
    }
}
