//! Corners and blobs of a photograph that other photographs show, too: extrema of differences of Gaussians over place and
//! scale, described by histograms of gradients (SIFT, Lowe 2004; compared as RootSIFT, Arandjelovic and Zisserman 2012).

use gs_scene::Image;
use multiversion::multiversion;

/// Bytes for each pixel that is worked on: six blurs of a grey picture and of its halves, five differences, what a blur takes.
const PER_PIXEL: u64 = 64;
/// Numbers of a description: 4 x 4 cells of 8 directions.
pub(super) const NUMBERS: usize = 128;
/// Length of a description.
const LENGTH: f32 = 1024.0;
/// Longer side of the picture that is worked on, at most; half as large a photograph is enlarged to twice its size.
pub(super) const LONGEST: u32 = 1600;
/// Blur of a photograph as it is taken, and of an octave's first level, in pixels.
const TAKEN: f64 = 0.5;
const FIRST: f64 = 1.6;
/// Scales of an octave.
const SCALES: usize = 3;
/// Least contrast, 0 to 1.
const CONTRAST: f64 = 0.003;
/// Largest ratio of the curvatures: more is an edge, along which a place is not known.
const EDGE: f64 = 10.0;
/// Most corners of a photograph; the strongest are kept.
const MOST: usize = 2500;
/// Least side of an octave in pixels.
const SMALLEST: usize = 24;

/// Corners of a photograph.
#[derive(Debug, Clone, Default)]
pub(super) struct Corners {
    /// Pixels of the photograph, centres at +0.5.
    pub at: Vec<[f64; 2]>,
    pub colors: Vec<[u8; 3]>,
    pub codes: Vec<Code>,
}

/// A description in whole numbers: products of two are exact in any order.
pub(super) type Code = [i16; NUMBERS];

/// A grey picture.
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Plane {
    fn at(&self, x: usize, y: usize) -> f64 {
        f64::from(self.values[y * self.width + x])
    }

    /// Bilinear; places are those of pixels, the border is repeated.
    fn sample(&self, x: f64, y: f64) -> f32 {
        let x = x.clamp(0.0, (self.width - 1) as f64);
        let y = y.clamp(0.0, (self.height - 1) as f64);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (u, v) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
        let [a, b] = [y0, y1].map(|y| {
            let row = &self.values[y * self.width..];
            row[x0] + u * (row[x1] - row[x0])
        });
        a + v * (b - a)
    }

    /// Blurred by a Gaussian of this standard deviation in pixels.
    fn blurred(&self, sigma: f64) -> Self {
        let reach = (3.0 * sigma).ceil() as usize;
        let weight = |d: usize| (-0.5 * (d as f64 / sigma).powi(2)).exp();
        let sum = weight(0) + 2.0 * (1..=reach).map(weight).sum::<f64>();
        let kernel: Vec<f32> = (0..=reach).map(|d| (weight(d) / sum) as f32).collect();
        let (w, h) = (self.width, self.height);
        let mut across = vec![0.0f32; w * h];
        let mut padded = vec![0.0f32; w + 2 * reach];
        for (row, out) in self.values.chunks_exact(w).zip(across.chunks_exact_mut(w)) {
            padded[..reach].fill(row[0]);
            padded[reach..reach + w].copy_from_slice(row);
            padded[reach + w..].fill(row[w - 1]);
            out.iter_mut().zip(row).for_each(|(o, v)| *o = kernel[0] * v);
            for d in 1..=reach {
                let (left, right) = (&padded[reach - d..], &padded[reach + d..]);
                for (o, (l, r)) in out.iter_mut().zip(left.iter().zip(right)) {
                    *o += kernel[d] * (l + r);
                }
            }
        }
        let mut values = vec![0.0f32; w * h];
        for (y, out) in values.chunks_exact_mut(w).enumerate() {
            let row = |y: usize| &across[y * w..(y + 1) * w];
            out.iter_mut().zip(row(y)).for_each(|(o, v)| *o = kernel[0] * v);
            for d in 1..=reach {
                let (above, below) = (row(y.saturating_sub(d)), row((y + d).min(h - 1)));
                for (o, (a, b)) in out.iter_mut().zip(above.iter().zip(below)) {
                    *o += kernel[d] * (a + b);
                }
            }
        }
        Self { width: w, height: h, values }
    }

    fn minus(&self, other: &Self) -> Self {
        let values = self.values.iter().zip(&other.values).map(|(a, b)| a - b).collect();
        Self { values, ..*self }
    }

    /// Every other pixel of every other row.
    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let row = |y: usize| self.values[2 * y * self.width..][..self.width].iter().step_by(2).copied();
        Self { width, height, values: (0..height).flat_map(row).collect() }
    }
}

