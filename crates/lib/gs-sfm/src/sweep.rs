//! Points from photographs with known poses alone: a depth for each pixel of small pictures by plane sweep (Collins 1996), smoothed
//! along lines (semi-global matching, Hirschmueller 2008), kept where a neighbouring view has nearly the same. A little wrong is better
//! than nothing: where nothing starts, nothing grows. What no view agrees with is worse than nothing, and so is what lies between.
//! More pixels become points where the picture has more to show.

use glam::{DMat3, DVec3, Vec3};
use gs_io::Result;
use gs_scene::{Camera, Image, PointCloud, size_within};
use multiversion::multiversion;
use rayon::prelude::*;
use stage::Stage;

/// Fewest corners that tell how far away things are.
pub const FEWEST_CORNERS: usize = 20;
/// Longer side of the small pictures.
const LONGEST: u32 = 160;
/// Depths that are tried, evenly spaced in 1 / depth.
const PLANES: usize = 96;
/// Neighbours that a picture is compared with.
const NEIGHBOURS: usize = 6;
/// Angle between two sights of the scene that is best, in degrees, and the least.
const ANGLE: f64 = 10.0;
const LEAST_ANGLE: f64 = 2.0;
/// Difference of colours beyond which a pixel is another one.
const MOST_DIFFERENCE: f32 = 0.2;
/// What a step of one plane costs between neighbouring pixels, and a larger one, which edges of the picture make cheaper.
const STEP: f32 = 0.004;
const JUMP: f32 = 0.1;
const EDGE: f32 = 0.04;
/// Planes that the depths of two views may differ by.
const AGREE: f64 = 4.0;
/// The shares of the known points between which the depths of a view lie, and how much nearer and farther others may be.
const RANGE: [f64; 2] = [0.02, 0.98];
const BEYOND: [f64; 2] = [0.6, 3.0];
/// Contrast with the pixels beside, 0 to 1, that is added to that of every pixel: plain walls need points too.
const PLAIN: f32 = 0.02;
/// Largest size of a Gaussian, in depths: a larger one can hang as haze before another camera.
const MOST_SIZE: f64 = 0.15;
/// Share of its depth that a pixel's place is at least away from all cameras: somebody stood there, so it is free.
const FREE: f64 = 0.2;
/// Points to start from: the corners, and after them the pixels that were drawn.
pub struct Swept {
    /// World units, with their colours.
    pub points: PointCloud,
    /// How many are corners.
    pub corners: usize,
    /// Largest size of the Gaussian of each.
    pub most_sizes: Vec<f64>,
}

/// A small picture with what is tried on it.
struct Small {
    /// Red, green, blue, opacity: four numbers are read at once.
    pixels: Vec<[f32; 4]>,
    camera: Camera,
    /// 1 / depth of the nearest and the farthest plane.
    range: [f64; 2],
    neighbours: Vec<usize>,
}

/// The colours and opacities of a picture.
fn pixels(image: &Image) -> Vec<[f32; 4]> {
    let opacity = |i: usize| image.alpha.as_ref().map_or(1.0, |a| a[i]);
    image.rgb.as_chunks().0.iter().enumerate().map(|(i, &[r, g, b])| [r, g, b, opacity(i)]).collect()
}

impl Small {
    /// 1 / depth of a plane, also between two.
    fn inverse(&self, plane: f64) -> f64 {
        self.range[0] + (self.range[1] - self.range[0]) * plane / (PLANES - 1) as f64
    }

    /// Whether its map of planes has nearly this place.
    fn agrees(&self, place: DVec3, map: &[f32]) -> bool {
        let Some((u, v, z)) = self.camera.sees(place) else { return false };
        let there = f64::from(map[v as usize * self.camera.width as usize + u as usize]);
        let step = (self.range[0] - self.range[1]) / (PLANES - 1) as f64;
        (1.0 / z - self.inverse(there)).abs() < AGREE * step
    }

