//! Densification: how the number of Gaussians changes while they are learnt. [`rules`] says what a way may do, and in which
//! order; [`adaptive`] (3DGS) and [`mcmc`] (3DGS-MCMC) each hold one way with its hyper-parameters.

pub mod adaptive;
pub mod mcmc;
pub mod rules;

use crate::training::schedule::LearningRates;
use adaptive::Adaptive;
use clap::ValueEnum;
use gs_scene::Gaussians;
use mcmc::Mcmc;
use rules::{Densify, Growth};
use serde::Serialize;

/// Which way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// Clone and split Gaussians whose mean gradient is large, as 3DGS does
    #[default]
    Adaptive,
    /// Move dead Gaussians to opaque ones, grow by 5% a round up to --max-gaussians, explore by noise (3DGS-MCMC)
    Mcmc,
    /// Keep the number of Gaussians
    None,
    /// Keep number, order and positions: Gaussian i is point i (ScanNet protocol)
    Fixed,
}

impl Strategy {
    /// The way with its usual hyper-parameters; none where the number of Gaussians stays.
    pub fn way(self) -> Option<Way> {
        match self {
            Self::Adaptive => Some(Way::Adaptive(Adaptive::default())),
            Self::Mcmc => Some(Way::Mcmc(Mcmc::default())),
            Self::None | Self::Fixed => None,
        }
    }

    /// These learning rates, without that of the centres where they stay.
    pub fn rates(self, rates: LearningRates) -> LearningRates {
        if self == Self::Fixed { LearningRates { position: 0.0, ..rates } } else { rates }
    }

    /// When the number of Gaussians grows in a run of `iterations`: as in 3DGS at 30,000 and more. Shorter runs begin
    /// earlier, in proportion, and densify for a larger share, because they have fewer rounds. 3DGS-MCMC goes on for longer:
    /// it moves Gaussians to where they are of use.
    pub fn growth(self, iterations: u32) -> Growth {
        let share = |numerator: u32, denominator: u32| {
            u32::try_from(u64::from(iterations) * u64::from(numerator) / u64::from(denominator)).unwrap_or(u32::MAX)
        };
        let until = match self {
            Self::Mcmc => iterations - iterations / 6,
            Self::Adaptive if iterations < 15_000 => share(7, 10).min(7500),
            Self::Adaptive => share(1, 2),
            Self::None | Self::Fixed => 0,
        };
        Growth { from: share(1, 20).min(500), until, every: share(1, 30).clamp(50, 100), max_gaussians: usize::MAX }
    }
}

/// A way to densify with its hyper-parameters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Way {
    Adaptive(Adaptive),
    Mcmc(Mcmc),
}

impl Way {
    /// What it does.
    pub fn rules(&self) -> &dyn Densify {
        match self {
            Self::Adaptive(way) => way,
            Self::Mcmc(way) => way,
        }
    }
}

/// The Gaussians that can be drawn: their opacity reaches 1/255 somewhere. All of them, where none can.
pub fn drawable(g: &Gaussians) -> Vec<u32> {
    let all = 0..g.len() as u32;
    let rows: Vec<u32> = all.clone().filter(|&i| g.opacity(i as usize) >= 1.0 / 255.0).collect();
    if rows.is_empty() { all.collect() } else { rows }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rounds_are_those_of_3dgs_and_short_runs_have_some() {
        let g = Strategy::Adaptive.growth(30_000);
        assert_eq!((g.from, g.until, g.every), (500, 15_000, 100));
        assert!(!g.is_due(500) && g.is_due(600) && !g.is_due(650) && !g.is_due(15_000));
        for iterations in [1, 60, 300, 1000, 3000, 7000] {
            let g = Strategy::Adaptive.growth(iterations);
            let rounds = (1..=iterations).filter(|&i| g.is_due(i)).count();
            assert!(rounds >= iterations.min(3000) as usize / 160 && g.until <= iterations, "{iterations}: {rounds}");
            assert!(!(1..=iterations).any(|i| Strategy::Fixed.growth(iterations).is_due(i)));
        }
    }
}
