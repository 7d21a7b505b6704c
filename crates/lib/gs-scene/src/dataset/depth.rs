//! Depth images beside photographs.

use super::View;
use crate::{Camera, decode_image};
use gs_io::{Error, IoContext, Result, npy};
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
        let (mut depth, size) = if self.path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
            self.read_array()?
        } else {
            self.read_picture()?
        };
        let own = |[fx, fy, cx, cy]: [f64; 4]| Camera {
            width: size.0 as u32,
            height: size.1 as u32,
            fx,
            fy,
            cx,
            cy,
            ..view.camera.clone()
        };
        let camera = match self.camera {
            DepthCamera::Pixels(camera) => own(camera),
            DepthCamera::Focal(focal) => {
                let (w, h) = (size.0 as f64, size.1 as f64);
                own([focal * w, focal * w, 0.5 * w, 0.5 * h])
            }
            DepthCamera::Photograph => {
                let (width, height) = view.straighten(&mut depth, size);
                let [shape, expected] = [(width as u32, height as u32), (view.camera.width, view.camera.height)]
                    .map(|(w, h)| f64::from(w) / f64::from(h));
                if !(0.8..1.25).contains(&(shape / expected)) {
                    return Err(Error::new("the depth image has another shape than the photograph")
                        .file(&self.path)
                        .found(format!("{}x{}", size.0, size.1))
                        .expected(format!("{}x{}, or that scaled", view.camera.width, view.camera.height))
                        .hint("export the depths again, or take them out of the dataset"));
                }
                view.camera.resized(width as u32, height as u32)
            }
        };
        Ok(DepthMap { camera, depth })
    }

    /// Depths `[height][width]` in world units, and width and height.
    fn read_picture(&self) -> Result<(Vec<f32>, (usize, usize))> {
        let picture = decode_image(&std::fs::read(&self.path).at("read", &self.path)?, &self.path)?;
        let DynamicImage::ImageLuma16(picture) = picture else {
            return Err(self.wrong(format!("{:?}", picture.color())));
        };
        let value = |p: u16| if p == UNKNOWN { 0.0 } else { (f64::from(p) * self.unit) as f32 };
        let depth = picture.pixels().map(|p| value(p[0])).collect();
        Ok((depth, (picture.width() as usize, picture.height() as usize)))
    }

    /// As [`Self::read_picture`], of NumPy's `[height, width]` or `[height, width, 1]`; what is no distance is not known.
    fn read_array(&self) -> Result<(Vec<f32>, (usize, usize))> {
        let array = npy::read_f32(&self.path)?;
        let shape = array.shape();
        let &[height, width] = shape.strip_suffix(&[1]).filter(|s| s.len() == 2).unwrap_or(shape) else {
            return Err(self.wrong(format!("{shape:?}")));
        };
        if array.is_empty() {
            return Err(self.wrong("nothing".into()));
        }
        let value = |&v: &f32| (f64::from(v) * self.unit) as f32;
        let depth = array.iter().map(value).map(|v| if v > 0.0 && v.is_finite() { v } else { 0.0 }).collect();
        Ok((depth, (width, height)))
    }

    fn wrong(&self, found: String) -> Error {
        Error::new("not a depth image")
            .file(&self.path)
            .found(found)
            .expected("a PNG of 16-bit grey, or npy [height, width]")
            .hint("export the depths again, or take them out of the dataset")
    }
}
