//! Sampled pixels with the Gaussians that they show: rendering of features for learners that see every pixel many times.

use crate::world::World;
use artifacts::{Level, flat};
use gs_io::Result;
use gs_raster::TILE;
use rand::RngExt;
use rand::seq::{SliceRandom, index};

const PIXELS: usize = TILE * TILE;

/// Sampled pixels of one view, in random order: a sparse matrix, pixels x kept Gaussians, of blending weights.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ViewPixels {
    /// The view's index.
    pub view: u32,
    /// Masks of each pixel, one of each level, -1 for none; `[pixels][levels]`.
    pub masks: Vec<i32>,
    /// Where the entries of each pixel begin; pixels + 1.
    pub ptr: Vec<usize>,
    /// Positions in the footprints' kept Gaussians.
    pub gaussian: Vec<u32>,
    /// Blending weights.
    pub weight: Vec<f32>,
}

impl ViewPixels {
    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.ptr.len().saturating_sub(1)
    }

    /// Renders features `[kept][dim]` into pixels `range`; `[pixels][dim]`.
    pub fn render(&self, range: std::ops::Range<usize>, features: &[f32], dim: usize) -> Vec<f32> {
        let mut out = vec![0.0; range.len() * dim];
        for (pixel, out) in range.zip(out.chunks_exact_mut(dim)) {
            for at in self.ptr[pixel]..self.ptr[pixel + 1] {
                let (i, w) = (self.gaussian[at] as usize, self.weight[at]);
                out.iter_mut().zip(&features[i * dim..(i + 1) * dim]).for_each(|(o, f)| *o += w * f);
            }
        }
        out
    }

    /// Adds to the derivatives by features `[kept][dim]` what follows from those by rendered pixels `range`.
    pub fn render_back(&self, range: std::ops::Range<usize>, by_pixel: &[f32], dim: usize, by_feature: &mut [f32]) {
        for (pixel, g) in range.zip(by_pixel.chunks_exact(dim)) {
            for at in self.ptr[pixel]..self.ptr[pixel + 1] {
                let (i, w) = (self.gaussian[at] as usize, self.weight[at]);
                by_feature[i * dim..(i + 1) * dim].iter_mut().zip(g).for_each(|(f, g)| *f += w * g);
            }
        }
    }
}

/// Up to `count` pixels of every view that has any, of those that lie in a mask with a feature at one of the levels.
pub fn sample(world: &World, levels: &[Level], count: usize, rng: &mut impl RngExt) -> Result<Vec<ViewPixels>> {
    let mut position = vec![u32::MAX; world.gaussians()];
    world.footprints.kept.iter().enumerate().for_each(|(at, &i)| position[i as usize] = at as u32);
    let mut all = Vec::new();
    for view in 0..world.views.len() {
        let (maps, camera) = world.maps(view)?;
        let features = world.features.get(&(view as u32));
        let described = |id: i32| {
            let feature = usize::try_from(id).ok().and_then(|id| features?.row(id));
            feature.is_some_and(|f| f.iter().any(|&v| v != 0.0))
        };
        let ids = |pixel: usize| levels.iter().map(move |&level| (level, pixel)).map(|(l, p)| flat(maps.level(l))[p]);
        let candidates: Vec<usize> = (0..maps.width() * maps.height()).filter(|&p| ids(p).any(described)).collect();
        let chosen = index::sample(rng, candidates.len(), count.min(candidates.len()));
        // Order of each pixel in the sample.
        let mut order = vec![u32::MAX; maps.width() * maps.height()];
        let mut pixels = ViewPixels { view: view as u32, ..ViewPixels::default() };
        for (at, chosen) in chosen.iter().enumerate() {
            order[candidates[chosen]] = at as u32;
            pixels.masks.extend(ids(candidates[chosen]).map(|id| if described(id) { id } else { -1 }));
        }
        let tiles = world.tiles(&camera, true, |t| {
            let mut out = Vec::new();
            for (x, y) in (0..t.height).flat_map(|y| (0..t.width).map(move |x| (x, y))) {
                let at = order[(t.y0 + y) * maps.width() + t.x0 + x];
                if at != u32::MAX {
                    let weights = t.weights.iter().skip(y * TILE + x).step_by(PIXELS);
                    let entries = t.gaussians.iter().map(|&i| position[i as usize]).zip(weights.copied());
                    out.push((at, entries.filter(|&(i, w)| w > 0.0 && i != u32::MAX).collect::<Vec<_>>()));
                }
            }
            out
        });
        let mut entries = vec![Vec::new(); chosen.len()];
        tiles.into_iter().flatten().for_each(|(at, of_pixel)| entries[at as usize] = of_pixel);
        pixels.ptr.push(0);
        for of_pixel in entries {
            pixels.gaussian.extend(of_pixel.iter().map(|e| e.0));
            pixels.weight.extend(of_pixel.iter().map(|e| e.1));
            pixels.ptr.push(pixels.gaussian.len());
        }
        if pixels.len() > 0 {
            all.push(pixels);
        }
    }
    Ok(all)
}

/// Draws batches: a view at a time, all views once before one comes again, and of a view's pixels one stretch after another.
#[derive(Debug, Default)]
pub struct Batches {
    stack: Vec<usize>,
    next: Vec<usize>,
}

impl Batches {
    /// The next batch of up to `count` pixels: an index into `views`, and a range of its pixels. None without views.
    pub fn draw(
        &mut self,
        views: &[ViewPixels],
        count: usize,
        rng: &mut impl RngExt,
    ) -> Option<(usize, std::ops::Range<usize>)> {
        if self.stack.is_empty() {
            self.stack.extend(0..views.len());
            self.stack.shuffle(rng);
            self.next.resize(views.len(), 0);
        }
        let view = self.stack.pop()?;
        let begin = if self.next[view] < views[view].len() { self.next[view] } else { 0 };
        let end = (begin + count).min(views[view].len());
        self.next[view] = end;
        Some((view, begin..end))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn two_pixels() -> ViewPixels {
        let (gaussian, weight) = (vec![0, 2, 1], vec![0.5, 0.25, 1.0]);
        ViewPixels { view: 0, masks: vec![0, 1], ptr: vec![0, 2, 3], gaussian, weight }
    }

    #[test]
    fn rendering_is_the_weighted_sum_and_goes_back_by_the_same_weights() {
        let pixels = two_pixels();
        // First pixel: 0.5 (1, 2) + 0.25 (4, 8) = (1.5, 3); second: (3, -1).
        let rendered = pixels.render(0..2, &[1.0, 2.0, 3.0, -1.0, 4.0, 8.0], 2);
        assert_eq!(rendered, [1.5, 3.0, 3.0, -1.0]);
        assert_eq!(pixels.render(1..2, &[1.0, 2.0, 3.0], 1), [2.0]);
        let mut back = vec![0.0; 3];
        pixels.render_back(0..2, &[2.0, -3.0], 1, &mut back);
        assert_eq!(back, [1.0, -3.0, 0.5]);
    }

    #[test]
    fn batches_take_all_views_and_all_pixels_in_turn() {
        let views = vec![two_pixels(), two_pixels()];
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut batches = Batches::default();
        let drawn: Vec<_> = (0..4).filter_map(|_| batches.draw(&views, 1, &mut rng)).collect();
        let of = |view: usize| drawn.iter().filter(|d| d.0 == view).map(|d| d.1.start).collect::<Vec<_>>();
        assert_eq!((of(0), of(1)), (vec![0, 1], vec![0, 1]));
        assert!(drawn[0].0 != drawn[1].0);
        assert!(Batches::default().draw(&[], 1, &mut rng).is_none());
    }
}
