//! The same projection and harmonics in double precision: in single precision, central differences could not tell a wrong
//! gradient from rounding.

pub(crate) mod real {
    //! The precision that `project.rs` and `sh.rs` are compiled in.
    pub(crate) use glam::{DMat3 as Mat3, DQuat as Quat, DVec2 as Vec2, DVec3 as Vec3};

    pub(crate) type Real = f64;

    pub(crate) fn narrow(v: Vec3) -> Vec3 {
        v
    }

    pub(crate) fn narrow_matrix(m: Mat3) -> Mat3 {
        m
    }

    pub(crate) fn widen(v: Vec3) -> Vec3 {
        v
    }
}

#[path = "project.rs"]
pub(crate) mod project;
#[path = "sh.rs"]
mod sh;
