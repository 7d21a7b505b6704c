//! The picture of one mask, as it is shown to CLIP.

use std::fmt;
use std::str::FromStr;

/// An 8-bit RGB picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `[height][width][3]`.
    pub pixels: Vec<u8>,
}

/// Ids of one level, possibly of another size than the photograph.
#[derive(Debug, Clone, Copy)]
pub struct LabelMap<'a> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `[height][width]`, negative for none.
    pub ids: &'a [i32],
}

/// Pixels `x0..x1` x `y0..y1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// First column.
    pub x0: usize,
    /// First row.
    pub y0: usize,
    /// One past the last column.
    pub x1: usize,
    /// One past the last row.
    pub y1: usize,
}

/// Bounds of the ids `0..count` in a map, in its pixels; `None` for ids without pixels.
pub fn mask_bounds(map: &LabelMap, count: usize) -> Vec<Option<Bounds>> {
    let mut found: Vec<Option<Bounds>> = vec![None; count];
    for y in 0..map.height {
        for x in 0..map.width {
            let Ok(id) = usize::try_from(map.ids[y * map.width + x]) else { continue };
            let Some(slot) = found.get_mut(id) else { continue };
            let b = slot.get_or_insert(Bounds { x0: x, y0: y, x1: x, y1: y });
            b.x0 = b.x0.min(x);
            b.x1 = b.x1.max(x + 1);
            b.y1 = y + 1;
        }
    }
    found
}

/// What the picture of a mask shows beside the mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crop {
    /// Black, as LangSplat has it.
    Black,
    /// The photograph's mean colour.
    Mean,
    /// The photograph itself, within the mask's box and this share of its width and height more on each side, in percent;
    /// padded to a square with the photograph's mean colour.
    Box(u32),
}

impl Crop {
    /// Most context of a box, in percent.
    const MOST: u32 = 200;

    /// The colour where the picture shows nothing of `image`.
    pub fn fill(self, image: &RgbImage) -> [u8; 3] {
        let count = (image.width * image.height) as u64;
        if self == Self::Black || count == 0 {
            return [0; 3];
        }
        let mut sum = [0u64; 3];
        image.pixels.chunks_exact(3).for_each(|p| (0..3).for_each(|c| sum[c] += u64::from(p[c])));
        sum.map(|s| ((2 * s + count) / (2 * count)) as u8)
    }
}

impl fmt::Display for Crop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Black => f.write_str("black"),
            Self::Mean => f.write_str("mean"),
            Self::Box(percent) => write!(f, "box{percent}"),
        }
    }
}

impl FromStr for Crop {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let percent = || text.strip_prefix("box")?.parse().ok().filter(|p| *p <= Self::MOST);
        match text {
            "black" => Ok(Self::Black),
            "mean" => Ok(Self::Mean),
            _ => percent().map(Self::Box).ok_or(format!("expected black, mean, or box0 to box{}", Self::MOST)),
        }
    }
}

