//! The photographs of a scene as 8-bit pictures.

use crate::options::SceneArgs;
use gs_io::{Result, hash_bytes};
use gs_scene::dataset::{self, Dataset, LoadOptions, View};
use onnx_models::RgbImage;
use stage::Stage;

/// Opens the scene and logs its warnings.
pub(crate) fn open(args: &SceneArgs, stage: &Stage) -> Result<Dataset> {
    let options = LoadOptions { resolution: args.resolution, ..LoadOptions::default() };
    let scene = dataset::load(&args.scene, &options)?;
    for warning in &scene.warnings {
        stage.warn(warning);
    }
    Ok(scene)
}

/// Pixels of the largest photograph.
pub(crate) fn largest(views: &[View]) -> u64 {
    views.iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0)
}

/// The photograph of a view, undistorted and at the resolution asked for, and the hash of its pixels.
pub(crate) fn read(view: &View) -> Result<(RgbImage, String)> {
    let image = view.load_image()?;
    let (width, height) = (image.width as usize, image.height as usize);
    let pixels = image.to_rgb8();
    let hash = hash_bytes(&[&image.width.to_le_bytes()[..], &image.height.to_le_bytes()[..], &pixels[..]].concat());
    Ok((RgbImage { width, height, pixels }, hash))
}
