//! PLY files in every shape the reader takes, and those it must refuse.

use gs_scene::{Gaussians, PointCloud, ply};
use std::fmt::Display;
use std::path::PathBuf;

/// Numbers that are all different and exact in f32.
fn sample(n: usize, sh_degree: u8) -> Gaussians {
    let k = usize::from(sh_degree + 1).pow(2);
    let value = |i: usize, j: usize| (i * 100 + j) as f32 * 0.125 - 7.0;
    Gaussians {
        means: (0..n).map(|i| [0, 1, 2].map(|j| value(i, j))).collect(),
        log_scales: (0..n).map(|i| [3, 4, 5].map(|j| value(i, j))).collect(),
        rotations: (0..n).map(|i| [6, 7, 8, 9].map(|j| value(i, j))).collect(),
        opacity_logits: (0..n).map(|i| value(i, 10) % 8.0).collect(),
        sh: (0..n).flat_map(|i| (0..3 * k).map(move |j| value(i, 11 + j))).collect(),
        sh_degree,
        ..Gaussians::default()
    }
}

/// Name and value of every property of Gaussian `i`.
fn properties(g: &Gaussians, i: usize) -> Vec<(String, f32)> {
    let k = g.sh_stride() / 3;
    let mut out: Vec<(String, f32)> = Vec::new();
    let mut put = |name: &str, values: &[f32]| {
        out.extend(values.iter().enumerate().map(|(j, v)| (format!("{name}{j}"), *v)));
    };
    put("scale_", &g.log_scales[i]);
    put("rot_", &g.rotations[i]);
    let sh = g.sh_of(i);
    put("f_dc_", &sh[..3]);
    // The file's order: all coefficients of red, then of green, then of blue.
    let rest: Vec<f32> = (0..3).flat_map(|channel| (1..k).map(move |c| sh[3 * c + channel])).collect();
    put("f_rest_", &rest);
    out.push(("opacity".into(), g.opacity_logits[i]));
    out.extend(["x", "y", "z"].iter().zip(g.means[i]).map(|(n, v)| (n.to_string(), v)));
    out
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Ascii,
    Little,
    Big,
}

/// A PLY with properties in reverse order, x y z as doubles, a list among the properties where `list` says so, and
/// another element with a list before the vertices.
fn encode(g: &Gaussians, kind: Kind, list: bool) -> Vec<u8> {
    let format = match kind {
        Kind::Ascii => "ascii",
        Kind::Little => "binary_little_endian",
        Kind::Big => "binary_big_endian",
    };
    let mut out = format!("ply\r\nformat {format} 1.0\ncomment a scene\nobj_info x\nelement camera 2\n").into_bytes();
    out.extend(b"property uchar id\nproperty list uchar int seen\n");
    out.extend(format!("element vertex {}\n", g.len()).bytes());
    let double = |name: &str| ["x", "y", "z"].contains(&name);
    for (name, _) in properties(g, 0).iter().rev() {
        out.extend(format!("property {} {name}\n", if double(name) { "float64" } else { "float" }).bytes());
    }
    if list {
        out.extend(b"property list ushort short tags\n");
    }
    out.extend(b"element face 1\nproperty list uchar int vertex_indices\nend_header\n");
    // A number as text with a blank behind it, or as its bytes, given as they are little-endian.
    let mut put = |text: &dyn Display, bytes: &[u8]| match kind {
        Kind::Ascii => out.extend(format!("{text} ").bytes()),
        Kind::Little => out.extend(bytes),
        Kind::Big => out.extend(bytes.iter().rev()),
    };
    let end = |put: &mut dyn FnMut(&dyn Display, &[u8])| put(&"\n", &[]);
    for camera in [7u8, 8] {
        put(&camera, &[camera]);
        put(&2, &[2]);
        put(&100, &100i32.to_le_bytes());
        put(&-200, &(-200i32).to_le_bytes());
        end(&mut put);
    }
    for i in 0..g.len() {
        for (name, v) in properties(g, i).iter().rev() {
            let bytes = if double(name) { f64::from(*v).to_le_bytes().to_vec() } else { v.to_le_bytes().to_vec() };
            put(v, &bytes);
        }
        if list {
            put(&1, &1u16.to_le_bytes());
            put(&5, &5i16.to_le_bytes());
        }
        end(&mut put);
    }
    put(&3, &[3]);
    [0i32, 1, 1].iter().for_each(|v| put(v, &v.to_le_bytes()));
    out
}

