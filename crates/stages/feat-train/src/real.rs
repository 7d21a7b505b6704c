//! Numbers the model computes with: f32 for training, f64 to check gradients by finite differences. And how weights of
//! footprints are kept: they never change, so fewer bits may do.

use std::ops::{Add, AddAssign, Mul, Sub};

/// f32 or f64.
pub trait Real:
    Copy
    + Default
    + Send
    + Sync
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + AddAssign
    + std::fmt::Debug
    + 'static
{
    /// From f64, rounded.
    fn of(v: f64) -> Self;
    /// To f64.
    fn get(self) -> f64;
}

impl Real for f32 {
    #[inline]
    fn of(v: f64) -> Self {
        v as f32
    }
    #[inline]
    fn get(self) -> f64 {
        f64::from(self)
    }
}

impl Real for f64 {
    #[inline]
    fn of(v: f64) -> Self {
        v
    }
    #[inline]
    fn get(self) -> f64 {
        self
    }
}

/// How a footprint's weight is kept.
pub trait Weight: Copy + Send + Sync + std::fmt::Debug + 'static {
    /// From f32, rounded to the nearest.
    fn of(v: f32) -> Self;
    /// To f32.
    fn get(self) -> f32;
}

impl Weight for f32 {
    #[inline(always)]
    fn of(v: f32) -> Self {
        v
    }
    #[inline(always)]
    fn get(self) -> f32 {
        self
    }
}

/// A weight in 16 bits: half precision without its sign, which weights do not need. 5 bits of exponent and 11 of mantissa
/// hold 2^-31 to 2 to within 2^-12 of the value; what is smaller becomes 2^-31.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Half(u16);

impl Half {
    /// Bits of f32's mantissa that are dropped.
    const DROPPED: u32 = 12;
    /// 2^-31 as f32.
    const LEAST: u32 = (127 - 31) << 23;
}

impl Weight for Half {
    #[inline(always)]
    fn of(v: f32) -> Self {
        let rounded = (v.max(0.0).to_bits() + (1 << (Self::DROPPED - 1))).saturating_sub(Self::LEAST) >> Self::DROPPED;
        Self(rounded.min(u32::from(u16::MAX)) as u16)
    }
    #[inline(always)]
    fn get(self) -> f32 {
        f32::from_bits(Self::LEAST + (u32::from(self.0) << Self::DROPPED))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_weights_are_near_and_ends_are_held() {
        let mut v = 2f32.powi(-31);
        while v < 1.999 {
            assert!((Half::of(v).get() - v).abs() <= v / 4096.0, "{v}");
            v *= 1.0137;
        }
        for exact in [1.0, 0.5, 0.75, 2f32.powi(-31)] {
            assert_eq!(Half::of(exact).get(), exact);
        }
        assert_eq!((Half::of(0.0).get(), Half::of(-1.0).get()), (2f32.powi(-31), 2f32.powi(-31)));
        assert!(Half::of(9.0).get() < 2.0);
        assert_ne!(Half::of(0.3).get(), 0.3);
    }
}
