//! Where one piece rises above the surface of another in another colour: what stands on a table does, one half of the table top does not.
//! A thing with a fold, such as the seat and the back of a chair, mostly keeps its colour there.

use crate::inputs::Inputs;
use artifacts::Graph;
use gs_io::Result;
use gs_scene::middle;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// How often the patch of a Gaussian takes in those of its neighbours. Fewer leave the normals to chance.
const ROUNDS: usize = 4;
/// Sine of the angle from which a patch rises above the plane of another.
const RISES: f64 = 0.25;
/// Centres lie in a line where the variance across it is at most this share of the variance along it.
const LINE: f64 = 1e-6;
/// Distance of hues from which two patches have different colours: shade alone stays below it. Chosen on scenes for tuning, with
/// [`DARK`] (docs/results/real-masks.md).
const OTHER_COLOUR: f64 = 0.05;
/// What a hue's sum of red, green and blue has more, so that the hue of what is nearly black is not chance.
const DARK: f64 = 0.15;

/// Where two pieces touch.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Rim {
    /// Pairs of neighbours, one in each piece; twice where each is a neighbour of the other.
    pub pairs: u32,
    /// Those of the pairs of which one rises above the surface of the other, in another colour.
    pub steps: u32,
}

impl Rim {
    /// Of both together.
    pub fn joined(self, other: Self) -> Self {
        Self { pairs: self.pairs + other.pairs, steps: self.steps + other.steps }
    }
}

/// Two pieces, the smaller number first, and their rim.
pub type Touch = ((u32, u32), Rim);

/// The kept Gaussians as points of surfaces.
pub struct Points<'a> {
    /// Their spatial neighbours.
    graph: &'a Graph,
    centres: Vec<Vector3<f64>>,
    /// The directions, of any length, from which each is seen.
    facing: Vec<Vector3<f64>>,
    hues: Vec<Vector3<f64>>,
}

impl<'a> Points<'a> {
    /// Those of the inputs. A Gaussian is seen from the cameras whose masks have it, by its weight in them; one in no mask, from all.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub(crate) fn of(inputs: &'a Inputs) -> Result<Self> {
        let (graph, footprints, means) = (&inputs.graph, &inputs.footprints, &inputs.geometry.gaussians.means);
        let centres: Vec<Vector3<f64>> =
            graph.kept.iter().map(|&i| Vector3::from(means[i as usize].map(f64::from))).collect();
        let cameras: Vec<Vector3<f64>> = inputs.views.iter().map(|v| v.camera.position().to_array().into()).collect();
        let mut facing = vec![Vector3::zeros(); centres.len()];
        let rows: Vec<u32> = (0..footprints.rows.len() as u32).collect();
        footprints.in_batches(&rows, |rows, batch| {
            for (&row, entries) in rows.iter().zip(batch) {
                let camera = cameras[footprints.rows[row as usize].view as usize];
                for (i, w) in entries.iter().map(|(i, w)| (i as usize, f64::from(w))) {
                    let way = camera - centres[i];
                    facing[i] += way * (w / way.norm().max(1e-300));
                }
            }
        })?;
        facing.par_iter_mut().zip(&centres).filter(|(facing, _)| **facing == Vector3::zeros()).for_each(
            |(facing, x)| *facing = cameras.iter().map(|c| (c - x).try_normalize(0.0).unwrap_or_default()).sum(),
        );
        let hues = graph.kept.iter().map(|&i| hue(inputs.geometry.gaussians.base_color(i as usize))).collect();
        Ok(Self { graph, centres, facing, hues })
    }

    /// The rims of all pieces that touch, ascending. `labels` are the pieces of the Gaussians, from 0.
    pub fn rims(&self, labels: &[i32]) -> Vec<Touch> {
        let patches = self.patches(labels);
        let patches = &patches;
        let touches = (0..labels.len()).into_par_iter().flat_map_iter(|i| {
            let others = self.neighbours(i).filter(move |&j| labels[j] != labels[i]);
            others.map(move |j| {
                let (a, b) = (labels[i] as u32, labels[j] as u32);
                ((a.min(b), a.max(b)), Rim { pairs: 1, steps: u32::from(patches[i].steps_to(&patches[j])) })
            })
        });
        let mut touches: Vec<Touch> = touches.collect();
        touches.par_sort_unstable_by_key(|t| t.0);
        touches.dedup_by(|next, t| {
            let same = next.0 == t.0;
            if same {
                t.1 = t.1.joined(next.1);
            }
            same
        });
        touches
    }

    /// The spatial neighbours of a Gaussian. Rows are padded with the Gaussian itself.
    fn neighbours(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        self.graph.gaussian_knn.row(i).into_iter().map(|&j| j as usize).filter(move |&j| j != i)
    }

    /// The patch of each Gaussian, as far as its own piece reaches.
    fn patches(&self, labels: &[i32]) -> Vec<Patch> {
        // Near the origin differences of squares keep their digits.
        let middle: Vector3<f64> = middle(self.centres.iter().map(|&x| x.into())).into();
        let mut moments: Vec<Moments> =
            self.centres.iter().zip(&self.hues).map(|(x, hue)| Moments::of(x - middle, *hue)).collect();
        for _ in 0..ROUNDS {
            let spread = |i: usize| {
                let own = self.neighbours(i).filter(|&j| labels[j] == labels[i]);
                own.fold(moments[i], |sum, j| sum.and(&moments[j]))
            };
            moments = (0..moments.len()).into_par_iter().map(spread).collect();
        }
        moments.par_iter().zip(&self.facing).map(|(m, facing)| m.patch(facing)).collect()
    }
}

