//! Which Gaussians count, and where they are.

use super::grid::{Grid, OUTSIDE, directions};
use super::up::frame_of;
use glam::{DMat3, DVec3};
use gs_scene::Gaussians;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;

/// Fainter Gaussians than this count for nothing.
const FAINT: f32 = 0.1;
/// Gaussians farther from the middle than this many times the median distance are background.
const FAR: f64 = 5.0;
/// A group of cubes with less than this share of the Gaussians is a floater.
const FLOATER: f64 = 0.005;
/// Optical depth from which cubes hang together.
const TOUCHES: f64 = 0.2;
/// Cubes along the longest side: of the grid that finds floaters, and of that which places cameras.
const COARSE: i32 = 64;
const FINE: i32 = 96;
/// Shares from which a scene is a room: of free space that is shut off, of directions that end in matter.
const SHUT_OFF: f64 = 0.75;
const ENCLOSED: f64 = 0.5;
/// The core holds this share of the Gaussians that count: those nearest to their median.
const CORE: f64 = 0.85;
/// It is the whole box where that reaches no farther than so many times its radius.
const COMPACT: f64 = 1.5;
/// Places and directions that are tried to tell a room from an object.
const PLACES: usize = 2000;
const DIRECTIONS: usize = 64;

/// What tells a room from an object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Inside {
    /// Share of the free space in the box that no way leads to from outside, 0 to 1: nearly all in a closed room; in a hollow
    /// thing a part, since a box around a thing has free corners.
    pub shut_off: f64,
    /// In the median over the rest of the free space, the share of directions that end in matter, 0 to 1.
    pub enclosure: f64,
}

impl Inside {
    /// Whether it is a room.
    pub fn is_room(&self) -> bool {
        self.shut_off >= SHUT_OFF || self.enclosure >= ENCLOSED
    }
}

/// The matter of a scene.
pub struct Matter {
    /// The Gaussians that count, ascending: opaque enough, near the others, and not floaters.
    pub counted: Vec<u32>,
    /// Too faint to count.
    pub faint: usize,
    /// Far from the others: background.
    pub far: usize,
    /// In groups that are too small.
    pub floaters: usize,
    /// Corners of the box of the centres of those that count.
    pub low: DVec3,
    /// See `low`.
    pub high: DVec3,
    /// Three axes at right angles, as columns, along which the scene is built; and the corners of the box along them, which is
    /// what a turned room fills.
    frame: DMat3,
    along: (DVec3, DVec3),
    /// The ball that holds most of them: Gaussians are small and many where photographs were looking.
    pub middle: DVec3,
    /// Its radius.
    pub radius: f64,
    /// The box and a little more, with all Gaussians that are not faint.
    pub grid: Grid,
}

impl Matter {
    /// Sorts the Gaussians; none where no Gaussian counts.
    pub fn of(g: &Gaussians) -> Option<Self> {
        let solid: Vec<u32> = (0..g.len() as u32).filter(|&i| g.opacity(i as usize) >= FAINT).collect();
        if solid.is_empty() {
            return None;
        }
        let at = |i: u32| DVec3::from(g.means[i as usize].map(f64::from));
        let middle = DVec3::from([0, 1, 2].map(|c| median(solid.iter().map(|&i| at(i)[c]).collect())));
        let reach = FAR * median(solid.iter().map(|&i| at(i).distance(middle)).collect());
        let near: Vec<u32> = solid.iter().copied().filter(|&i| at(i).distance(middle) <= reach).collect();
        let (low, high) = bounds(near.iter().map(|&i| at(i)));
        let mut grid = Grid::over(low, high, COARSE);
        grid.add(g, &near);
        let cube_of = |i: u32| grid.index(grid.cube(at(i)));
        let mut holds = vec![0usize; grid.depth.len()];
        near.iter().for_each(|&i| holds[cube_of(i)] += 1);
        let (group, groups) = grid.groups(|c| grid.depth[c] >= TOUCHES, true);
        let mut members = vec![0usize; groups];
        near.iter().filter_map(|&i| usize::try_from(group[cube_of(i)]).ok()).for_each(|k| members[k] += 1);
        let least = ((FLOATER * near.len() as f64) as usize).min(members.iter().copied().max().unwrap_or(0));
        let stays = |i: &u32| usize::try_from(group[cube_of(*i)]).is_ok_and(|k| members[k] >= least.max(1));
        let mut counted: Vec<u32> = near.iter().copied().filter(stays).collect();
        if counted.is_empty() {
            // Dust without any group.
            counted.clone_from(&near);
        }
        let (low, high) = bounds(counted.iter().map(|&i| at(i)));
        let mut fine = Grid::over(low, high, FINE);
        let inside: Vec<u32> = solid.iter().copied().filter(|&i| fine.has(fine.cube(at(i)))).collect();
        fine.add(g, &inside);
        let median_centre = DVec3::from([0, 1, 2].map(|c| median(counted.iter().map(|&i| at(i)[c]).collect())));
        let mut away: Vec<f64> = counted.iter().map(|&i| at(i).distance(median_centre)).collect();
        away.sort_by(f64::total_cmp);
        let core = away[((CORE * away.len() as f64) as usize).min(away.len() - 1)].max(fine.side);
        let whole = 0.5 * low.distance(high);
        let (middle, radius) =
            if whole <= COMPACT * core { (0.5 * (low + high), whole) } else { (median_centre, core) };
        let radius = radius.max(fine.side);
        let frame = frame_of(g, &counted);
        let along = bounds(counted.iter().map(|&i| frame.transpose() * at(i)));
        Some(Self {
            frame,
            along,
            faint: g.len() - solid.len(),
            far: solid.len() - near.len(),
            floaters: near.len() - counted.len(),
            counted,
            low,
            high,
            middle,
            radius,
            grid: fine,
        })
    }

