//! What can be done in a given time: from the measured speed of a few iterations to a number of iterations, a picture
//! size and a most number of Gaussians.

use crate::densification::rules::Growth;
use crate::training::schedule::Schedule;
use serde::{Deserialize, Serialize};

/// Divisors of the picture size that a plan may choose.
const DIVISORS: [f64; 7] = [1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0];
/// Factors on the number of Gaussians that a plan may choose, most first.
const GROWTHS: [f64; 14] = [64.0, 48.0, 32.0, 24.0, 16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.25, 1.0];
/// Iterations that make each multiple of the first number of Gaussians worth its time.
const ITERATIONS_PER_GROWTH: f64 = 400.0;
/// Parts of a run whose time is estimated one by one.
const PARTS: u32 = 256;
/// Share of a forward and backward pass that is forward.
const FORWARD_SHARE: f64 = 0.45;

/// Least of [`Speed::exponent`]. Doubling a start's Gaussians often costs nothing there, but a run's later Gaussians overlap more: runs took
/// 15 to 23 % more than plans without it said.
const LEAST_EXPONENT: f64 = 0.1;

/// How long iterations take: `pixels` x (share of the pixels) x (N / `gaussians`)^`exponent` + `each` x N / `gaussians`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Speed {
    /// Number of Gaussians at which it was measured.
    pub gaussians: f64,
    /// Seconds per iteration that grow with the pixels, for full pictures.
    pub pixels: f64,
    /// Seconds per iteration that grow with the Gaussians alone.
    pub each: f64,
    /// How the former grow with the number of Gaussians.
    pub exponent: f64,
}

impl Speed {
    /// The speed by three measurements: seconds per iteration with full pictures, with pictures of a `share` (below 1) of
    /// the pixels, and with full pictures and twice the Gaussians. Times are noisy, so every figure is kept plausible.
    pub fn fit(gaussians: usize, full: f64, (share, small): (f64, f64), doubled: f64) -> Self {
        let full = full.max(1e-6);
        let pixels = ((full - small) / (1.0 - share)).clamp(0.3 * full, full);
        let each = full - pixels;
        let exponent = ((doubled - 2.0 * each).max(1e-9) / pixels).log2().clamp(LEAST_EXPONENT, 1.0);
        Self { gaussians: gaussians.max(1) as f64, pixels, each, exponent }
    }

    /// Seconds of an iteration with `gaussians` Gaussians and a share of the pixels.
    pub fn seconds(&self, gaussians: f64, share: f64) -> f64 {
        let growth = gaussians / self.gaussians;
        self.pixels * share * growth.powf(self.exponent) + self.each * growth
    }
}

/// What a run may use.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Time, seconds.
    pub seconds: f64,
    pub iterations: u32,
    /// Gaussians to begin with.
    pub start: usize,
    /// Gaussians.
    pub gaussians: usize,
    pub divisor: f64,
    /// Held-out views, each rendered eleven times.
    pub heldout: usize,
}

/// What a run is to do.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    pub iterations: u32,
    /// Most Gaussians.
    pub gaussians: usize,
    pub divisor: f64,
    /// How long it should take, seconds.
    pub seconds: f64,
}

/// The plan for these limits. `course` gives the schedule and the growth of a number of iterations.
///
/// Full pictures come first, then as many Gaussians as get `ITERATIONS_PER_GROWTH` iterations for each multiple of
/// their first number. Where not even the first number gets them, the pictures become smaller; and where that does not
/// suffice, there are fewer iterations.
pub fn plan(speed: &Speed, limits: &Limits, course: impl Fn(u32) -> (Schedule, Growth)) -> Plan {
    let fit = |gaussians: usize, divisor: f64| {
        let seconds = |iterations: u32| expected(speed, limits, &course(iterations), gaussians, divisor);
        // The most iterations that fit, at least one.
        let (mut low, mut high) = (1, limits.iterations.max(1));
        while low < high {
            let middle = low + (high - low).div_ceil(2);
            if seconds(middle) <= limits.seconds { low = middle } else { high = middle - 1 }
        }
        Plan { iterations: low, gaussians, divisor, seconds: seconds(low) }
    };
    let mut last = None;
    for divisor in DIVISORS.into_iter().filter(|&d| d == 1.0 || d <= limits.divisor) {
        for growth in GROWTHS {
            let gaussians = ((limits.start as f64 * growth) as usize).min(limits.gaussians).max(limits.start);
            let wanted = ITERATIONS_PER_GROWTH * gaussians as f64 / limits.start.max(1) as f64;
            let p = fit(gaussians, divisor);
            if f64::from(p.iterations) >= wanted.min(f64::from(limits.iterations)) {
                return p;
            }
            last = Some(p);
        }
    }
    last.unwrap_or_else(|| fit(limits.start, 1.0))
}

