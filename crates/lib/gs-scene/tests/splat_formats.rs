//! Files written by hand, byte by byte, against every reader of splats.

use flate2::Compression;
use flate2::write::GzEncoder;
use gs_scene::Geometry;
use gs_scene::splat::{self, Format, Splat};
use image_webp::{ColorType, WebPEncoder};
use serde_json::json;
use std::fs;
use std::io::Write;
use std::path::PathBuf;

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn put(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, bytes).unwrap();
        path
    }

    fn read(&self, name: &str, bytes: &[u8]) -> Splat {
        splat::read(self.put(name, bytes)).unwrap()
    }

    /// What is said of a damaged file, which begins with its name.
    fn refused(&self, name: &str, bytes: &[u8]) -> String {
        let path = self.put(name, bytes);
        let e = splat::read(&path).unwrap_err().to_string();
        assert!(e.starts_with(&path.display().to_string()) && !e.contains('\n'), "{e}");
        e
    }
}

#[track_caller]
fn near(found: &[f32], wanted: &[f32]) {
    let off = found.iter().zip(wanted).any(|(a, b)| (a - b).abs() > 1e-5 * b.abs().max(1.0) && a != b);
    assert!(found.len() == wanted.len() && !off, "{found:?} is not {wanted:?}");
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn words(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// A compressed PLY of two Gaussians with harmonics of degree 1; `colors`: whether chunks have ranges of colours.
fn compressed(colors: bool) -> Vec<u8> {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\ncomment antialias true\nelement chunk 1\n");
    let groups = [("", "xyz"), ("scale_", "xyz"), ("", "rgb")];
    for (group, axes) in &groups[..if colors { 3 } else { 2 }] {
        for most in ["min", "max"] {
            axes.chars().for_each(|a| header += &format!("property float {most}_{group}{a}\n"));
        }
    }
    header += "element vertex 2\nproperty uint packed_position\nproperty uint packed_rotation\nproperty uint packed_scale\n\
               property uint packed_color\nelement sh 2\n";
    (0..9).for_each(|i| header += &format!("property uchar f_rest_{i}\n"));
    header += "end_header\n";
    let mut ranges = vec![-1.0, -2.0, -3.0, 1.0, 2.0, 3.0, -6.0, -6.0, -6.0, -1.0, -1.0, -1.0];
    if colors {
        ranges.extend([0.0, 0.0, 0.0, 2.0, 1.0, 1.0]);
    }
    let vertices = [
        // At the least of x and z, the most of y; no turn; the largest scale along x; red, 51 of 255 opaque.
        [1023 << 11, 512 << 20 | 512 << 10 | 512, 2047 << 21, 0xff00_0033],
        // The largest part of the rotation is z (3); opaque.
        [2047 << 21 | 1023 << 11 | 2047, 3 << 30 | 1023 << 20, 0, 0x0000_80ff],
    ];
    let sh = [[0u8, 255, 128, 127, 0, 0, 64, 0, 0], [128; 9]];
    [header.into_bytes(), floats(&ranges), words(vertices.as_flattened()), sh.concat()].concat()
}

#[test]
fn a_compressed_ply_is_read() {
    let dir = Folder::new();
    let s = dir.read("a.ply", &compressed(true));
    assert_eq!(
        (s.kind.as_str(), s.antialias, s.gaussians.len(), s.gaussians.sh_degree),
        ("compressed PLY", true, 2, 1)
    );
    let g = &s.gaussians;
    near(g.means.as_flattened(), &[-1.0, 2.0, -3.0, 1.0, 2.0, 3.0]);
    near(g.log_scales.as_flattened(), &[-1.0, -6.0, -6.0, -6.0, -6.0, -6.0]);
    // 512 lies half a step beside the middle of 1023.
    let half = 0.5 / 1023.0 * 2f32.sqrt();
    near(&g.rotations[0], &[1.0, half, half, half]);
    // Parts w, x, y and the largest, z: w is as large as a smaller part can be, x and y as small.
    let most = 0.5f32.sqrt();
    near(&g.rotations[1], &[most, -most, -most, 0.0]);
    near(&[g.opacity(0), g.opacity(1)], &[0.2, 1.0]);
    near(&g.base_color(0), &[2.0, 0.0, 0.0]);
    near(&g.base_color(1), &[0.0, 0.0, 128.0 / 255.0]);
    // By channel in the file: red has bytes 0 to 2. The outermost stand for the ends, the others for the middle of their step.
    let at = |b: f32| ((b + 0.5) / 256.0 - 0.5) * 8.0;
    near(&g.sh_of(0)[3..], &[-4.0, at(127.0), at(64.0), 4.0, -4.0, -4.0, at(128.0), -4.0, -4.0]);
    let plain = dir.read("b.ply", &compressed(false)).gaussians;
    near(&plain.base_color(0), &[1.0, 0.0, 0.0]);
    // Every reader of PLYs takes it.
    assert!(splat::holds_gaussians(dir.0.path().join("a.ply")).unwrap());
    let geometry = Geometry::read(dir.0.path().join("a.ply")).unwrap();
    assert!(geometry.antialias && geometry.gaussians.opacity_logits[1] == 50.0);
    let starved = String::from_utf8_lossy(&compressed(true)).replace("element chunk 1", "element chunk 0");
    assert!(splat::read(dir.put("c.ply", starved.as_bytes())).is_err());
}

/// The kinds of numbers of two Gaussians as an SPZ has them, of versions 2 and 3.
fn spz_parts(version: u32) -> [Vec<u8>; 6] {
    let positions = match version {
        // Halves: 1, -2, 0.5; 0.
        1 => [0x3c00u16, 0xc000, 0x3800, 0, 0, 0].iter().flat_map(|h| h.to_le_bytes()).collect(),
        // 24 bits, 8 of them behind the point: 1, -2, 0.5; the least number there is, 0, the largest.
        _ => vec![0, 1, 0, 0, 0xfe, 0xff, 0x80, 0, 0, 0, 0, 0x80, 0, 0, 0, 0xff, 0xff, 0x7f],
    };
    let rotations = match version {
        // x = 1, w = 0; and x y z as near to 0 as a byte comes.
        1 | 2 => vec![255, 128, 128, 127, 127, 127],
        // The largest is w (3), x y z are 0; the largest is x (0), y = -0.7071, z = w = 0.
        _ => words(&[3 << 30, 1 << 29 | 511 << 20]),
    };
    let sh = vec![128, 0, 192, 255, 128, 128, 128, 128, 64, 128, 128, 128, 128, 128, 128, 128, 128, 128];
    [positions, vec![51, 255], vec![0, 128, 255, 127, 127, 127], vec![160, 0, 255, 96, 96, 96], rotations, sh]
}

fn spz_header(version: u32, count: u32, degree: u8, flags: u8) -> Vec<u8> {
    [b"NGSP".to_vec(), words(&[version, count]), vec![degree, 8, flags, 0]].concat()
}

fn gz(bytes: &[u8]) -> Vec<u8> {
    let mut out = GzEncoder::new(Vec::new(), Compression::fast());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

fn old_spz(version: u32, flags: u8, behind: &[u8]) -> Vec<u8> {
    gz(&[spz_header(version, 2, 1, flags), spz_parts(version).concat(), behind.to_vec()].concat())
}

/// A zstd frame of one block as it is.
fn zstd(bytes: &[u8]) -> Vec<u8> {
    let block = 1 | (bytes.len() as u32) << 3;
    [&[0x28, 0xb5, 0x2f, 0xfd, 0x20, bytes.len() as u8][..], &block.to_le_bytes()[..3], bytes].concat()
}

fn new_spz(extensions: &[u8]) -> Vec<u8> {
    let parts = spz_parts(4);
    let mut header = spz_header(4, 2, 1, if extensions.is_empty() { 0 } else { 2 });
    header[15] = 6;
    header.extend(words(&[32 + extensions.len() as u32, 0, 0, 0]));
    header.extend(extensions);
    let packed = parts.each_ref().map(|p| zstd(p));
    for (packed, part) in packed.iter().zip(&parts) {
        header.extend((packed.len() as u64).to_le_bytes());
        header.extend((part.len() as u64).to_le_bytes());
    }
    [header, packed.concat()].concat()
}

#[test]
fn every_version_of_spz_is_read() {
    let dir = Folder::new();
    for version in 1..=4 {
        let bytes = if version == 4 { new_spz(&[]) } else { old_spz(version, 0, &[]) };
        // Whatever its name is.
        let s = dir.read("a.ply", &bytes);
        let g = &s.gaussians;
        assert_eq!((s.kind, s.antialias, g.len(), g.sh_degree), (format!("SPZ version {version}"), false, 2, 1));
        // Up and back become down and forward.
        near(&g.means[0], &[1.0, 2.0, -0.5]);
        if version > 1 {
            near(&g.means[1], &[-32768.0, 0.0, -32767.996]);
        }
        near(&g.log_scales[0], &[0.0, -10.0, 5.9375]);
        near(&[g.opacity(0), g.opacity(1)], &[0.2, 1.0]);
        near(&g.sh_of(0)[..3], &[-0.5 / 0.15, (128.0 / 255.0 - 0.5) / 0.15, 0.5 / 0.15]);
        // Coefficients y z x of three channels each: y and z change signs.
        near(&g.sh_of(0)[3..], &[0.0, 1.0, -0.5, -127.0 / 128.0, 0.0, 0.0, 0.0, 0.0, -0.5]);
        match version {
            1 | 2 => {
                near(&g.rotations[0], &[0.0, 1.0, -1.0 / 255.0, -1.0 / 255.0]);
                let little = -0.5f32 / 127.5;
                near(&g.rotations[1], &[(1.0 - 3.0 * little * little).sqrt(), little, -little, -little]);
            }
            _ => {
                near(&g.rotations[0], &[1.0, 0.0, 0.0, 0.0]);
                near(&g.rotations[1], &[0.0, 0.5f32.sqrt(), 0.5f32.sqrt(), 0.0]);
            }
        }
    }
    assert!(dir.read("a", &old_spz(2, 1, &[])).antialias);
}

#[test]
fn extensions_of_spz_are_followed_or_named() {
    let dir = Folder::new();
    // Right, down, front: nothing is turned. Behind an extension of somebody else.
    let rdf = words(&[0x1234_0001, 4, 7, 0xADBE_0003, 4, 6]);
    for bytes in [new_spz(&rdf), old_spz(3, 2, &rdf)] {
        let s = dir.read("a.spz", &bytes);
        near(&s.gaussians.means[0], &[1.0, -2.0, 0.5]);
        near(&s.gaussians.sh_of(0)[3..6], &[0.0, -1.0, 0.5]);
        assert_eq!(s.left_out, ["extension 0x12340001 of 4 bytes"]);
        assert!(Geometry::read(dir.0.path().join("a.spz")).unwrap().damage().unwrap().contains("0x12340001"));
    }
    // Right, back, up: z is up, as in Blender.
    let s = dir.read("a.spz", &new_spz(&words(&[0xADBE_0003, 4, 16])));
    near(&s.gaussians.means[0], &[1.0, -0.5, 2.0]);
    assert!(dir.refused("a.spz", &new_spz(&words(&[0xADBE_0003, 4, 17]))).contains("coordinate_system"));
    assert!(dir.refused("a.spz", &new_spz(&words(&[5, 400, 1]))).contains("longer than the extensions"));
    // Degree 4 of the harmonics is walked through.
    let four = [spz_header(3, 1, 4, 0), vec![0; 9], vec![9; 11], vec![192; 72]].concat();
    let s = dir.read("a.spz", &gz(&four));
    assert_eq!((s.gaussians.sh_degree, s.gaussians.sh.len()), (3, 48));
    assert_eq!(s.left_out, ["spherical harmonics of degree 4"]);
}

#[test]
fn damaged_spzs_are_refused_with_field_and_place() {
    let dir = Folder::new();
    let good = new_spz(&[]);
    let with = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        bytes
    };
    for (bytes, wanted) in [
        (with(4, 9), "version, byte 4 of the header: not a value of SPZ; found 9, expected 1 to 4"),
        (with(11, 0xff), "number of points, byte 8 of the header"),
        (with(12, 7), "degree of harmonics, byte 12 of the header"),
        (with(13, 99), "fractional bits, byte 13"),
        (with(15, 5), "number of streams, byte 15 of the file: not a value of SPZ; found 5, expected 6"),
        (with(16, 9), "place of the table of contents, byte 16"),
        (with(40, 3), "unpacked size in the table of contents, byte 40"),
        (with(32, 3), "sizes in the table of contents"),
        (good[..good.len() - 3].to_vec(), "sizes in the table of contents"),
        (with(128, 0), "positions: cannot be unpacked"),
        (gz(&spz_header(3, 2, 1, 0)), "positions, byte 16 of the unpacked data: the file is cut short"),
        (gz(b"something else than an SPZ"), "magic, byte 0"),
        (gz(&[spz_header(4, 0, 0, 0), vec![0; 32]].concat()), "version 4 in gzip"),
        (spz_header(3, 0, 0, 0).repeat(2), "3 without gzip"),
        (good[..20].to_vec(), "header, byte 0 of the unpacked data: the file is cut short"),
    ] {
        let e = dir.refused("a.spz", &bytes);
        assert!(e.contains(wanted), "{e}\n{wanted}");
    }
    // The checksum at the end of gzip counts.
    let mut flipped = old_spz(2, 0, &[]);
    let n = flipped.len();
    flipped[n - 6] ^= 1;
    assert!(dir.refused("a.spz", &flipped).contains("cannot be unpacked"));
}

#[test]
fn a_dot_splat_is_read() {
    let dir = Folder::new();
    let one = [floats(&[1.0, -2.0, 3.0, 0.5, 1.0, 2.0]), vec![255, 0, 51, 51], vec![0, 128, 192, 128]].concat();
    let s = dir.read("a.splat", &[one.clone(), one].concat());
    let g = &s.gaussians;
    assert_eq!((s.kind.as_str(), g.len(), g.sh_degree), (".splat", 2, 0));
    near(&g.means[1], &[1.0, -2.0, 3.0]);
    near(&g.log_scales[1], &[0.5f32.ln(), 0.0, 2f32.ln()]);
    near(&g.base_color(1), &[1.0, 0.0, 0.2]);
    near(&[g.opacity(1)], &[0.2]);
    near(&g.rotations[1], &[-1.0, 0.0, 0.5, 0.0]);
    assert!(dir.refused("b.splat", &[0; 33]).contains("length: not a .splat file; found 33 bytes"));
    // Its first bytes say nothing: without the name nobody knows.
    assert!(dir.refused("b.dat", &[0; 32]).contains("not a file of Gaussians"));
}

fn webp(width: u32, pixels: &[[u8; 4]]) -> Vec<u8> {
    let mut out = Vec::new();
    let height = pixels.len() as u32 / width;
    WebPEncoder::new(&mut out).encode(pixels.as_flattened(), width, height, ColorType::Rgba8).unwrap();
    out
}

/// The pictures of a SOG of two Gaussians with harmonics of degree 1, two pixels wide and high.
fn sog_pictures() -> Vec<(&'static str, Vec<u8>)> {
    let none = [0, 0, 0, 255];
    let mut palette = vec![none; 192];
    // Row 1 of the palette lies behind the three pixels of row 0.
    palette[3..6].copy_from_slice(&[[0, 1, 2, 255], [3, 4, 5, 255], [6, 7, 8, 255]]);
    vec![
        ("l.webp", webp(2, &[[0, 255, 0, 255], [255, 0, 255, 255], none, none])),
        ("u.webp", webp(2, &[[0, 255, 128, 255], [255, 0, 127, 255], none, none])),
        // No turn: w is largest (252). A tag that is none.
        ("q.webp", webp(2, &[[255, 128, 128, 253], [1, 2, 3, 9], none, none])),
        ("s.webp", webp(2, &[[0, 1, 255, 255], [2, 2, 2, 255], none, none])),
        ("c.webp", webp(2, &[[0, 1, 2, 51], [3, 3, 3, 255], none, none])),
        ("p.webp", webp(192, &palette)),
        ("n.webp", webp(2, &[[1, 0, 0, 255], [0, 1, 0, 255], none, none])),
    ]
}

fn sog_meta(version: u32) -> serde_json::Value {
    let table: Vec<f64> = (0..256).map(|i| f64::from(i) * 0.25 - 8.0).collect();
    let means =
        json!({"mins": [-1.0, -1.0, -1.0], "maxs": [1.0, 1.0, 1.0], "files": ["l.webp", "u.webp"], "shape": [2, 3]});
    let quats = json!({"files": ["q.webp"]});
    if version == 2 {
        return json!({"version": 2, "count": 2, "means": means, "quats": quats,
            "scales": {"codebook": table, "files": ["s.webp"]}, "sh0": {"codebook": table, "files": ["c.webp"]},
            "shN": {"count": 2, "bands": 1, "codebook": table, "files": ["p.webp", "n.webp"]}});
    }
    json!({"means": means, "quats": quats,
        "scales": {"mins": [-5.1, 0.0, 0.0], "maxs": [0.0, 255.0, 2.0], "files": ["s.webp"]},
        "sh0": {"mins": [0.0, 0.0, 0.0, -1.0], "maxs": [1.0, 255.0, 510.0, 1.0], "files": ["c.webp"]},
        "shN": {"mins": -127.5, "maxs": 127.5, "files": ["p.webp", "n.webp"]}})
}

fn sog_folder(dir: &Folder, meta: &serde_json::Value) -> PathBuf {
    sog_pictures().iter().for_each(|(name, bytes)| _ = dir.put(&format!("sog/{name}"), bytes));
    dir.put("sog/meta.json", meta.to_string().as_bytes())
}

fn sog_archive(meta: &serde_json::Value, method: zip::CompressionMethod) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in sog_pictures().into_iter().chain([("meta.json", meta.to_string().into_bytes())]) {
        archive.start_file(name, options).unwrap();
        archive.write_all(&bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

#[test]
fn sogs_of_both_versions_are_read_from_folders_and_archives() {
    let dir = Folder::new();
    for version in [1, 2] {
        let meta = sog_folder(&dir, &sog_meta(version));
        let s = splat::read(&meta).unwrap();
        let g = &s.gaussians;
        assert_eq!((s.kind, g.len(), g.sh_degree), (format!("SOG version {version}, unbundled"), 2, 1));
        let e = 1f32.exp_m1();
        // 0x8000 is half a step above the middle.
        near(&g.means[0], &[-e, e, 0.5 / 65535.0 * 2.0]);
        near(&g.means[1], &[e, -e, -0.5 / 65535.0 * 2.0]);
        let little = 0.5f32.sqrt() / 255.0;
        near(&g.rotations[0], &[0.5f32.sqrt(), (0.5 - 2.0 * little * little).sqrt(), little, little]);
        assert!(g.rotations[1][0].is_nan() && !g.is_whole(1), "one damaged Gaussian, and the scene is read");
        if version == 2 {
            near(&g.log_scales[0], &[-8.0, -7.75, 55.75]);
            near(&g.sh_of(0)[..3], &[-8.0, -7.75, -7.5]);
            near(&g.sh_of(0)[3..], &[-8.0, -7.75, -7.5, -7.25, -7.0, -6.75, -6.5, -6.25, -6.0]);
            near(&[g.opacity(0)], &[0.2]);
            assert!(g.sh_of(1)[3..].iter().all(|v| v.is_nan()), "row 256 of the palette is not there");
        } else {
            near(&g.log_scales[0], &[-5.1, 1.0, 2.0]);
            near(&g.sh_of(0)[..3], &[0.0, 1.0, 4.0]);
            near(&g.sh_of(0)[3..], &[-127.5, -126.5, -125.5, -124.5, -123.5, -122.5, -121.5, -120.5, -119.5]);
            near(&[g.opacity_logits[0]], &[-0.6]);
        }
        // The folder, and archives of any name, are the same.
        assert_eq!(splat::read(dir.0.path().join("sog")).unwrap().gaussians.means, g.means);
        for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
            let bundled = dir.read("a.zip", &sog_archive(&sog_meta(version), method));
            assert_eq!(
                (bundled.kind, bundled.gaussians.sh_of(0)),
                (format!("SOG version {version}, bundled"), g.sh_of(0))
            );
            assert_eq!(Geometry::read(dir.0.path().join("a.zip")).unwrap().damaged, [1]);
        }
    }
}

#[test]
fn several_files_have_one_hash_and_are_no_geometry() {
    let dir = Folder::new();
    let meta = sog_folder(&dir, &sog_meta(2));
    let before = splat::hash(&meta).unwrap();
    assert_eq!(splat::files(dir.0.path().join("sog")).unwrap().len(), 8);
    assert_eq!(splat::hash(dir.0.path().join("sog")).unwrap(), before);
    let e = Geometry::read(&meta).unwrap_err().to_string();
    assert!(e.contains("several files") && e.contains("gs-geom convert"), "{e}");
    dir.put("sog/c.webp", &webp(2, &[[9, 9, 9, 9]; 4]));
    assert_ne!(splat::hash(&meta).unwrap(), before);
}

#[test]
fn damaged_sogs_are_refused_with_field() {
    let dir = Folder::new();
    let refused = |key: &[&str], value: serde_json::Value| {
        let mut meta = sog_meta(2);
        *key.iter().fold(&mut meta, |m, k| m.get_mut(*k).unwrap()) = value;
        let path = sog_folder(&dir, &meta);
        splat::read(&path).unwrap_err().to_string()
    };
    for (key, value, wanted) in [
        (&["version"][..], json!(3), "meta.json, version: not a value of SOG; found 3"),
        (&["count"], json!(u64::MAX), "meta.json, count: not a value of SOG; found 18446744073709551615"),
        (&["count"], json!(5), "files[0]: not a value of SOG; found 4 pixels, expected one for each of 5 Gaussians"),
        (&["means", "mins"], json!([1, 2]), "means.mins: not a value of SOG; found a list of 2, expected 3 numbers"),
        (&["sh0", "codebook"], json!([1.0]), "sh0.codebook: not a value of SOG; found a list of 1, expected 256"),
        (&["shN", "bands"], json!(2), "shN.bands"),
        (&["scales", "files"], json!(["../s.webp"]), "not the name of a file in the same folder; found ../s.webp"),
        (&["scales", "files"], json!(["meta.json"]), "not a WebP picture"),
        (&["scales", "files"], json!([]), "scales.files[0]"),
        (&["scales", "files"], json!(["no.webp"]), "no.webp"),
    ] {
        let e = refused(key, value);
        assert!(e.contains(wanted), "{e}\n{wanted}");
    }
    let whole = sog_archive(&sog_meta(2), zip::CompressionMethod::Stored);
    dir.refused("a.sog", &whole[..whole.len() / 2]);
    assert!(dir.refused("meta.json", b"{").contains("not JSON"));
}

/// A glTF of two Gaussians: positions 4 floats apart, opacities as bytes, rotations as shorts.
fn gltf(node: &serde_json::Value, extension: &serde_json::Value) -> (serde_json::Value, Vec<u8>) {
    let shorts = |v: [i16; 4]| v.map(i16::to_le_bytes).concat();
    let parts = [
        floats(&[1.0, 2.0, 3.0, f32::NAN, 0.0, 0.0, 1.0, f32::NAN]),
        floats(&[1.0, 0.5, 0.25, 1.0, 1.0, 1.0]),
        [shorts([0, 0, 0, i16::MAX]), shorts([0, i16::MIN, 0, 0])].concat(),
        vec![51, 255, 0, 0],
        floats(&[0.1, 0.2, 0.3, 0.0, 0.0, 0.0]),
        floats(&[1.0, 2.0, 3.0, 0.0, 0.0, 0.0]),
        floats(&[4.0, 5.0, 6.0, 0.0, 0.0, 0.0]),
        floats(&[7.0, 8.0, 9.0, 0.0, 0.0, 0.0]),
    ];
    let (mut views, mut at) = (Vec::new(), 0);
    for part in &parts {
        views.push(json!({"buffer": 0, "byteOffset": at, "byteLength": part.len()}));
        at += part.len();
    }
    views[0]["byteStride"] = 16.into();
    let accessor = |view: usize, kind: &str, component: u32| json!({"bufferView": view, "componentType": component, "count": 2, "type": kind, "normalized": component != 5126});
    let accessors = [(0, "VEC3", 5126), (1, "VEC3", 5126), (2, "VEC4", 5122), (3, "SCALAR", 5121)];
    let mut accessors: Vec<_> = accessors.iter().map(|(v, k, c)| accessor(*v, k, *c)).collect();
    accessors.extend((4..8).map(|v| accessor(v, "VEC3", 5126)));
    let name = |s: &str| format!("KHR_gaussian_splatting:{s}");
    let attributes = json!({
        "POSITION": 0, name("SCALE"): 1, name("ROTATION"): 2, name("OPACITY"): 3, name("SH_DEGREE_0_COEF_0"): 4,
        name("SH_DEGREE_1_COEF_0"): 5, name("SH_DEGREE_1_COEF_1"): 6, name("SH_DEGREE_1_COEF_2"): 7,
    });
    let primitive = json!({"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": extension}});
    let description = json!({
        "asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"children": [1]}, node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}, primitive]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": at}],
    });
    (description, parts.concat())
}

