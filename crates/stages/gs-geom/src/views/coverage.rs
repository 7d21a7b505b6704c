//! What the views show of the scene, and what they do not.

use super::choice::ENOUGH;
use super::grid::Grid;
use super::matter::bounds;
use super::sight::members;
use glam::DVec3;
use serde::Serialize;
use std::cmp::Reverse;

/// Places of unseen Gaussians that are listed.
const LISTED: usize = 8;
/// Cubes along the longest side, of the grid in which unseen Gaussians hang together.
const CUBES: i32 = 24;

/// What the views show of the Gaussians that count.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Coverage {
    /// Gaussians that count.
    pub gaussians: usize,
    /// Share of them that at least 8 views show well, 0 to 1.
    pub seen_by_8: f64,
    /// Share of them that at least one view does.
    pub seen: f64,
    /// Share of them that some camera of those tried sees: the rest lies inside of things or behind walls.
    pub reachable: f64,
    /// Share of the reachable ones that at least 8 views show well.
    pub reachable_by_8: f64,
    /// How many of them 0, 1, ... 7, and 8 or more views show well.
    pub by_views: [usize; ENOUGH as usize + 1],
    /// Where those are that no view shows, the most first: inside of things, below them, in narrow places.
    pub unseen: Vec<Place>,
}

/// Gaussians that hang together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Place {
    pub gaussians: usize,
    /// Corners of the box of their centres, world units.
    pub low: [f64; 3],
    /// See `low`.
    pub high: [f64; 3],
}

impl Coverage {
    /// From the sightings of each Gaussian, whether some camera sees it, and its centre.
    pub fn of(sightings: &[u8], reachable: &[u64], centres: &[DVec3]) -> Self {
        let can_be = members(reachable).count();
        let often = members(reachable).filter(|&i| sightings[i] >= ENOUGH).count();
        let mut by_views = [0; ENOUGH as usize + 1];
        sightings.iter().for_each(|&s| by_views[s.min(ENOUGH) as usize] += 1);
        let all = sightings.len();
        let share = |n: usize| n as f64 / all.max(1) as f64;
        let lost: Vec<DVec3> = centres.iter().zip(sightings).filter(|s| *s.1 == 0).map(|s| *s.0).collect();
        Self {
            gaussians: all,
            seen_by_8: share(by_views[ENOUGH as usize]),
            seen: share(all - by_views[0]),
            reachable: share(can_be),
            reachable_by_8: often as f64 / can_be.max(1) as f64,
            by_views,
            unseen: places(&lost, centres),
        }
    }
}

fn places(lost: &[DVec3], centres: &[DVec3]) -> Vec<Place> {
    let (low, high) = bounds(centres.iter().copied());
    if lost.is_empty() {
        return Vec::new();
    }
    let grid = Grid::over(low, high, CUBES);
    let mut of_cube: Vec<Vec<DVec3>> = vec![Vec::new(); grid.depth.len()];
    lost.iter().for_each(|&p| of_cube[grid.index(grid.cube(p))].push(p));
    let (group, groups) = grid.groups(|c| !of_cube[c].is_empty(), false);
    let mut members: Vec<Vec<DVec3>> = vec![Vec::new(); groups];
    for (cube, points) in of_cube.into_iter().enumerate().filter(|c| group[c.0] >= 0) {
        members[group[cube] as usize].extend(points);
    }
    members.sort_by_key(|m| Reverse(m.len()));
    let place = |points: Vec<DVec3>| {
        let (low, high) = bounds(points.iter().copied());
        Place { gaussians: points.len(), low: low.to_array(), high: high.to_array() }
    };
    members.into_iter().take(LISTED).map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_unseen_are_told_by_place() {
        let line = |n: usize, x: f64| (0..n).map(move |i| DVec3::new(x + 0.01 * i as f64, 0.0, 0.0));
        let centres: Vec<DVec3> = line(3, 0.0).chain(line(2, 5.0)).chain([DVec3::new(10.0, 0.0, 0.0)]).collect();
        let c = Coverage::of(&[0, 0, 0, 0, 0, 9], &[0b10_0001], &centres);
        assert_eq!((c.gaussians, c.by_views[0], c.by_views[8]), (6, 5, 1));
        assert_eq!(c.unseen.iter().map(|p| p.gaussians).collect::<Vec<_>>(), [3, 2]);
        assert_eq!((c.unseen[1].low[0], c.unseen[1].high[0]), (5.0, 5.01));
        assert!((c.seen - 1.0 / 6.0).abs() < 1e-12 && c.seen == c.seen_by_8 && c.reachable_by_8 == 0.5);
    }
}
