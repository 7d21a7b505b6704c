//! MobileSAM on a photograph.

use mask_embed::nms::Pixels;
use mask_embed::sam::Sam;
use onnx_models::{EngineOptions, RgbImage};
use std::path::Path;

#[test]
#[ignore = "needs ../shared/data/desk and the models of make models; run make test-data"]
fn laptop_kettle_and_plush_are_three_wholes() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
    let photo = root.join("../shared/data/desk/images/input_0001.jpg");
    let models = root.join("models");
    let photo = image::open(photo).unwrap().to_rgb8();
    let photo = RgbImage { width: photo.width() as usize, height: photo.height() as usize, pixels: photo.into_raw() };
    let sam = Sam::open(models, &EngineOptions::default(), false).unwrap();
    let embedded = sam.encode(&photo).unwrap();
    assert_eq!(embedded.frame, [1024, 575]);
    // A point on the keyboard, the kettle, the plush's side; the last of three masks is the whole thing. Areas in
    // pixels of a 256-wide picture.
    let whole =
        [([0.5, 0.522], 2600..3100), ([0.245, 0.522], 400..620), ([0.781, 0.522], 1300..1800)].map(|(p, area)| {
            let answer = sam.decode(&embedded, p, 0.0).unwrap();
            assert_eq!(answer.masks.len(), 3);
            let whole = answer.logits.chunks_exact(Sam::MASK_SIDE * Sam::MASK_SIDE).nth(2).unwrap();
            let mask = Pixels::new(Sam::MASK_SIDE, whole.iter().map(|&l| l > 0.0));
            assert!(answer.masks[2].1 > 0.75 && area.contains(&mask.area), "{p:?}: {} {:?}", mask.area, answer.masks);
            mask
        });
    for (i, a) in whole.iter().enumerate() {
        assert!(whole[..i].iter().all(|b| a.overlap(b) < 30));
    }
}