/// Seconds that a schedule should take when the number of Gaussians grows from its first to `gaussians` in the first half
/// of densification.
fn expected(
    speed: &Speed,
    limits: &Limits,
    (schedule, growth): &(Schedule, Growth),
    gaussians: usize,
    divisor: f64,
) -> f64 {
    let (start, most) = (limits.start as f64, gaussians as f64);
    let from = f64::from(growth.from);
    let until = from + 0.5 * (f64::from(growth.until) - from).max(1.0);
    let number =
        |iteration: f64| start + (most - start).max(0.0) * ((iteration - from) / (until - from)).clamp(0.0, 1.0);
    let part = f64::from(schedule.iterations) / f64::from(PARTS);
    let one = |i: u32| {
        let at = (f64::from(i) + 0.5) * part;
        let divisor = divisor * f64::from(schedule.divisor((at as u32).max(1)));
        part * speed.seconds(number(at), 1.0 / (divisor * divisor))
    };
    let views = 11.0 * limits.heldout as f64 * FORWARD_SHARE * speed.seconds(most, 1.0 / (divisor * divisor));
    (0..PARTS).map(one).sum::<f64>() + views
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densification::Strategy;
    use proptest::prelude::*;

    const SPEED: Speed = Speed { gaussians: 10_000.0, pixels: 0.09, each: 0.01, exponent: 0.5 };

    fn limits(seconds: f64) -> Limits {
        Limits { seconds, iterations: 30_000, start: 10_000, gaussians: 1_000_000, divisor: 8.0, heldout: 0 }
    }

    fn course(n: u32) -> (Schedule, Growth) {
        (Schedule::for_iterations(n), Strategy::Adaptive.growth(n))
    }

    fn planned(seconds: f64) -> Plan {
        plan(&SPEED, &limits(seconds), course)
    }

    #[test]
    fn a_speed_comes_back_from_its_measurements() {
        let small = (1.0 / 16.0, SPEED.seconds(10_000.0, 1.0 / 16.0));
        let fitted = Speed::fit(10_000, SPEED.seconds(10_000.0, 1.0), small, SPEED.seconds(20_000.0, 1.0));
        assert!((fitted.pixels - SPEED.pixels).abs() < 1e-9 && (fitted.exponent - 0.5).abs() < 1e-9, "{fitted:?}");
        let noisy = Speed::fit(10_000, 0.1, (0.25, 0.2), 0.01);
        assert!(noisy.pixels > 0.0 && noisy.exponent == LEAST_EXPONENT && noisy.each >= 0.0);
    }

    #[test]
    fn more_time_is_for_larger_pictures_then_iterations_and_gaussians() {
        let plans = [1.0, 10.0, 60.0, 600.0, 3600.0, 1e6].map(planned);
        for (p, seconds) in plans.iter().zip([1.0, 10.0, 60.0, 600.0, 3600.0, 1e6]) {
            assert!(p.seconds <= seconds && (p.iterations == 30_000 || p.seconds > 0.97 * seconds), "{p:?}");
        }
        assert!(plans[0].divisor == 8.0 && plans[1].divisor > 1.0 && plans[2].divisor == 1.0, "{plans:?}");
        assert!(plans.windows(2).all(|p| p[0].gaussians <= p[1].gaussians));
        assert_eq!((plans[5].iterations, plans[5].gaussians), (30_000, 640_000));
    }

    #[test]
    fn small_pictures_at_the_start_leave_time_for_more_iterations() {
        let coarse = |n| (Schedule { coarse: vec![(n / 4, 8), (n / 2, 2)], ..course(n).0 }, course(n).1);
        let p = plan(&SPEED, &limits(100.0), coarse);
        assert!(p.iterations > planned(100.0).iterations, "{p:?}");
    }

    proptest! {
        #[test]
        fn plans_keep_to_their_limits(
            seconds in 0.01f64..1e5,
            iterations in 1u32..100_000,
            start in 0usize..1_000_000,
            most in 1usize..2_000_000,
            divisor in 0.5f64..9.0,
        ) {
            let limits = Limits { seconds, iterations, start, gaussians: most, divisor, heldout: 2 };
            let p = plan(&SPEED, &limits, course);
            prop_assert!((1..=iterations).contains(&p.iterations) && p.gaussians <= most.max(start));
            prop_assert!(p.divisor == 1.0 || p.divisor <= divisor);
            prop_assert!(p.seconds <= seconds || p.iterations == 1);
        }
    }
}
