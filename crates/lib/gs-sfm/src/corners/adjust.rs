//! Poses, focal lengths and points that fit the corners best (bundle adjustment; Triggs et al. 2000): Levenberg and Marquardt's
//! steps, the points eliminated, the rest by conjugate gradients that never form the matrix.

use super::pairs::EXACT;
use super::tracks::{Point, error, limit};
use crate::turn::{moved, turned_from};
use crate::{median, solve};
use glam::{DMat3, DVec3};
use gs_scene::Camera;

/// Steps of a round at most, and of the conjugate gradients within one.
const STEPS: usize = 12;
const INNER: usize = 60;
/// By how much focal lengths are expected to be off.
const ZOOM: f64 = 0.02;
/// Median length of three numbers of a normal distribution, in its standard deviations.
const MEDIAN_LENGTH: f64 = 1.538;

/// A pose that is off by more than so many expected errors is held less and less (Cauchy): a few may be wrong where most are right.
const WRONG: f64 = 3.0;

/// How far the given poses are expected to be off, about and along each axis. An error of this size weighs as much as a corner that is
/// off by [`EXACT`]. So the scene stays where the given poses have it, and poses that fit the corners stay as they are: where few corners are
/// shared, other poses would fit these as well.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slack {
    /// Radians.
    pub turn: f64,
    /// World units.
    pub shift: f64,
}

impl Slack {
    /// Of poses of which nothing is known: five degrees, also seen from a scene so far away.
    pub fn widest(depth: f64) -> Self {
        let turn = 5f64.to_radians();
        Self { turn, shift: turn * depth }
    }

    /// As far as the cameras of the views in `free` have moved, in the median; no more than `self`.
    pub fn learnt(self, cameras: &[Camera], given: &[Camera], free: &[bool]) -> Self {
        let of = |f: fn(&Camera, &Camera) -> f64| {
            let moved = cameras.iter().zip(given).zip(free).filter(|(_, free)| **free);
            let lengths: Vec<f64> = moved.map(|((c, g), _)| f(c, g)).collect();
            (!lengths.is_empty()).then(|| median(lengths) / MEDIAN_LENGTH)
        };
        let turn = of(|c, g| turned_from(&g.rotation, &c.rotation).length());
        let shift = of(|c, g| c.position().distance(g.position()));
        let within = |found: Option<f64>, most: f64| found.map_or(most, |f| f.clamp(1e-3 * most, most));
        Self { turn: within(turn, self.turn), shift: within(shift, self.shift) }
    }
}

/// What moves, and what it moves from.
pub(super) struct Bundle<'a> {
    pub cameras: &'a mut [Camera],
    /// As they were given.
    pub given: &'a [Camera],
    /// The lens of each view; views of one lens share a focal length.
    pub lenses: &'a [usize],
    /// Views whose cameras move.
    pub free: &'a [bool],
    pub points: &'a mut [Point],
    /// By how much the given poses are expected to be off.
    pub slack: Slack,
    /// Whether points and focal lengths move, too.
    pub all: bool,
}

/// A corner's residual and its derivatives by turn, shift, focal length and place, all times the root of its weight.
struct Row {
    view: usize,
    residual: [f64; 2],
    by_camera: [[f64; 6]; 2],
    by_zoom: [f64; 2],
    by_place: [DVec3; 2],
}

/// What a step is solved from.
struct System {
    /// Rows of all points, those of a point together.
    rows: Vec<Row>,
    /// Ends of the points' rows.
    ends: Vec<usize>,
    /// Inverse of each point's own block; zero where points do not move.
    inverse: Vec<DMat3>,
    /// The priors' part of the diagonal and what they want: 6 for each view, then one for each lens.
    prior: Vec<f64>,
    pull: Vec<f64>,
    /// Diagonal blocks of the views, then of the lenses, for the preconditioner.
    blocks: Vec<[[f64; 6]; 6]>,
    of_lenses: Vec<f64>,
}

