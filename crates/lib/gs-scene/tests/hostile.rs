//! Damaged files of every kind: an error, never a panic, and no allocation out of proportion to the file.

use glam::DVec3;
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::{Camera, Gaussians, Image, PointCloud, colmap, ply};
use proptest::prelude::*;
use std::alloc::{GlobalAlloc, Layout, System};
use std::fs;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Remembers the largest block that was asked for.
struct Watched;

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator unchanged; the counter is an atomic and allocates nothing.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Relaxed);
        // SAFETY: the caller keeps this function's contract, which is that of the system's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Relaxed);
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Relaxed);
        // SAFETY: as above.
        unsafe { System.realloc(block, layout, size) }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(block, layout) }
    }
}

#[global_allocator]
static WATCHED: Watched = Watched;

/// All files here are of a kilobyte or two; a picture may claim 2,000 pixels of 12 bytes for each byte of its file.
const MOST: usize = 48 << 20;

const FULL: LoadOptions = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };

struct Originals {
    _dir: tempfile::TempDir,
    /// Name and contents; each is damaged in turn.
    plys: Vec<Vec<u8>>,
    pictures: Vec<Vec<u8>>,
    scenes: Vec<(std::path::PathBuf, Vec<&'static str>)>,
}

/// Good files of each kind, made once.
fn originals() -> &'static Originals {
    static MADE: OnceLock<Originals> = OnceLock::new();
    MADE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let g = Gaussians {
            means: vec![[1.0, 2.0, 3.0]; 5],
            log_scales: vec![[-3.0; 3]; 5],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 5],
            opacity_logits: vec![0.5; 5],
            sh: vec![0.25; 5 * 12],
            sh_degree: 1,
        };
        let points = PointCloud { positions: vec![[0.0, 1.0, 2.0]; 6], colors: vec![[9, 8, 7]; 6] };
        ply::write_gaussians(at("g.ply"), &g, &["a comment".into()]).unwrap();
        ply::write_points(at("p.ply"), &points, &[]).unwrap();
        let lists = "ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int i\nelement vertex 2\nproperty float x\n\
                     property list uchar float l\nproperty float y\nproperty float z\nend_header\n3 1 2 3\n1 4\n\
                     0.5 2 1 2 1 2\n1 0 2 3\n";
        let big_lists = [
            &b"ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty list uint double l\nproperty double x\n\
               property short y\nproperty float z\nend_header\n"[..],
            &[0, 0, 0, 1],
            &[0; 8 + 8 + 2 + 4],
            &[0; 4 + 8 + 2 + 4],
        ]
        .concat();
        let plys =
            vec![fs::read(at("g.ply")).unwrap(), fs::read(at("p.ply")).unwrap(), lists.into(), big_lists];

        let photo = Image { width: 20, height: 16, rgb: (0..960).map(|i| i as f32 / 960.0).collect(), alpha: None };
        photo.write_png(at("a.png")).unwrap();
        image::RgbImage::from_raw(20, 16, photo.to_rgb8()).unwrap().save(at("a.jpg")).unwrap();
        let pictures = vec![fs::read(at("a.png")).unwrap(), fs::read(at("a.jpg")).unwrap()];

        let camera = Camera::look_at(DVec3::new(3.0, 1.0, 1.0), DVec3::ZERO, DVec3::Z, 20, 16, 1.0);
        let views: Vec<_> = (0..3).map(|i| (format!("{i}.png"), camera.clone())).collect();
        let put = |path: &str, text: &[u8]| {
            fs::create_dir_all(at(path).parent().unwrap()).unwrap();
            fs::write(at(path), text).unwrap();
        };
        let pose = "0 0 1 2\n1 0 0 3\n0 1 0 4\n0 0 0 1\n";
        colmap::write_model(&at("bin/sparse/0"), &views, &points).unwrap();
        put("txt/sparse/0/cameras.txt", b"# c\n1 OPENCV 20 16 20 20 10 8 0.01 -0.01 0.001 0.001\n");
        put(
            "txt/sparse/0/images.txt",
            b"1 1 0 0 0 0 0 4 1 0.png\n1 2 -1 3 4 7\n2 1 0.1 0 0 0 0 4 1 1.png\n\n3 1 0 0.1 0 0 0 4 1 2.png\n\n",
        );
        put("txt/sparse/0/points3D.txt", b"1 0.5 1 2 9 8 7 0.1 1 2\n2 0.5 1 2 9 8 7 0.1\n");
        let frames: Vec<String> = (0..3)
            .map(|i| {
                format!(
                    "{{\"file_path\": \"./images/{i}\", \"transform_matrix\": \
                     [[0,0,1,2],[1,0,0,3],[0,1,0,4],[0,0,0,1]]}}"
                )
            })
            .collect();
        let json = format!("{{\"camera_angle_x\": 0.8, \"k1\": 0.01, \"frames\": [{}]}}", frames.join(", "));
        put("json/transforms.json", json.as_bytes());
        put("json/points3d.ply", &plys[1]);
        put("scannet/intrinsic/intrinsic_color.txt", b"20 0 10 0\n0 20 8 0\n0 0 1 0\n0 0 0 1\n");
        put("scannet/s_vh_clean_2.ply", &plys[1]);
        for i in 0..3 {
            for folder in ["bin/images", "txt/images", "json/images", "scannet/color"] {
                put(&format!("{folder}/{i}.png"), &pictures[0]);
            }
            put(&format!("scannet/pose/{i}.txt"), pose.as_bytes());
        }
        let scenes = vec![
            (at("bin"), vec!["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"]),
            (at("txt"), vec!["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"]),
            (at("json"), vec!["transforms.json", "points3d.ply", "images/1.png"]),
            (at("scannet"), vec!["intrinsic/intrinsic_color.txt", "pose/1.txt", "s_vh_clean_2.ply", "color/1.png"]),
        ];
        Originals { _dir: dir, plys, pictures, scenes }
    })
}