    /// Difference of the colours beside a pixel, 0 to about 1; 0 on the border.
    fn contrast(&self, pixel: usize) -> f32 {
        let (w, h) = (self.camera.width as usize, self.camera.height as usize);
        let (x, y) = (pixel % w, pixel / w);
        if x == 0 || y == 0 || x + 1 == w || y + 1 == h {
            return 0.0;
        }
        let across = |step: usize| difference(self.pixels[pixel + step], self.pixels[pixel - step]);
        across(1).hypot(across(w))
    }

    fn place(&self, pixel: usize, plane: f64) -> DVec3 {
        let (c, w) = (&self.camera, self.camera.width as usize);
        let (x, y) = ((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5);
        let sight = DVec3::new((x - c.cx) / c.fx, (y - c.cy) / c.fy, 1.0);
        c.rotation.transpose() * (sight / self.inverse(plane) - c.translation)
    }
}

/// The small picture of a photograph. A little blurred, by an odd size between: what is sharp matches only at the right fraction of a
/// pixel.
pub fn small(photograph: &Image, camera: &Camera) -> Image {
    let (w, h) = size_within((camera.width, camera.height), LONGEST);
    photograph.resize_area(w + w / 2, h + h / 2).resize_area(w, h)
}

/// The corners, which say how far away things are, and points of what several pictures show, each [`small`]. `draw` takes places of
/// a list of weights, in proportion to them; each place counts once.
///
/// # Errors
/// When the run is interrupted.
pub fn points(
    pictures: Vec<Image>,
    cameras: &[Camera],
    corners: PointCloud,
    draw: impl FnOnce(&[f64]) -> Vec<usize>,
    stage: &Stage,
) -> Result<Swept> {
    let cameras: Vec<Camera> = cameras.iter().zip(&pictures).map(|(c, p)| c.resized(p.width, p.height)).collect();
    let known: Vec<DVec3> = corners.positions.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
    let own: Vec<Vec<f64>> = cameras.iter().map(|c| depths(c, &known)).collect();
    let all = own.concat();
    let pictures: Vec<Small> = pictures
        .into_iter()
        .zip(&cameras)
        .zip(own)
        .enumerate()
        .map(|(i, ((picture, camera), own))| {
            let [near, far] = range(if own.len() < 20 { all.clone() } else { own });
            Small {
                neighbours: neighbours(&cameras, i, 0.5 * (near + far)),
                pixels: pixels(&picture),
                camera: camera.clone(),
                range: [1.0 / near, 1.0 / far],
            }
        })
        .collect();
    let mut progress = stage.progress("depth map", pictures.len() as u64);
    let mut maps: Vec<Vec<f32>> = Vec::new();
    for part in pictures.chunks(2 * rayon::current_num_threads()) {
        stage.go_on()?;
        maps.extend(part.par_iter().map(|p| planes(p, &pictures)).collect::<Vec<_>>());
        part.iter().for_each(|_| progress.step());
    }
    progress.finish(&[]);
    let worth: Vec<(usize, u32, f32)> = (0..pictures.len())
        .into_par_iter()
        .flat_map_iter(|view| {
            let pixels = (0..).zip(weights(view, &pictures, &maps));
            pixels.filter(|&(_, weight)| weight > 0.0).map(move |(pixel, weight)| (view, pixel, weight))
        })
        .collect();
    let nearest = |place: DVec3| {
        let seen = cameras.iter().filter_map(|c| c.sees(place));
        seen.map(|(_, _, depth)| depth).fold(f64::INFINITY, f64::min)
    };
    let mut swept = Swept {
        corners: corners.len(),
        points: corners,
        most_sizes: known.iter().map(|&place| MOST_SIZE * nearest(place)).collect(),
    };
    let weights: Vec<f64> = worth.iter().map(|&(_, _, weight)| f64::from(weight)).collect();
    let mut chosen = draw(&weights);
    chosen.sort_unstable();
    chosen.dedup();
    for (view, pixel) in chosen.into_iter().map(|i| (worth[i].0, worth[i].1 as usize)) {
        let (small, plane) = (&pictures[view], f64::from(maps[view][pixel]));
        let (place, depth) = (small.place(pixel, plane), 1.0 / small.inverse(plane));
        if cameras.iter().any(|c| c.position().distance(place) < FREE * depth) {
            continue;
        }
        let [color @ .., _] = small.pixels[pixel];
        swept.points.positions.push(place.as_vec3().to_array());
        swept.points.colors.push(color.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8));
        swept.most_sizes.push(MOST_SIZE * depth);
    }
    Ok(swept)
}

