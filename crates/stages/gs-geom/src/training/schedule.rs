//! What changes with the iteration: learning rates, degree of the spherical harmonics, picture size, and the order of the
//! views. Iterations count from 1.

use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::Serialize;

/// Iterations that the rates of 3DGS are made for.
const STOCK_ITERATIONS: f64 = 30_000.0;
/// Shorter runs take larger steps, by the ratio of iterations to this power (docs/geometry.md).
const STEP_POWER: f64 = 2.0 / 3.0;
/// Steps are larger by this factor at most.
const MOST_STEP: f64 = 5.0;
/// Share of a run after which all rates fall to [`LearningRates::end`].
const FALL: f64 = 0.8;

/// Learning rates; the defaults are those of 3DGS. The rates of the centres are per unit of the scene's extent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LearningRates {
    /// Of the centres, at the start; 0 keeps them in place.
    pub position: f64,
    /// Of the centres, at the end; exponential between.
    pub position_end: f64,
    /// Of the constant colour term; a twentieth of it of the other spherical harmonics.
    pub feature: f64,
    /// Of the opacity logits.
    pub opacity: f64,
    /// Of the logarithms of the scales.
    pub scaling: f64,
    /// Of the quaternions.
    pub rotation: f64,
    /// What is left at the end of all but the centres'; they fall exponentially over the last fifth of the run.
    pub end: f64,
    /// Whether a parameter whose gradient is 0 stays, with its moments. Else it follows its moments, as in 3DGS.
    pub selective: bool,
}

impl LearningRates {
    /// For a run of so many iterations.
    pub fn for_iterations(iterations: u32) -> Self {
        let step = (STOCK_ITERATIONS / f64::from(iterations.max(1))).powf(STEP_POWER).clamp(1.0, MOST_STEP);
        let base = Self::default();
        Self {
            position: step * base.position,
            feature: step * base.feature,
            scaling: step * base.scaling,
            rotation: step * base.rotation,
            end: 0.1,
            selective: true,
            // Not the opacity's: larger steps gained nothing (docs/results/lost.md).
            ..base
        }
    }

    /// The rates once this share of a run is over; those of the centres are [`Schedule::rate_of_centres`]'s.
    #[must_use]
    pub fn at(&self, share: f64) -> Self {
        let left = self.end.powf(((share - FALL) / (1.0 - FALL)).max(0.0));
        let [feature, opacity, scaling, rotation] =
            [self.feature, self.opacity, self.scaling, self.rotation].map(|rate| left * rate);
        Self { feature, opacity, scaling, rotation, ..*self }
    }
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            position: 1.6e-4,
            position_end: 1.6e-4 / 100.0,
            feature: 0.0025,
            opacity: 0.05,
            scaling: 0.005,
            rotation: 0.001,
            end: 1.0,
            selective: false,
        }
    }
}

/// What changes when.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Schedule {
    pub iterations: u32,
    /// Iterations after which the degree of the spherical harmonics grows by one.
    pub sh_every: u32,
    /// Picture sizes: (last iteration, divisor of the training size), in order; afterwards the full training size.
    pub coarse: Vec<(u32, u32)>,
}

impl Schedule {
    /// The schedule of 3DGS at 30,000 iterations and more, with full pictures. Shorter runs grow the degree earlier, in
    /// proportion.
    pub fn for_iterations(iterations: u32) -> Self {
        Self { iterations, sh_every: (iterations / 10).clamp(1, 1000), coarse: Vec::new() }
    }

    /// The same with small pictures at the start: a quarter of the size for a sixth of the iterations, half for as many.
    #[must_use]
    pub fn coarse_to_fine(self) -> Self {
        let n = self.iterations;
        Self { coarse: vec![((n / 6).min(500), 4), ((n / 3).min(1000), 2)], ..self }
    }

    /// The picture sizes in words; none where they are full throughout.
    pub fn sizes(&self) -> Option<String> {
        let sizes: Vec<String> =
            self.coarse.iter().map(|(last, divisor)| format!("1/{divisor} until {last}")).collect();
        (!sizes.is_empty()).then(|| format!("{}, then full", sizes.join(", ")))
    }

    /// Share of the run that is over at an iteration, 0 to 1.
    pub fn share(&self, iteration: u32) -> f64 {
        (f64::from(iteration) / f64::from(self.iterations.max(1))).clamp(0.0, 1.0)
    }

    /// Learning rate of the centres at an iteration, world units, for a scene of this extent (see [`crate::start::extent`]).
    pub fn rate_of_centres(&self, rates: &LearningRates, iteration: u32, extent: f64) -> f32 {
        let t = self.share(iteration);
        let rate = (rates.position.ln() * (1.0 - t) + rates.position_end.ln() * t).exp();
        if rates.position.min(rates.position_end) > 0.0 { (rate * extent) as f32 } else { 0.0 }
    }

    /// Degree of the spherical harmonics in use at an iteration.
    pub fn sh_degree(&self, iteration: u32, most: u8) -> u8 {
        u8::try_from(iteration / self.sh_every.max(1)).unwrap_or(u8::MAX).min(most)
    }

    /// Divisor of the training size at an iteration.
    pub fn divisor(&self, iteration: u32) -> u32 {
        self.coarse.iter().find(|(last, _)| iteration <= *last).map_or(1, |&(_, divisor)| divisor)
    }
}

/// A generator for one purpose at one iteration: nothing of it need be kept to go on after an interruption.
pub fn generator(seed: u64, purpose: Purpose, iteration: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream((purpose as u64) << 48 | iteration);
    rng
}

