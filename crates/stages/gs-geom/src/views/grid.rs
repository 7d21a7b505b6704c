//! A grid of cubes around the Gaussians: how much light each takes away, which are free, and how far a ray gets.

use glam::{DMat3, DQuat, DVec3, IVec3};
use gs_scene::Gaussians;
use std::collections::VecDeque;

/// Optical depth of a cube below which it is free: less than a tenth of the light that crosses it is lost.
pub const FREE: f64 = 0.1;
/// Optical depth at which a ray ends: two thirds of the light are lost.
const END: f64 = 1.0;
/// The number of the free space that goes on outside the grid.
pub const OUTSIDE: i32 = 0;
/// How far a Gaussian reaches, standard deviations.
const REACH: f64 = 2.0;

/// Cubes along the axes of the world.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// The low corner, world units.
    pub low: DVec3,
    /// Side of a cube, world units.
    pub side: f64,
    /// Cubes along x, y and z.
    pub size: IVec3,
    /// Mean optical depth of a way straight through each cube, x fastest.
    pub depth: Vec<f64>,
}

impl Grid {
    /// A grid over the box from `low` to `high` with `most` cubes along its longest side and one more at each end.
    pub fn over(low: DVec3, high: DVec3, most: i32) -> Self {
        let side = ((high - low).max_element() / f64::from(most)).max(f64::MIN_POSITIVE);
        let size = ((high - low) / side).ceil().as_ivec3().max(IVec3::ONE) + 2;
        let middle = 0.5 * (low + high);
        let low = middle - 0.5 * side * size.as_dvec3();
        let count = size.as_i64vec3().element_product() as usize;
        Self { low, side, size, depth: vec![0.0; count] }
    }

    /// Adds the Gaussians `of`. What a Gaussian takes from the light, as an area (see [`shadow`]), is spread over the cubes
    /// around it by its density, of at least half a cube along each of its axes.
    pub fn add(&mut self, g: &Gaussians, of: &[u32]) {
        let mut shares = Vec::new();
        for &i in of {
            let i = i as usize;
            let (centre, axes) = (DVec3::from(g.means[i].map(f64::from)), axes(g, i));
            let widths = scales(g, i).max(DVec3::splat(0.5 * self.side));
            let to_unit = DMat3::from_diagonal(widths.recip()) * axes.transpose();
            let spread = DMat3::from_diagonal(widths) * axes.transpose();
            let reach = REACH * DVec3::new(spread.x_axis.length(), spread.y_axis.length(), spread.z_axis.length());
            let from = self.cube(centre - reach).max(IVec3::ZERO);
            let to = self.cube(centre + reach).min(self.size - 1);
            shares.clear();
            let mut all = 0.0;
            for z in from.z..=to.z {
                for y in from.y..=to.y {
                    for x in from.x..=to.x {
                        let cube = IVec3::new(x, y, z);
                        let off = (to_unit * (self.middle(cube) - centre)).length_squared();
                        if off <= REACH * REACH {
                            let share = (-0.5 * off).exp();
                            all += share;
                            shares.push((self.index(cube), share));
                        }
                    }
                }
            }
            let area = shadow(g, i) / (self.side * self.side);
            shares.iter().for_each(|&(at, share)| self.depth[at] += area * share / all);
        }
    }

    /// The cube that holds a point; it may lie outside the grid.
    pub fn cube(&self, point: DVec3) -> IVec3 {
        // Far points would overflow.
        ((point - self.low) / self.side).floor().clamp(DVec3::splat(-1.0), self.size.as_dvec3()).as_ivec3()
    }

    /// The middle of a cube, world units.
    pub fn middle(&self, cube: IVec3) -> DVec3 {
        self.low + self.side * (cube.as_dvec3() + 0.5)
    }

    /// Whether the grid has this cube.
    pub fn has(&self, cube: IVec3) -> bool {
        cube.cmpge(IVec3::ZERO).all() && cube.cmplt(self.size).all()
    }

    /// A cube's place in [`Self::depth`].
    pub fn index(&self, cube: IVec3) -> usize {
        (cube.x as usize) + self.size.x as usize * (cube.y as usize + self.size.y as usize * cube.z as usize)
    }