/// Bytes of the face that ends a binary file of [`encode`].
const FACE: usize = 13;

fn file(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    std::fs::write(&path, bytes).unwrap();
    (dir, path)
}

fn read(bytes: &[u8]) -> gs_io::Result<Gaussians> {
    let (_dir, path) = file(bytes);
    ply::read_gaussians(path)
}

fn refuse(bytes: &[u8]) -> String {
    let (_dir, path) = file(bytes);
    let e = ply::read_gaussians(&path).unwrap_err().to_string();
    assert!(e.starts_with(&path.display().to_string()) && !e.contains('\n'), "{e}");
    e
}

#[test]
fn every_encoding_order_and_degree_reads_the_same() {
    for degree in 0..=3 {
        let g = sample(5, degree);
        for kind in [Kind::Ascii, Kind::Little, Kind::Big] {
            for list in [false, true] {
                assert_eq!(read(&encode(&g, kind, list)).unwrap(), g);
            }
        }
    }
}

#[test]
fn the_layout_written_is_that_of_the_original_code() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("g.ply");
    let g = sample(3, 3);
    ply::write_gaussians(&path, &g, &["made by a test".into(), "two\nlines".into()]).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let mut expected =
        String::from("ply\nformat binary_little_endian 1.0\ncomment made by a test\ncomment two lines\n");
    expected += "element vertex 3\n";
    let rest: Vec<String> = (0..45).map(|i| format!("f_rest_{i}")).collect();
    let mut names = vec!["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"];
    names.extend(rest.iter().map(String::as_str));
    names.extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]);
    assert_eq!(names.len(), 62);
    expected.extend(names.iter().map(|n| format!("property float {n}\n")));
    assert_eq!(header, expected + "end_header\n");
    assert_eq!(bytes.len(), end + 3 * 62 * 4);
    let value = |i: usize, name: &str| {
        let at = end + 4 * (62 * i + names.iter().position(|n| *n == name).unwrap());
        f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
    };
    for i in 0..3 {
        for (name, v) in properties(&g, i) {
            assert_eq!(value(i, &name), v, "{name}");
        }
        assert_eq!(value(i, "ny"), 0.0);
    }
    assert_eq!(ply::read_gaussians(&path).unwrap(), g);
}

#[test]
fn points_round_trip_and_colours_of_other_types_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("p.ply");
    let points = PointCloud {
        positions: vec![[1.0, -2.5, 3.25], [0.1, 0.2, 0.3]],
        colors: vec![[0, 128, 255], [1, 2, 3]],
        ..PointCloud::default()
    };
    ply::write_points(&path, &points, &["a".into()]).unwrap();
    assert_eq!(ply::read_points(&path).unwrap(), points);
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    let floats = "property float red\nproperty float green\nproperty float blue\nend_header\n1 2 3 0 0.5 1";
    std::fs::write(&path, format!("{text}{floats}")).unwrap();
    assert_eq!(ply::read_points(&path).unwrap().colors, [[0, 128, 255]]);
    std::fs::write(&path, format!("{text}end_header\n1 2 3\n")).unwrap();
    let white = ply::read_points(&path).unwrap();
    assert_eq!((white.positions, white.colors), (vec![[1.0, 2.0, 3.0]], vec![[255, 255, 255]]));
}