/// A corner within its octave.
struct Place {
    octave: usize,
    level: usize,
    x: f64,
    y: f64,
    /// Standard deviation of its blur, in pixels of the octave.
    sigma: f64,
    strength: f64,
}

/// By how much a photograph is enlarged.
fn zoom(width: u32, height: u32) -> f64 {
    let longest = width.max(height).max(1);
    if 2 * longest <= LONGEST { 2.0 } else { (f64::from(LONGEST) / f64::from(longest)).min(1.0) }
}

/// Bytes that the corners of a photograph of this size take to find, besides its decoding.
pub(super) fn bytes((width, height): (u32, u32)) -> u64 {
    let by = zoom(width, height);
    PER_PIXEL * (f64::from(width) * f64::from(height) * by * by) as u64
}

/// The corners of a photograph, the strongest first. `roll` is the direction of "up" in the picture, in radians from its own: two
/// photographs of a camera that was turned describe a corner alike.
pub(super) fn detect(image: &Image, roll: f64) -> Corners {
    let zoom = zoom(image.width, image.height);
    let sized = |v: u32| ((f64::from(v) * zoom).round() as u32).max(1);
    let picture = image.resize_area(sized(image.width), sized(image.height));
    let grey = picture.rgb.as_chunks::<3>().0.iter().map(|p| 0.299 * p[0] + 0.587 * p[1] + 0.114 * p[2]).collect();
    let (width, height) = (picture.width as usize, picture.height as usize);
    let scale = [width as f64 / f64::from(image.width), height as f64 / f64::from(image.height)];
    drop(picture);
    let taken = TAKEN * zoom.max(1.0);
    let mut first = Plane { width, height, values: grey }.blurred((FIRST * FIRST - taken * taken).sqrt());
    let (mut places, mut octaves) = (Vec::new(), Vec::new());
    while first.width.min(first.height) >= SMALLEST {
        let mut levels = vec![first];
        for i in 1..SCALES + 3 {
            let (before, now) = (sigma(i as f64 - 1.0), sigma(i as f64));
            levels.push(levels[i - 1].blurred((now * now - before * before).sqrt()));
        }
        extrema(&levels, octaves.len(), &mut places);
        first = levels[SCALES].halved();
        octaves.push(levels);
    }
    // Equal strengths in the order in which they were found.
    places.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    places.truncate(MOST);
    let mut out = Corners::default();
    for p in places {
        let unit = (1u64 << p.octave) as f64;
        let at = [(p.x * unit + 0.5) / scale[0], (p.y * unit + 0.5) / scale[1]];
        let column = (at[0] as usize).min(image.width as usize - 1);
        let row = (at[1] as usize).min(image.height as usize - 1);
        let pixel = row * image.width as usize + column;
        // What is transparent is no thing.
        if image.alpha.as_ref().is_some_and(|a| a[pixel] < 0.5) {
            continue;
        }
        let from = 3 * pixel;
        out.at.push(at);
        out.colors.push([0, 1, 2].map(|c| (image.rgb[from + c].clamp(0.0, 1.0) * 255.0).round() as u8));
        out.codes.push(describe(&octaves[p.octave][p.level], &p, roll));
    }
    out
}

/// Blur of a level of an octave, in pixels of the octave.
fn sigma(level: f64) -> f64 {
    FIRST * (level / SCALES as f64).exp2()
}

/// Adds the extrema of an octave's differences.
fn extrema(levels: &[Plane], octave: usize, out: &mut Vec<Place>) {
    let differences: Vec<Plane> = levels.windows(2).map(|l| l[1].minus(&l[0])).collect();
    let (w, h) = (levels[0].width, levels[0].height);
    for level in 1..=SCALES {
        let [below, own, above] = [0, 1, 2].map(|k| &differences[level - 1 + k]);
        let mut stands_out = vec![false; w];
        for y in 1..h - 1 {
            outstanding(&own.values[(y - 1) * w..(y + 2) * w], &mut stands_out);
            for x in (1..w - 1).filter(|&x| stands_out[x]) {
                let v = own.values[y * w + x];
                let sign = v.signum();
                // Strictly above the neighbours that come later, so that of two equal ones one is left.
                let highest = [own, below, above].iter().enumerate().all(|(k, plane)| {
                    (y - 1..=y + 1).all(|y2| {
                        let row = &plane.values[y2 * w + x - 1..=y2 * w + x + 1];
                        row.iter().enumerate().all(|(i, &o)| {
                            let itself = k == 0 && y2 == y && i == 1;
                            itself
                                || sign * o < sign * v
                                || (o == v && (k == 1 || (k == 0 && (y2, x + i) < (y, x + 1))))
                        })
                    })
                });
                if highest && let Some(p) = refined(&differences, octave, level, x, y) {
                    out.push(p);
                }
            }
        }
    }
}

