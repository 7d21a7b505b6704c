//! Depth images beside photographs.

use super::View;
use crate::{Camera, decode_image};
use gs_io::{Error, IoContext, Result};
use image::DynamicImage;
use std::path::PathBuf;

/// World units of a depth image's number, where nothing else is said: nerfstudio, ScanNet and 7-Scenes write millimetres, the world
/// is in metres.
pub(crate) const MILLIMETRES: f64 = 1e-3;

/// Where a Kinect saw nothing; other sensors do not reach so far, and write 0.
const UNKNOWN: u16 = u16::MAX;

/// A depth image of a view.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Depth {
    pub path: PathBuf,
    /// World units of a number.
    pub unit: f64,
    pub camera: DepthCamera,
}

/// The camera of a depth image, which stands where the photograph's does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum DepthCamera {
    /// The photograph's, at another size.
    Photograph,
    /// fx, fy, cx, cy in pixels.
    Pixels([f64; 4]),
    /// The focal length in widths of the image, whose middle the camera looks at.
    Focal(f64),
}

/// How far away things are along the optical axis.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// The pinhole camera of the map, at its size.
    pub camera: Camera,
    /// `[height][width]`, camera z in world units; 0 where it is not known.
    pub depth: Vec<f32>,
}

impl Depth {
    pub(super) fn load(&self, view: &View) -> Result<DepthMap> {
        let picture = decode_image(&std::fs::read(&self.path).at("read", &self.path)?, &self.path)?;
        let DynamicImage::ImageLuma16(picture) = picture else {
            return Err(Error::new("not a depth image")
                .file(&self.path)
                .found(format!("{:?}", picture.color()))
                .expected("a PNG of 16-bit grey")
                .hint("export the depths again, or take them out of the dataset"));
        };
        let (width, height) = picture.dimensions();
        let value = |p: u16| if p == UNKNOWN { 0.0 } else { (f64::from(p) * self.unit) as f32 };
        let mut depth: Vec<f32> = picture.pixels().map(|p| value(p[0])).collect();
        let own = |[fx, fy, cx, cy]: [f64; 4]| Camera { width, height, fx, fy, cx, cy, ..view.camera.clone() };
        let camera = match self.camera {
            DepthCamera::Pixels(camera) => own(camera),
            DepthCamera::Focal(focal) => {
                let (w, h) = (f64::from(width), f64::from(height));
                own([focal * w, focal * w, 0.5 * w, 0.5 * h])
            }
            DepthCamera::Photograph => {
                view.undistort_nearest(&mut depth, width as usize, height as usize);
                view.camera.resized(width, height)
            }
        };
        Ok(DepthMap { camera, depth })
    }
}