    /// The cube at a place in [`Self::depth`].
    pub fn cube_at(&self, index: usize) -> IVec3 {
        let (x, y) = (self.size.x as usize, self.size.y as usize);
        IVec3::new((index % x) as i32, (index / x % y) as i32, (index / x / y) as i32)
    }

    /// The high corner, world units.
    pub fn high(&self) -> DVec3 {
        self.low + self.side * self.size.as_dvec3()
    }

    /// Whether every cube within `radius` cubes of a point's is free. What lies outside the grid is.
    pub fn is_clear(&self, point: DVec3, radius: i32) -> bool {
        let at = self.cube(point);
        let around = (-radius..=radius).flat_map(|z| {
            (-radius..=radius).flat_map(move |y| (-radius..=radius).map(move |x| at + IVec3::new(x, y, z)))
        });
        around.into_iter().all(|c| !self.has(c) || self.depth[self.index(c)] < FREE)
    }

    /// How far a ray from a point gets along a unit direction before it ends in matter, world units; none where it leaves the
    /// grid.
    pub fn distance(&self, from: DVec3, direction: DVec3) -> Option<f64> {
        let most = (self.high() - self.low).length() + from.distance(0.5 * (self.low + self.high()));
        let (step, mut passed, mut lost) = (0.5 * self.side, 0.0, 0.0);
        let mut inside = false;
        while passed < most {
            passed += step;
            let cube = self.cube(from + passed * direction);
            let here = self.has(cube);
            if inside && !here {
                return None;
            }
            inside |= here;
            if here {
                lost += 0.5 * self.depth[self.index(cube)];
                if lost >= END {
                    return Some(passed);
                }
            }
        }
        None
    }

    /// Numbers the connected groups of the cubes that `belongs`, from 0; -1 for other cubes. Cubes that share a corner touch
    /// where `corners` says so, else those that share a face. Also gives the number of groups.
    pub fn groups(&self, belongs: impl Fn(usize) -> bool, corners: bool) -> (Vec<i32>, usize) {
        let mut group = vec![-1; self.depth.len()];
        let offsets: Vec<IVec3> = (0..27)
            .map(|k| IVec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1))
            .filter(|o| *o != IVec3::ZERO && (corners || o.abs().element_sum() == 1))
            .collect();
        let (mut groups, mut open) = (0, VecDeque::new());
        for start in 0..self.depth.len() {
            if group[start] >= 0 || !belongs(start) {
                continue;
            }
            group[start] = groups;
            open.push_back(start);
            while let Some(at) = open.pop_front() {
                let cube = self.cube_at(at);
                for next in offsets.iter().map(|&o| cube + o).filter(|&c| self.has(c)) {
                    let next = self.index(next);
                    if group[next] < 0 && belongs(next) {
                        group[next] = groups;
                        open.push_back(next);
                    }
                }
            }
            groups += 1;
        }
        (group, groups as usize)
    }

    /// Which free space each cube is in: [`OUTSIDE`], or a number of its own for each that matter shuts off; -1 for matter.
    pub fn spaces(&self) -> Vec<i32> {
        let (mut space, groups) = self.groups(|c| self.depth[c] < FREE, false);
        let mut number: Vec<i32> = (1..=groups as i32).collect();
        for c in 0..space.len() {
            let cube = self.cube_at(c);
            if space[c] >= 0 && (cube.cmpeq(IVec3::ZERO).any() || cube.cmpeq(self.size - 1).any()) {
                number[space[c] as usize] = OUTSIDE;
            }
        }
        space.iter_mut().filter(|s| **s >= 0).for_each(|s| *s = number[*s as usize]);
        space
    }
}

/// Standard deviations of a Gaussian along its own axes, world units.
pub fn scales(g: &Gaussians, i: usize) -> DVec3 {
    DVec3::from(g.log_scales[i].map(|s| f64::from(s).exp()))
}

/// The unit axes of a Gaussian, as columns.
pub fn axes(g: &Gaussians, i: usize) -> DMat3 {
    let [w, x, y, z] = g.rotations[i].map(f64::from);
    let q = DQuat::from_xyzw(x, y, z, w);
    if q.length_squared() > 0.0 { DMat3::from_quat(q.normalize()) } else { DMat3::IDENTITY }
}