/// Which pixels of the middle one of three rows are no less than the four beside them, or no more, and not faint; not of the first and
/// the last pixel.
#[multiversion(targets("x86_64+avx2"))]
fn outstanding(rows: &[f32], out: &mut [bool]) {
    let w = out.len();
    let (above, row, below) = (&rows[..w], &rows[w..2 * w], &rows[2 * w..3 * w]);
    for x in 1..w - 1 {
        let (v, [a, b, c, d]) = (row[x], [row[x - 1], row[x + 1], above[x], below[x]]);
        let high = (v >= a) & (v >= b) & (v >= c) & (v >= d);
        let low = (v <= a) & (v <= b) & (v <= c) & (v <= d);
        out[x] = (high | low) & (v.abs() >= (0.5 * CONTRAST) as f32);
    }
}

/// The extremum between the pixels and scales, by a quadratic; none where it is faint, on an edge, or elsewhere.
fn refined(differences: &[Plane], octave: usize, level: usize, x: usize, y: usize) -> Option<Place> {
    let (w, h) = (differences[0].width, differences[0].height);
    let (mut level, mut x, mut y) = (level, x, y);
    for _ in 0..4 {
        let [b, d, a] = [level - 1, level, level + 1].map(|l| &differences[l]);
        let v = d.at(x, y);
        let gradient = glam::DVec3::new(
            0.5 * (d.at(x + 1, y) - d.at(x - 1, y)),
            0.5 * (d.at(x, y + 1) - d.at(x, y - 1)),
            0.5 * (a.at(x, y) - b.at(x, y)),
        );
        let xx = d.at(x + 1, y) + d.at(x - 1, y) - 2.0 * v;
        let yy = d.at(x, y + 1) + d.at(x, y - 1) - 2.0 * v;
        let ss = a.at(x, y) + b.at(x, y) - 2.0 * v;
        let xy = 0.25 * (d.at(x + 1, y + 1) - d.at(x - 1, y + 1) - d.at(x + 1, y - 1) + d.at(x - 1, y - 1));
        let xs = 0.25 * (a.at(x + 1, y) - a.at(x - 1, y) - b.at(x + 1, y) + b.at(x - 1, y));
        let ys = 0.25 * (a.at(x, y + 1) - a.at(x, y - 1) - b.at(x, y + 1) + b.at(x, y - 1));
        let hessian = glam::DMat3::from_cols_array(&[xx, xy, xs, xy, yy, ys, xs, ys, ss]);
        if hessian.determinant().abs() < 1e-15 {
            return None;
        }
        let off = -(hessian.inverse() * gradient);
        if off.abs().max_element() <= 0.5 {
            let strength = (v + 0.5 * gradient.dot(off)).abs();
            let (trace, det) = (xx + yy, xx * yy - xy * xy);
            let sharp = det > 0.0 && trace * trace * EDGE < (EDGE + 1.0).powi(2) * det;
            return (strength >= CONTRAST && sharp).then(|| Place {
                octave,
                level,
                x: x as f64 + off.x,
                y: y as f64 + off.y,
                sigma: sigma(level as f64 + off.z),
                strength,
            });
        }
        let step = |v: usize, by: f64, most: usize| {
            let to = v as f64 + if by.abs() > 0.5 { by.signum() } else { 0.0 };
            (1.0..=most as f64).contains(&to).then_some(to as usize)
        };
        (x, y, level) = (step(x, off.x, w - 2)?, step(y, off.y, h - 2)?, step(level, off.z, SCALES)?);
    }
    None
}