/// The picture of mask `id`: the photograph cut to the mask's `bounds` (in pixels of the map, from [`mask_bounds`]), with
/// `crop` beside the mask, padded on both sides to a square of the colour `fill` ([`Crop::fill`]), resized to `size` x
/// `size`. Gives `[3][size][size]`.
///
/// When the photograph is larger than the map, a pixel belongs to the mask of the map pixel that its centre falls in.
/// Differences from LangSplat's script, which shows black: its box leaves out the last row and column of the mask, and its
/// resizing skips pixels when it shrinks, where this one averages ([`resize_rgb`]).
///
/// # Panics
/// When `bounds` do not lie in the map: a programming error.
pub fn crop_mask(
    image: &RgbImage,
    map: &LabelMap,
    id: i32,
    bounds: Bounds,
    size: usize,
    crop: Crop,
    fill: [u8; 3],
) -> Vec<u8> {
    assert!(bounds.x1 <= map.width && bounds.y1 <= map.height, "bounds lie in the map");
    // Photograph columns whose centre (x + 0.5) * map.width / width falls at or after map column c.
    let first = |c: usize, map_len: usize, len: usize| (2 * c * len).saturating_sub(map_len).div_ceil(2 * map_len);
    let (mut x0, mut x1) = (first(bounds.x0, map.width, image.width), first(bounds.x1, map.width, image.width));
    let (mut y0, mut y1) = (first(bounds.y0, map.height, image.height), first(bounds.y1, map.height, image.height));
    if let Crop::Box(percent) = crop {
        let more = |len: usize| (len * percent as usize + 50) / 100;
        let (dx, dy) = (more(x1.saturating_sub(x0)), more(y1.saturating_sub(y0)));
        (x0, x1) = (x0.saturating_sub(dx), (x1 + dx).min(image.width));
        (y0, y1) = (y0.saturating_sub(dy), (y1 + dy).min(image.height));
    }
    let (w, h) = (x1.saturating_sub(x0), y1.saturating_sub(y0));
    let side = w.max(h).max(1);
    let (left, top) = ((side - w) / 2, (side - h) / 2);
    let mut square = RgbImage { width: side, height: side, pixels: fill.repeat(side * side) };
    for y in 0..h {
        let row = (2 * (y0 + y) + 1) * map.height / (2 * image.height) * map.width;
        for x in 0..w {
            let column = (2 * (x0 + x) + 1) * map.width / (2 * image.width);
            if matches!(crop, Crop::Box(_)) || map.ids[row + column] == id {
                let from = ((y0 + y) * image.width + x0 + x) * 3;
                let to = ((top + y) * side + left + x) * 3;
                square.pixels[to..to + 3].copy_from_slice(&image.pixels[from..from + 3]);
            }
        }
    }
    let small = resize_rgb(&square, size, size);
    let mut planes = vec![0; 3 * size * size];
    for (i, pixel) in small.pixels.chunks_exact(3).enumerate() {
        for c in 0..3 {
            planes[c * size * size + i] = pixel[c];
        }
    }
    planes
}

/// Resizes a picture: linear interpolation where it grows, the same triangle widened to cover all pixels where it
/// shrinks, each axis by itself. Pixel centres lie at +0.5; at the edges the weights of what is there
/// are scaled up.
pub fn resize_rgb(image: &RgbImage, width: usize, height: usize) -> RgbImage {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let columns = taps(image.width, width);
    let rows = taps(image.height, height);
    let mut wide = vec![0f32; image.height * width * 3];
    for y in 0..image.height {
        let from = &image.pixels[y * image.width * 3..(y + 1) * image.width * 3];
        for (x, (start, weights)) in columns.iter().enumerate() {
            let mut sum = [0f32; 3];
            for (i, w) in weights.iter().enumerate() {
                for c in 0..3 {
                    sum[c] += w * f32::from(from[(start + i) * 3 + c]);
                }
            }
            wide[(y * width + x) * 3..][..3].copy_from_slice(&sum);
        }
    }
    let mut pixels = vec![0u8; width * height * 3];
    let mut line = vec![0f32; width * 3];
    for (y, (start, weights)) in rows.iter().enumerate() {
        line.fill(0.0);
        for (i, w) in weights.iter().enumerate() {
            let from = &wide[(start + i) * width * 3..(start + i + 1) * width * 3];
            for (sum, v) in line.iter_mut().zip(from) {
                *sum += w * v;
            }
        }
        for (p, v) in pixels[y * width * 3..(y + 1) * width * 3].iter_mut().zip(&line) {
            *p = v.round().clamp(0.0, 255.0) as u8;
        }
    }
    RgbImage { width, height, pixels }
}