impl Bundle<'_> {
    /// Moves everything to a better fit; corners farther off than `width` limits count less and less (Cauchy).
    pub fn adjust(&mut self, width: f64) {
        let mut damping = 1e-4;
        let mut cost = self.cost(self.cameras, self.points, width);
        for _ in 0..STEPS {
            let system = self.system(width, damping);
            let step = system.solve(self, damping);
            let (cameras, points) = self.stepped(&system, &step);
            let now = self.cost(&cameras, &points, width);
            if now < cost {
                let done = cost - now < 1e-4 * cost;
                self.cameras.clone_from_slice(&cameras);
                self.points.clone_from_slice(&points);
                cost = now;
                damping = (damping * 0.1).max(1e-9);
                if done {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
    }

    fn count_lenses(&self) -> usize {
        self.lenses.iter().max().map_or(0, |l| l + 1)
    }

    /// How far a camera is from where it was given, in expected errors: turn, shift, logarithm of the focal length.
    fn off(&self, c: &Camera, view: usize) -> (DVec3, DVec3, f64) {
        let given = &self.given[view];
        let shift = c.rotation * (c.position() - given.position());
        (
            turned_from(&given.rotation, &c.rotation) / self.slack.turn,
            shift / self.slack.shift,
            (c.fx / given.fx).ln() / ZOOM,
        )
    }

    fn cost(&self, cameras: &[Camera], points: &[Point], width: f64) -> f64 {
        let mut sum = 0.0;
        for p in points {
            for (s, at) in &p.seen {
                let c = &cameras[s.view];
                let e = error(c, p.place, *at).map_or(1e6, |e| e.length_squared() / limit(c, EXACT).powi(2));
                sum += width * width * (e / (width * width)).ln_1p();
            }
        }
        let mut seen = vec![false; self.count_lenses()];
        for (v, c) in cameras.iter().enumerate().filter(|(v, _)| self.free[*v]) {
            let (turn, shift, zoom) = self.off(c, v);
            sum += WRONG * WRONG * wrong(turn, shift).ln_1p();
            if self.all && !std::mem::replace(&mut seen[self.lenses[v]], true) {
                sum += zoom * zoom;
            }
        }
        sum
    }

    fn system(&self, width: f64, damping: f64) -> System {
        let (views, lenses) = (self.cameras.len(), self.count_lenses());
        let mut s = System {
            rows: Vec::new(),
            ends: Vec::new(),
            inverse: Vec::new(),
            prior: vec![0.0; 6 * views + lenses],
            pull: vec![0.0; 6 * views + lenses],
            blocks: vec![[[0.0; 6]; 6]; views],
            of_lenses: vec![0.0; lenses],
        };
        let Slack { turn: about, shift: along } = self.slack;
        for (v, c) in self.cameras.iter().enumerate().filter(|(v, _)| self.free[*v]) {
            let (turn, shift, zoom) = self.off(c, v);
            let weight = 1.0 / (1.0 + wrong(turn, shift));
            for k in 0..3 {
                s.prior[6 * v + k] = weight / (about * about);
                s.pull[6 * v + k] = weight * turn[k] / about;
                s.prior[6 * v + 3 + k] = weight / (along * along);
                // A shift of the world's points is one of the camera the other way.
                s.pull[6 * v + 3 + k] = -weight * shift[k] / along;
            }
            let lens = 6 * views + self.lenses[v];
            if self.all {
                s.prior[lens] = 1.0 / (ZOOM * ZOOM);
                s.pull[lens] = zoom / ZOOM;
            }
            (0..6).for_each(|k| s.blocks[v][k][k] += s.prior[6 * v + k]);
        }
        for p in &*self.points {
            let mut block = DMat3::ZERO;
            for (sighting, at) in &p.seen {
                let (view, c) = (sighting.view, &self.cameras[sighting.view]);
                let Some(e) = error(c, p.place, *at) else { continue };
                let (t, per_limit) = (c.to_camera(p.place), 1.0 / limit(c, EXACT));
                let weight = per_limit / (1.0 + (e.length() * per_limit / width).powi(2)).sqrt();
                let by_t = [
                    DVec3::new(c.fx / t.z, 0.0, -c.fx * t.x / (t.z * t.z)) * weight,
                    DVec3::new(0.0, c.fy / t.z, -c.fy * t.y / (t.z * t.z)) * weight,
                ];
                let free = self.free[view];
                let of_camera = |row: DVec3| {
                    let turn = t.cross(row);
                    if free { [turn.x, turn.y, turn.z, row.x, row.y, row.z] } else { [0.0; 6] }
                };
                let off = [c.fx * t.x / t.z * weight, c.fy * t.y / t.z * weight];
                let row = Row {
                    view,
                    residual: [e.x * weight, e.y * weight],
                    by_camera: by_t.map(of_camera),
                    by_zoom: if self.all { off } else { [0.0; 2] },
                    by_place: if self.all { by_t.map(|row| c.rotation.transpose() * row) } else { [DVec3::ZERO; 2] },
                };
                for k in 0..2 {
                    let d = row.by_place[k];
                    block += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
                    for i in 0..6 {
                        (0..6).for_each(|j| s.blocks[view][i][j] += row.by_camera[k][i] * row.by_camera[k][j]);
                    }
                    s.of_lenses[self.lenses[view]] += row.by_zoom[k] * row.by_zoom[k];
                }
                s.rows.push(row);
            }
            s.ends.push(s.rows.len());
            let damped = block + DMat3::from_diagonal(damping * block.diagonal());
            let inverse = damped.inverse();
            // A point that its sights do not hold stays.
            s.inverse.push(if self.all && inverse.is_finite() { inverse } else { DMat3::ZERO });
        }
        s
    }

    /// Cameras and points after a step.
    fn stepped(&self, system: &System, step: &[f64]) -> (Vec<Camera>, Vec<Point>) {
        let views = self.cameras.len();
        let camera = |(v, c): (usize, &Camera)| {
            let turn = DVec3::from_slice(&step[6 * v..]);
            let shift = DVec3::from_slice(&step[6 * v + 3..]);
            let zoom = if self.all { step[6 * views + self.lenses[v]] } else { 0.0 };
            if self.free[v] {
                moved(c, turn, shift, zoom)
            } else {
                Camera { fx: c.fx * zoom.exp(), fy: c.fy * zoom.exp(), ..c.clone() }
            }
        };
        let cameras = self.cameras.iter().enumerate().map(camera).collect();
        let mut points = self.points.to_vec();
        if self.all {
            system.each_point(|p, rows| {
                let mut sum = DVec3::ZERO;
                for row in rows {
                    let a = row.along(step, views, self.lenses);
                    (0..2).for_each(|k| sum += row.by_place[k] * (row.residual[k] + a[k]));
                }
                points[p].place -= system.inverse[p] * sum;
            });
        }
        (cameras, points)
    }
}

/// The square of how far a pose is off, in expected errors, over that of [`WRONG`].
fn wrong(turn: DVec3, shift: DVec3) -> f64 {
    (turn.length_squared() + shift.length_squared()) / (WRONG * WRONG)
}

impl Row {
    /// What a step changes of the residual, the place as it is.
    fn along(&self, step: &[f64], views: usize, lenses: &[usize]) -> [f64; 2] {
        let own = &step[6 * self.view..6 * self.view + 6];
        let zoom = step[6 * views + lenses[self.view]];
        [0, 1].map(|k| self.by_camera[k].iter().zip(own).map(|(a, b)| a * b).sum::<f64>() + self.by_zoom[k] * zoom)
    }

    /// Adds the transposed derivatives times `by`.
    fn back(&self, by: [f64; 2], out: &mut [f64], views: usize, lenses: &[usize]) {
        for k in 0..2 {
            for (o, d) in out[6 * self.view..6 * self.view + 6].iter_mut().zip(&self.by_camera[k]) {
                *o += d * by[k];
            }
            out[6 * views + lenses[self.view]] += self.by_zoom[k] * by[k];
        }
    }
}

impl System {
    fn each_point(&self, mut f: impl FnMut(usize, &[Row])) {
        let mut begin = 0;
        for (p, &end) in self.ends.iter().enumerate() {
            f(p, &self.rows[begin..end]);
            begin = end;
        }
    }

    /// The step of cameras and focal lengths.
    fn solve(&self, bundle: &Bundle<'_>, damping: f64) -> Vec<f64> {
        let (views, lenses) = (bundle.cameras.len(), bundle.lenses);
        // The transposed derivatives times what of `of` no move of the points takes up.
        let reduced = |of: &dyn Fn(&Row) -> [f64; 2], out: &mut [f64]| {
            self.each_point(|p, rows| {
                let mut sum = DVec3::ZERO;
                for row in rows {
                    let a = of(row);
                    sum += row.by_place[0] * a[0] + row.by_place[1] * a[1];
                }
                let place = self.inverse[p] * sum;
                for row in rows {
                    let a = of(row);
                    row.back([0, 1].map(|k| a[k] - row.by_place[k].dot(place)), out, views, lenses);
                }
            });
        };
        let diagonal = |i: usize| {
            let own = if i < 6 * views { self.blocks[i / 6][i % 6][i % 6] } else { self.of_lenses[i - 6 * views] };
            if own > 0.0 { own } else { 1.0 }
        };
        let apply = |v: &[f64]| {
            let mut out: Vec<f64> = (0..v.len()).map(|i| (self.prior[i] + damping * diagonal(i)) * v[i]).collect();
            reduced(&|row| row.along(v, views, lenses), &mut out);
            out
        };
        let precondition = |v: &[f64]| {
            let mut out = v.to_vec();
            for (view, block) in self.blocks.iter().enumerate() {
                let mut block = *block;
                (0..6).for_each(|k| block[k][k] += damping * diagonal(6 * view + k) + 1e-30);
                let own: [f64; 6] = std::array::from_fn(|k| v[6 * view + k]);
                if let Some(x) = solve::<6>(block, own) {
                    out[6 * view..6 * view + 6].copy_from_slice(&x);
                }
            }
            for i in 6 * views..v.len() {
                out[i] = v[i] / (self.prior[i] + (1.0 + damping) * diagonal(i));
            }
            out
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let mut left = self.pull.clone();
        reduced(&|row| row.residual, &mut left);
        left.iter_mut().for_each(|v| *v = -*v);
        let mut x = vec![0.0; left.len()];
        let mut z = precondition(&left);
        let mut way = z.clone();
        let mut rest = dot(&left, &z);
        let first = rest;
        for _ in 0..INNER {
            if rest <= 1e-10 * first {
                break;
            }
            let along = apply(&way);
            let step = rest / dot(&way, &along).max(f64::MIN_POSITIVE);
            x.iter_mut().zip(&way).for_each(|(x, w)| *x += step * w);
            left.iter_mut().zip(&along).for_each(|(l, a)| *l -= step * a);
            z = precondition(&left);
            let now = dot(&left, &z);
            way.iter_mut().zip(&z).for_each(|(w, z)| *w = z + now / rest * *w);
            rest = now;
        }
        x
    }
}