/// `count` places of a list of weights, drawn with replacement in proportion to them; none where all are zero or their sum is not
/// finite.
pub fn drawn(weights: impl Iterator<Item = f64>, count: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let mut total = 0.0;
    let add = |weight| {
        total += weight;
        total
    };
    let sums: Vec<f64> = weights.map(add).collect();
    if total <= 0.0 || !total.is_finite() {
        return Vec::new();
    }
    // The first whose sum lies above the draw: its own share is then positive.
    let mut one = || {
        let at = rng.random::<f64>() * total;
        sums.partition_point(|&s| s <= at).min(sums.len() - 1)
    };
    (0..count).map(|_| one()).collect()
}

/// What random numbers are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Where Gaussians start.
    Start = 1,
    /// The order of the views.
    Order = 2,
    /// Where the halves of a split Gaussian go, and which Gaussians are copied.
    Split = 3,
    /// The colour behind the scene.
    Background = 4,
}

/// The order of the views: each once per round, shuffled anew every round.
#[derive(Debug, Clone)]
pub struct ViewOrder {
    seed: u64,
    round: Option<u64>,
    order: Vec<usize>,
}

impl ViewOrder {
    /// An order of `views` views.
    pub fn new(seed: u64, views: usize) -> Self {
        Self { seed, round: None, order: (0..views).collect() }
    }

    /// The view of an iteration.
    pub fn at(&mut self, iteration: u32) -> usize {
        let (n, i) = (self.order.len() as u64, u64::from(iteration.saturating_sub(1)));
        if self.round != Some(i / n) {
            self.round = Some(i / n);
            self.order.sort_unstable();
            self.order.shuffle(&mut generator(self.seed, Purpose::Order, i / n));
        }
        self.order[(i % n) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_weighs_more_is_drawn_more_often() {
        let weights = [vec![1.0, 0.0], vec![3.0; 1000], vec![1.0; 1000]].concat();
        let draw = |weights: &[f64]| drawn(weights.iter().copied(), 500, &mut generator(1, Purpose::Start, 0));
        let places = draw(&weights);
        assert!(places.len() == 500 && !places.contains(&1));
        let heavy = places.iter().filter(|i| (2..1002).contains(*i)).count() as f64 / places.len() as f64;
        assert!((0.70..0.80).contains(&heavy), "{heavy}");
        assert!(draw(&[0.0; 9]).is_empty() && draw(&[]).is_empty());
    }

    #[test]
    fn the_full_schedule_is_that_of_3dgs() {
        let s = Schedule::for_iterations(30_000);
        let base = LearningRates::default();
        let close = |a: f32, b: f64| (f64::from(a) / b - 1.0).abs() < 1e-3;
        assert!(close(s.rate_of_centres(&base, 0, 2.0), 3.2e-4));
        assert!(close(s.rate_of_centres(&base, 15_000, 1.0), 1.6e-5));
        assert!(close(s.rate_of_centres(&base, 30_000, 1.0), 1.6e-6));
        assert_eq!([0, 999, 1000, 2000, 3000, 30_000].map(|i| s.sh_degree(i, 3)), [0, 0, 1, 2, 3, 3]);
    }

    #[test]
    fn short_runs_take_larger_steps_and_all_fall_at_the_end() {
        let stock = LearningRates::default();
        assert_eq!([0.0, 0.5, 1.0].map(|share| stock.at(share)), [stock; 3]);
        let long = LearningRates::for_iterations(30_000);
        assert_eq!(LearningRates { end: 1.0, selective: false, ..long }, stock);
        assert_eq!(LearningRates::for_iterations(100_000), long);
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-9;
        let times = |rates: LearningRates, step: f64| {
            near(rates.position, step * stock.position)
                && near(rates.feature, step * stock.feature)
                && near(rates.scaling, step * stock.scaling)
                && near(rates.rotation, step * stock.rotation)
                && rates.opacity == stock.opacity
                && rates.position_end == stock.position_end
        };
        let short = LearningRates::for_iterations(1000);
        assert!(times(short, 5.0) && times(LearningRates::for_iterations(10_000), 3f64.powf(2.0 / 3.0)));
        assert_eq!(short.at(0.8), short);
        assert!(
            near(short.at(1.0).opacity, 0.1 * short.opacity)
                && near(short.at(0.9).scaling, short.scaling / 10f64.sqrt())
        );
        assert_eq!(short.at(1.0).position, short.position, "the schedule has its own fall for these");
    }

    #[test]
    fn picture_sizes_follow_each_other() {
        let s = Schedule { coarse: vec![(10, 4), (20, 2)], ..Schedule::for_iterations(100) };
        assert_eq!([1, 10, 11, 20, 21, 100].map(|i| s.divisor(i)), [4, 4, 2, 2, 1, 1]);
        assert_eq!(Schedule::for_iterations(600).coarse_to_fine().coarse, [(100, 4), (200, 2)]);
        assert_eq!(Schedule::for_iterations(30_000).coarse_to_fine().coarse, [(500, 4), (1000, 2)]);
    }

    #[test]
    fn every_round_shows_every_view_and_rounds_can_be_entered_anywhere() {
        let mut order = ViewOrder::new(3, 7);
        let all: Vec<usize> = (1..=70).map(|i| order.at(i)).collect();
        for round in all.chunks(7) {
            let mut sorted = round.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, [0, 1, 2, 3, 4, 5, 6]);
        }
        assert_ne!(all[..7], all[7..14], "shuffled anew");
        let mut late = ViewOrder::new(3, 7);
        assert_eq!((40..=70).map(|i| late.at(i)).collect::<Vec<_>>(), all[39..]);
        let mut other = ViewOrder::new(4, 7);
        assert_ne!((1..=70).map(|i| other.at(i)).collect::<Vec<_>>(), all);
    }
}