#[test]
fn parameters_must_be_finite_but_opacity_may_be_infinite() {
    let mut g = sample(6, 0);
    g.means[2][1] = f32::NAN;
    g.means[5][0] = f32::INFINITY;
    let e = refuse(&encode(&g, Kind::Little, false));
    assert!(e.contains("vertex 2, x, y, z: a parameter is not finite; found 2 of 6 vertices"), "{e}");
    // As are positions of points; doubles beyond f32 are as bad.
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
    let (_dir, path) = file(format!("{text}0 0 0\n1e300 0 0\n").as_bytes());
    let e = ply::read_points(&path).unwrap_err().to_string();
    assert!(e.contains("vertex 1: a position is not finite") && e.contains("1 of 2 vertices"), "{e}");
    let mut g = sample(4, 1);
    g.opacity_logits[1] = f32::INFINITY;
    g.opacity_logits[3] = f32::NEG_INFINITY;
    let back = read(&encode(&g, Kind::Little, false)).unwrap();
    assert_eq!((back.opacity_logits[1], back.opacity_logits[3]), (50.0, -50.0));
    g.log_scales[3][2] = f32::NEG_INFINITY;
    let e = refuse(&encode(&g, Kind::Big, false));
    assert!(e.contains("vertex 3, scale_*: a parameter is not finite"), "{e}");
    g.log_scales[3][2] = 0.0;
    g.opacity_logits[0] = f32::NAN;
    assert!(refuse(&encode(&g, Kind::Ascii, true)).contains("vertex 0, opacity"));
}

#[test]
fn damage_is_named() {
    let good = encode(&sample(4, 0), Kind::Little, false);
    let text = String::from_utf8_lossy(&good).into_owned();
    let header_end = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let with = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let header = std::str::from_utf8(&good[..header_end]).unwrap().replace(from, to);
        [header.as_bytes(), &good[header_end..]].concat()
    };
    let cases: [(Vec<u8>, &str); 17] = [
        (Vec::new(), "the header does not end"),
        (b"PNG\n".to_vec(), "not a PLY file"),
        (good[..40].to_vec(), "the header does not end"),
        (
            good[..good.len() - FACE - 1].to_vec(),
            "element vertex: the file is cut short or its count lies; found 3 rows, expected 4 rows",
        ),
        (good[..header_end + 5].to_vec(), "element camera"),
        (good[..good.len() - 1].to_vec(), "element face: the file is cut short or its count lies; found 0 rows"),
        ([&good[..], b"\n\0"].concat(), "header: the file goes on after its last element"),
        (
            with("element face 1", "element face 0"),
            "found 13 bytes more, expected the end of the file after element camera 2",
        ),
        (with("element vertex 4", "element vertex 5"), "element vertex: the file is cut short or its count lies"),
        (with("element vertex 4", "element vertex 18446744073709551615"), "element vertex"),
        (with("element vertex 4", "element vertex 99999999999999999999"), "element vertex: not a count"),
        (with("element vertex 4", "element vertex -4"), "element vertex: not a count"),
        (with("element vertex", "element corner"), "the file has no vertices"),
        (with("property float opacity", "property float alpha"), "opacity: the vertices lack a property"),
        (with("property float opacity", "property half opacity"), "unknown type"),
        (with("property float opacity", "property float rot_1"), "a property is named twice"),
        (with("binary_little_endian", "binary_middle_endian"), "unknown format; found binary_middle_endian"),
    ];
    for (bytes, expected) in cases {
        let e = refuse(&bytes);
        assert!(e.contains(expected), "{e}\nlacks {expected}");
    }
    let text = |degree, from: &str, to: &str| {
        let all = String::from_utf8_lossy(&encode(&sample(1, degree), Kind::Ascii, false)).into_owned();
        assert!(all.contains(from), "{from}");
        all.replace(from, to).into_bytes()
    };
    for (degree, from, to, expected) in [
        (1, "f_rest_8", "f_last", "f_rest_*: impossible number of spherical-harmonics properties; found 8"),
        (3, "f_rest_9\n", "other\n", "f_rest_*: impossible number of spherical-harmonics properties; found 44"),
        (3, "f_rest_9\n", "f_rest_45\n", "f_rest_9: the vertices lack a property"),
        (1, "f_rest_8\n", "f_rest_9\n", "f_rest_8: the vertices lack a property"),
        (0, "7 2 100", "7 9999999 100", "element camera: the file is cut short"),
        (0, "7 2 100", "7 2 many", "camera 0: not a number; found many"),
    ] {
        let e = refuse(&text(degree, from, to));
        assert!(e.contains(expected), "{e}\nlacks {expected}");
    }
}

