//! Every format, with good files, damaged ones, and those that once were findings.

use hostile_files::{FORMATS, Format, corpus, findings, format, mutate, run, seeds};
use proptest::prelude::*;

/// Damages the seeds of a format in one way.
fn damage(format: &Format, which: usize, other: usize, seed: u64) {
    let seeds = seeds(format);
    let bytes = mutate(&seeds[which % seeds.len()], &seeds[other % seeds.len()], seed);
    run(format, &bytes);
}

macro_rules! formats {
    ($($name:ident),*) => {
        proptest! {
            $(
                #[test]
                fn $name(which in 0usize..9, other in 0usize..9, seed: u64) {
                    damage(format(stringify!($name)), which, other, seed);
                }
            )*
        }
    };
}
formats!(
    ply, colmap_bin, colmap_txt, transforms, npy, npz, artifact, labels, scannet, spz, sog, dot_splat, gltf, id_png
);

#[test]
fn findings_stay_fixed() {
    let all: Vec<_> = FORMATS.iter().flat_map(|f| findings(f).into_iter().map(move |bytes| run(f, &bytes))).collect();
    assert!(!all.is_empty(), "no findings in testdata");
}

#[test]
fn what_fuzzing_kept_is_withstood() {
    // The formats of splats were added after the last long run of the fuzzer.
    let added = ["spz", "sog", "dot_splat", "gltf"];
    for format in &FORMATS {
        let files = corpus(format);
        assert!(files.len() > 100 || added.contains(&format.name), "{}: {} files", format.name, files.len());
        files.iter().for_each(|bytes| _ = run(format, bytes));
    }
}

#[test]
fn good_files_take_little_memory() {
    for format in &FORMATS {
        for seed in seeds(format) {
            // Files of a kilobyte: what is held are buffers for writing, a megabyte each.
            assert!(run(format, &seed) < 2 << 20, "{}", format.name);
        }
    }
}

#[test]
fn names_that_lead_out_are_refused() {
    let escapes =
        ["../../x.png", "../x.png", "/dev/shm/x.png", "images/../../x.png", "..", ".", "", "images/..", "a/\\..\\x"];
    for name in escapes {
        let images = seeds(format("colmap_bin")).swap_remove(1);
        let at = images.windows(6).position(|w| w == b"0.png\0").unwrap();
        let mut bytes = images;
        bytes.splice(at..at + 5, name.bytes());
        run(format("colmap_bin"), &bytes);
        for kind in ["colmap_txt", "transforms"] {
            for seed in seeds(format(kind)) {
                let text = String::from_utf8(seed).unwrap();
                for good in ["0.png", "./images/0", "points.ply"] {
                    run(format(kind), text.replacen(good, name, 1).as_bytes());
                }
            }
        }
    }
}