/// Gradients around a corner, in 4 x 4 cells by 8 directions.
fn describe(plane: &Plane, p: &Place, roll: f64) -> Code {
    const SIDE: usize = 16;
    let spacing = 0.75 * p.sigma;
    let (sin, cos) = roll.sin_cos();
    let mut cells = [0.0f32; NUMBERS];
    for j in 0..SIDE {
        for i in 0..SIDE {
            let (u, v) = (i as f64 - 7.5, j as f64 - 7.5);
            let (x, y) = (p.x + spacing * (cos * u - sin * v), p.y + spacing * (sin * u + cos * v));
            let dx = f64::from(plane.sample(x + 1.0, y) - plane.sample(x - 1.0, y));
            let dy = f64::from(plane.sample(x, y + 1.0) - plane.sample(x, y - 1.0));
            let (dx, dy) = (cos * dx + sin * dy, cos * dy - sin * dx);
            let weight = (-(u * u + v * v) / 128.0).exp() * dx.hypot(dy);
            let direction = dy.atan2(dx).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU * 8.0;
            let (column, row) = ((i as f64 + 0.5) / 4.0 - 0.5, (j as f64 + 0.5) / 4.0 - 0.5);
            for (r, by_row) in beside(row) {
                for (c, by_column) in beside(column) {
                    if !(0..4).contains(&r) || !(0..4).contains(&c) {
                        continue;
                    }
                    for (k, by) in beside(direction) {
                        let to = ((r * 4 + c) * 8 + k.rem_euclid(8)) as usize;
                        cells[to] += (weight * by_row * by_column * by) as f32;
                    }
                }
            }
        }
    }
    let length = cells.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    // No single edge decides.
    cells.iter_mut().for_each(|v| *v = (*v / length).min(0.2));
    let sum = cells.iter().sum::<f32>().max(1e-12);
    cells.map(|v| (LENGTH * (v / sum).sqrt()).round() as i16)
}

/// The two whole numbers around `v`, with the weights of a linear interpolation.
fn beside(v: f64) -> [(i32, f64); 2] {
    let low = v.floor();
    [(low as i32, 1.0 - (v - low)), (low as i32 + 1, v - low)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Discs of random places, sizes and greys, turned by `turn` about the middle.
    fn discs(width: u32, height: u32, turn: f64, shift: [f64; 2]) -> Image {
        let (mid, (sin, cos)) = ([0.5 * f64::from(width), 0.5 * f64::from(height)], turn.sin_cos());
        let noise = |k: u32| f64::from(k.wrapping_mul(2_654_435_761) >> 8) / f64::from(1 << 24);
        let mut rgb = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (f64::from(x) + 0.5 - mid[0] - shift[0], f64::from(y) + 0.5 - mid[1] - shift[1]);
                let (u, v) = (cos * u + sin * v + mid[0], cos * v - sin * u + mid[1]);
                let mut value = 0.5;
                for k in 0..60 {
                    let [a, b, r, g] = [0, 1, 2, 3].map(|i| noise(4 * k + i + 1));
                    let d = (u - a * f64::from(width)).hypot(v - b * f64::from(height));
                    value += (g - 0.5) / (1.0 + (2.0 * (d - 2.0 - 6.0 * r)).exp());
                }
                rgb.extend([value as f32; 3]);
            }
        }
        Image { width, height, rgb, alpha: None }
    }

    fn nearest(code: &Code, others: &Corners) -> usize {
        let product = |o: &Code| code.iter().zip(o).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum::<i32>();
        (0..others.codes.len()).max_by_key(|&i| product(&others.codes[i])).unwrap()
    }

    #[test]
    fn corners_are_found_again_in_a_moved_and_turned_picture() {
        let (w, h) = (160, 120);
        let still = detect(&discs(w, h, 0.0, [0.0; 2]), 0.0);
        assert!(still.at.len() > 30, "{}", still.at.len());
        for (turn, shift) in [(0.0, [3.3, -1.7]), (0.5, [0.0, 0.0])] {
            let moved = detect(&discs(w, h, turn, shift), turn);
            let (mut right, mut all) = (0, 0);
            for (at, code) in still.at.iter().zip(&still.codes) {
                let (u, v) = (at[0] - 80.0, at[1] - 60.0);
                let (sin, cos) = f64::sin_cos(turn);
                let to = [cos * u - sin * v + 80.0 + shift[0], sin * u + cos * v + 60.0 + shift[1]];
                if !((8.0..152.0).contains(&to[0]) && (8.0..112.0).contains(&to[1])) {
                    continue;
                }
                all += 1;
                let found = moved.at[nearest(code, &moved)];
                right += usize::from((found[0] - to[0]).hypot(found[1] - to[1]) < 0.7);
            }
            assert!(all > 20 && right * 10 >= all * 7, "{right} of {all} at {turn}");
        }
    }

    #[test]
    fn a_plain_or_tiny_picture_has_no_corners() {
        for (width, height) in [(1, 1), (64, 48)] {
            let image = Image { width, height, rgb: vec![0.5; 3 * (width * height) as usize], alpha: None };
            assert!(detect(&image, 0.0).at.is_empty());
        }
    }
}