/// Depths of the points that a camera sees.
fn depths(c: &Camera, points: &[DVec3]) -> Vec<f64> {
    points.iter().filter_map(|p| c.sees(*p)).map(|p| p.2).collect()
}

fn range(mut depths: Vec<f64>) -> [f64; 2] {
    depths.sort_by(f64::total_cmp);
    let at =
        |share: f64| depths.get(((depths.len() as f64 * share) as usize).min(depths.len().saturating_sub(1))).copied();
    let [near, far] = RANGE.map(|share| at(share).unwrap_or(1.0));
    [near * BEYOND[0], far * BEYOND[1]]
}

/// The views to compare with: those that look at the same from an angle that tells depths and shows no other sides.
fn neighbours(cameras: &[Camera], own: usize, depth: f64) -> Vec<usize> {
    let c = &cameras[own];
    let target = c.rotation.transpose() * (DVec3::new(0.0, 0.0, depth) - c.translation);
    let mut all: Vec<(f64, usize)> = Vec::new();
    for (i, o) in cameras.iter().enumerate() {
        let angle = (c.position() - target).angle_between(o.position() - target).to_degrees();
        if i != own && o.sees(target).is_some() && angle >= LEAST_ANGLE {
            all.push(((angle / ANGLE).ln().abs(), i));
        }
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all.truncate(NEIGHBOURS);
    all.into_iter().map(|a| a.1).collect()
}

/// The best plane of each pixel, between two where the costs say so; NaN where no neighbour sees it.
fn planes(own: &Small, all: &[Small]) -> Vec<f32> {
    let costs = costs(own, all);
    let smooth = smoothed(&costs, own);
    (0..own.pixels.len())
        .map(|pixel| {
            let of = &smooth[pixel * PLANES..(pixel + 1) * PLANES];
            let best = (0..PLANES).min_by(|&a, &b| of[a].total_cmp(&of[b])).unwrap_or(0);
            let known = costs[pixel * PLANES + best] < MOST_DIFFERENCE;
            if best == 0 || best + 1 == PLANES || !known {
                return f32::NAN;
            }
            let [a, b, c] = [of[best - 1], of[best], of[best + 1]];
            best as f32 + (0.5 * (a - c) / (a - 2.0 * b + c).max(1e-9)).clamp(-0.5, 0.5)
        })
        .collect()
}

/// Difference of the colours of each pixel at each plane from those of the better half of the neighbours that see it.
fn costs(own: &Small, all: &[Small]) -> Vec<f32> {
    let c = &own.camera;
    let w = c.width as usize;
    // The sight of a pixel in a neighbour's axes: a z + b, with z the depth.
    let others: Vec<(&Small, DMat3, DVec3)> = own
        .neighbours
        .iter()
        .map(|&i| {
            let o = &all[i].camera;
            let turn = o.rotation * c.rotation.transpose();
            (&all[i], turn, o.translation - turn * c.translation)
        })
        .collect();
    let inverses: [f32; PLANES] = std::array::from_fn(|plane| own.inverse(plane as f64) as f32);
    let mut found = vec![[0.0; PLANES]; others.len()];
    let mut costs = vec![0.0; own.pixels.len() * PLANES];
    for (pixel, costs) in costs.as_chunks_mut::<PLANES>().0.iter_mut().enumerate() {
        let sight = DVec3::new(((pixel % w) as f64 + 0.5 - c.cx) / c.fx, ((pixel / w) as f64 + 0.5 - c.cy) / c.fy, 1.0);
        for (found, (o, turn, shift)) in found.iter_mut().zip(&others) {
            differences(o, own.pixels[pixel], (*turn * sight).as_vec3(), shift.as_vec3(), &inverses, found);
        }
        better_half(&mut found, costs);
    }
    costs
}

/// Difference of a colour from what a neighbour shows at each plane, where its axes have the place `a + b / depth`; infinite where it
/// does not see it.
#[multiversion(targets("x86_64+avx2"))]
fn differences(o: &Small, color: [f32; 4], a: Vec3, b: Vec3, inverses: &[f32; PLANES], out: &mut [f32; PLANES]) {
    let [fx, fy, cx, cy] = [o.camera.fx, o.camera.fy, o.camera.cx - 0.5, o.camera.cy - 0.5].map(|v| v as f32);
    let mut at = [[0.0f32; PLANES]; 2];
    let [us, vs] = &mut at;
    for (k, inverse) in inverses.iter().enumerate() {
        let z = a.z + b.z * inverse;
        // Behind the neighbour: outside of its picture.
        let by = if z > 0.0 { 1.0 / z } else { f32::NAN };
        us[k] = fx * (a.x + b.x * inverse) * by + cx;
        vs[k] = fy * (a.y + b.y * inverse) * by + cy;
    }
    for (out, (u, v)) in out.iter_mut().zip(us.iter().zip(vs)) {
        *out = sample(o, *u, *v).map_or(f32::INFINITY, |seen| difference(seen, color).min(MOST_DIFFERENCE));
    }
}

/// The mean difference of two colours' channels.
#[inline(always)]
fn difference(a: [f32; 4], b: [f32; 4]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]).abs()).sum::<f32>() / 3.0
}

