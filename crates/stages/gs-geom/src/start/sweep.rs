//! Points from photographs with known poses alone: a depth for each pixel of small pictures by plane sweep (Collins 1996), smoothed
//! along lines (semi-global matching, Hirschmueller 2008), kept where the depths of neighbouring views agree. Between these a view's
//! other pixels get what is interpolated: plain walls and floors have no depth of their own, and where nothing starts, nothing grows.

use super::depths::Voxels;
use glam::{DMat3, DVec3};
use gs_io::Result;
use gs_scene::dataset::View;
use gs_scene::{Camera, Image, PointCloud};
use rayon::prelude::*;
use stage::Stage;

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
const JUMP: f32 = 0.05;
const EDGE: f32 = 0.04;
/// Planes that the depths of two views may differ by.
const AGREE: f64 = 1.5;
/// Views that must agree with a depth.
const LEAST_AGREEING: usize = 2;
/// Every how many pixels a filled depth is a point.
const FILL: usize = 2;
/// The shares of the known points between which the depths of a view lie, and how much nearer and farther others may be.
const RANGE: [f64; 2] = [0.02, 0.98];
const BEYOND: [f64; 2] = [0.6, 2.0];

/// A small picture with what is tried on it.
struct Small {
    image: Image,
    camera: Camera,
    /// 1 / depth of the nearest and the farthest plane.
    range: [f64; 2],
    neighbours: Vec<usize>,
}

impl Small {
    /// 1 / depth of a plane, also between two.
    fn inverse(&self, plane: f64) -> f64 {
        self.range[0] + (self.range[1] - self.range[0]) * plane / (PLANES - 1) as f64
    }