/// What is done to a file: bytes overwritten, bytes put in, the rest cut off.
#[derive(Debug, Clone)]
struct Damage {
    overwrite: Vec<(usize, u8)>,
    /// Eight bytes of a lying count or number.
    word: Option<(usize, u64)>,
    insert: Option<(usize, Vec<u8>)>,
    cut: Option<usize>,
}

fn damage() -> impl Strategy<Value = Damage> {
    let at = 0usize..1 << 16;
    let words =
        prop::sample::select(vec![0, 1, 255, 1 << 31, 1 << 40, u64::MAX, f64::NAN.to_bits(), f64::INFINITY.to_bits()]);
    let text = prop::sample::select(vec!["-", "9", "99999999999", "nan", " ", "\n", "inf ", "e9", "\"", "[", "\0"]);
    (
        prop::collection::vec((at.clone(), any::<u8>()), 0..4),
        prop::option::of((at.clone(), words)),
        prop::option::of((at.clone(), text.prop_map(|t| t.as_bytes().to_vec()))),
        prop::option::of(at),
    )
        .prop_map(|(overwrite, word, insert, cut)| Damage { overwrite, word, insert, cut })
}

impl Damage {
    fn apply(&self, good: &[u8]) -> Vec<u8> {
        let mut b = good.to_vec();
        let n = b.len();
        for &(at, v) in &self.overwrite {
            b[at % n] = v;
        }
        if let Some((at, v)) = self.word {
            let at = at % n;
            let end = (at + 8).min(n);
            b[at..end].copy_from_slice(&v.to_le_bytes()[..end - at]);
        }
        if let Some((at, bytes)) = &self.insert {
            let at = at % n;
            b.splice(at..at, bytes.iter().copied());
        }
        if let Some(cut) = self.cut {
            b.truncate(cut % n);
        }
        b
    }
}