/// The area of an opaque thing that would take as much light as a Gaussian does, in the mean over all directions: an optical
/// depth of -ln(1 - opacity exp(-r²/2)) summed over its mean projection. World units squared.
pub fn shadow(g: &Gaussians, i: usize) -> f64 {
    /// Of Thomsen's formula for the surface of an ellipsoid, of which the mean projection is a quarter.
    const P: f64 = 1.6075;
    let s = scales(g, i);
    let mean = [s.x * s.y, s.y * s.z, s.z * s.x].map(|p| p.powf(P)).iter().sum::<f64>() / 3.0;
    // The integral of -ln(1 - o e^-t) over t from 0 is o + o²/4 + o³/9 + ...
    let o = f64::from(g.opacity(i)).min(0.99);
    let lost: f64 = (1..=8).map(|k| o.powi(k) / f64::from(k * k)).sum();
    std::f64::consts::TAU * mean.powf(P.recip()) * lost
}

/// `count` unit directions, evenly over the sphere.
pub fn directions(count: usize) -> impl Iterator<Item = DVec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::views::testing::{cloud, wall};

    #[test]
    fn a_wall_stops_light_and_air_does_not() {
        // A wall in the plane x = 0, 2 by 2.
        let g = cloud(&wall(DVec3::ZERO, DVec3::Y, DVec3::Z, 41), 0.05, 0.99);
        let mut grid = Grid::over(DVec3::new(-1.0, -1.0, -1.0), DVec3::splat(1.0), 32);
        grid.add(&g, &(0..g.len() as u32).collect::<Vec<_>>());
        let hit = grid.distance(DVec3::new(-0.8, 0.1, 0.1), DVec3::X).unwrap();
        assert!((hit - 0.8).abs() < 0.15, "{hit}");
        assert_eq!(grid.distance(DVec3::new(-0.8, 0.1, 0.1), DVec3::Y), None);
        assert!(grid.is_clear(DVec3::new(-0.5, 0.0, 0.0), 2) && !grid.is_clear(DVec3::new(-0.1, 0.0, 0.0), 2));
        // A wall across the whole grid parts the free space in two.
        let matter = |i: usize| grid.depth[i] >= FREE;
        assert_eq!((grid.groups(matter, true).1, grid.groups(|i| !matter(i), false).1), (1, 2));
    }

    #[test]
    fn shadows_have_their_closed_forms() {
        let one = |scale: [f64; 3], o: f32| {
            let mut g = cloud(&[DVec3::ZERO], 1.0, o);
            g.log_scales[0] = scale.map(|s| s.ln() as f32);
            shadow(&g, 0)
        };
        // A faint ball: the integral of o exp(-r²/2) over a plane.
        let ball = one([2.0; 3], 0.01);
        assert!((ball / (std::f64::consts::TAU * 4.0 * 0.01) - 1.0).abs() < 0.01, "{ball}");
        // A flat disc shows half of its area in the mean.
        let disc = one([1.0, 1.0, 1e-6], 0.01);
        assert!((disc / (0.5 * std::f64::consts::TAU * 0.01) - 1.0).abs() < 0.02, "{disc}");
    }

    #[test]
    fn directions_are_even() {
        let sum: DVec3 = directions(100).sum();
        assert!(sum.length() < 0.2 && directions(64).all(DVec3::is_normalized));
    }

    #[test]
    fn the_optical_depth_of_a_cloud_is_its_area() {
        // What is spread over the grid is what the Gaussians take, whole.
        let g = cloud(&[DVec3::ZERO, DVec3::splat(0.2)], 0.1, 0.5);
        let mut grid = Grid::over(DVec3::splat(-1.0), DVec3::splat(1.0), 20);
        grid.add(&g, &[0, 1]);
        let spread = grid.depth.iter().sum::<f64>() * grid.side * grid.side;
        assert!((spread / (shadow(&g, 0) + shadow(&g, 1)) - 1.0).abs() < 1e-9);
    }
}