/// For each output pixel: the first input pixel it reads and their weights, which sum to 1.
fn taps(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f64 / to as f64;
    let reach = scale.max(1.0);
    (0..to)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale - 0.5;
            let start = (centre - reach).floor().max(0.0) as usize;
            let end = ((centre + reach).ceil() as usize).min(from - 1);
            let weight = |p: usize| (1.0 - (p as f64 - centre).abs() / reach).max(0.0);
            let weights: Vec<f64> = (start..=end).map(weight).collect();
            let sum: f64 = weights.iter().sum();
            (start, weights.iter().map(|w| (w / sum) as f32).collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on_black(image: &RgbImage, map: &LabelMap, id: i32, bounds: Bounds, size: usize) -> Vec<u8> {
        crop_mask(image, map, id, bounds, size, Crop::Black, [0; 3])
    }

    fn flat(width: usize, height: usize, color: [u8; 3]) -> RgbImage {
        RgbImage { width, height, pixels: color.repeat(width * height) }
    }

    #[test]
    fn a_wide_mask_is_centred_on_black() {
        // A 4 x 2 mask at (1, 1) of an 8 x 4 photograph, shown at its own size: rows 1 and 2 of 4 are the mask.
        let image = flat(8, 4, [10, 20, 30]);
        let mut ids = vec![-1; 32];
        for y in 1..3 {
            for x in 1..5 {
                ids[y * 8 + x] = 0;
            }
        }
        let map = LabelMap { width: 8, height: 4, ids: &ids };
        let bounds = mask_bounds(&map, 2);
        assert_eq!(bounds, [Some(Bounds { x0: 1, y0: 1, x1: 5, y1: 3 }), None]);
        let crop = on_black(&image, &map, 0, bounds[0].unwrap(), 4);
        for (c, v) in [10, 20, 30].into_iter().enumerate() {
            let plane = &crop[c * 16..(c + 1) * 16];
            assert_eq!(plane[..4], [0; 4]);
            assert_eq!(plane[4..12], [v; 8]);
            assert_eq!(plane[12..], [0; 4]);
        }
    }

    #[test]
    fn neighbours_inside_the_box_are_black() {
        let image = flat(4, 4, [200; 3]);
        let mut ids = vec![3; 16];
        ids[5] = 7; // within the box of mask 3
        let map = LabelMap { width: 4, height: 4, ids: &ids };
        let b = mask_bounds(&map, 8);
        let crop = on_black(&image, &map, 3, b[3].unwrap(), 4);
        assert_eq!(crop.iter().filter(|&&v| v == 0).count(), 3);
        assert_eq!((crop[5], crop[4]), (0, 200));
        // A mask of one pixel fills its square.
        assert_eq!(on_black(&image, &map, 7, b[7].unwrap(), 2), [200; 12]);
    }

    #[test]
    fn a_small_map_marks_blocks_of_a_large_photograph() {
        // Map 2 x 1 on a photograph 6 x 3: mask 1 is its right half.
        let mut image = flat(6, 3, [0; 3]);
        for y in 0..3 {
            for x in 3..6 {
                image.pixels[(y * 6 + x) * 3] = 90;
            }
        }
        let map = LabelMap { width: 2, height: 1, ids: &[0, 1] };
        let b = mask_bounds(&map, 2);
        let crop = on_black(&image, &map, 1, b[1].unwrap(), 3);
        assert_eq!((crop[..9].to_vec(), crop[9..].to_vec()), (vec![90; 9], vec![0; 18]));
        // And a large map on a small photograph: a mask between its pixel centres gives a black picture, no panic.
        let ids = [0, 1, 0, 0];
        let map = LabelMap { width: 4, height: 1, ids: &ids };
        let b = mask_bounds(&map, 2);
        assert_eq!(on_black(&flat(1, 1, [9; 3]), &map, 1, b[1].unwrap(), 2), [0; 12]);
    }

    #[test]
    fn the_background_is_the_mean_or_what_is_there() {
        // 20 x 10: columns 5 to 14 of rows 4 and 5 are the mask, of red 200; elsewhere red is the column's number.
        let mut image = flat(20, 10, [0, 50, 100]);
        let mut ids = vec![-1; 200];
        for y in 0..10 {
            for x in 0..20 {
                let inside = (5..15).contains(&x) && (4..6).contains(&y) && x != 9;
                image.pixels[(y * 20 + x) * 3] = if inside { 200 } else { x as u8 };
                ids[y * 20 + x] = if inside { 0 } else { -1 };
            }
        }
        let map = LabelMap { width: 20, height: 10, ids: &ids };
        let bounds = mask_bounds(&map, 1)[0].unwrap();
        let mean = Crop::Mean.fill(&image);
        let sum: usize = image.pixels.iter().step_by(3).map(|&v| v as usize).sum();
        assert_eq!((mean, Crop::Black.fill(&image)), ([(sum as f64 / 200.0).round() as u8, 50, 100], [0; 3]));
        // The picture of red at the box's own size, row by row.
        let show = |crop: Crop, size: usize| crop_mask(&image, &map, 0, bounds, size, crop, crop.fill(&image));
        let rows =
            |picture: &[u8], size: usize| picture[..size * size].chunks(size).map(<[u8]>::to_vec).collect::<Vec<_>>();
        let masked = rows(&show(Crop::Mean, 10), 10);
        assert_eq!((masked[3].clone(), masked[6].clone()), (vec![mean[0]; 10], vec![mean[0]; 10]));
        assert_eq!(masked[4], [200, 200, 200, 200, mean[0], 200, 200, 200, 200, 200]);
        // 20 % of 10 columns are 2 on each side; of 2 rows 0.4, which is none.
        let near = rows(&show(Crop::Box(20), 14), 14);
        assert_eq!(near[6], [3, 4, 200, 200, 200, 200, 9, 200, 200, 200, 200, 200, 15, 16]);
        assert_eq!((near[5].clone(), near[8].clone()), (vec![mean[0]; 14], vec![mean[0]; 14]));
        // 60 % are 6, of which the photograph has 5 on either side; of 2 rows 1.2, which is one.
        let wide = rows(&show(Crop::Box(60), 20), 20);
        assert_eq!(wide[8], (0..20).collect::<Vec<u8>>());
        assert_eq!((wide[9][5], wide[7][0]), (200, mean[0]));
        // A mask between the photograph's pixel centres shows nothing.
        let map = LabelMap { width: 4, height: 1, ids: &[0, 1, 0, 0] };
        let b = mask_bounds(&map, 2)[1].unwrap();
        assert_eq!(crop_mask(&flat(1, 1, [9; 3]), &map, 1, b, 2, Crop::Box(20), [7; 3]), [7; 12]);
    }

    #[test]
    fn crops_are_named_as_they_are_typed() {
        for name in ["black", "mean", "box0", "box10", "box200"] {
            assert_eq!(name.parse::<Crop>().unwrap().to_string(), name);
        }
        for wrong in ["", "Black", "box", "box-1", "box201", "box1.5"] {
            assert_eq!(wrong.parse::<Crop>().unwrap_err(), "expected black, mean, or box0 to box200");
        }
    }

    #[test]
    fn resizing_keeps_flat_colours_averages_and_interpolates() {
        for (w, h) in [(3, 5), (17, 2), (224, 224)] {
            assert!(resize_rgb(&flat(7, 9, [1, 128, 255]), w, h).pixels.chunks(3).all(|p| p == [1, 128, 255]));
        }
        // Linear interpolation of 0, 100 to four pixels: centres at -0.25, 0.25, 0.75, 1.25 of the pair.
        let pair = RgbImage { width: 2, height: 1, pixels: vec![0, 0, 0, 100, 100, 100] };
        let grown = resize_rgb(&pair, 4, 1);
        assert_eq!(grown.pixels.iter().step_by(3).copied().collect::<Vec<_>>(), [0, 25, 75, 100]);
        // Stripes of one pixel become their mean.
        let stripes =
            RgbImage { width: 64, height: 1, pixels: (0..64).flat_map(|x| [(x % 2) as u8 * 200; 3]).collect() };
        assert!(resize_rgb(&stripes, 4, 1).pixels.iter().all(|&v| v.abs_diff(100) <= 4));
    }
}