fn glb(description: &serde_json::Value, binary: &[u8]) -> Vec<u8> {
    let mut text = description.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 28 + text.len() + binary.len();
    [
        &b"glTF"[..],
        &2u32.to_le_bytes(),
        &(total as u32).to_le_bytes(),
        &(text.len() as u32).to_le_bytes(),
        b"JSON",
        &text,
        &(binary.len() as u32).to_le_bytes(),
        b"BIN\0",
        binary,
    ]
    .concat()
}

fn ellipse() -> serde_json::Value {
    json!({"kernel": "ellipse", "colorSpace": "srgb_rec709_display"})
}

#[test]
fn a_gltf_is_read_with_its_nodes() {
    let dir = Folder::new();
    let (description, binary) = gltf(&json!({"mesh": 0}), &ellipse());
    let s = dir.read("a.glb", &glb(&description, &binary));
    let g = &s.gaussians;
    assert_eq!((s.kind.as_str(), g.len(), g.sh_degree), ("glTF 2.0 with KHR_gaussian_splatting", 2, 1));
    assert!(s.left_out.is_empty());
    // Left and up become right and down.
    near(g.means.as_flattened(), &[-1.0, -2.0, 3.0, 0.0, 0.0, 1.0]);
    near(&g.log_scales[0], &[0.0, 0.5f32.ln(), 0.25f32.ln()]);
    near(&g.rotations[0], &[1.0, 0.0, 0.0, 0.0]);
    near(&g.rotations[1], &[0.0, 0.0, 1.0, 0.0]);
    near(&[g.opacity(0), g.opacity(1)], &[0.2, 1.0]);
    // Coefficients y z x: y and x change signs.
    near(g.sh_of(0), &[0.1, 0.2, 0.3, -1.0, -2.0, -3.0, 4.0, 5.0, 6.0, -7.0, -8.0, -9.0]);

    // A quarter turn from x to y, twice as large, one up.
    let half = 0.5f64.sqrt();
    let node = json!({"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 2, 2], "translation": [0, 1, 0]});
    let linear = json!({"kernel": "ellipse", "colorSpace": "lin_rec709_display"});
    let (description, binary) = gltf(&node, &linear);
    let s = dir.read("a.glb", &glb(&description, &binary));
    let g = &s.gaussians;
    // (1, 2, 3) turns to (-2, 1, 3), grows to (-4, 2, 6), rises to (-4, 3, 6), and is (4, -3, 6) in our axes.
    near(&g.means[0], &[4.0, -3.0, 6.0]);
    near(&g.log_scales[0], &[2f32.ln(), 0.0, 0.5f32.ln()]);
    // -y z -x of the old axes: red along them 1, 4, 7. Old x is new y, old y is new -x; then both change signs.
    near(&g.sh_of(0)[3..], &[-7.0, -8.0, -9.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0]);
    assert!(s.left_out[0].contains("lin_rec709_display"), "{:?}", s.left_out);

    // As text, with its buffer beside it or in it.
    let (mut description, binary) = gltf(&json!({"mesh": 0}), &ellipse());
    dir.put("b.bin", &binary);
    description["buffers"][0]["uri"] = "b.bin".into();
    let path = dir.put("b.gltf", description.to_string().as_bytes());
    near(&splat::read(&path).unwrap().gaussians.means[0], &[-1.0, -2.0, 3.0]);
    assert_eq!((Format::of_file(&path).unwrap(), splat::files(&path).unwrap().len()), (Format::Gltf, 2));
    assert!(Geometry::read(&path).unwrap_err().to_string().contains("several files"));
    description["buffers"][0]["uri"] = "data:application/octet-stream;base64,AAAA".into();
    assert!(dir.refused("c.gltf", description.to_string().as_bytes()).contains("do not lie in its buffer"));
}

#[test]
fn damaged_gltfs_are_refused_with_field() {
    let dir = Folder::new();
    let (good, binary) = gltf(&json!({"mesh": 0}), &ellipse());
    let mut cases = Vec::new();
    let mut case = |pointer: &str, value: serde_json::Value, wanted: &'static str| {
        let mut damaged = good.clone();
        *damaged.pointer_mut(pointer).unwrap() = value;
        cases.push((glb(&damaged, &binary), wanted));
    };
    case("/nodes/1", json!({"mesh": 0, "scale": [1, 2, 1]}), "one scale for all axes");
    case("/nodes/1", json!({"children": [0]}), "its own child");
    case("/nodes/1", json!({"mesh": 0, "matrix": [1]}), "nodes[1]: matrix is not 16 numbers");
    case("/accessors/0/count", json!(3), "POSITION, accessors[0]: its numbers do not lie in its buffer");
    case("/accessors/0/count", json!(u64::MAX), "accessors[0]");
    case("/accessors/1/type", json!("VEC2"), "found 2, expected 3");
    case("/accessors/3/count", json!(1), "OPACITY: not a value for each position; found 1, expected 2");
    case("/accessors/2/componentType", json!(5125), "ROTATION, accessors[2]: unknown component type");
    case("/bufferViews/4/byteOffset", json!(1u64 << 40), "accessors[4]");
    case("/meshes/0/primitives/1/attributes/POSITION", json!("x"), "POSITION: no such attribute");
    case("/meshes/0/primitives/1/extensions", json!({}), "no primitive with Gaussians");
    let spz = json!({"KHR_gaussian_splatting": {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}});
    case("/meshes/0/primitives/1/extensions", spz, "KHR_gaussian_splatting_compression_spz_2");
    let whole = glb(&good, &binary);
    cases.push((whole[..whole.len() - 9].to_vec(), "length of a chunk"));
    cases.push((whole[..7].to_vec(), "version"));
    for (bytes, wanted) in cases {
        let e = dir.refused("a.glb", &bytes);
        assert!(e.contains(wanted), "{e}\n{wanted}");
    }
    let e =
        dir.refused("a.gltf", good.to_string().replace("\"byteLength\"", "\"uri\":\"../x\",\"byteLength\"").as_bytes());
    assert!(e.contains("not the name of a file"), "{e}");
}
