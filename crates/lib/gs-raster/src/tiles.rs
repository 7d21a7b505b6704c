//! Which Gaussians touch which tile, front to back.

use crate::dropped::Dropped;
use crate::lanes::project_range;
use crate::project::{Lens, Splat};
use crate::types::RasterOptions;
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Side of a tile in pixels.
pub const TILE: usize = 16;
/// Pixels of a tile.
pub(crate) const PIXELS: usize = TILE * TILE;
/// Gaussians that one task projects: fixed, so that results do not depend on the number of threads.
const CHUNK: usize = 1024;
/// Bits that one pass of the sort looks at.
const DIGIT: usize = 11;

/// Left, top, width, height of a tile within the image.
pub(crate) type Rectangle = (usize, usize, usize, usize);

/// A tile of a view.
#[derive(Clone, Copy)]
pub(crate) struct Tile<'a> {
    pub splats: &'a [Splat],
    /// Positions in `splats` of the Gaussians that touch it, front to back.
    pub list: &'a [u32],
    pub rectangle: Rectangle,
}

/// The Gaussians that a view sees, and the lists of its tiles. Building it again for another view reuses its memory.
#[derive(Default)]
pub(crate) struct Tiles {
    pub lens: Lens,
    /// Original indices of the splats, ascending.
    pub index: Vec<u32>,
    /// Projected Gaussians, in the order of `index`.
    pub splats: Vec<Splat>,
    /// Where each tile's list begins in `entries`; tiles + 1.
    pub offsets: Vec<u32>,
    /// Positions in `splats`, tile after tile, front to back (ties by index) within each.
    pub entries: Vec<u32>,
    /// Where each splat's places begin in `places`; splats + 1.
    pub first: Vec<u32>,
    /// Where in `entries` each splat is, splat after splat, in tile order within each.
    pub places: Vec<u32>,
    pub columns: usize,
    pub dropped: Dropped,
    chunks: Vec<Chunk>,
    sort: Sort,
}

/// What one task projects.
#[derive(Default)]
struct Chunk {
    index: Vec<u32>,
    splats: Vec<Splat>,
    /// Tiles of each splat, ascending, one splat after the other, and how many each has.
    touched: Vec<u32>,
    counts: Vec<u32>,
    dropped: Dropped,
}

impl Chunk {
    fn fill(&mut self, g: &Gaussians, chunk: usize, lens: &Lens, options: &RasterOptions, grid: [usize; 2]) {
        let Self { index, splats, touched, counts, dropped } = self;
        index.clear();
        splats.clear();
        touched.clear();
        counts.clear();
        *dropped = Dropped::default();
        let range = chunk * CHUNK..((chunk + 1) * CHUNK).min(g.len());
        let seen = |i: usize, s: Splat| {
            let before = touched.len();
            push_tiles(&s, grid, touched);
            counts.push((touched.len() - before) as u32);
            index.push(i as u32);
            splats.push(s);
        };
        project_range(g, range, lens, options, dropped, seen);
    }
}

