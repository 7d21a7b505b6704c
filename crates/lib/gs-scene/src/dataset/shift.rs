//! Datasets far from the origin: georeferenced ones.

use super::Dataset;
use crate::middle::{middle, shift_of};
use crate::{Gaussians, say_shift};
use glam::DVec3;
use gs_io::{Error, Result};
use std::path::Path;

/// How many times as far as they are wide cameras may be from Gaussians. Those of one scene lie within a few.
const APART: f64 = 1_000.0;

impl Dataset {
    /// Brings a dataset that is far from the origin near it: by its points, or where it has none by its cameras.
    pub(super) fn settle(&mut self) {
        let shift = match self.points.is_empty() {
            false => self.points.shift,
            true => shift_of(self.views.iter().map(|v| v.camera.position().to_array())),
        };
        self.shift_to(shift);
    }

    /// Takes the cameras to the world less another shift. The points keep their own.
    fn shift_to(&mut self, shift: [f64; 3]) {
        if self.shift != shift {
            self.views.iter_mut().for_each(|v| v.shift_to(shift));
            self.shift = shift;
        }
    }

    /// Takes the cameras to where `gaussians` of the file `path` are: to the world less their shift.
    ///
    /// # Errors
    /// When the cameras are far away from them then: one of the two is in the world's coordinates, and the other is not.
    pub fn follow(&mut self, gaussians: &Gaussians, path: &Path) -> Result<()> {
        if self.shift == gaussians.shift {
            return Ok(());
        }
        let own = self.shift;
        self.shift_to(gaussians.shift);
        let cameras = || self.views.iter().map(|v| v.camera.position().to_array());
        let at = middle(cameras());
        let finite = |m: &&[f32; 3]| m.iter().all(|v| v.is_finite());
        let theirs = middle(gaussians.means.iter().filter(finite).map(|m| m.map(f64::from)));
        let distance = |p: [f64; 3], q: [f64; 3]| DVec3::from(p).distance(q.into());
        let width = cameras().map(|c| distance(c, at)).fold(gaussians.spread(), f64::max);
        if distance(at, theirs) <= APART * width {
            return Ok(());
        }
        Err(Error::new("the Gaussians and the photographs lie far apart: one of them is less a shift that the other has")
            .file(path)
            .field("shift")
            .found(format!("{}; that of {} is {}", say_shift(gaussians.shift), self.root.display(), say_shift(own)))
            .expected("Gaussians where the cameras are")
            .hint("give both in the same coordinates; a PLY from which X, Y, Z were subtracted says so in its header: comment shift X Y Z"))
    }
}