/// An error is one line that begins with a file; no block was larger than [`MOST`].
fn check<T>(result: gs_io::Result<T>, dir: &Path) -> Result<Option<T>, TestCaseError> {
    let largest = LARGEST.load(Relaxed);
    prop_assert!(largest < MOST, "a block of {largest} bytes");
    match result {
        Ok(v) => Ok(Some(v)),
        Err(e) => {
            let e = e.to_string();
            prop_assert!(e.starts_with(&dir.display().to_string()) && !e.contains('\n'), "{e}");
            Ok(None)
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(600))]

    #[test]
    fn damaged_plys(which in 0usize..4, damage in damage()) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.ply");
        fs::write(&path, damage.apply(&originals().plys[which])).unwrap();
        if let Some(g) = check(ply::read_gaussians(&path), dir.path())? {
            prop_assert!(g.check().is_ok());
            prop_assert!(g.means.iter().flatten().chain(&g.sh).all(|v| v.is_finite()));
        }
        if let Some(p) = check(ply::read_points(&path), dir.path())? {
            prop_assert_eq!(p.positions.len(), p.colors.len());
            prop_assert!(p.positions.iter().flatten().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn damaged_pictures(which in 0usize..2, damage in damage()) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        fs::write(&path, damage.apply(&originals().pictures[which])).unwrap();
        if let Some(i) = check(Image::read(&path), dir.path())? {
            prop_assert_eq!(i.rgb.len(), 3 * i.width as usize * i.height as usize);
        }
    }

    #[test]
    fn damaged_scenes(which in 0usize..4, file in 0usize..12, damage in damage()) {
        let (good, files) = &originals().scenes[which];
        let dir = tempfile::tempdir().unwrap();
        copy(good, dir.path());
        let path = dir.path().join(files[file % files.len()]);
        fs::write(&path, damage.apply(&fs::read(&path).unwrap())).unwrap();
        let loaded = check(dataset::load(dir.path(), &FULL), dir.path())?;
        for view in loaded.iter().flat_map(|d| &d.views) {
            let c = &view.camera;
            prop_assert!(c.rotation.is_finite() && c.translation.is_finite());
            prop_assert!((c.rotation.determinant() - 1.0).abs() < 1e-6);
            prop_assert!([c.fx, c.fy, c.cx, c.cy].iter().all(|v| v.is_finite()));
            if let Some(image) = check(view.load_image(), dir.path())? {
                prop_assert_eq!((image.width, image.height), (c.width, c.height));
                prop_assert!(image.rgb.iter().all(|v| (0.0..=1.0).contains(v)));
            }
        }
    }
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(&path, target).unwrap();
        }
    }
}

#[test]
fn the_originals_are_good() {
    let o = originals();
    for (scene, _) in &o.scenes {
        let d = dataset::load(scene, &FULL).unwrap();
        assert_eq!((d.views.len(), d.warnings.len()), (3, 0), "{}", scene.display());
        assert!(d.points.len() >= 2);
        d.views[2].load_image().unwrap();
    }
    let dir = tempfile::tempdir().unwrap();
    for (i, bytes) in o.plys.iter().enumerate() {
        let path = dir.path().join("a.ply");
        fs::write(&path, bytes).unwrap();
        assert!(ply::read_points(&path).unwrap().len() >= 2);
        assert_eq!(ply::read_gaussians(&path).is_ok(), i == 0);
    }
}

#[test]
fn a_picture_whose_header_lies_is_refused_before_it_is_decoded() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let mut png = originals().pictures[0].clone();
    // Width and height in IHDR, and the chunk's checksum after its 13 bytes.
    png[16..20].copy_from_slice(&16_000u32.to_be_bytes());
    png[20..24].copy_from_slice(&16_000u32.to_be_bytes());
    let crc = crc32(&png[12..29]);
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    fs::write(&path, &png).unwrap();
    let e = Image::read(&path).unwrap_err().to_string();
    assert!(e.contains("size: the picture is too large, or its header lies; found 16000x16000"), "{e}");
}

/// PNG's checksum.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 })
    })
}
