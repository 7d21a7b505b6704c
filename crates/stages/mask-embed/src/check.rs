//! `mask-embed check`: whether the two halves of a CLIP model can be run and fit together.

use crate::options::CheckArgs;
use gs_io::{Error, Result};
use onnx_models::{ClipImage, ClipText};
use stage::Stage;

/// Runs both halves once and says what they are.
pub(crate) fn run(args: &CheckArgs, stage: &Stage) -> Result<()> {
    let (image, text) =
        (ClipImage::open(&args.clip, &args.engine.options())?, ClipText::open(&args.clip, &args.engine.options())?);
    let (pictures, texts) = (image.dimension(), text.dimension());
    if pictures != texts {
        return Err(Error::new("the two halves are of different models: their features have different dimensions")
            .file(&args.clip)
            .found(format!("{pictures} numbers of a picture, {texts} of a text"))
            .expected("the same number"));
    }
    text.check()?;
    let name = if image.config().name.is_empty() { "CLIP" } else { &image.config().name };
    stage.info(&format!("{name}: features of {texts} numbers, pictures of {0}x{0}", image.size()));
    Ok(())
}
