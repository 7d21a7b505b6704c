//! Random numbers of the distributions that scenes are drawn from.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

/// A random number of -1 to 1.
pub(crate) fn either_way(rng: &mut ChaCha8Rng) -> f64 {
    rng.random::<f64>() * 2.0 - 1.0
}

/// A factor of `1 - amount` to `1 + amount`.
pub(crate) fn vary(rng: &mut ChaCha8Rng, amount: f64) -> f64 {
    1.0 + amount * (2.0 * rng.random::<f64>() - 1.0)
}

/// A standard normal number (Box and Muller).
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (TAU * b).cos()
}
