//! What all stages read: [`Gaussians`] and their [`ply`] files, [`points`], [`Camera`]s, [`dataset`]s of posed photographs, images.
//!
//! Conventions, once for the whole workspace:
//! * World and camera coordinates are right-handed; cameras look along +z with x right and y down (OpenCV, COLMAP).
//! * A pixel's centre lies at +0.5: pixel (0, 0) covers [0, 1) x [0, 1) and `cx, cy` are in that frame.
//! * Quaternions are stored w x y z and need not be normalised; scales are stored as logarithms, opacities as logits.
//! * Transforms are named `target_from_source`: `camera_from_world * p_world = p_camera`.

mod camera;
pub mod dataset;
mod gaussians;
mod geometry;
pub mod harmonics;
mod holdout;
mod image;
mod labelled;
mod lens;
mod middle;
mod order;
pub mod ply;
pub mod points;
pub mod splat;

pub use camera::Camera;
pub use dataset::colmap;
pub use gaussians::{Gaussians, SH_C0, logit, sh_coefficients};
pub use geometry::Geometry;
pub use holdout::{HoldOut, Learnt};
pub use image::{Image, decode as decode_image, has_alpha as image_has_alpha, size_of as image_size, size_within};
pub use labelled::Labelled;
pub use middle::{middle, say as say_shift};
pub use order::morton_order;
pub use ply::PointCloud;