/// Bilinear colour at a place in pixels, whose centres are whole numbers; none outside.
#[inline(always)]
fn sample(o: &Small, x: f32, y: f32) -> Option<[f32; 4]> {
    let (w, h) = (o.camera.width as usize, o.camera.height as usize);
    if !(x >= 0.0 && y >= 0.0 && x < (w - 1) as f32 && y < (h - 1) as f32) {
        return None;
    }
    let (x0, y0) = (x as u32, y as u32);
    let (u, v) = (x - x0 as f32, y - y0 as f32);
    let at = y0 as usize * w + x0 as usize;
    let (above, below) = (&o.pixels[at..at + 2], &o.pixels[at + w..at + w + 2]);
    Some(std::array::from_fn(|k| {
        let (s, t) = (above[0][k] + u * (above[1][k] - above[0][k]), below[0][k] + u * (below[1][k] - below[0][k]));
        s + v * (t - s)
    }))
}

/// Of each plane the mean of the smaller half of what was found; infinite ones do not count. Sorts what was found.
#[multiversion(targets("x86_64+avx2"))]
fn better_half(found: &mut [[f32; PLANES]], out: &mut [f32; PLANES]) {
    for end in 1..found.len() {
        for k in (0..end).rev() {
            let [low, high] = &mut found[k..k + 2] else { unreachable!("two of them") };
            for (a, b) in low.iter_mut().zip(high) {
                (*a, *b) = if *b < *a { (*b, *a) } else { (*a, *b) };
            }
        }
    }
    let mut counts = [0.0f32; PLANES];
    for of in found.iter() {
        counts.iter_mut().zip(of).for_each(|(n, v)| *n += if *v < f32::INFINITY { 1.0 } else { 0.0 });
    }
    let mut sums = [0.0f32; PLANES];
    for (k, of) in found.iter().enumerate() {
        // One of one or two, two of three or four.
        let taken = sums.iter_mut().zip(of).zip(&counts);
        taken.for_each(|((sum, v), n)| *sum += if *n > 2.0 * k as f32 { *v } else { 0.0 });
    }
    for ((out, sum), n) in out.iter_mut().zip(sums).zip(counts) {
        *out = if n > 0.0 { sum / (0.5 * n).ceil() } else { MOST_DIFFERENCE };
    }
}

