//! What the server does while it is busy.

mod common;

use common::{Run, SIZE, click};
use gs_scene::Image;
use serde_json::{Value, json};

#[test]
fn clicks_are_answered_while_texts_are_encoded() {
    let run = Run::with_slow_words();
    let server = run.serve(&[]);
    std::thread::scope(|scope| {
        let text = scope.spawn(|| server.get("/find?text=mug"));
        for _ in 0..3 {
            assert_eq!(server.json("POST", "/pick", &click(32, 24, &[]))["instance"], json!(0));
            assert!(!text.is_finished(), "a click waited for the text");
        }
        assert_eq!(text.join().unwrap().0, 200);
    });
}

#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "reads /proc")]
fn few_photographs_are_decoded_at_a_time() {
    // Some 75 MB each while it is decoded.
    let (width, height) = (2400u32, 1800u32);
    let run = Run::new();
    let layout = run.scene().join("transforms.json");
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(&layout).unwrap()).unwrap();
    let scale = f64::from(width) / f64::from(SIZE.0);
    ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|f| transforms[f] = json!(transforms[f].as_f64().unwrap() * scale));
    (transforms["w"], transforms["h"]) = (width.into(), height.into());
    let at = |k: usize| format!("images/f{k}.png");
    let rgb = (0..width * height * 3).map(|i| (i % 255) as f32 / 255.0).collect();
    Image { width, height, rgb, alpha: None }.write_png(run.scene().join(at(0))).unwrap();
    let frame = transforms["frames"][0].clone();
    let frames = (0..40).map(|k| {
        if k > 0 {
            let _ = std::fs::remove_file(run.scene().join(at(k)));
            std::fs::hard_link(run.scene().join(at(0)), run.scene().join(at(k))).unwrap();
        }
        json!({"file_path": at(k), "transform_matrix": frame["transform_matrix"]})
    });
    transforms["frames"] = frames.collect();
    std::fs::write(&layout, transforms.to_string()).unwrap();
    run.sign();
    let server = run.serve(&[]);
    let before = server.peak();
    assert_eq!(server.get("/photograph/0").0, 200);
    let one = server.peak() - before;
    std::thread::scope(|scope| {
        let server = &server;
        (0..40).for_each(|k| _ = scope.spawn(move || assert_eq!(server.get(&format!("/photograph/{k}")).0, 200)));
    });
    let all = server.peak() - before;
    eprintln!("one photograph: {one} bytes, forty at once: {all}");
    assert!(one > u64::from(3 * width * height) && all < 4 * one, "one: {one} bytes, forty: {all}");
}
