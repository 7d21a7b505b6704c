//! Gaussians that are not drawn, and why.

/// How many Gaussians were not drawn, and why. A Gaussian counts once, under the first reason that holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// A parameter is NaN or infinite (infinite opacity logits are opacities of 0 and 1 and are fine), or the colour is.
    pub not_finite: usize,
    /// The centre is nearer than the near plane or behind the camera.
    pub behind: usize,
    /// The quaternion is zero, or single precision does not hold the projected covariance.
    pub degenerate: usize,
    /// The opacity is below 1/255, at which every contribution is skipped.
    pub transparent: usize,
    /// The region where alpha reaches 1/255 lies outside the image.
    pub outside: usize,
}

impl Dropped {
    /// All that were not drawn.
    pub fn total(&self) -> usize {
        self.not_finite + self.behind + self.degenerate + self.transparent + self.outside
    }

    /// Counts one, for the reason of this position from 1.
    pub(crate) fn count(&mut self, reason: usize) {
        let Self { not_finite, behind, degenerate, transparent, outside } = self;
        *[not_finite, behind, degenerate, transparent, outside][reason - 1] += 1;
    }

    pub(crate) fn add(&mut self, o: &Self) {
        self.not_finite += o.not_finite;
        self.behind += o.behind;
        self.degenerate += o.degenerate;
        self.transparent += o.transparent;
        self.outside += o.outside;
    }
}
