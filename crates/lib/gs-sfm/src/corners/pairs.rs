//! The same corners in two photographs: alike, near each other's epipolar lines by poses that need not be exact, and in
//! agreement about how the two cameras lie.

use super::detect::{Code, Corners, NUMBERS};
use glam::{DMat3, DQuat, DVec2, DVec3};
use gs_scene::Camera;
use multiversion::multiversion;

/// Largest angle between the optical axes of a pair.
const WIDEST: f64 = 50.0;
/// Ranks of the partners of a photograph among its neighbours: near ones see the same, farther ones give angles.
const RANKS: [usize; 13] = [0, 1, 2, 3, 4, 5, 7, 9, 12, 15, 19, 24, 31];
/// The second nearest description must be farther by this factor: else the corner is one of many alike.
const RATIO: f64 = 0.88;
/// Distance from the epipolar line at which corners are compared at all, as a share of the picture's diagonal: 2.5 degrees
/// for usual lenses.
const BAND: f64 = 0.05;
/// The same once the pair agrees about its poses; also the error of a corner that belongs to a point.
pub(super) const EXACT: f64 = 0.0025;
/// Fewest matches of a pair, and their share of those before poses were agreed on.
const FEWEST: usize = 8;
const SHARE: f64 = 0.25;

/// Pairs of photographs that may show the same, in order.
pub(super) fn partners(cameras: &[Camera]) -> Vec<[usize; 2]> {
    let axis = |c: &Camera| c.rotation.transpose() * DVec3::Z;
    let mean = cameras.iter().map(Camera::position).sum::<DVec3>() / cameras.len().max(1) as f64;
    let size = cameras.iter().map(|c| c.position().distance(mean)).fold(0.0, f64::max).max(1e-12);
    let mut pairs = Vec::new();
    for (i, a) in cameras.iter().enumerate() {
        let mut near: Vec<(f64, usize)> = Vec::new();
        for (j, b) in cameras.iter().enumerate() {
            let angle = axis(a).angle_between(axis(b)).to_degrees();
            if i != j && angle < WIDEST {
                near.push((angle / WIDEST + a.position().distance(b.position()) / size, j));
            }
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        pairs.extend(RANKS.iter().filter_map(|&r| near.get(r)).map(|&(_, j)| [i.min(j), i.max(j)]));
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Corners `[of the first, of the second]` that are the same.
pub(super) fn matches(corners: [&Corners; 2], cameras: [&Camera; 2]) -> Vec<[usize; 2]> {
    let alike = alike(corners, cameras);
    let sight = |k: usize| alike.iter().map(move |m| sight(cameras[k], corners[k].at[m[k]])).collect::<Vec<_>>();
    let (first, second) = (sight(0), sight(1));
    let pose = Between::of(cameras).agreed(cameras, &first, &second);
    let focal = focal(cameras);
    let limit = EXACT * diagonal(cameras);
    let (before, mut alike) = (alike.len(), alike);
    let mut at = 0;
    alike.retain(|_| {
        at += 1;
        focal * pose.distance(first[at - 1], second[at - 1]).abs() < limit
    });
    if alike.len() < FEWEST || (alike.len() as f64) < SHARE * before as f64 { Vec::new() } else { alike }
}

fn diagonal(cameras: [&Camera; 2]) -> f64 {
    let of = |c: &Camera| f64::from(c.width).hypot(f64::from(c.height));
    0.5 * (of(cameras[0]) + of(cameras[1]))
}

fn focal(cameras: [&Camera; 2]) -> f64 {
    0.25 * (cameras[0].fx + cameras[0].fy + cameras[1].fx + cameras[1].fy)
}

/// The ray through a pixel, at depth 1.
fn sight(c: &Camera, at: [f64; 2]) -> DVec2 {
    DVec2::new((at[0] - c.cx) / c.fx, (at[1] - c.cy) / c.fy)
}

/// The pose of a second camera as the first sees it: `p_second = rotation p_first + along`; the length of `along` says nothing.
struct Between {
    rotation: DMat3,
    along: DVec3,
}

impl Between {
    fn of([a, b]: [&Camera; 2]) -> Self {
        let rotation = b.rotation * a.rotation.transpose();
        Self { rotation, along: (b.translation - rotation * a.translation).normalize_or(DVec3::X) }
    }

    fn essential(&self) -> DMat3 {
        let t = self.along;
        DMat3::from_cols(DVec3::new(0.0, t.z, -t.y), DVec3::new(-t.z, 0.0, t.x), DVec3::new(t.y, -t.x, 0.0))
            * self.rotation
    }

    /// Sampson's distance of two sights from agreeing, at depth 1.
    fn distance(&self, a: DVec2, b: DVec2) -> f64 {
        sampson(&self.essential(), a, b)
    }

    /// Turned and shifted by small angles: three of the rotation, two of the direction.
    fn moved(&self, by: &[f64; 5]) -> Self {
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(by[0], by[1], by[2])));
        let (x, y) = self.along.any_orthonormal_pair();
        Self { rotation: turn * self.rotation, along: (self.along + by[3] * x + by[4] * y).normalize() }
    }

    /// The pose that most of the matches agree on, near this one: least squares of the distances, with weights that fall for those
    /// that are far (Geman and McClure), from wide to narrow. A pair that tells nothing of a direction stays there.
    fn agreed(self, cameras: [&Camera; 2], a: &[DVec2], b: &[DVec2]) -> Self {
        const STEP: f64 = 1e-6;
        let unit = diagonal(cameras) / focal(cameras);
        let mut pose = self;
        for width in [0.03, 0.02, 0.012, 0.008, 0.005, 0.003, 0.002, 0.0015, 0.0015, 0.0015] {
            let width = width * unit;
            let here = pose.essential();
            let beside: Vec<DMat3> = (0..5)
                .map(|k| {
                    let mut by = [0.0; 5];
                    by[k] = STEP;
                    pose.moved(&by).essential()
                })
                .collect();
            let (mut h, mut g) = ([[0.0; 5]; 5], [0.0; 5]);
            for (&a, &b) in a.iter().zip(b) {
                let r = sampson(&here, a, b);
                let weight = (width * width / (width * width + r * r)).powi(2);
                let d: [f64; 5] = std::array::from_fn(|k| (sampson(&beside[k], a, b) - r) / STEP);
                for i in 0..5 {
                    g[i] += weight * d[i] * r;
                    (0..5).for_each(|j| h[i][j] += weight * d[i] * d[j]);
                }
            }
            // As one match that wants each angle to stay within 0.05.
            (0..5).for_each(|k| h[k][k] += (width / 0.05).powi(2));
            let Some(step) = crate::solve::<5>(h, g.map(|v| -v)) else { return pose };
            pose = pose.moved(&step);
        }
        pose
    }
}

fn sampson(e: &DMat3, a: DVec2, b: DVec2) -> f64 {
    let (a, b) = (a.extend(1.0), b.extend(1.0));
    let (line_b, line_a) = (*e * a, e.transpose() * b);
    b.dot(line_b) / (line_b.truncate().length_squared() + line_a.truncate().length_squared()).sqrt().max(1e-300)
}

/// Corners whose descriptions are each other's nearest by far, among those near the epipolar lines.
fn alike(corners: [&Corners; 2], cameras: [&Camera; 2]) -> Vec<[usize; 2]> {
    let e = Between::of(cameras).essential();
    let sights = [0, 1].map(|k| corners[k].at.iter().map(|&at| sight(cameras[k], at)).collect::<Vec<DVec2>>());
    let band = BAND * diagonal(cameras) / focal(cameras);
    let mut best = [0, 1].map(|k| vec![Best::default(); corners[k].at.len()]);
    let mut near = Vec::new();
    for (i, a) in sights[0].iter().enumerate() {
        let line = e * a.extend(1.0);
        near_line(&sights[1], line, band * line.truncate().length(), &mut near);
        let [own, others] = &mut best;
        compare(i, &corners[0].codes[i], &corners[1].codes, &near, (&mut own[i], others));
    }
    let mutual = |i: usize| {
        let j = best[0][i].clear()?;
        (best[1][j].clear() == Some(i)).then_some([i, j])
    };
    (0..corners[0].at.len()).filter_map(mutual).collect()
}

/// The sights within reach of a line.
#[multiversion(targets("x86_64+avx2"))]
fn near_line(sights: &[DVec2], line: DVec3, reach: f64, near: &mut Vec<u32>) {
    near.clear();
    for (part, sights) in sights.chunks(64).enumerate() {
        let mut is_near = [0u8; 64];
        for (is_near, b) in is_near.iter_mut().zip(sights) {
            *is_near = u8::from((line.x * b.x + line.y * b.y + line.z).abs() < reach);
        }
        for (eight, flags) in is_near.as_chunks().0.iter().enumerate() {
            let mut flags = u64::from_le_bytes(*flags);
            while flags != 0 {
                near.push((64 * part + 8 * eight) as u32 + flags.trailing_zeros() / 8);
                flags &= flags - 1;
            }
        }
    }
}

/// Shows corner `i` those that are near, and these the corner.
#[multiversion(targets("x86_64+avx2"))]
fn compare(i: usize, code: &Code, codes: &[Code], near: &[u32], (own, others): (&mut Best, &mut [Best])) {
    for &j in near {
        let (other, best) = (&codes[j as usize], &mut others[j as usize]);
        let [first, second] = [0, NUMBERS / 2].map(|from| from..from + NUMBERS / 2);
        let half = difference(&code[first.clone()], &other[first]);
        // Most are too far by half of their numbers.
        if half >= own.second && half >= best.second {
            continue;
        }
        let distance = half + difference(&code[second.clone()], &other[second]);
        own.see(distance, j as usize);
        best.see(distance, i);
    }
}

/// Squared distance of two descriptions, or of parts of them.
#[inline(always)]
fn difference(a: &[i16], b: &[i16]) -> i32 {
    let square = |(x, y): (&i16, &i16)| {
        let d = i32::from(*x - *y);
        d * d
    };
    a.iter().zip(b).map(square).sum()
}

/// The nearest and the second nearest distance so far.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Best {
    first: i32,
    second: i32,
    of: usize,
}

