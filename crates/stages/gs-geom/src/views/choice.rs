//! Which of the cameras that could be are: one after the other, always the one that adds most.

use super::sight::{Candidate, members};
use gs_scene::Camera;

/// Views that every Gaussian should have.
pub const ENOUGH: u8 = 8;
/// What a sighting is worth that comes after 0, 1, ... others: 1000 / sqrt(1 + others). Whole numbers add up alike in every
/// order.
const WORTH: [u64; ENOUGH as usize] = [1000, 707, 577, 500, 447, 408, 378, 354];
/// Distance between views, in diagonals of the scene and radians of their axes together, below which the second is worth less.
const APART: f64 = 0.4;
/// Views that give fewer than this share of the Gaussians a sighting that they lack are not worth their time.
const LEAST: f64 = 0.002;

/// The cameras chosen so far.
pub struct Choice {
    /// Sightings of each Gaussian that counts, up to [`ENOUGH`].
    pub sightings: Vec<u8>,
    pub cameras: Vec<Camera>,
    diagonal: f64,
}

impl Choice {
    /// Nothing is chosen yet, of a scene with `gaussians` that count.
    pub fn new(gaussians: usize, diagonal: f64) -> Self {
        Self { sightings: vec![0; gaussians], cameras: Vec::new(), diagonal }
    }

    /// Takes cameras from the pool, at most until there are `most`.
    pub fn take(&mut self, pool: &mut Vec<Candidate>, most: usize) {
        // Worth only falls as more is seen: what was worth less than the best is so still, and is not looked at again.
        let mut worth: Vec<f64> = pool.iter().map(|c| self.worth(c)).collect();
        while self.cameras.len() < most && !pool.is_empty() {
            let best = loop {
                let best = greatest(&worth);
                let now = self.worth(&pool[best]);
                if now >= worth[best] {
                    break best;
                }
                worth[best] = now;
            };
            let lacking = members(&pool[best].sight.seen).filter(|&i| self.sightings[i] < ENOUGH).count();
            if (lacking as f64) < (LEAST * self.sightings.len() as f64).max(1.0) {
                return;
            }
            worth.remove(best);
            let Candidate { camera, sight } = pool.remove(best);
            members(&sight.seen).for_each(|i| self.sightings[i] = (self.sightings[i] + 1).min(ENOUGH));
            self.cameras.push(camera);
        }
    }

    /// What a camera would add.
    fn worth(&self, candidate: &Candidate) -> f64 {
        let all: u64 = members(&candidate.sight.seen).filter_map(|i| WORTH.get(self.sightings[i] as usize)).sum();
        let apart = |c: &Camera| {
            let turn = c.rotation.row(2).dot(candidate.camera.rotation.row(2)).clamp(-1.0, 1.0).acos();
            turn + c.position().distance(candidate.camera.position()) / self.diagonal
        };
        let nearest = self.cameras.iter().map(apart).fold(APART, f64::min);
        all as f64 * nearest / APART
    }
}

/// The place of the greatest value, of equals the first.
fn greatest(values: &[f64]) -> usize {
    values.iter().enumerate().fold(0, |best, (i, v)| if *v > values[best] { i } else { best })
}

#[cfg(test)]
mod tests {
    use super::super::sight::Sight;
    use super::*;
    use glam::DVec3;

    fn candidate(eye: DVec3, seen: u64) -> Candidate {
        let sight = Sight { seen: vec![seen], shown: vec![seen] };
        Candidate { camera: Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 8, 8, 1.0), sight }
    }

    #[test]
    fn the_best_comes_first_and_the_rest_is_left() {
        let mut choice = Choice::new(8, 1.0);
        let mut pool = vec![
            candidate(DVec3::X, 0b0000_0011),
            candidate(DVec3::Y, 0b0011_1111),
            candidate(-DVec3::X, 0b1100_0000),
            // Nearly the best again: worth less than what shows something else.
            candidate(DVec3::new(0.01, 1.0, 0.0), 0b0011_1111),
        ];
        choice.take(&mut pool, 2);
        let eyes: Vec<DVec3> = choice.cameras.iter().map(|c| c.position().round()).collect();
        assert_eq!(eyes, [DVec3::Y, -DVec3::X]);
        assert_eq!(choice.sightings, [1; 8]);
        choice.take(&mut pool, 10);
        assert_eq!((choice.cameras.len(), pool.len()), (4, 0));
        assert_eq!(choice.sightings, [3, 3, 2, 2, 2, 2, 1, 1]);
    }

    #[test]
    fn what_is_seen_enough_is_worth_nothing() {
        let mut choice = Choice::new(3, 1.0);
        let mut pool: Vec<Candidate> = (0..20)
            .map(|i| candidate(DVec3::new((0.5 * f64::from(i)).cos(), (0.5 * f64::from(i)).sin(), 0.1), 0b011))
            .collect();
        choice.take(&mut pool, 20);
        assert_eq!((choice.cameras.len(), choice.sightings), (ENOUGH as usize, vec![ENOUGH, ENOUGH, 0]));
    }
}
