//! Boxes along the axes.

use gs_io::{Error, Result};
use serde::Serialize;
use std::str::FromStr;

/// Corners of a box along the axes, world units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bounds {
    /// Least x, y, z.
    pub low: [f32; 3],
    /// Greatest x, y, z.
    pub high: [f32; 3],
}

impl Bounds {
    /// Whether a point lies in the box, its faces included.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        (0..3).all(|c| (self.low[c]..=self.high[c]).contains(&point[c]))
    }
}

impl FromStr for Bounds {
    type Err = Error;

    /// As a person writes it: `x0,y0,z0,x1,y1,z1`.
    fn from_str(s: &str) -> Result<Self> {
        let wrong = || {
            Error::new("not a box")
                .found(s)
                .expected("x0,y0,z0,x1,y1,z1: six finite numbers, the low corner before the high one")
        };
        let numbers: Vec<f32> =
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
            "-1,0, 2.5,1,0,3".parse::<Bounds>().unwrap(),
            Bounds { low: [-1.0, 0.0, 2.5], high: [1.0, 0.0, 3.0] }
        );
        for wrong in ["", "1,2,3", "0,0,0,1,1,-1", "0,0,0,1,1,nan", "0,0,0,1,1,inf", "a,0,0,1,1,1", "0,0,0,1,1,1,1"] {
            assert!(wrong.parse::<Bounds>().is_err(), "{wrong}");
        }
    }
}