    /// The box's diagonal, world units.
    pub fn diagonal(&self) -> f64 {
        self.low.distance(self.high).max(self.grid.side)
    }

    /// How much of the directions from a point end in matter, 0 to 1.
    pub fn enclosure(&self, point: DVec3) -> f64 {
        let hits = directions(DIRECTIONS).filter(|&d| self.grid.distance(point, d).is_some()).count();
        hits as f64 / DIRECTIONS as f64
    }

    /// Whether the scene is looked at from within, and why: the free space in its box that is shut off from the outside, as a
    /// share, and the median enclosure of the free space that is not.
    pub fn inside(&self, rng: &mut ChaCha8Rng) -> Inside {
        let middle = |c: usize| self.grid.middle(self.grid.cube_at(c));
        let space = self.grid.spaces();
        let (open, shut): (Vec<usize>, Vec<usize>) =
            (0..space.len()).filter(|&c| space[c] >= 0 && self.contains(middle(c))).partition(|&c| space[c] == OUTSIDE);
        let shut_off = shut.len() as f64 / (open.len() + shut.len()).max(1) as f64;
        let mut found: Vec<f64> = Vec::new();
        if !open.is_empty() {
            let places: Vec<usize> = (0..PLACES).map(|_| open[rng.random_range(0..open.len())]).collect();
            found = places.par_iter().map(|&c| self.enclosure(middle(c))).collect();
            found.sort_by(f64::total_cmp);
        }
        let enclosure = found.get(found.len() / 2).copied().unwrap_or(1.0);
        Inside { shut_off, enclosure }
    }

    /// Whether a point lies in the box along the scene's own axes.
    pub fn contains(&self, point: DVec3) -> bool {
        let point = self.frame.transpose() * point;
        point.cmpge(self.along.0).all() && point.cmple(self.along.1).all()
    }
}

/// The middle one of numbers, of an even number the greater; there is one at least.
pub fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Corners of the box around points.
pub fn bounds(points: impl Iterator<Item = DVec3>) -> (DVec3, DVec3) {
    points.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::testing::{ball, cloud, room};
    use rand::SeedableRng;

    #[test]
    fn floaters_and_background_do_not_decide_the_bounds() {
        let mut g = ball(3000);
        let more =
            cloud(&[DVec3::new(3.0, 0.0, 0.0), DVec3::new(0.0, 90.0, 0.0), DVec3::new(1.5, 1.5, 1.5)], 0.02, 0.9);
        let faint = cloud(&[DVec3::new(0.0, 0.0, 2.0)], 0.5, 0.05);
        for more in [more, faint] {
            g.means.extend(more.means);
            g.log_scales.extend(more.log_scales);
            g.rotations.extend(more.rotations);
            g.opacity_logits.extend(more.opacity_logits);
            g.sh.extend(more.sh);
        }
        let m = Matter::of(&g).unwrap();
        assert_eq!((m.counted.len(), m.floaters, m.far, m.faint), (3000, 2, 1, 1));
        assert!(m.low.min_element() > -1.01 && m.high.max_element() < 1.01);
    }

    #[test]
    fn rooms_enclose_and_balls_do_not() {
        let of = |g: &Gaussians| Matter::of(g).unwrap().inside(&mut ChaCha8Rng::seed_from_u64(0));
        let (ball, closed) = (of(&ball(4000)), of(&room(DMat3::IDENTITY)));
        // Of the box around a hollow ball, the ball is pi/6.
        assert!((0.4..0.55).contains(&ball.shut_off) && ball.enclosure < 0.45 && !ball.is_room(), "{ball:?}");
        assert!(closed.shut_off > 0.95 && closed.is_room(), "{closed:?}");
        // Without its ceiling.
        let mut open = room(DMat3::IDENTITY);
        let kept: Vec<u32> = (0..open.len() as u32).filter(|&i| open.means[i as usize][2] < 0.99).collect();
        open = open.select(&kept);
        let open = of(&open);
        assert!(open.shut_off < 0.05 && open.is_room(), "{open:?}");
    }

    #[test]
    fn nothing_opaque_is_nothing() {
        assert!(Matter::of(&cloud(&[DVec3::ZERO; 3], 0.1, 0.01)).is_none());
        // One Gaussian is a scene.
        assert_eq!(Matter::of(&cloud(&[DVec3::ONE], 0.1, 0.9)).unwrap().counted, [0]);
    }
}