    fn place(&self, pixel: usize, plane: f64) -> DVec3 {
        let (c, w) = (&self.camera, self.camera.width as usize);
        let (x, y) = ((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5);
        let sight = DVec3::new((x - c.cx) / c.fx, (y - c.cy) / c.fy, 1.0);
        c.rotation.transpose() * (sight / self.inverse(plane) - c.translation)
    }
}

/// At most `most` points of what several of `views` show. `known` points say how far away things are.
pub(crate) fn points(views: &[(&View, &Camera)], known: &PointCloud, most: usize, stage: &Stage) -> Result<PointCloud> {
    let small = |&(view, camera): &(&View, &Camera)| -> Result<(Image, Camera)> {
        let longest = camera.width.max(camera.height);
        let by = (f64::from(LONGEST) / f64::from(longest)).min(1.0);
        let [w, h] = [camera.width, camera.height].map(|v| ((f64::from(v) * by).round() as u32).max(1));
        Ok((view.load_image()?.resize_area(w, h), camera.resized(w, h)))
    };
    let pictures = views.par_iter().map(small).collect::<Result<Vec<_>>>()?;
    let cameras: Vec<Camera> = pictures.iter().map(|p| p.1.clone()).collect();
    let known: Vec<DVec3> = known.positions.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
    let mut all: Vec<f64> = cameras.iter().flat_map(|c| depths(c, &known)).collect();
    all.sort_by(f64::total_cmp);
    let pictures: Vec<Small> = pictures
        .into_iter()
        .enumerate()
        .map(|(i, (image, camera))| {
            let own = depths(&camera, &known);
            let [near, far] = range(if own.len() < 20 { all.clone() } else { own });
            Small {
                neighbours: neighbours(&cameras, i, 0.5 * (near + far)),
                image,
                camera,
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
    let mut voxels = Voxels::new(all.get(all.len() / 2).copied().unwrap_or(1.0));
    for own in 0..pictures.len() {
        for (place, color) in agreed(own, &pictures, &maps) {
            voxels.see(place, color);
        }
        voxels.limit(most);
    }
    Ok(voxels.cloud())
}

/// Depths of the points that a camera sees.
fn depths(c: &Camera, points: &[DVec3]) -> Vec<f64> {
    let inside = |&(u, v, z): &(f64, f64, f64)| {
        z > 0.0 && (0.0..f64::from(c.width)).contains(&u) && (0.0..f64::from(c.height)).contains(&v)
    };
    points.iter().map(|p| c.project(*p)).filter(inside).map(|p| p.2).collect()
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
        let (u, v, z) = o.project(target);
        let sees = z > 0.0 && (0.0..f64::from(o.width)).contains(&u) && (0.0..f64::from(o.height)).contains(&v);
        if i != own && sees && angle >= LEAST_ANGLE {
            all.push(((angle / ANGLE).ln().abs(), i));
        }
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all.truncate(NEIGHBOURS);
    all.into_iter().map(|a| a.1).collect()
}

/// The best plane of each pixel, between two where the costs say so; NaN where no neighbour sees it.
fn planes(own: &Small, all: &[Small]) -> Vec<f32> {
    let (w, h) = (own.image.width as usize, own.image.height as usize);
    let costs = costs(own, all);
    let smooth = smoothed(&costs, &own.image);
    (0..w * h)
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
    let (w, h) = (own.image.width as usize, own.image.height as usize);
    let c = &own.camera;
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
    let mut costs = vec![MOST_DIFFERENCE; w * h * PLANES];
    for (pixel, costs) in costs.chunks_exact_mut(PLANES).enumerate() {
        let sight = DVec3::new(((pixel % w) as f64 + 0.5 - c.cx) / c.fx, ((pixel / w) as f64 + 0.5 - c.cy) / c.fy, 1.0);
        let color = &own.image.rgb[3 * pixel..3 * pixel + 3];
        for (plane, cost) in costs.iter_mut().enumerate() {
            let inverse = own.inverse(plane as f64);
            let mut found = [f32::INFINITY; NEIGHBOURS];
            let mut count = 0;
            for (o, turn, shift) in &others {
                let p = *turn * sight + *shift * inverse;
                if p.z <= 0.0 {
                    continue;
                }
                let (u, v) = (o.camera.fx * p.x / p.z + o.camera.cx, o.camera.fy * p.y / p.z + o.camera.cy);
                if let Some(seen) = sample(&o.image, u, v) {
                    let difference = (0..3).map(|k| (seen[k] - color[k]).abs()).sum::<f32>() / 3.0;
                    found[count] = difference.min(MOST_DIFFERENCE);
                    count += 1;
                }
            }
            if count > 0 {
                found[..count].sort_by(f32::total_cmp);
                let half = count.div_ceil(2);
                *cost = found[..half].iter().sum::<f32>() / half as f32;
            }
        }
    }
    costs
}

/// Bilinear colour; none outside.
fn sample(image: &Image, u: f64, v: f64) -> Option<[f32; 3]> {
    let (w, h) = (image.width as usize, image.height as usize);
    let (x, y) = (u - 0.5, v - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < (w - 1) as f64 && y < (h - 1) as f64) {
        return None;
    }
    let (x0, y0) = (x as usize, y as usize);
    let (a, b) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
    let at = 3 * (y0 * w + x0);
    let (above, below) = (&image.rgb[at..at + 6], &image.rgb[at + 3 * w..at + 3 * w + 6]);
    Some([0, 1, 2].map(|k| {
        let (s, t) = (above[k] + a * (above[k + 3] - above[k]), below[k] + a * (below[k + 3] - below[k]));
        s + b * (t - s)
    }))
}

/// Sums of the least costs of all ways that lead to a pixel from eight sides, with what changes of the plane cost on the way.
fn smoothed(costs: &[f32], image: &Image) -> Vec<f32> {
    let (w, h) = (image.width as usize, image.height as usize);
    let mut sums = vec![0.0f32; costs.len()];
    let mut along = vec![0.0f32; costs.len()];
    let difference =
        |a: usize, b: usize| (0..3).map(|k| (image.rgb[3 * a + k] - image.rgb[3 * b + k]).abs()).sum::<f32>() / 3.0;
    for (dx, dy) in [(1i64, 0i64), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)] {
        for step in 0..w * h {
            // From the side that the way comes from.
            let pixel = if dy > 0 || (dy == 0 && dx > 0) { step } else { w * h - 1 - step };
            let (x, y) = ((pixel % w) as i64 - dx, (pixel / w) as i64 - dy);
            let here = pixel * PLANES..(pixel + 1) * PLANES;
            if x < 0 || y < 0 || x >= w as i64 || y >= h as i64 {
                along[here.clone()].copy_from_slice(&costs[here]);
                continue;
            }
            let from = y as usize * w + x as usize;
            let mut before = [0.0f32; PLANES + 2];
            before[1..=PLANES].copy_from_slice(&along[from * PLANES..(from + 1) * PLANES]);
            (before[0], before[PLANES + 1]) = (f32::INFINITY, f32::INFINITY);
            let least = before[1..=PLANES].iter().copied().fold(f32::INFINITY, f32::min);
            let jump = least + (JUMP / (1.0 + difference(pixel, from) / EDGE)).max(1.5 * STEP);
            for (k, (to, cost)) in along[here.clone()].iter_mut().zip(&costs[here]).enumerate() {
                let beside = before[k].min(before[k + 2]) + STEP;
                *to = cost + before[k + 1].min(beside).min(jump) - least;
            }
        }
        sums.iter_mut().zip(&along).for_each(|(s, a)| *s += a);
    }
    sums
}

/// Places and colours of the pixels whose depths neighbours agree with.
fn agreed(own: usize, all: &[Small], maps: &[Vec<f32>]) -> Vec<(DVec3, [u8; 3])> {
    let small = &all[own];
    let needed = LEAST_AGREEING.min(small.neighbours.len());
    let w = small.camera.width as usize;
    let agrees = |(pixel, &plane): (usize, &f32)| {
        if plane.is_nan() || needed == 0 {
            return false;
        }
        let place = small.place(pixel, f64::from(plane));
        let agrees = |&&i: &&usize| {
            let (o, (u, v, z)) = (&all[i], all[i].camera.project(place));
            if !(z > 0.0 && u >= 0.0 && v >= 0.0 && u < f64::from(o.camera.width) && v < f64::from(o.camera.height)) {
                return false;
            }
            let there = maps[i][v as usize * o.camera.width as usize + u as usize];
            let step = (o.range[0] - o.range[1]) / (PLANES - 1) as f64;
            (1.0 / z - o.inverse(f64::from(there))).abs() < AGREE * step
        };
        small.neighbours.iter().filter(agrees).count() >= needed
    };
    let sure: Vec<bool> = maps[own].iter().enumerate().map(agrees).collect();
    let known: Vec<[f32; 2]> =
        maps[own].iter().zip(&sure).map(|(p, s)| if *s { [*p, 1.0] } else { [0.0; 2] }).collect();
    let filled = filled(&known, w);
    // What is transparent is no thing.
    let is_there = |pixel: usize| small.image.alpha.as_ref().is_none_or(|a| a[pixel] >= 0.5);
    let on_grid = |pixel: usize| (pixel % w).is_multiple_of(FILL) && (pixel / w).is_multiple_of(FILL);
    let is_used = |&pixel: &usize| is_there(pixel) && (sure[pixel] || (on_grid(pixel) && filled[pixel][1] > 0.0));
    let point = |pixel: usize| {
        let color = [0, 1, 2].map(|k| (small.image.rgb[3 * pixel + k].clamp(0.0, 1.0) * 255.0).round() as u8);
        (small.place(pixel, f64::from(filled[pixel][0])), color)
    };
    (0..sure.len()).filter(is_used).map(point).collect()
}

/// Fills what is not known of `[height][width]` values and weights from means over larger and larger squares, interpolated; what is
/// known stays.
fn filled(known: &[[f32; 2]], w: usize) -> Vec<[f32; 2]> {
    let h = known.len() / w.max(1);
    if known.iter().all(|k| k[1] > 0.0) || w.max(h) < 2 {
        return known.to_vec();
    }
    let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
    let mut coarse = vec![[0.0f32; 2]; half_w * half_h];
    for (i, [value, weight]) in known.iter().enumerate() {
        let to = &mut coarse[i / w / 2 * half_w + i % w / 2];
        *to = [to[0] + weight * value, to[1] + weight];
    }
    coarse.iter_mut().filter(|c| c[1] > 0.0).for_each(|c| *c = [c[0] / c[1], 1.0]);
    let coarse = filled(&coarse, half_w);
    let from_coarse = |i: usize| {
        // Places of the four squares around the pixel's middle.
        let place = |v: usize, most: usize| {
            let p = (v as f32 + 0.5) / 2.0 - 0.5;
            let low = p.floor().max(0.0) as usize;
            (low.min(most - 1), (low + 1).min(most - 1), (p - low as f32).clamp(0.0, 1.0))
        };
        let ((x0, x1, a), (y0, y1, b)) = (place(i % w, half_w), place(i / w, half_h));
        let mut sum = [0.0f32; 2];
        for (x, y, by) in
            [(x0, y0, (1.0 - a) * (1.0 - b)), (x1, y0, a * (1.0 - b)), (x0, y1, (1.0 - a) * b), (x1, y1, a * b)]
        {
            let [value, weight] = coarse[y * half_w + x];
            sum = [sum[0] + by * weight * value, sum[1] + by * weight];
        }
        if sum[1] > 0.0 { [sum[0] / sum[1], 1.0] } else { [0.0; 2] }
    };
    known.iter().enumerate().map(|(i, k)| if k[1] > 0.0 { *k } else { from_coarse(i) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_are_filled_from_around_and_known_values_stay() {
        let (w, h) = (21, 13);
        let plane = |i: usize| (i % w) as f32 + 2.0 * (i / w) as f32;
        let known: Vec<[f32; 2]> =
            (0..w * h).map(|i| if (6..15).contains(&(i % w)) { [0.0; 2] } else { [plane(i), 1.0] }).collect();
        let all = filled(&known, w);
        // Means of what is known lie within it.
        let most = plane(w * h - 1) + 1e-3;
        for (i, v) in all.iter().enumerate() {
            assert!(v[1] > 0.0 && (-1e-3..most).contains(&v[0]), "{i}: {v:?}");
            assert!(known[i][1] == 0.0 || v[0] == plane(i), "{i}: {v:?}");
        }
        let (left, right) = (all[6 * w + 6][0], all[6 * w + 14][0]);
        assert!(left < right, "{left} {right}");
        assert!(filled(&vec![[0.0; 2]; w * h], w).iter().all(|v| v[1] == 0.0));
    }

    /// A textured wall four units away, seen by three cameras beside each other.
    #[test]
    fn a_wall_is_where_it_is() {
        let camera = |x: f64| Camera::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 0.0, 4.0), -DVec3::Y, 64, 48, 1.0);
        let texture = |x: f64, y: f64| {
            [0.0, 1.0, 2.0]
                .map(|k| (0.5 + 0.25 * (3.0 * x + k).sin() + 0.25 * (4.0 * y - 1.7 * x * y + 2.0 * k).cos()) as f32)
        };
        let cameras = [-0.4, 0.0, 0.4].map(camera);
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
            Small { image, camera: c.clone(), range: [1.0 / 2.0, 1.0 / 9.0], neighbours: neighbours(&cameras, i, 4.0) }
        };
        let all: Vec<Small> = (0..3).map(small).collect();
        let maps: Vec<Vec<f32>> = all.iter().map(|s| planes(s, &all)).collect();
        let points = agreed(1, &all, &maps);
        let off: Vec<f64> = points.iter().map(|(p, _)| (p.z - 4.0).abs()).collect();
        let near = off.iter().filter(|d| **d < 0.1).count();
        assert!(points.len() > 2000 && near * 20 > points.len() * 18, "{near} of {}", points.len());
    }
}