impl Tiles {
    pub fn new(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Self {
        let mut tiles = Self::default();
        tiles.build(g, camera, options);
        tiles
    }

    /// The tiles of a view, of which only the one that holds a pixel has its whole list; with that tile's number.
    pub fn around(g: &Gaussians, camera: &Camera, options: &RasterOptions, [x, y]: [usize; 2]) -> (Self, usize) {
        let tile = [x / TILE, y / TILE];
        // A tile more on each side, for the rounding of edges in single precision.
        let corner = |more: f64| tile.map(|t| (t as f64 + more) * TILE as f64);
        let mut tiles = Self::default();
        tiles.build_for(g, Lens::new(camera).within([corner(-1.0), corner(2.0)]), options);
        let number = tile[1] * tiles.columns + tile[0];
        (tiles, number)
    }

    pub fn build(&mut self, g: &Gaussians, camera: &Camera, options: &RasterOptions) {
        self.build_for(g, Lens::new(camera), options);
    }

    fn build_for(&mut self, g: &Gaussians, lens: Lens, options: &RasterOptions) {
        let columns = (lens.width as usize).div_ceil(TILE);
        let rows = (lens.height as usize).div_ceil(TILE);
        self.chunks.resize_with(g.len().div_ceil(CHUNK), Chunk::default);
        let chunks = self.chunks.par_iter_mut().enumerate();
        chunks.for_each(|(c, chunk)| chunk.fill(g, c, &lens, options, [columns, rows]));

        let Self { chunks, index, splats, places, first, offsets, dropped, sort, .. } = self;
        // Two parts that need nothing of each other.
        let copy = || {
            index.clear();
            splats.clear();
            for chunk in &*chunks {
                index.extend_from_slice(&chunk.index);
                splats.extend_from_slice(&chunk.splats);
            }
        };
        let list = || {
            *dropped = Dropped::default();
            places.clear();
            first.clear();
            first.push(0);
            let mut end = 0;
            for chunk in &*chunks {
                places.extend_from_slice(&chunk.touched);
                first.extend(chunk.counts.iter().map(|n| {
                    end += n;
                    end
                }));
                dropped.add(&chunk.dropped);
            }
            offsets.clear();
            offsets.resize(columns * rows + 1, 0);
            for &t in &*places {
                offsets[t as usize + 1] += 1;
            }
            for t in 0..columns * rows {
                offsets[t + 1] += offsets[t];
            }
            sort.by_depth(chunks.iter().flat_map(|chunk| &chunk.splats));
        };
        rayon::join(copy, list);
        self.entries.resize(self.places.len(), 0);
        // Tiles become places in their lists; each list's end moves through it, and is the next one's beginning at the end.
        for &i in &self.sort.order {
            for place in &mut self.places[self.first[i as usize] as usize..self.first[i as usize + 1] as usize] {
                let next = &mut self.offsets[*place as usize];
                *place = *next;
                self.entries[*next as usize] = i;
                *next += 1;
            }
        }
        self.offsets.rotate_right(1);
        self.offsets[0] = 0;
        self.lens = lens;
        self.columns = columns;
    }

    pub fn count(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Tile `t`.
    pub fn tile(&self, t: usize) -> Tile<'_> {
        let (x, y) = (t % self.columns * TILE, t / self.columns * TILE);
        let (width, height) = (TILE.min(self.lens.width as usize - x), TILE.min(self.lens.height as usize - y));
        let list = &self.entries[self.offsets[t] as usize..self.offsets[t + 1] as usize];
        Tile { splats: &self.splats, list, rectangle: (x, y, width, height) }
    }
}

/// Radix sort of 32-bit keys, lowest digit first; equal depths stay in the order of their index.
#[derive(Default)]
struct Sort {
    pairs: Vec<(u32, u32)>,
    other: Vec<(u32, u32)>,
    order: Vec<u32>,
}

impl Sort {
    /// Puts the positions of splats into `order`, front to back.
    fn by_depth<'a>(&mut self, splats: impl Iterator<Item = &'a Splat>) {
        self.pairs.clear();
        // Positive floats sort as their bits do.
        self.pairs.extend(splats.zip(0..).map(|(s, i)| (s.depth.to_bits(), i)));
        let count = self.pairs.len();
        self.other.resize(count, (0, 0));
        let digit = |key: u32, pass: usize| (key >> (pass * DIGIT)) as usize & ((1 << DIGIT) - 1);
        let mut counts = [[0u32; 1 << DIGIT]; 32usize.div_ceil(DIGIT)];
        for (key, _) in &self.pairs {
            for (pass, counts) in counts.iter_mut().enumerate() {
                counts[digit(*key, pass)] += 1;
            }
        }
        for (pass, counts) in counts.iter_mut().enumerate() {
            if counts.iter().any(|&n| n as usize == count) {
                continue;
            }
            let mut begin = 0;
            for n in counts.iter_mut() {
                (*n, begin) = (begin, begin + *n);
            }
            for &pair in &self.pairs {
                let next = &mut counts[digit(pair.0, pass)];
                self.other[*next as usize] = pair;
                *next += 1;
            }
            std::mem::swap(&mut self.pairs, &mut self.other);
        }
        self.order.clear();
        self.order.extend(self.pairs.iter().map(|(_, i)| i));
    }
}

/// Appends the tiles, of `columns` times `rows`, in which some pixel may get alpha >= 1/255: in every row of tiles those
/// between the leftmost and the rightmost point there of the ellipse sigma = ln(255 opacity). Some beside it may be among them.
fn push_tiles(s: &Splat, [columns, rows]: [usize; 2], out: &mut Vec<u32>) {
    const SIDE: f32 = TILE as f32;
    let range = |low: f32, high: f32, count: usize| {
        // Casts round towards zero and stop at the ends: floors that call no library.
        let high = if high >= 0.0 { ((high / SIDE) as usize).saturating_add(1) } else { 0 };
        (low / SIDE) as usize..high.min(count)
    };
    let [x, y] = s.mean;
    let [width, height] = s.extent;
    let all = range(x - width, x + width, columns);
    let down = range(y - height, y + height, rows);
    let [a, b, c] = s.conic;
    // Margins for the rounding of this against that of the kernels' own, which are half as large.
    let sigma = s.sigma_max * 1.0002 + 2e-5;
    let margin = 2e-3 + 2e-4 * width;
    // Height of the rightmost point over the centre's; the leftmost one lies opposite.
    let rightmost = -b * width / c;
    // Leftmost and rightmost point at a height; nothing (left beyond right) above and below.
    let at = |v: f32| {
        let half = (2.0 * sigma * a - v * v * s.conic_det).max(0.0).sqrt() / a;
        let middle = -b * v / a;
        if v.abs() <= height { [middle - half, middle + half] } else { [f32::INFINITY, f32::NEG_INFINITY] }
    };
    let narrow = all.len() <= 1 || down.len() <= 1 || !(rightmost.is_finite() && (sigma * a).is_finite());
    let mut upper = at((down.start * TILE) as f32 - y);
    for ty in down {
        let (top, bottom) = ((ty * TILE) as f32 - y, ((ty + 1) * TILE) as f32 - y);
        let lower = at(bottom);
        let [mut left, mut right] = [upper[0].min(lower[0]), upper[1].max(lower[1])];
        upper = lower;
        let within = |v: f32| top <= v + margin && v - margin <= bottom;
        if within(rightmost) {
            right = width;
        }
        if within(-rightmost) {
            left = -width;
        }
        let own = range(x + left - margin, x + right + margin, columns);
        let own = if narrow { all.clone() } else { own.start.max(all.start)..own.end.min(all.end) };
        out.extend(own.map(|tx| (ty * columns + tx) as u32));
    }
}
