//! Projection and harmonics in single precision, as the renderer uses them.

pub(crate) mod real {
    //! The precision that `project.rs` and `sh.rs` are compiled in.
    use glam::{DMat3, DVec3};
    pub(crate) use glam::{Mat3, Quat, Vec2, Vec3};

    pub(crate) type Real = f32;

    pub(crate) fn narrow(v: DVec3) -> Vec3 {
        v.as_vec3()
    }

    pub(crate) fn narrow_matrix(m: DMat3) -> Mat3 {
        m.as_mat3()
    }

    pub(crate) fn widen(v: Vec3) -> DVec3 {
        v.as_dvec3()
    }
}

#[path = "project.rs"]
pub(crate) mod project;
#[path = "sh.rs"]
mod sh;

use gs_scene::Gaussians;

impl<'a> project::Parameters<'a> {
    /// Those of Gaussian `i`.
    pub fn of(g: &'a Gaussians, i: usize) -> Self {
        Self {
            mean: g.means[i],
            log_scale: g.log_scales[i],
            rotation: g.rotations[i],
            opacity_logit: g.opacity_logits[i],
            sh: g.sh_of(i),
            sh_degree: g.sh_degree,
        }
    }
}