#[test]
fn a_count_smaller_than_the_data_is_refused() {
    let (_dir, path) = file(b"");
    ply::write_gaussians(&path, &sample(4, 0), &[]).unwrap();
    let good = std::fs::read(&path).unwrap();
    let at = good.windows(16).position(|w| w == b"element vertex 4").unwrap() + 15;
    let fewer = [&good[..at], b"3", &good[at + 1..]].concat();
    let e = refuse(&fewer);
    let expected = "found 68 bytes more, expected the end of the file after element vertex 3, as the header says";
    assert!(e.contains(expected), "{e}");
    // Faces are no remains, and an empty line at the end is none either.
    let spaced = [&encode(&sample(4, 0), Kind::Ascii, false)[..], b"\n\r\n"].concat();
    assert_eq!(read(&spaced).unwrap(), sample(4, 0));
    let more = [&spaced[..], b"1 2 3\n"].concat();
    assert!(refuse(&more).contains("the file goes on after its last element"));
}

#[test]
fn colours_keep_to_the_range_of_their_type() {
    let colours = |kind: &str, values: &str| {
        let properties: String = ["red", "green", "blue"].map(|c| format!("property {kind} {c}\n")).concat();
        let xyz = "property float x\nproperty float y\nproperty float z\n";
        let text = format!("ply\nformat ascii 1.0\nelement vertex 2\n{xyz}{properties}end_header\n");
        let (_dir, path) = file(format!("{text}1 2 3 0 0 0\n1 2 3 {values}\n").as_bytes());
        ply::read_points(&path).map(|p| p.colors[1]).map_err(|e| e.to_string())
    };
    assert_eq!(colours("uchar", "9 128 255").unwrap(), [9, 128, 255]);
    assert_eq!(colours("int", "0 1 255").unwrap(), [0, 1, 255]);
    // Floats a little beside their range are arithmetic's.
    assert_eq!(colours("double", "-0.0000001 0.5 1.000001").unwrap(), [0, 128, 255]);
    let e = colours("float", "0.5 200 1").unwrap_err();
    assert!(e.contains("vertex 1, green: a colour is out of range; found 200, expected 0 to 1"), "{e}");
    assert!(colours("ushort", "0 0 65535").unwrap_err().contains("blue: a colour is out of range; found 65535"));
    assert!(colours("float", "nan 0 0").unwrap_err().contains("red: a colour is out of range"));
    assert!(colours("char", "-1 0 0").unwrap_err().contains("expected 0 to 255"));
}

#[test]
fn labels_are_read_beside_positions() {
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                property ushort label\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\
                1 2 3 0\n4 5 6 65535\n3 0 1 1\n";
    let read = |text: &str, property| {
        let (_dir, path) = file(text.as_bytes());
        ply::read_labels(path, property, [0.0; 3]).map_err(|e| e.to_string())
    };
    assert_eq!(read(text, "label").unwrap(), (vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], vec![0, 65535]));
    assert!(read(text, "class").unwrap_err().contains("class: the vertices lack a property"));
    let e = read(&text.replace("ushort", "float").replace("65535", "-1"), "label").unwrap_err();
    assert!(e.contains("vertex 1, label: not a label; found -1"), "{e}");
}

#[test]
fn a_bad_set_of_arrays_does_not_replace_a_good_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("g.ply");
    ply::write_gaussians(&path, &sample(2, 0), &[]).unwrap();
    let before = std::fs::read(&path).unwrap();
    let mut bad = sample(2, 0);
    bad.opacity_logits.pop();
    let e = ply::write_gaussians(&path, &bad, &[]).unwrap_err().to_string();
    assert!(e.contains("opacity_logits: arrays of different lengths; found 1, expected 2"), "{e}");
    assert_eq!(std::fs::read(&path).unwrap(), before);
}
