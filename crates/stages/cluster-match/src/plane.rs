//! Whether two instances lie in one plane: floors, walls and table tops are planes, and fall into pieces most often.

use gs_scene::Gaussians;
use nalgebra::{Matrix3, Vector3};

/// A plane is at most this much as thick as it is wide, in standard deviations along its two shorter principal axes.
const FLAT: f64 = 0.25;
/// Two lie in one plane if both together are at most this many times as thick as the thicker one.
const THICKER: f64 = 1.1;

/// Where the centres of some Gaussians lie: weight, mean and covariance, each Gaussian weighted by its opacity.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Place {
    weight: f64,
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
}

impl Place {
    /// The place of each of `instances` instances. `labels` are those of the Gaussians `kept`, -1 for none.
    pub fn of_instances(gaussians: &Gaussians, kept: &[u32], labels: &[i32], instances: usize) -> Vec<Self> {
        let mut out = vec![Self::default(); instances];
        let members = || {
            let own = kept.iter().zip(labels).filter_map(|(&i, &l)| Some((i as usize, usize::try_from(l).ok()?)));
            own.map(|(i, k)| {
                let weight = 1.0 / (1.0 + f64::from(-gaussians.opacity_logits[i]).exp());
                (k, weight, Vector3::from(gaussians.means[i].map(f64::from)))
            })
        };
        for (k, w, x) in members() {
            out[k].weight += w;
            out[k].mean += w * x;
        }
        out.iter_mut().for_each(|p| p.mean /= p.weight.max(1e-300));
        for (k, w, x) in members() {
            let d = x - out[k].mean;
            out[k].covariance += w * d * d.transpose();
        }
        out.iter_mut().for_each(|p| p.covariance /= p.weight.max(1e-300));
        out
    }

    /// The place of both.
    pub fn joined(&self, other: &Self) -> Self {
        let weight = self.weight + other.weight;
        Self { weight, ..self.mixed(other, self.weight / weight.max(1e-300)) }
    }

    /// Whether both lie in one plane, however many Gaussians each has.
    pub fn in_plane_of(&self, other: &Self) -> bool {
        let both = self.mixed(other, 0.5).axes();
        let thicker = self.axes()[0].max(other.axes()[0]);
        both[0] < FLAT * both[1] && both[0] <= THICKER * thicker
    }

    fn mixed(&self, other: &Self, share: f64) -> Self {
        let mean = share * self.mean + (1.0 - share) * other.mean;
        let about = |p: &Self| p.covariance + (p.mean - mean) * (p.mean - mean).transpose();
        Self { weight: 1.0, mean, covariance: share * about(self) + (1.0 - share) * about(other) }
    }

    /// Standard deviations along the principal axes, ascending.
    fn axes(&self) -> [f64; 3] {
        let mut axes: [f64; 3] = self.covariance.symmetric_eigenvalues().into();
        axes.sort_unstable_by(f64::total_cmp);
        axes.map(|v| v.max(0.0).sqrt())
    }
}

#[cfg(test)]
pub(crate) mod testing {
    use super::*;

    /// Places of Gaussians with the given centres, one for each list, all of the same opacity.
    pub fn places(lists: &[Vec<[f32; 3]>]) -> Vec<Place> {
        let means: Vec<[f32; 3]> = lists.iter().flatten().copied().collect();
        let labels: Vec<i32> = lists.iter().enumerate().flat_map(|(k, l)| l.iter().map(move |_| k as i32)).collect();
        let kept: Vec<u32> = (0..means.len() as u32).collect();
        let gaussians = Gaussians { opacity_logits: vec![0.0; means.len()], means, ..Gaussians::default() };
        Place::of_instances(&gaussians, &kept, &labels, lists.len())
    }

    /// A square board of 10 x 10 centres, one unit long, from `corner` along the axes `u` and `v`; a hundredth of it thick.
    pub fn board(corner: [f32; 3], u: usize, v: usize) -> Vec<[f32; 3]> {
        let centre = |i: usize| {
            let mut x = corner;
            x[u] += (i % 10) as f32 / 10.0;
            x[v] += (i / 10) as f32 / 10.0;
            x[3 - u - v] += if i.is_multiple_of(3) { 0.01 } else { 0.0 };
            x
        };
        (0..100).map(centre).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::testing::{board, places};

    #[test]
    fn what_lies_in_one_plane_is_told_from_what_does_not() {
        let of = places(&[
            board([0.0; 3], 0, 1),
            board([5.0, -3.0, 0.005], 0, 1),
            board([0.0, 0.0, 0.3], 0, 1),
            board([1.0, 0.0, 0.0], 1, 2),
            board([1.0, 0.0, 0.0], 1, 2).into_iter().chain(board([0.0; 3], 0, 1)).collect(),
        ]);
        let flat = |a: usize, b: usize| of[a].in_plane_of(&of[b]);
        // Pieces of one floor, far apart; a shelf above it; a wall at its end; an edge of a box.
        assert!(flat(0, 1) && flat(1, 0) && flat(0, 0));
        assert!(!flat(0, 2) && !flat(0, 3) && !flat(0, 4) && !flat(4, 4));
    }

    #[test]
    fn a_small_piece_counts_as_much_as_a_large_one() {
        let floor: Vec<[f32; 3]> = (0..30).flat_map(|i| board([(i % 6) as f32, (i / 6) as f32, 0.0], 0, 1)).collect();
        let of = places(&[floor, board([2.0, 2.0, 0.1], 0, 2)]);
        assert!(!of[0].in_plane_of(&of[1]));
    }

    #[test]
    fn the_place_of_both_is_that_of_all_their_gaussians() {
        let (a, b) = (board([0.0; 3], 0, 1), board([3.0, 1.0, 2.0], 1, 2));
        let both: Vec<[f32; 3]> = a.iter().chain(&b[..40]).copied().collect();
        let of = places(&[a, b[..40].to_vec(), both]);
        let joined = of[0].joined(&of[1]);
        assert!((joined.mean - of[2].mean).norm() < 1e-12 && (joined.covariance - of[2].covariance).norm() < 1e-12);
        assert!((joined.weight - of[2].weight).abs() < 1e-9);
    }
}
