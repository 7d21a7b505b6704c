//! Pinhole cameras.

use glam::{DMat3, DVec3};

/// An undistorted pinhole camera with its pose. Kept in f64: poses are few, and far-away origins need the digits.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point, x, in pixels from the image's left edge.
    pub cx: f64,
    /// Principal point, y, in pixels from the image's top edge.
    pub cy: f64,
    /// Rotation of the pose: `p_camera = rotation * p_world + translation` (camera from world, OpenCV axes).
    pub rotation: DMat3,
    /// Translation of the pose, in world units.
    pub translation: DVec3,
}

impl Camera {
    /// The camera's centre in the world.
    pub fn position(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The pose in the world, world from camera, in rows.
    pub fn pose(&self) -> [[f64; 4]; 4] {
        let (r, p) = (self.rotation.transpose(), self.position());
        let row = |i: usize| [r.x_axis[i], r.y_axis[i], r.z_axis[i], p[i]];
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }

    /// The same with the camera in OpenGL's axes: x right, y up, looking along -z.
    pub fn opengl_pose(&self) -> [[f64; 4]; 4] {
        self.pose().map(|[x, y, z, w]| [x, -y, -z, w])
    }

    /// A point of the world in camera coordinates.
    pub fn to_camera(&self, world: DVec3) -> DVec3 {
        self.rotation * world + self.translation
    }

    /// Pixel coordinates and depth (camera z) of a point of the world; meaningless when the depth is not positive.
    pub fn project(&self, world: DVec3) -> (f64, f64, f64) {
        let p = self.to_camera(world);
        (self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy, p.z)
    }

    /// Pixel coordinates and depth of a point of the world; none where it is behind the camera or outside of its image.
    pub fn sees(&self, world: DVec3) -> Option<(f64, f64, f64)> {
        let (u, v, z) = self.project(world);
        let inside = (0.0..f64::from(self.width)).contains(&u) && (0.0..f64::from(self.height)).contains(&v);
        (z > 0.0 && inside).then_some((u, v, z))
    }

    /// The same camera with an image of `width` x `height` pixels: focal lengths and principal point scale with each
    /// axis.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, ..*self }
    }

    /// A camera at `eye` that looks at `target`, with `up` pointing up in the image; square pixels and the horizontal
    /// field of view in radians.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3, width: u32, height: u32, fov_x: f64) -> Self {
        let z = (target - eye).normalize_or_zero();
        let x = z.cross(up).normalize_or_zero();
        let y = z.cross(x);
        let rotation = DMat3::from_cols(x, y, z).transpose();
        let f = 0.5 * f64::from(width) / (0.5 * fov_x).tan();
        Self {
            width,
            height,
            fx: f,
            fy: f,
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
            rotation,
            translation: -(rotation * eye),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_centres_the_target_upright() {
        let c = Camera::look_at(DVec3::new(3.0, -2.0, 1.5), DVec3::ZERO, DVec3::Z, 640, 480, 1.0);
        let (u, v, d) = c.project(DVec3::ZERO);
        assert!((u - 320.0).abs() < 1e-9 && (v - 240.0).abs() < 1e-9 && (d - 15.25f64.sqrt()).abs() < 1e-9);
        assert!(c.project(DVec3::new(0.0, 0.0, 0.1)).1 < 240.0, "up is up");
        assert!((c.rotation.determinant() - 1.0).abs() < 1e-12);
        assert!((c.position() - DVec3::new(3.0, -2.0, 1.5)).length() < 1e-12);
    }
}
