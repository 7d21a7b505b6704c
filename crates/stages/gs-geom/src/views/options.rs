//! The options of `gs-geom views`.

use crate::options::GeometryOptions;
use clap::ValueEnum;
use glam::DVec3;
use gs_io::{Error, Result};
use serde::Serialize;
use stage::within;
use std::path::PathBuf;
use std::str::FromStr;

#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct Views {
    #[command(flatten)]
    #[serde(skip)]
    pub geometry: GeometryOptions,
    /// Folder for the dataset: images/, sparse/0/ (COLMAP) and transforms.json; contact.png, all pictures on one; views.json,
    /// what they cover
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub out: PathBuf,
    /// Most views, 1 to 1000; fewer where every Gaussian that can be seen is in 8 of them
    #[arg(long, value_name = "COUNT", default_value_t = 32, value_parser = within(1usize..=1000))]
    pub views: usize,
    /// Width and height of the pictures in pixels, 16 to 8192 each
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "640x480")]
    pub size: Size,
    /// Horizontal field of view in degrees, 20 to 120
    #[arg(long, value_name = "DEGREES", default_value_t = 60.0, value_parser = within(20.0f64..=120.0))]
    pub fov: f64,
    /// Where cameras stand
    #[arg(long, value_enum, default_value_t = Look::Auto)]
    pub look: Look,
    /// Direction that is up in the pictures, in the world's axes, such as 0,0,1 [from level surfaces, else 0,-1,0]
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub up: Option<Up>,
}

/// Where cameras stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Look {
    /// In the free space of a room, around an object, as the scene is
    Auto,
    /// In the free space of a room
    InsideOut,
    /// Around an object
    OutsideIn,
}

impl Look {
    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::InsideOut => "inside-out",
            Self::OutsideIn => "outside-in",
        }
    }
}

/// Width and height in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size(pub u32, pub u32);

impl FromStr for Size {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let side = |v: &str| v.parse().ok().filter(|v| (16..=8192).contains(v));
        let size = s.split_once('x').and_then(|(w, h)| Some(Self(side(w)?, side(h)?)));
        size.ok_or_else(|| Error::new("not a size").found(s).expected("WIDTHxHEIGHT, 16 to 8192 each, such as 640x480"))
    }
}

impl std::fmt::Display for Size {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.0, self.1)
    }
}

/// A direction, unit length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Up(pub [f64; 3]);

impl FromStr for Up {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let numbers: Vec<f64> = s.split(',').filter_map(|v| v.trim().parse().ok()).collect();
        let given = s.split(',').count();
        let up = match numbers[..] {
            [x, y, z] if given == 3 => DVec3::new(x, y, z).try_normalize(),
            _ => None,
        };
        up.filter(|u| u.is_finite()).map(|u| Self(u.to_array())).ok_or_else(|| {
            Error::new("not a direction").found(s).expected("x,y,z: three finite numbers, not all zero, such as 0,0,1")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_directions_are_read() {
        assert_eq!("640x480".parse::<Size>().unwrap(), Size(640, 480));
        assert_eq!("0,0,-2".parse::<Up>().unwrap().0, [0.0, 0.0, -1.0]);
        for wrong in ["640", "8x8", "640x", "x480", "640x480x3", "9000x100", "-64x64"] {
            assert!(wrong.parse::<Size>().is_err(), "{wrong}");
        }
        for wrong in ["", "0,0,0", "1,2", "1,2,3,4", "a,0,1", "nan,0,1", "inf,0,1"] {
            assert!(wrong.parse::<Up>().is_err(), "{wrong}");
        }
    }
}