impl Default for Best {
    fn default() -> Self {
        Self { first: i32::MAX, second: i32::MAX, of: usize::MAX }
    }
}

impl Best {
    fn see(&mut self, distance: i32, of: usize) {
        if distance < self.first {
            *self = Self { first: distance, second: self.first, of };
        } else if distance < self.second {
            self.second = distance;
        }
    }

    /// The nearest, where the second is farther.
    fn clear(&self) -> Option<usize> {
        (f64::from(self.first) < RATIO * RATIO * f64::from(self.second)).then_some(self.of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_is_near_and_nearest_is_that_of_the_plain_version(
            sights in prop::collection::vec((-1.0f64..1.0, -1.0f64..1.0), 1..200),
            line in (-1.0f64..1.0, -1.0f64..1.0, -0.5f64..0.5),
            reach in 0.0f64..0.5,
            seed: u16,
        ) {
            let sights: Vec<DVec2> = sights.into_iter().map(DVec2::from).collect();
            let line = DVec3::from(line);
            let mut near = Vec::new();
            near_line(&sights, line, reach, &mut near);
            let is_near = |j: &usize| line.dot(sights[*j].extend(1.0)).abs() < reach;
            let expected: Vec<usize> = (0..sights.len()).filter(is_near).collect();
            prop_assert_eq!(near.iter().map(|&j| j as usize).collect::<Vec<_>>(), &expected[..]);

            // Two corners in turn, so that what is near has seen some already.
            let code = |k: usize| -> Code {
                std::array::from_fn(|n| ((k + usize::from(seed)) * 40_503 + n * 7919 + k * n * 31) as i16 % 200)
            };
            let codes: Vec<Code> = (0..sights.len()).map(code).collect();
            let mut others = vec![Best::default(); codes.len()];
            let mut plain = others.clone();
            for i in 0..2 {
                let (own, mut plain_own) = (&mut Best::default(), Best::default());
                compare(i, &code(1000 + i), &codes, &near, (own, &mut others));
                for &j in &expected {
                    let distance = difference(&code(1000 + i), &codes[j]);
                    plain_own.see(distance, j);
                    plain[j].see(distance, i);
                }
                prop_assert_eq!(*own, plain_own);
                prop_assert_eq!(&others, &plain);
            }
        }
    }
}
