//! Boxes along the axes.

use gs_io::{Error, Result};
use serde::Serialize;
use std::str::FromStr;

/// Corners of a box along the axes, world units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bounds<T = f32> {
    /// Least x, y, z.
    pub low: [T; 3],
    /// Greatest x, y, z.
    pub high: [T; 3],
}

impl Bounds<f64> {
    /// Whether a point less `shift` lies in the box, its faces included.
    pub fn contains(&self, point: [f32; 3], shift: [f64; 3]) -> bool {
        let near = |corner: [f64; 3], c: usize| (corner[c] - shift[c]) as f32;
        (0..3).all(|c| (near(self.low, c)..=near(self.high, c)).contains(&point[c]))
    }
}

impl FromStr for Bounds<f64> {
    type Err = Error;

    /// As a person writes it: `x0,y0,z0,x1,y1,z1`.
    fn from_str(s: &str) -> Result<Self> {
        let wrong = || {
            Error::new("not a box")
                .found(s)
                .expected("x0,y0,z0,x1,y1,z1: six finite numbers, the low corner before the high one")
        };
        let numbers: Vec<f64> =
            s.split(',').map(|v| v.trim().parse()).collect::<std::result::Result<_, _>>().map_err(|_| wrong())?;
        let [x0, y0, z0, x1, y1, z1] = numbers[..] else { return Err(wrong()) };
        let (low, high) = ([x0, y0, z0], [x1, y1, z1]);
        let fits = (0..3).all(|c| low[c].is_finite() && high[c].is_finite() && low[c] <= high[c]);
        if fits { Ok(Self { low, high }) } else { Err(wrong()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_read() {
        assert_eq!(
            "-1,0, 2.5,1,0,3".parse::<Bounds<f64>>().unwrap(),
            Bounds { low: [-1.0, 0.0, 2.5], high: [1.0, 0.0, 3.0] }
        );
        for wrong in ["", "1,2,3", "0,0,0,1,1,-1", "0,0,0,1,1,nan", "0,0,0,1,1,inf", "a,0,0,1,1,1", "0,0,0,1,1,1,1"] {
            assert!(wrong.parse::<Bounds<f64>>().is_err(), "{wrong}");
        }
    }
}
