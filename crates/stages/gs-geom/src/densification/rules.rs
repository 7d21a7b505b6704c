//! What a way to densify may do in an iteration, and what it knows about the iteration.

use crate::training::checkpoint::{ScreenGradients, State};
use crate::training::optimiser::Adam;
use crate::training::schedule::Schedule;
use gs_raster::{Gradients, Workspace};
use gs_scene::{Camera, Gaussians};
use serde::Serialize;

/// When the number of Gaussians grows, and how far: hyper-parameters that all ways have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Growth {
    /// After this iteration.
    pub from: u32,
    /// Before this iteration.
    pub until: u32,
    /// Iterations between two rounds.
    pub every: u32,
    /// Most Gaussians there may be.
    pub max_gaussians: usize,
}

impl Growth {
    /// Whether a round is due after this iteration.
    pub fn is_due(&self, iteration: u32) -> bool {
        iteration > self.from && iteration < self.until && iteration.is_multiple_of(self.every.max(1))
    }
}

/// An iteration of a run.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// From 1.
    pub iteration: u32,
    pub seed: u64,
    /// Size of the scene, world units.
    pub extent: f64,
    pub schedule: &'a Schedule,
    pub growth: &'a Growth,
}

/// What a round of densification did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Report {
    pub cloned: usize,
    /// Gaussians replaced by two smaller ones.
    pub split: usize,
    pub removed: usize,
    /// Dead Gaussians moved elsewhere.
    pub relocated: usize,
}

/// The rules of a way to densify, in the order in which an iteration follows them. Each does nothing unless a way says
/// otherwise.
pub trait Densify {
    /// Before the render.
    fn before(&self, _gaussians: &mut Gaussians, _adam: &mut Adam, _at: Moment<'_>) {}

    /// Adds the gradients of its own terms of the loss.
    fn regularise(&self, _gaussians: &Gaussians, _gradients: &mut Gradients) {}

    /// After the optimiser's step, whose learning rate of the centres was `rate`.
    fn explore(&self, _gaussians: &mut Gaussians, _rate: f32, _at: Moment<'_>) {}

    /// Takes note of the gradients of the view that was rendered last.
    fn observe(&self, _seen: &mut ScreenGradients, _view: &Workspace, _camera: &Camera, _at: Moment<'_>) {}

    /// A round: changes the Gaussians. None where there is nothing to go by.
    fn round(&self, state: &mut State, at: Moment<'_>) -> Option<Report>;
}
