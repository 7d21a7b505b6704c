//! From which side things are looked at: nobody photographed the back of a wall, and renders of it show nothing of use.

use super::sight::{Candidate, Sight, count, members};
use glam::DVec3;

/// Cosine of the angle to the best camera, below which a camera looks at the other side.
const BEHIND: f64 = -0.2;
/// A camera on the other side counts where it sees at least this share of what the best one sees: things may have two sides.
const AS_GOOD: f64 = 0.8;
/// A camera that sees more than this share of all that it shows from behind stands where nobody took a photograph.
const MOST_BEHIND: f64 = 0.25;

/// Of each Gaussian that counts, the camera that sees it and most of all others.
pub struct Front {
    /// How many Gaussians that camera sees; 0 where none sees this one.
    most: Vec<usize>,
    /// Unit direction to it.
    toward: Vec<DVec3>,
}

impl Front {
    /// From cameras all over the scene.
    pub fn of(cameras: &[Candidate], centres: &[DVec3]) -> Self {
        let mut front = Self { most: vec![0; centres.len()], toward: vec![DVec3::ZERO; centres.len()] };
        for camera in cameras {
            let (all, eye) = (count(&camera.sight.shown), camera.camera.position());
            for i in members(&camera.sight.shown) {
                if all > front.most[i] {
                    (front.most[i], front.toward[i]) = (all, (eye - centres[i]).normalize_or_zero());
                }
            }
        }
        front
    }

    /// Takes away from what a camera sees all that it sees from behind; false where that is too much.
    pub fn keep(&self, sight: &mut Sight, eye: DVec3, centres: &[DVec3]) -> bool {
        let all = count(&sight.shown) as f64;
        let behind: Vec<usize> = members(&sight.shown)
            .filter(|&i| all < AS_GOOD * self.most[i] as f64)
            .filter(|&i| (eye - centres[i]).normalize_or_zero().dot(self.toward[i]) < BEHIND)
            .collect();
        behind.iter().for_each(|&i| sight.seen[i / 64] &= !(1 << (i % 64)));
        behind.len() as f64 <= MOST_BEHIND * all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gs_scene::Camera;

    fn camera(eye: DVec3, seen: u64) -> Candidate {
        let sight = Sight { seen: vec![seen], shown: vec![seen] };
        Candidate { camera: Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 8, 8, 1.0), sight }
    }

    #[test]
    fn the_back_of_a_wall_does_not_count_but_two_sides_do() {
        // A wall of 0 and 1 with things before it; 6 has two sides, and 7 is seen from behind alone.
        let centres = [DVec3::ZERO; 8];
        let all = [camera(DVec3::X, 0b0011_1111), camera(-DVec3::X, 0b1000_0011)];
        let front = Front::of(&all, &centres);
        let kept = |eye, seen: u64| {
            let mut sight = camera(eye, seen).sight;
            (front.keep(&mut sight, eye, &centres), sight.seen[0])
        };
        assert_eq!(kept(DVec3::X, 0b0000_0011), (true, 0b0000_0011));
        assert_eq!(kept(DVec3::Y, 0b0000_0011), (true, 0b0000_0011));
        assert_eq!(kept(-DVec3::X, 0b1000_0011), (false, 0b1000_0000));
        assert_eq!(kept(-DVec3::X, 0b0101_1111), (true, 0b0101_1111));
    }
}
