//! A scene as numbers, to be changed and written out again.

use artifacts::{MaskMaps, maps_path};
use glam::{DMat3, DQuat, DVec3};
use gs_io::{Result, create_dir};
use gs_scene::dataset::{LoadOptions, Resolution, load};
use gs_scene::{Camera, Gaussians, Image, PointCloud, colmap, ply};
use ndarray::Array3;
use std::path::Path;

/// A posed photograph with its masks.
#[derive(Debug, Clone)]
pub struct Shot {
    pub stem: String,
    pub camera: Camera,
    pub image: Image,
    pub masks: MaskMaps,
}

/// Photographs with masks, points and Gaussians.
#[derive(Debug, Clone)]
pub struct World {
    /// By name.
    pub shots: Vec<Shot>,
    pub points: PointCloud,
    /// Gaussians; without harmonics, so that turning the world does not change their colours.
    pub gaussians: Gaussians,
}

impl World {
    /// Reads a scene, its masks and its geometry.
    pub fn read(scene: &Path, masks: &Path, geometry: &Path) -> Result<Self> {
        let dataset = load(scene, &LoadOptions { resolution: Resolution::Divisor(1.0), ..LoadOptions::default() })?;
        let shots = dataset.views.iter().map(|v| {
            let masks = MaskMaps::read(maps_path(masks, v.stem()))?;
            Ok(Shot { stem: v.stem().into(), camera: v.camera.clone(), image: v.load_image()?, masks })
        });
        let shots = shots.collect::<Result<_>>()?;
        Ok(Self { shots, points: dataset.points.clone(), gaussians: ply::read_gaussians(geometry)? })
    }

    /// Writes it as a COLMAP scene with `language_features`, and `geometry.ply` beside `scene`, in a folder.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let scene = folder.join("scene");
        let (images, masks, sparse) = (scene.join("images"), scene.join("language_features"), scene.join("sparse/0"));
        for d in [&images, &masks, &sparse] {
            create_dir(d)?;
        }
        for s in &self.shots {
            s.image.write_png(images.join(format!("{}.png", s.stem)))?;
            s.masks.write(maps_path(&masks, &s.stem))?;
        }
        let views: Vec<(String, Camera)> =
            self.shots.iter().map(|s| (format!("{}.png", s.stem), s.camera.clone())).collect();
        colmap::write_model(&sparse, &views, &self.points)?;
        ply::write_gaussians(folder.join("geometry.ply"), &self.gaussians, &[])
    }

    /// The world scaled by `scale`, then turned, then moved: what the cameras see stays.
    pub fn moved(mut self, scale: f64, turn: DQuat, shift: DVec3) -> Self {
        let place = |p: [f32; 3]| (turn * (DVec3::from(p.map(f64::from)) * scale) + shift).to_array().map(|v| v as f32);
        self.gaussians.means.iter_mut().for_each(|m| *m = place(*m));
        self.points.positions.iter_mut().for_each(|m| *m = place(*m));
        let grown = scale.ln() as f32;
        self.gaussians.log_scales.iter_mut().flatten().for_each(|s| *s += grown);
        for r in &mut self.gaussians.rotations {
            let [w, x, y, z] = r.map(f64::from);
            let q = turn * DQuat::from_xyzw(x, y, z, w);
            *r = [q.w, q.x, q.y, q.z].map(|v| v as f32);
        }
        for s in &mut self.shots {
            // R p + t, times the scale, at p = turn^-1 (p' - shift) / scale.
            let rotation = s.camera.rotation * DMat3::from_quat(turn).transpose();
            s.camera.translation = scale * s.camera.translation - rotation * shift;
            s.camera.rotation = rotation;
        }
        self
    }

    /// Gaussian `order[i]` at place `i`.
    pub fn with_gaussians(mut self, order: &[u32]) -> Self {
        self.gaussians = self.gaussians.select(order);
        self
    }

    /// Masks with other ids: `id` becomes `count - 1 - id`, level by level as before.
    pub fn with_mask_ids_reversed(mut self) -> Self {
        for s in &mut self.shots {
            for mut ids in s.masks.ids.outer_iter_mut() {
                let known = ids.iter().copied().filter(|&i| i >= 0);
                let Some((low, high)) = known.clone().min().zip(known.max()) else { continue };
                ids.iter_mut().filter(|i| **i >= 0).for_each(|i| *i = low + high - *i);
            }
        }
        self
    }

    /// Views under other names, so that their order is the other way round. Held-out views stay the same ones.
    pub fn with_views_reversed(mut self) -> Self {
        let n = self.shots.len();
        for (i, s) in self.shots.iter_mut().enumerate() {
            s.stem = format!("turned_{:05}", n - i);
        }
        self.shots.reverse();
        self
    }

    /// Photographs and masks of twice the width and height.
    pub fn at_twice_the_size(mut self) -> Self {
        for s in &mut self.shots {
            let (w, h) = (s.image.width as usize, s.image.height as usize);
            s.camera = s.camera.resized(2 * w as u32, 2 * h as u32);
            let mut rgb = Vec::with_capacity(12 * w * h);
            for i in 0..4 * w * h {
                let (y, x) = (i / (2 * w) / 2, i % (2 * w) / 2);
                rgb.extend(&s.image.rgb[3 * (y * w + x)..3 * (y * w + x) + 3]);
            }
            s.image = Image { width: 2 * w as u32, height: 2 * h as u32, rgb, alpha: None };
            let shape = (s.masks.levels().len(), 2 * s.masks.height(), 2 * s.masks.width());
            let ids = Array3::from_shape_fn(shape, |(level, y, x)| s.masks.ids[[level, y / 2, x / 2]]);
            s.masks = MaskMaps { ids };
        }
        self
    }

    /// Each Gaussian twice, each with the opacity that makes two of them what one was.
    pub fn with_gaussians_halved(mut self) -> Self {
        let n = self.gaussians.len() as u32;
        let twice: Vec<u32> = (0..n).flat_map(|i| [i, i]).collect();
        self.gaussians = self.gaussians.select(&twice);
        for o in &mut self.gaussians.opacity_logits {
            let alpha = 1.0 / (1.0 + (-f64::from(*o)).exp());
            let half = 1.0 - (1.0 - alpha).sqrt();
            *o = (half / (1.0 - half).max(1e-12)).ln() as f32;
        }
        self
    }
}
