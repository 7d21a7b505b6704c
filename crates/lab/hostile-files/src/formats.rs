//! The formats and what must hold of whatever their readers accept.

use crate::seeds;
use artifacts::{
    Descriptors, Edits, Features, Footprints, Graph, InstanceNames, Instances, MaskFeatures, MaskMaps, TruePoints,
    TrueScene, note_path, read_mask_names,
};
use clap::Parser;
use eval::{read_labels, read_mask, read_truth};
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::{Geometry, Image, PointCloud, ply, splat};
use objects::{Ids, Scene};
use query::{TextSource, TextTable};
use stage::{Program, Stage};
use std::fs;
use std::io::Write;
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

/// A kind of file that the stages read.
pub struct Format {
    /// Its name, which is also that of its fuzz target and of its folder in `testdata/`.
    pub name: &'static str,
    /// Gives the bytes to the readers; panics on a finding.
    pub(crate) check: fn(&[u8]),
    /// Makes the small good files.
    pub(crate) seeds: fn() -> Vec<Vec<u8>>,
    /// Bytes of memory that readers may hold whatever the file's length, and for each of its bytes.
    pub(crate) memory: (usize, usize),
}

/// Buffers, the names of a dataset, and what libraries set up on first use.
const FIXED: usize = 1 << 20;
/// Binary files: their bytes, and their numbers in one or two layouts. An ascii PLY has a float in two bytes.
const BINARY: usize = 24;
/// A JSON value takes 32 bytes and may have two characters in the file; an object of one entry takes 600 and has eight.
const JSON: usize = 200;
/// A picture may claim 2,000 pixels for each byte: it is decoded, then widened to floats.
const PICTURE: usize = 2_000 * 24;

/// All formats.
pub const FORMATS: [Format; 14] = [
    Format { name: "ply", check: check_ply, seeds: seeds::ply, memory: (FIXED, BINARY) },
    Format {
        name: "colmap_bin",
        check: |bytes| check_colmap("colmap_bin", "bin", bytes),
        seeds: seeds::colmap_bin,
        memory: (FIXED, BINARY),
    },
    Format {
        name: "colmap_txt",
        check: |bytes| check_colmap("colmap_txt", "txt", bytes),
        seeds: seeds::colmap_txt,
        memory: (FIXED, BINARY),
    },
    Format { name: "transforms", check: check_transforms, seeds: seeds::transforms, memory: (FIXED, JSON) },
    Format { name: "npy", check: check_npy, seeds: seeds::npy, memory: (FIXED, BINARY) },
    // One array of 16 MiB is believed, then 64 bytes a byte; of one-byte numbers, as floats.
    Format { name: "npz", check: check_npz, seeds: seeds::npz, memory: (7 << 24, JSON + 64 * 5) },
    Format { name: "artifact", check: check_artifact, seeds: seeds::artifact, memory: (FIXED, JSON) },
    // Edits and names of instances, names of masks, scene.json and ids of Gaussians, too. Polygons stand for pictures of the size that the file names; all of a frame have 2^28 pixels at most.
    Format { name: "labels", check: check_labels, seeds: seeds::labels, memory: (FIXED + (1 << 28), JSON) },
    Format { name: "scannet", check: check_scannet, seeds: seeds::scannet, memory: (FIXED, JSON) },
    // Packed: a byte stands for as many as gzip makes of it, and a Gaussian takes 26 times what it has in the file. A window of
    // zstd is believed up to 8 MiB, and held twice.
    Format { name: "spz", check: check_spz, seeds: seeds::spz, memory: (20 * FIXED, 27_000) },
    // 64 Gaussians a byte are believed, in as many pixels of several pictures; the palette of harmonics has 2^20 pixels.
    Format { name: "sog", check: check_sog, seeds: seeds::sog, memory: (64 * FIXED, 64 * 400) },
    Format { name: "dot_splat", check: check_dot_splat, seeds: seeds::dot_splat, memory: (FIXED, BINARY) },
    // A byte may be read as a number, and stand in several vectors.
    Format { name: "gltf", check: check_gltf, seeds: seeds::gltf, memory: (FIXED, 2 * JSON) },
    // Writing takes a buffer of a megabyte for each file.
    Format { name: "id_png", check: check_id_png, seeds: seeds::id_png, memory: (4 * FIXED, PICTURE) },
];

const FULL: LoadOptions = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };

/// A folder of this process with the good files that stand beside a damaged one.
pub(crate) fn folder() -> &'static Path {
    static MADE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let dir = MADE.get_or_init(|| {
        // In memory where the system has such a place.
        let base = Some(PathBuf::from("/dev/shm")).filter(|p| p.is_dir()).unwrap_or_else(std::env::temp_dir);
        let dir = tempfile::Builder::new().prefix("hostile-files.").tempdir_in(base).expect("a temporary folder");
        let at = |name: &str| dir.path().join(name);
        let put = |name: &str, bytes: &[u8]| {
            fs::create_dir_all(at(name).parent().expect("a parent")).expect("a folder");
            fs::write(at(name), bytes).expect("written");
        };
        let photo = seeds::photograph().to_png();
        for scene in ["colmap_bin/images", "colmap_txt/images", "transforms/images", "scannet/color"] {
            for i in 0..3 {
                put(&format!("{scene}/{i}.png"), &photo);
            }
        }
        // What a name that leads out of a scene would find.
        put("x", b"outside");
        put("x.png", &photo);
        for (scene, ext, files) in
            [("colmap_bin", "bin", seeds::colmap_bin()), ("colmap_txt", "txt", seeds::colmap_txt())]
        {
            for (name, bytes) in ["cameras", "images", "points3D"].iter().zip(files) {
                put(&format!("{scene}/sparse/0/{name}.{ext}"), &bytes[1..]);
            }
        }
        put("transforms/points.ply", &seeds::ply()[1]);
        for (name, bytes) in SCANNET.iter().zip(seeds::scannet()) {
            put(name, &bytes[1..]);
        }
        for i in 0..3 {
            put(&format!("scannet/pose/{i}.txt"), &seeds::scannet()[4][1..]);
        }
        for (name, bytes) in SOG.iter().zip(seeds::sog()) {
            put(&format!("sog/{name}"), &bytes[1..]);
        }
        put("labels/one", b"");
        dir
    });
    dir.path()
}

/// Files of a scan, in the order of their seeds.
const SCANNET: [&str; 5] = [
    "scannet/s.segs.json",
    "scannet/s.aggregation.json",
    "scannet/s_vh_clean_2.labels.ply",
    "scannet/intrinsic/intrinsic_color.txt",
    "scannet/pose/1.txt",
];

/// Puts the bytes at a place in the folder for as long as `read` runs; the good file comes back afterwards.
fn with(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    let path = folder().join(name);
    let good = fs::read(&path).ok();
    fs::write(&path, bytes).expect("written");
    read(&path);
    if let Some(good) = good {
        fs::write(&path, good).expect("written");
    }
}

/// An error is one line that names the file; a value is passed on.
fn sound<T>(result: gs_io::Result<T>, inside: &Path) -> Option<T> {
    result
        .map_err(|e| {
            let e = e.to_string();
            let names = e.starts_with(&inside.display().to_string());
            assert!(names && !e.contains(['\n', '\r']), "not one line about {}: {e}", inside.display());
        })
        .ok()
}

fn sound_points(p: &PointCloud) {
    assert_eq!(p.positions.len(), p.colors.len());
    assert!(p.positions.iter().flatten().all(|v| v.is_finite()));
}

fn check_ply(bytes: &[u8]) {
    with("a.ply", bytes, |path| {
        if let Some(g) = sound(ply::read_gaussians(path), path) {
            assert!(g.check().is_ok() && g.means.iter().flatten().chain(&g.sh).all(|v| v.is_finite()));
        }
        if let Some(g) = sound(Geometry::read(path), path) {
            assert!(g.gaussians.means.iter().flatten().all(|v| v.is_finite()));
        }
        sound(ply::read_points(path), path).iter().for_each(sound_points);
        if let Some((vertices, labels)) = sound(ply::read_labels(path, "label", [0.0; 3]), path) {
            assert_eq!(vertices.len(), labels.len());
        }
        sound(ply::is_antialiased(path), path);
        sound(ply::Vertices::read(path), path);
    });
}

/// Gives a file of Gaussians to their readers; errors name something in `inside`.
fn check_splat(path: &Path, inside: &Path) {
    if let Some(read) = sound(splat::read(path), inside) {
        assert!(read.gaussians.check().is_ok());
    }
    if let Some(g) = sound(Geometry::read(path), inside) {
        assert!(g.gaussians.means.iter().flatten().all(|v| v.is_finite()));
    }
    for file in sound(splat::files(path), inside).into_iter().flatten() {
        assert_eq!(file.parent(), path.parent(), "{} leads out", file.display());
    }
    sound(splat::bytes_as_ply(path), inside);
}

