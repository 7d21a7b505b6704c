//! Features of pictures that are asked for.

use gs_io::{Error, Result};
use onnx_models::{Bounds, ClipImage, Crop, LabelMap, RgbImage, crop_mask};
use query::{EngineArgs, LabelledScene};
use std::path::{Path, PathBuf};

/// Features of the pictures, padded to a square with black, as masks are shown to CLIP.
pub(super) fn features(
    pictures: &[PathBuf],
    clip: &Path,
    engine: &EngineArgs,
    scene: &LabelledScene,
) -> Result<Vec<Vec<f32>>> {
    // --clip may name text.onnx itself; the image encoder lies beside it.
    let folder = if clip.is_dir() { clip } else { clip.parent().unwrap_or(Path::new("")) };
    let encoder = ClipImage::open(folder, &engine.options())?;
    if encoder.dimension() != scene.instances.dim() {
        return Err(Error::new("the image features are of another model than the masks'")
            .file(scene.path())
            .field("descriptor")
            .found(format!("dimension {}", scene.instances.dim()))
            .expected(encoder.dimension()));
    }
    let one = |path: &PathBuf| {
        let image = gs_scene::Image::read(path)?;
        let (width, height) = (image.width as usize, image.height as usize);
        let picture = RgbImage { width, height, pixels: image.to_rgb8() };
        let ids = vec![0; width * height];
        let map = LabelMap { width, height, ids: &ids };
        let whole = Bounds { x0: 0, y0: 0, x1: width, y1: height };
        Ok(crop_mask(&picture, &map, 0, whole, encoder.size(), Crop::Black, [0; 3]))
    };
    let crops: Vec<Vec<u8>> = pictures.iter().map(one).collect::<Result<_>>()?;
    Ok(encoder.encode(&crops.concat())?.chunks_exact(encoder.dimension()).map(<[f32]>::to_vec).collect())
}