/// Sums of the least costs of all ways that lead to a pixel from eight sides, with what changes of the plane cost on the way.
fn smoothed(costs: &[f32], own: &Small) -> Vec<f32> {
    let (w, h) = (own.camera.width as usize, own.camera.height as usize);
    let mut sums = vec![0.0f32; costs.len()];
    let mut along = vec![0.0f32; costs.len()];
    let difference = |a: usize, b: usize| difference(own.pixels[a], own.pixels[b]);
    let costs = costs.as_chunks::<PLANES>().0;
    for (dx, dy) in [(1i64, 0i64), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)] {
        let along = along.as_chunks_mut::<PLANES>().0;
        for step in 0..w * h {
            // From the side that the way comes from.
            let pixel = if dy > 0 || (dy == 0 && dx > 0) { step } else { w * h - 1 - step };
            let (x, y) = ((pixel % w) as i64 - dx, (pixel / w) as i64 - dy);
            if x < 0 || y < 0 || x >= w as i64 || y >= h as i64 {
                along[pixel] = costs[pixel];
                continue;
            }
            let from = y as usize * w + x as usize;
            let jump = (JUMP / (1.0 + difference(pixel, from) / EDGE)).max(1.5 * STEP);
            along[pixel] = onward(&along[from], &costs[pixel], jump);
        }
        sums.iter_mut().zip(along.as_flattened()).for_each(|(s, a)| *s += a);
    }
    sums
}

/// The least costs of the ways to a pixel, from those to the one before, less the least of these.
#[multiversion(targets("x86_64+avx2"))]
fn onward(before: &[f32; PLANES], costs: &[f32; PLANES], jump: f32) -> [f32; PLANES] {
    fn smaller(a: f32, b: f32) -> f32 {
        if a < b { a } else { b }
    }
    let mut least = [f32::INFINITY; 8];
    for part in before.as_chunks::<8>().0 {
        least.iter_mut().zip(part).for_each(|(l, v)| *l = smaller(*l, *v));
    }
    let least = least.into_iter().fold(f32::INFINITY, smaller);
    let mut padded = [f32::INFINITY; PLANES + 2];
    padded[1..=PLANES].copy_from_slice(before);
    std::array::from_fn(|k| {
        let beside = smaller(padded[k], padded[k + 2]) + STEP;
        costs[k] + smaller(smaller(padded[k + 1], beside), least + jump) - least
    })
}

