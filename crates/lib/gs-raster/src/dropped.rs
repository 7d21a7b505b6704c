//! Gaussians that are not drawn, and why.

/// Why a Gaussian is not drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unseen {
    NotFinite,
    Behind,
    Degenerate,
    Transparent,
    Outside,
}

impl Unseen {
    /// From `Projected::unseen`; none for what is drawn.
    pub fn of(code: f64) -> Option<Self> {
        [Self::NotFinite, Self::Behind, Self::Degenerate, Self::Transparent, Self::Outside]
            .get((code as usize).wrapping_sub(1))
            .copied()
    }
}

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

    pub(crate) fn count(&mut self, reason: Unseen) {
        *match reason {
            Unseen::NotFinite => &mut self.not_finite,
            Unseen::Behind => &mut self.behind,
            Unseen::Degenerate => &mut self.degenerate,
            Unseen::Transparent => &mut self.transparent,
            Unseen::Outside => &mut self.outside,
        } += 1;
    }

    pub(crate) fn add(&mut self, o: &Self) {
        self.not_finite += o.not_finite;
        self.behind += o.behind;
        self.degenerate += o.degenerate;
        self.transparent += o.transparent;
        self.outside += o.outside;
    }
}
