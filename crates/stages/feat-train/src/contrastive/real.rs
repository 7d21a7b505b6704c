//! Numbers the model computes with: f32 for training, f64 to check gradients by finite differences.

use std::ops::{Add, AddAssign, Mul};

pub trait Real:
    Copy + Default + Send + Sync + PartialOrd + Into<f64> + Add<Output = Self> + Mul<Output = Self> + AddAssign
{
    /// Rounded from f64.
    fn of(v: f64) -> Self;

    #[inline]
    fn get(self) -> f64 {
        self.into()
    }
}

impl Real for f32 {
    #[inline]
    fn of(v: f64) -> Self {
        v as f32
    }
}

impl Real for f64 {
    #[inline]
    fn of(v: f64) -> Self {
        v
    }
}