fn check_spz(bytes: &[u8]) {
    with("a.spz", bytes, |path| check_splat(path, path));
    // What is in gzip is damaged inside it too.
    if bytes.starts_with(b"NGSP") {
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        packed.write_all(bytes).expect("in memory");
        with("a.spz", &packed.finish().expect("in memory"), |path| check_splat(path, path));
    }
}

fn check_dot_splat(bytes: &[u8]) {
    with("a.splat", bytes, |path| check_splat(path, path));
}

fn check_gltf(bytes: &[u8]) {
    let name = if bytes.starts_with(b"glTF") { "a.glb" } else { "a.gltf" };
    with(name, bytes, |path| check_splat(path, path));
}

/// The files of a SOG, in the order of their seeds; behind them an archive of all.
const SOG: [&str; 9] = ["meta.json", "l.webp", "u.webp", "q.webp", "s.webp", "c.webp", "p.webp", "n.webp", "a.sog"];

fn check_sog(bytes: &[u8]) {
    let files = SOG.map(|name| format!("sog/{name}"));
    check_part(&files, bytes, |path| {
        let folder = folder().join("sog");
        check_splat(&folder.join("meta.json"), &folder);
        if path.ends_with("a.sog") {
            check_splat(path, path);
        }
    });
}

/// Loads a scene; its views must be sound and lie within it.
fn check_scene(root: &Path) {
    let Some(scene) = sound(dataset::load(root, &FULL), root) else { return };
    sound_points(&scene.points);
    for view in &scene.views {
        let c = &view.camera;
        assert!(c.rotation.is_finite() && c.translation.is_finite() && (c.rotation.determinant() - 1.0).abs() < 1e-6);
        assert!([c.fx, c.fy, c.cx, c.cy].iter().all(|v| v.is_finite()));
        let within = view.image_path.strip_prefix(root).expect("a photograph within the scene");
        assert!(!within.components().any(|c| c == Component::ParentDir), "{} leads out", view.image_path.display());
        if let Some(image) = sound(view.load_image(), root) {
            assert_eq!((image.width, image.height), (c.width, c.height));
            assert!(image.rgb.iter().all(|v| (0.0..=1.0).contains(v)));
        }
        // Stages name their files after it.
        let stem = Path::new(view.stem()).components().collect::<Vec<_>>();
        assert!(matches!(stem[..], [Component::Normal(_)]), "{:?} is no file name", view.stem());
        assert!(!view.stem().contains('/'), "{:?} names a folder", view.stem());
    }
}

/// Puts the bytes behind the first, which says which of the files it is.
fn check_part(files: &[String], bytes: &[u8], read: impl FnOnce(&Path)) {
    let Some((&which, bytes)) = bytes.split_first() else { return };
    with(&files[usize::from(which) % files.len()], bytes, read);
}

fn check_colmap(scene: &str, ext: &str, bytes: &[u8]) {
    let files = ["cameras", "images", "points3D"].map(|name| format!("{scene}/sparse/0/{name}.{ext}"));
    check_part(&files, bytes, |_| check_scene(&folder().join(scene)));
}

fn check_transforms(bytes: &[u8]) {
    with("transforms/transforms.json", bytes, |_| check_scene(&folder().join("transforms")));
}

fn check_npy(bytes: &[u8]) {
    with("a_s.npy", bytes, |path| {
        sound(gs_io::npy::read_f32(path), path);
        if let Some(m) = sound(MaskMaps::read(path), path) {
            assert_eq!(m.ids.dim().0, 4);
            // Tables of so many rows are made from it.
            assert!(m.ids.iter().all(|&i| i >= -1) && m.id_count() <= (bytes.len() * 4).max(1 << 16));
        }
        if let Some(f) = sound(MaskFeatures::read(path), path) {
            // A row of that width is made for each instance.
            assert!(f.dim() <= bytes.len().max(1 << 16));
        }
    });
}

fn check_npz(bytes: &[u8]) {
    with("a.npz", bytes, |path| {
        if let Some(table) = sound(TextTable::read(path), path) {
            assert!(TextSource::Table(table).dim() > 0);
        }
    });
}

