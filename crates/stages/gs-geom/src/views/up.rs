//! Which way is up.

use super::grid::{axes, directions, scales};
use super::matter::Matter;
use glam::{DMat3, DVec3};
use gs_scene::Gaussians;
use serde::Serialize;

/// A Gaussian is flat, and has a normal, where its least scale is below this share of the next.
const FLAT: f64 = 0.5;
/// Normals within this angle of an axis count for it: 12 degrees.
const NEAR: f64 = 0.978;
/// Least share of the flat Gaussians that are level; of evenly spread normals 0.02 are near every axis.
const LEVEL: f64 = 0.12;
/// Axes at right angles have at most this cosine: 73 degrees.
const ACROSS: f64 = 0.3;
/// Level Gaussians at one end are a floor, where they are so many times those at the other.
const ONE_SIDED: f64 = 1.7;
/// Cosine of an angle to +z or -y within which the files' convention says which end is up: 25 degrees.
const USUAL: f64 = 0.906;
/// Directions that are tried first.
const TRIED: usize = 800;

/// How up was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// It was given.
    Given,
    /// The axis of the level surfaces.
    Level,
    /// No direction stands out: -y, as in most files of Gaussians.
    Convention,
}

impl Rule {
    /// For people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Given => "as given",
            Self::Level => "from level surfaces",
            Self::Convention => "by convention",
        }
    }
}

/// A flat Gaussian.
struct Flat {
    centre: DVec3,
    normal: DVec3,
}

/// Up of a scene, unit length.
///
/// Rooms, tables and floors are built at right angles: of the three axes at right angles that most flat Gaussians face, up is
/// the one with most of them, where those at one end of the scene alone, such as a floor, count up to twice, and in a `room`,
/// which is wider than high, their number for each unit of height counts. Areas would tell less: walls without detail, and what
/// lies behind them, are few large Gaussians. Of the two ends, see [`standing`].
pub fn up_of(g: &Gaussians, matter: &Matter, room: bool) -> (DVec3, Rule) {
    let flat = flat_ones(g, &matter.counted);
    let all = flat.len() as f64;
    let mut best: Option<(f64, DVec3)> = None;
    let mut axes: Vec<DVec3> = Vec::new();
    for _ in 0..3 {
        let Some(axis) = peak(&flat, &axes).filter(|a| facing(&flat, *a) >= LEVEL * all && all > 0.0) else { break };
        axes.push(axis);
        let (low, high) = ends(g, matter, &flat, axis);
        let score = facing(&flat, axis) * (1.0 + (low - high).abs() / (low + high).max(f64::MIN_POSITIVE));
        let [bottom, _, top] = heights(g, matter, axis);
        let score = if room { score / (top - bottom).max(f64::MIN_POSITIVE) } else { score };
        if best.is_none_or(|b| score > b.0) {
            best = Some((score, axis));
        }
    }
    match best {
        Some((_, axis)) => (standing(g, matter, &flat, axis), Rule::Level),
        None => (DVec3::NEG_Y, Rule::Convention),
    }
}

/// Three axes at right angles, as columns: those that most flat Gaussians face, where some stand out; else the world's.
pub fn frame_of(g: &Gaussians, counted: &[u32]) -> DMat3 {
    let flat = flat_ones(g, counted);
    let stands_out = |a: &DVec3| !flat.is_empty() && facing(&flat, *a) >= LEVEL * flat.len() as f64;
    let Some(x) = peak(&flat, &[]).filter(stands_out) else { return DMat3::IDENTITY };
    let second = peak(&flat, &[x]).filter(stands_out).map(|y| y - x * y.dot(x));
    let y = second.and_then(DVec3::try_normalize).unwrap_or_else(|| x.any_orthonormal_vector());
    DMat3::from_cols(x, y, x.cross(y))
}

fn flat_ones(g: &Gaussians, counted: &[u32]) -> Vec<Flat> {
    let mut flat = Vec::new();
    for i in counted.iter().map(|&i| i as usize) {
        let (s, axes) = (scales(g, i), axes(g, i));
        let least = if s.x <= s.y && s.x <= s.z {
            0
        } else if s.y <= s.z {
            1
        } else {
            2
        };
        let next = (0..3).filter(|&c| c != least).map(|c| s[c]).fold(f64::INFINITY, f64::min);
        if s[least] < FLAT * next {
            let centre = DVec3::from(g.means[i].map(f64::from));
            flat.push(Flat { centre, normal: axes.col(least) });
        }
    }
    flat
}

