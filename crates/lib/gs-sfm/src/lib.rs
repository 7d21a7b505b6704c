//! What photographs alone say of a scene: where cameras stood, and points to start from.
//!
//! * `corners`: corners that several photographs show are matched, placed, and fitted, with the poses where asked for
//! * `sweep`: a depth for each pixel of small pictures
//! * `turn`: small turns and shifts of cameras
//!
//! Nothing depends on the number of threads.

pub mod corners;
pub mod sweep;
pub mod turn;

use clap::ValueEnum;
use serde::{Serialize, Serializer};

/// Whether poses are refined. In records `off` and `on` are false and true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Refine {
    /// They stay as they are given.
    Off,
    /// Always.
    On,
    /// Where the photographs show that it pays; never for COLMAP's poses with points, which come from the photographs
    Auto,
}

impl Serialize for Refine {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            own => serializer.serialize_bool(*own == Self::On),
        }
    }
}

/// The middle of the values; of an even number the upper one.
fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The solution of a symmetric positive system; none where it is not positive.
pub fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    // Cholesky's factor, in the lower triangle.
    for i in 0..N {
        for j in 0..=i {
            let sum = a[i][j] - (0..j).map(|k| a[i][k] * a[j][k]).sum::<f64>();
            if i == j {
                if sum <= 0.0 || sum.is_nan() {
                    return None;
                }
                a[i][i] = sum.sqrt();
            } else {
                a[i][j] = sum / a[j][j];
            }
        }
    }
    for i in 0..N {
        b[i] = (b[i] - (0..i).map(|k| a[i][k] * b[k]).sum::<f64>()) / a[i][i];
    }
    for i in (0..N).rev() {
        b[i] = (b[i] - (i + 1..N).map(|k| a[k][i] * b[k]).sum::<f64>()) / a[i][i];
    }
    Some(b)
}
