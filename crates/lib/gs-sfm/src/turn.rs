//! Small turns and shifts of cameras.

use glam::{DMat3, DQuat, DVec3};
use gs_scene::Camera;

/// The camera turned and shifted in its own axes, its focal lengths times `exp(zoom)`.
pub fn moved(c: &Camera, turn: DVec3, shift: DVec3, zoom: f64) -> Camera {
    let turn = DQuat::from_scaled_axis(turn);
    let rotation = (turn * DQuat::from_mat3(&c.rotation)).normalize();
    Camera {
        rotation: DMat3::from_quat(rotation),
        translation: turn * c.translation + shift,
        fx: c.fx * zoom.exp(),
        fy: c.fy * zoom.exp(),
        ..c.clone()
    }
}

/// The rotation vector that turns camera axes `from` into `to`, in the camera's axes.
pub fn turned_from(from: &DMat3, to: &DMat3) -> DVec3 {
    let q = DQuat::from_mat3(&(*to * from.transpose())).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    q.to_scaled_axis()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_told() {
        let (c, turn) = (
            Camera::look_at(DVec3::new(1.0, -2.0, 0.5), DVec3::ZERO, DVec3::Z, 64, 48, 1.0),
            DVec3::new(0.1, -0.2, 0.3),
        );
        assert!(turned_from(&c.rotation, &moved(&c, turn, DVec3::ONE, 0.0).rotation).distance(turn) < 1e-12);
        assert!(turned_from(&c.rotation, &c.rotation).length() < 1e-12);
    }
}