/// Flat Gaussians that face along an axis, either way.
fn facing(flat: &[Flat], axis: DVec3) -> f64 {
    flat.iter().filter(|f| f.normal.dot(axis).abs() >= NEAR).count() as f64
}

/// The axis that most flat Gaussians face, of those at right angles to others.
fn peak(flat: &[Flat], others: &[DVec3]) -> Option<DVec3> {
    // Both ends of an axis are one: a hemisphere does.
    let tried = directions(TRIED).filter(|d| d.z >= 0.0 && others.iter().all(|o| o.dot(*d).abs() < ACROSS));
    let best =
        tried.map(|d| (facing(flat, d), d)).fold((0.0, None), |b, n| if n.0 > b.0 { (n.0, Some(n.1)) } else { b });
    // The mean of what is near, a few times over, is the middle of the peak.
    (0..4).try_fold(best.1?, |axis, _| {
        let near = flat.iter().filter(|f| f.normal.dot(axis).abs() >= NEAR);
        near.map(|f| f.normal * f.normal.dot(axis).signum()).sum::<DVec3>().try_normalize()
    })
}

/// Heights along an axis between which nearly all Gaussians lie, and that of their median.
fn heights(g: &Gaussians, matter: &Matter, axis: DVec3) -> [f64; 3] {
    let height = |i: &u32| DVec3::from(g.means[*i as usize].map(f64::from)).dot(axis);
    let mut heights: Vec<f64> = matter.counted.iter().map(height).collect();
    heights.sort_by(f64::total_cmp);
    let n = heights.len();
    [heights[n / 50], heights[n / 2], heights[n - 1 - n / 50]]
}

/// Flat Gaussians that face along an axis in the lowest and in the highest third.
fn ends(g: &Gaussians, matter: &Matter, flat: &[Flat], axis: DVec3) -> (f64, f64) {
    let [low, _, high] = heights(g, matter, axis);
    flat.iter().filter(|f| f.normal.dot(axis).abs() >= NEAR).fold((0.0, 0.0), |(lowest, highest), f| {
        let place = (f.centre.dot(axis) - low) / (high - low).max(f64::MIN_POSITIVE);
        if place < 1.0 / 3.0 {
            (lowest + 1.0, highest)
        } else if place > 2.0 / 3.0 {
            (lowest, highest + 1.0)
        } else {
            (lowest, highest)
        }
    })
}

/// The end of an axis towards which things stand: +z or -y where it is near to one of these, as files have it; else away from
/// the end that alone has a floor; else from which more of the Gaussians lie in the other half, since things stand on floors.
fn standing(g: &Gaussians, matter: &Matter, flat: &[Flat], axis: DVec3) -> DVec3 {
    if let Some(usual) = [DVec3::Z, DVec3::NEG_Y].into_iter().find(|u| u.dot(axis).abs() > USUAL) {
        return axis * usual.dot(axis).signum();
    }
    let (lowest, highest) = ends(g, matter, flat, axis);
    if lowest.max(highest) > ONE_SIDED * lowest.min(highest) {
        return if lowest > highest { axis } else { -axis };
    }
    let [low, middle, high] = heights(g, matter, axis);
    if middle - low <= high - middle { axis } else { -axis }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::testing::{ball, room};
    use glam::DQuat;

    #[test]
    fn a_tilted_room_stands_upright() {
        for (axis, angle) in [(DVec3::X, 0.4), (DVec3::new(1.0, 2.0, -0.5), 1.9), (DVec3::Y, -2.6)] {
            let turn = DMat3::from_quat(DQuat::from_axis_angle(axis.normalize(), angle));
            let g = room(turn);
            let (up, rule) = up_of(&g, &Matter::of(&g).unwrap(), true);
            assert!(rule == Rule::Level && up.dot(turn * DVec3::Z) > 0.999, "{up} for {}", turn * DVec3::Z);
        }
    }

    #[test]
    fn a_ball_has_the_files_up() {
        let g = ball(1000);
        assert_eq!(up_of(&g, &Matter::of(&g).unwrap(), false), (DVec3::NEG_Y, Rule::Convention));
    }
}