/// How much each pixel is worth as a point: its contrast, shared among the views that see it; nothing where no neighbour agrees with
/// its depth, and where it is transparent.
fn weights(own: usize, all: &[Small], maps: &[Vec<f32>]) -> Vec<f32> {
    let small = &all[own];
    let weight = |(pixel, &plane): (usize, &f32)| {
        if plane.is_nan() || small.pixels[pixel][3] < 0.5 {
            return 0.0;
        }
        let place = small.place(pixel, f64::from(plane));
        let agree = small.neighbours.iter().filter(|&&i| all[i].agrees(place, &maps[i])).count();
        if agree == 0 { 0.0 } else { (PLAIN + small.contrast(pixel)) / (1 + agree) as f32 }
    };
    maps[own].iter().enumerate().map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A textured wall four units away, seen by cameras beside each other.
    fn wall(cameras: &[f64]) -> Vec<Small> {
        let camera = |x: f64| Camera::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 0.0, 4.0), -DVec3::Y, 64, 48, 1.0);
        let texture = |x: f64, y: f64| {
            [0.0, 1.0, 2.0]
                .map(|k| (0.5 + 0.25 * (3.0 * x + k).sin() + 0.25 * (4.0 * y - 1.7 * x * y + 2.0 * k).cos()) as f32)
        };
        let cameras: Vec<Camera> = cameras.iter().map(|&x| camera(x)).collect();
        let small = |i: usize| {
            let c = &cameras[i];
            let mut rgb = Vec::new();
            for pixel in 0..64 * 48 {
                let (x, y) = ((pixel % 64) as f64 + 0.5, (pixel / 64) as f64 + 0.5);
                let sight = DVec3::new((x - c.cx) / c.fx, (y - c.cy) / c.fy, 1.0) * 4.0;
                let p = c.rotation.transpose() * (sight - c.translation);
                rgb.extend(texture(p.x, p.y));
            }
            let image = Image { width: 64, height: 48, rgb, alpha: None };
            let neighbours = neighbours(&cameras, i, 4.0);
            Small { pixels: pixels(&image), camera: c.clone(), range: [1.0 / 2.0, 1.0 / 9.0], neighbours }
        };
        (0..cameras.len()).map(small).collect()
    }

    #[test]
    fn a_wall_is_where_it_is() {
        let all = wall(&[-0.4, 0.0, 0.4]);
        let maps: Vec<Vec<f32>> = all.iter().map(|s| planes(s, &all)).collect();
        let weights = weights(1, &all, &maps);
        let known: Vec<usize> = (0..weights.len()).filter(|&i| weights[i] > 0.0).collect();
        let near = known.iter().filter(|&&i| (all[1].place(i, f64::from(maps[1][i])).z - 4.0).abs() < 0.1).count();
        assert!(known.len() > 2000 && near * 20 > known.len() * 18, "{near} of {}", known.len());
    }

    /// [`costs`], plainly.
    fn plain_costs(own: &Small, all: &[Small], pixel: usize, plane: usize) -> f32 {
        let place = own.place(pixel, plane as f64);
        let seen = |&i: &usize| {
            let (o, (u, v, z)) = (&all[i], all[i].camera.project(place));
            let (w, h) = (o.camera.width as usize, o.camera.height as usize);
            let (x, y) = (u - 0.5, v - 0.5);
            if !(z > 0.0 && x >= 0.0 && y >= 0.0 && x < (w - 1) as f64 && y < (h - 1) as f64) {
                return None;
            }
            let color = |k: usize| {
                let at = |dx: usize, dy: usize| {
                    let weight = |d: usize, v: f64| if d == 0 { 1.0 - v.fract() } else { v.fract() };
                    let pixel = (y as usize + dy) * w + x as usize + dx;
                    weight(dx, x) * weight(dy, y) * f64::from(o.pixels[pixel][k])
                };
                at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1)
            };
            let off = (0..3).map(|k| (color(k) - f64::from(own.pixels[pixel][k])).abs()).sum::<f64>() / 3.0;
            Some(off.min(f64::from(MOST_DIFFERENCE)))
        };
        let mut found: Vec<f64> = own.neighbours.iter().filter_map(seen).collect();
        found.sort_by(f64::total_cmp);
        let half = found.len().div_ceil(2);
        if half == 0 { MOST_DIFFERENCE } else { (found[..half].iter().sum::<f64>() / half as f64) as f32 }
    }

    #[test]
    fn costs_are_those_of_the_plain_version() {
        let all = wall(&[-0.9, -0.4, 0.0, 0.3, 0.8, 1.3]);
        let own = &all[1];
        assert_eq!(own.neighbours.len(), 5);
        let costs = costs(own, &all);
        // All cameras are level: a neighbour sees the first and the last row on its border, or just not.
        let inner = 64 * PLANES..47 * 64 * PLANES;
        let off = |i: usize| (costs[i] - plain_costs(own, &all, i / PLANES, i % PLANES)).abs();
        assert!(inner.clone().filter(|&i| off(i) > 1e-4).count() < inner.len() / 1000);
        assert!(costs.contains(&MOST_DIFFERENCE) && costs.iter().any(|&c| c < 0.01));
    }

    #[test]
    fn the_way_onward_is_that_of_the_plain_version() {
        let number = |k: usize| ((k * 2_654_435_761) % 1000) as f32 / 1000.0;
        let (before, costs): ([f32; PLANES], [f32; PLANES]) =
            (std::array::from_fn(|k| 0.1 * number(k)), std::array::from_fn(|k| number(k + 500)));
        let jump = 0.03;
        let least = before.iter().copied().fold(f32::INFINITY, f32::min);
        for (k, next) in onward(&before, &costs, jump).into_iter().enumerate() {
            let ways = (0..PLANES).map(|from| before[from] + [0.0, STEP, jump][k.abs_diff(from).min(2)]);
            // A jump may lead to any plane.
            let best = ways.fold(least + jump, f32::min);
            assert!((next - (costs[k] + best - least)).abs() < 1e-6, "{k}");
        }
    }
}