/// A bit of surface.
struct Patch {
    centre: Vector3<f64>,
    /// Towards those who see it; zero where it has no surface.
    normal: Vector3<f64>,
    hue: Vector3<f64>,
}

impl Patch {
    /// Whether one rises above the other in another colour. What has no surface does so always, so that crumbs join only what they agree
    /// with.
    fn steps_to(&self, other: &Self) -> bool {
        let is_crumb = self.normal == Vector3::zeros() || other.normal == Vector3::zeros();
        let is_other = || (self.hue - other.hue).norm() > OTHER_COLOUR;
        is_crumb || is_other() && (self.is_above(other) || other.is_above(self))
    }

    /// Whether it lies above the plane of `other`.
    fn is_above(&self, other: &Self) -> bool {
        let way = self.centre - other.centre;
        other.normal.dot(&way) >= RISES * way.norm()
    }
}

/// The shares of red, green and blue in a colour, which light and shade change little.
fn hue(color: [f32; 3]) -> Vector3<f64> {
    let color = Vector3::from(color.map(|c| f64::from(c.clamp(0.0, 1.0))));
    color / (color.sum() + DARK)
}

/// Sums over Gaussians: their number, their centres, the squares of these, and their hues.
#[derive(Clone, Copy)]
struct Moments {
    count: f64,
    sum: Vector3<f64>,
    squares: Matrix3<f64>,
    hues: Vector3<f64>,
}

impl Moments {
    fn of(x: Vector3<f64>, hue: Vector3<f64>) -> Self {
        Self { count: 1.0, sum: x, squares: x * x.transpose(), hues: hue }
    }

    fn and(self, other: &Self) -> Self {
        Self {
            count: self.count + other.count,
            sum: self.sum + other.sum,
            squares: self.squares + other.squares,
            hues: self.hues + other.hues,
        }
    }