fn check_artifact(bytes: &[u8]) {
    // With the checksum that fits: what matters here is what readers check beyond it.
    let mut sealed = bytes.to_vec();
    gs_io::artifact::seal(&mut sealed);
    with("a.safetensors", &sealed, |path| {
        sound(Graph::read(path), path);
        sound(Features::read(path), path);
        if let Some((d, _)) = sound(Descriptors::read(path), path) {
            d.row.iter().for_each(|&r| _ = d.of_row(r as usize));
        }
        if let Some(f) = sound(Footprints::read(path), path) {
            (0..f.rows.len()).for_each(|r| _ = f.entries(r));
        }
        if let Some((instances, _)) = sound(Instances::read(path), path) {
            for k in 0..instances.len() {
                _ = instances.descriptor_of(k);
                if let Some(family) = instances.family(k) {
                    family.own.iter().for_each(|&c| _ = instances.gaussians_of_cluster(c));
                    family.parts.iter().for_each(|&c| _ = instances.instances_of_cluster(c));
                }
            }
            instances.cluster_sizes();
        }
        sound(TruePoints::read(path), path);
        sound(TrueScene::read(path), path);
    });
}

fn check_labels(bytes: &[u8]) {
    with("labels/frame_00001.json", bytes, |path| {
        if let Some(edits) = sound(Edits::read(path), path) {
            let (mut instances, means) = (seeds::instances(), [[0.0; 3]; 4]);
            if let Ok(remarks) = edits.apply(&mut instances, &means) {
                assert!(remarks.names.keys().chain(remarks.notes.keys()).all(|&k| instances.count[k as usize] > 0));
                assert!(remarks.metres_per_unit.is_none_or(|m| m.is_finite() && m > 0.0));
            }
        }
        if let Some(scene) = sound(Scene::read(path), path) {
            scene
                .relations
                .iter()
                .for_each(|r| assert!(scene.object(r.subject).is_some() && scene.object(r.object).is_some()));
            assert!(scene.objects.iter().all(|o| o.bounds.corners().as_flattened().iter().all(|v| !v.is_nan())));
        }
        if let Some(names) = sound(InstanceNames::parse(bytes).map_err(|e| e.file(path)), path) {
            assert!(names.named.iter().all(|n| names.best(n.instance).is_some_and(|c| !c.name.is_empty())));
        }
        let masks = path.parent().expect("a folder");
        fs::copy(path, note_path(masks, "a")).expect("a copy");
        if let Some(names) = sound(read_mask_names(masks, "a"), &note_path(masks, "a")) {
            assert!(names.values().all(|mask| !mask.name.is_empty() && mask.score.is_finite()));
        }
        if let Some(ids) = sound(Ids::parse(bytes).map_err(|e| e.file(path)), path) {
            assert!(ids.instance.iter().all(|&i| i >= -1));
        }
        if let Some(frame) = sound(read_labels(path), path) {
            assert_eq!(frame.frame, "frame_00001");
            for (name, mask) in &frame.categories {
                assert_eq!(mask.bits.len(), frame.width as usize * frame.height as usize);
                // Pictures of queries are named so.
                let file = eval::numbered(1, name);
                assert!(!file.is_empty() && !file.contains(['/', '\\', '\0']) && !file.contains(".."), "{file:?}");
            }
        }
    });
}

fn check_scannet(bytes: &[u8]) {
    check_part(&SCANNET.map(String::from), bytes, |path| {
        let [segs, aggregation, labels] = [0, 1, 2].map(|i| folder().join(SCANNET[i]));
        let scan = folder().join("scannet");
        if let Some((vertices, _)) = sound(ply::read_labels(&labels, "label", [0.0; 3]), &scan)
            && let Some(truth) = sound(read_truth(&segs, &aggregation, vertices.len()), &scan)
        {
            assert_eq!(truth.len(), vertices.len());
        }
        sound(ply::read_points(&labels), &scan).iter().for_each(sound_points);
        check_scene(&scan);
        sound(artifacts::MaskTruth::read_all(path), path);
    });
}

fn check_id_png(bytes: &[u8]) {
    let dir = folder().join("pictures");
    fs::create_dir_all(&dir).expect("a folder");
    with("pictures/a.png", bytes, |path| {
        if let Some(i) = sound(Image::read(path), path) {
            assert_eq!(i.rgb.len(), 3 * i.width as usize * i.height as usize);
        }
        sound(read_mask(path), path);
        let out = folder().join("maps");
        let args = ["mask-embed", "import", "--quiet", "--labels"].map(Into::into);
        let args = args.into_iter().chain([dir.clone().into_os_string(), "--out".into(), out.clone().into()]);
        let args = mask_embed::Args::try_parse_from(args).expect("sound arguments");
        if sound(args.run(&Stage::silent("mask-embed")), &dir).is_some() {
            MaskMaps::read(artifacts::maps_path(&out, "a")).expect("a map");
        }
    });
}
