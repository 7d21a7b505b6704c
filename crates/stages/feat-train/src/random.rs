//! Random numbers that no crate gives as they are needed here.

use rand::RngExt;

/// A standard normal number (Box-Muller).
pub fn normal(rng: &mut impl RngExt) -> f64 {
    let (a, b): (f64, f64) = (1.0 - rng.random_range(0.0..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}