    fn patch(&self, facing: &Vector3<f64>) -> Patch {
        let centre = self.sum / self.count;
        let axes = (self.squares / self.count - centre * centre.transpose()).symmetric_eigen();
        let least = axes.eigenvalues.imin();
        let most = axes.eigenvalues.imax();
        let normal: Vector3<f64> = axes.eigenvectors.column(least).into();
        // The axes of one Gaussian, or of a line, are rounding errors.
        let middle = axes.eigenvalues.sum() - axes.eigenvalues[least] - axes.eigenvalues[most];
        let flat = self.count > 1.0 && middle > LINE * axes.eigenvalues[most];
        let side = if normal.dot(facing) < 0.0 { -1.0 } else { 1.0 };
        let normal = if flat { side * normal } else { Vector3::zeros() };
        Patch { centre, normal, hue: self.hues / self.count }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    type Sheet = ([f64; 3], [f64; 3], [f64; 3]);

    /// The share of the rim of two sheets of 20 x 20 Gaussians along which one rises above the other. A sheet has a corner and the steps
    /// along its edges. All are seen from above. One more Gaussian, a piece of its own, is `far` away.
    fn step(sheets: [Sheet; 2], moved: f64, far: f64) -> f64 {
        step_of(sheets, [WHITE, RED], moved, far)
    }

    const WHITE: [f32; 3] = [0.9; 3];
    const RED: [f32; 3] = [0.6, 0.1, 0.1];

    /// The same for sheets of these `colours`.
    fn step_of(sheets: [Sheet; 2], colours: [[f32; 3]; 2], moved: f64, far: f64) -> f64 {
        let sheet = |(corner, u, v): Sheet| {
            let [corner, u, v] = [corner, u, v].map(Vector3::from);
            (0..400).map(move |i| corner.add_scalar(moved) + f64::from(i % 20) * u + f64::from(i / 20) * v)
        };
        let mut centres: Vec<Vector3<f64>> = sheets.into_iter().flat_map(sheet).collect();
        centres.push(Vector3::repeat(far));
        let labels: Vec<i32> = (0..801).map(|i| i / 400).collect();
        let nearest = |x: &Vector3<f64>| {
            let mut order: Vec<u32> = (0..801).collect();
            order.sort_by(|&a, &b| (centres[a as usize] - x).norm().total_cmp(&(centres[b as usize] - x).norm()));
            order
        };
        let rows: Vec<Vec<u32>> = centres.iter().map(nearest).collect();
        let gaussian_knn = Array2::from_shape_fn((801, 9), |(i, k)| if i < 800 { rows[i][k] } else { 800 });
        let graph = Graph { kept: (0..801).collect(), gaussian_knn, ..Graph::default() };
        let facing = vec![Vector3::new(0.6, -0.4, 10.0); 801];
        let hues = labels.iter().map(|&l| hue(colours[l as usize % 2])).collect();
        let touches = Points { graph: &graph, centres, facing, hues }.rims(&labels);
        assert!(touches.len() == 1 && touches[0].0 == (0, 1) && touches[0].1.pairs >= 40, "{touches:?}");
        f64::from(touches[0].1.steps) / f64::from(touches[0].1.pairs)
    }

    const FLOOR: Sheet = ([0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);

    #[test]
    fn what_stands_or_lies_on_a_floor_rises_above_it() {
        let wall = ([19.5, 0.0, 0.5], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
        let shelf = ([17.0, 0.0, 1.5], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
        let ramp = ([20.0, 0.0, 0.6], [0.8, 0.0, 0.6], [0.0, 1.0, 0.0]);
        for (name, other) in [("wall", wall), ("shelf", shelf), ("ramp", ramp)] {
            assert!(step([FLOOR, other], 0.0, 1e3) > 0.9, "{name}: {}", step([FLOOR, other], 0.0, 1e3));
            assert!(step([other, FLOOR], 0.0, 1e3) > 0.9, "{name}");
        }
    }

    #[test]
    fn what_goes_on_flat_or_falls_away_does_not_rise() {
        let flat = ([20.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
        let roof = ([20.0, 0.0, -0.6], [0.8, 0.0, -0.6], [0.0, 1.0, 0.0]);
        for (name, other) in [("flat", flat), ("roof", roof)] {
            assert!(step([FLOOR, other], 0.0, 1e3) < 0.1, "{name}: {}", step([FLOOR, other], 0.0, 1e3));
        }
    }

    #[test]
    fn one_gaussian_or_a_line_has_no_surface_and_so_is_a_step() {
        let (x, up) = (Vector3::new(1.0, 2.0, 0.0), Vector3::z());
        let of = |x| Moments::of(x, hue(WHITE));
        let line = of(x).and(&of(3.0 * x));
        let plane = line.and(&of(Vector3::x()));
        let [one, line, plane] = [of(x), line, plane].map(|m| m.patch(&up));
        assert!(plane.steps_to(&one) && line.steps_to(&plane));
        assert!((plane.normal - up).norm() < 1e-9 && !one.is_above(&plane) && !plane.steps_to(&plane));
    }

    #[test]
    fn what_rises_in_the_same_colour_is_no_step() {
        let wall = ([19.5, 0.0, 0.5], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
        let shaded = RED.map(|c| 0.75 * c);
        for (colours, steps) in
            [([RED, RED], false), ([RED, shaded], false), ([WHITE, [0.5; 3]], false), ([WHITE, [0.05; 3]], true)]
        {
            let step = step_of([FLOOR, wall], colours, 0.0, 1e3);
            assert!(if steps { step > 0.9 } else { step == 0.0 }, "{colours:?}: {step}");
        }
    }

    #[test]
    fn neither_a_far_origin_nor_a_far_gaussian_changes_steps() {
        let wall = ([19.5, 0.0, 0.5], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
        let near = step([FLOOR, wall], 0.0, 1e3);
        assert_eq!([step([FLOOR, wall], 4096.0, 1e3), step([FLOOR, wall], 0.0, 1e15)], [near; 2]);
    }
}
