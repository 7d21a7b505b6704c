//! What is up in a scene.

use glam::DVec3;
use gs_io::{Error, Result};
use gs_scene::Camera;
use nalgebra::{Matrix3, SymmetricEigen};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Where it is known from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpSource {
    /// The cameras of the photographs: people hold them level.
    Cameras,
    /// A person said so.
    Given,
}

/// The direction against gravity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Up {
    /// Unit vector in the world.
    pub direction: [f64; 3],
    /// Where it is known from.
    pub from: UpSource,
}

/// Mean up vector of the cameras below which they agree on nothing: they look straight down, or were held anyhow.
const LEAST_AGREEMENT: f64 = 0.2;
/// How much more the second direction of the cameras' right vectors must vary than the third, for the third to be what all
/// of them stand upright to.
const LEAST_TURN: f64 = 10.0;

impl Up {
    /// Up as a person gives it; any length but zero.
    pub fn given(direction: [f64; 3]) -> Option<Self> {
        let unit = DVec3::from(direction).try_normalize()?;
        Some(Self { direction: unit.into(), from: UpSource::Given })
    }

    /// Up by the cameras: what is square to the right side of all of them, since people hold cameras level but tilt them;
    /// where they don't turn enough to tell, their mean up. None where they don't agree.
    pub fn of_cameras<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> Option<Self> {
        let (mut sum, mut rights, mut count) = (DVec3::ZERO, Matrix3::<f64>::zeros(), 0.0f64);
        for camera in cameras {
            let right = camera.rotation.row(0);
            sum -= camera.rotation.row(1);
            let right = nalgebra::Vector3::new(right.x, right.y, right.z);
            rights += right * right.transpose();
            count += 1.0;
        }
        let mean = sum / count.max(1.0);
        if mean.length() < LEAST_AGREEMENT {
            return None;
        }
        let eigen = SymmetricEigen::new(rights / count);
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let [least, second, _] = order.map(|i| eigen.eigenvalues[i].max(1e-6));
        let column = eigen.eigenvectors.column(order[0]);
        let level = DVec3::new(column[0], column[1], column[2]).normalize();
        let up = match second > LEAST_TURN * least {
            true => level * level.dot(mean).signum(),
            false => mean.normalize(),
        };
        Some(Self { direction: up.into(), from: UpSource::Cameras })
    }

    /// The direction.
    pub fn vector(&self) -> DVec3 {
        DVec3::from(self.direction)
    }

    /// Whether the direction is a unit vector.
    pub(crate) fn is_unit(&self) -> bool {
        (self.vector().length() - 1.0).abs() < 1e-6
    }
}

impl FromStr for Up {
    type Err = Error;

    /// `x`, `-y`, `z` and so on, or three numbers: `0,-1,0`.
    fn from_str(text: &str) -> Result<Self> {
        let axis = match text.trim_start_matches(['+', '-']) {
            "x" => Some(DVec3::X),
            "y" => Some(DVec3::Y),
            "z" => Some(DVec3::Z),
            _ => None,
        };
        let signed = axis.filter(|_| text.len() <= 2).map(|a| if text.starts_with('-') { -a } else { a });
        let numbers = || {
            let parts: Vec<f64> = text.split(',').map(|p| p.trim().parse().ok()).collect::<Option<_>>()?;
            <[f64; 3]>::try_from(parts).ok().map(DVec3::from)
        };
        signed.or_else(numbers).filter(|v| v.is_finite()).and_then(|v| Self::given(v.into())).ok_or_else(|| {
            Error::new("not a direction").found(text).expected("x, -x, y, -y, z, -z, or three numbers such as 0,-1,0")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(up: DVec3, degrees: std::ops::Range<i32>) -> Vec<Camera> {
        let side = up.any_orthonormal_vector();
        let eye = |a: i32| {
            let (sin, cos) = f64::from(a).to_radians().sin_cos();
            side * cos * 3.0 + up.cross(side) * sin * 3.0 + up * 2.5
        };
        degrees.step_by(10).map(|a| Camera::look_at(eye(a), DVec3::ZERO, up, 64, 48, 1.0)).collect()
    }

    #[test]
    fn tilted_cameras_of_one_side_still_tell_up() {
        let up = DVec3::new(0.2, -0.9, 0.4).normalize();
        for cameras in [ring(up, 0..360), ring(up, 0..60)] {
            let found = Up::of_cameras(&cameras).unwrap();
            assert!(found.vector().dot(up) > 1.0 - 1e-9, "{found:?}");
            assert_eq!(found.from, UpSource::Cameras);
        }
        // A single camera: its own up.
        let one = &ring(up, 0..10)[..1];
        let own = -one[0].rotation.row(1);
        assert!(Up::of_cameras(one).unwrap().vector().dot(own) > 1.0 - 1e-9);
    }

    #[test]
    fn cameras_that_do_not_agree_tell_nothing() {
        assert_eq!(Up::of_cameras([]), None);
        let both = [ring(DVec3::Z, 0..10), ring(-DVec3::Z, 0..10)].concat();
        assert_eq!(Up::of_cameras(&both), None);
    }

    #[test]
    fn directions_are_read_from_text() {
        let of = |text: &str| text.parse::<Up>().map(|u| u.direction).map_err(|e| e.to_string());
        assert_eq!(of("z"), Ok([0.0, 0.0, 1.0]));
        assert_eq!(of("-y"), Ok([0.0, -1.0, 0.0]));
        assert_eq!(of("0, -3,0"), Ok([0.0, -1.0, 0.0]));
        for bad in ["", "w", "--z", "0,0,0", "1,2", "1,2,3,4", "nan,0,1", "inf,0,0", "1e400,0,0"] {
            assert!(of(bad).unwrap_err().contains("not a direction"), "{bad}");
        }
    }
}
