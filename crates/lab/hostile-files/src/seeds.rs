//! Small good files of each format, from which damaged ones are made.

use artifacts::{
    Descriptors, Features, FootprintsBuilder, Granule, Graph, Instances, MaskFeatures, MaskMaps, Match, Members,
    OrientedBox, Row, TreeEdge, TruePoints,
};
use gs_io::Provenance;
use gs_scene::splat::{self, Extra, Format as SplatFormat};
use gs_scene::{Camera, Gaussians, Image, PointCloud, colmap, ply};
use ndarray::{Array2, Array3, ArrayView, arr2};
use std::fs;
use std::io::Write;
use std::path::Path;

fn made(name: &str, write: impl FnOnce(&Path)) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join(name);
    write(&path);
    fs::read(&path).expect("it was just written")
}

/// A text picture of a scene's photograph.
pub(crate) fn photograph() -> Image {
    Image { width: 20, height: 16, rgb: (0..960).map(|i| i as f32 / 960.0).collect(), alpha: None }
}

fn points() -> PointCloud {
    PointCloud { positions: vec![[0.0, 1.0, 2.0]; 6], colors: vec![[9, 8, 7]; 6], ..PointCloud::default() }
}

fn gaussians() -> Gaussians {
    Gaussians {
        means: vec![[1.0, 2.0, 3.0]; 5],
        log_scales: vec![[-3.0; 3]; 5],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; 5],
        opacity_logits: vec![0.5; 5],
        sh: vec![0.25; 5 * 12],
        sh_degree: 1,
        ..Gaussians::default()
    }
}

fn splat(format: SplatFormat) -> Vec<u8> {
    splat::encode(format, &gaussians(), &Extra::default()).expect("written")
}

/// Of version 3 as it is; of versions 1 to 3 before they are packed; of version 4, with an extension.
pub(crate) fn spz() -> Vec<Vec<u8>> {
    let header = |version: u8, degree: u8, flags: u8| {
        [&b"NGSP"[..], &[version, 0, 0, 0, 2, 0, 0, 0, degree, 12, flags, 0]].concat()
    };
    let extension = [0x03, 0x00, 0xbe, 0xad, 4, 0, 0, 0, 6, 0, 0, 0];
    let mut new = header(4, 0, 2);
    new[15] = 5;
    new.extend([32 + 12, 0, 0, 0]);
    new.extend([0; 12]);
    new.extend(extension);
    // Frames of zstd of one block as it is.
    let sizes = [18u8, 2, 6, 6, 8];
    sizes.iter().for_each(|s| new.extend([9 + s, 0, 0, 0, 0, 0, 0, 0, *s, 0, 0, 0, 0, 0, 0, 0]));
    for size in sizes {
        new.extend([0x28, 0xb5, 0x2f, 0xfd, 0x20, size, 1 | size << 3, size >> 5, 0]);
        new.extend(vec![7; usize::from(size)]);
    }
    vec![
        splat(SplatFormat::Spz),
        [header(1, 1, 0), vec![9; 12 + 2 + 6 + 6 + 6 + 18]].concat(),
        [header(2, 4, 1), vec![9; 18 + 2 + 6 + 6 + 6 + 144]].concat(),
        [header(3, 3, 2), vec![9; 18 + 2 + 6 + 6 + 8 + 90], extension.to_vec()].concat(),
        new,
    ]
}

/// A file of a SOG behind a byte that says which.
pub(crate) fn sog() -> Vec<Vec<u8>> {
    let picture = |width: u32| {
        let pixels: Vec<u8> = (0..8 * width).flat_map(|i| [i as u8 % 2, 0, 3, 252 + i as u8 % 4]).collect();
        let mut bytes = Vec::new();
        let encoder = image_webp::WebPEncoder::new(&mut bytes);
        encoder.encode(&pixels, width, 8, image_webp::ColorType::Rgba8).expect("written");
        bytes
    };
    let table = format!("[{}1]", "0.5,".repeat(255));
    let meta = format!(
        r#"{{"version":2,"count":50,"means":{{"mins":[-1,-1,-1],"maxs":[1,1,1],"files":["l.webp","u.webp"]}},
"scales":{{"codebook":{table},"files":["s.webp"]}},"quats":{{"files":["q.webp"]}},"sh0":{{"codebook":{table},"files":["c.webp"]}},
"shN":{{"count":64,"bands":1,"codebook":{table},"files":["p.webp","n.webp"]}}}}"#
    );
    let mut parts = vec![meta.into_bytes()];
    parts.extend([8, 8, 8, 8, 8, 192, 8].map(picture));
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let names = ["meta.json", "l.webp", "u.webp", "q.webp", "s.webp", "c.webp", "p.webp", "n.webp"];
    for (name, bytes) in names.iter().zip(&parts) {
        archive.start_file(*name, zip::write::SimpleFileOptions::default()).expect("begun");
        archive.write_all(bytes).expect("written");
    }
    parts.push(archive.finish().expect("finished").into_inner());
    parts.into_iter().zip(0u8..).map(|(bytes, i)| [vec![i], bytes].concat()).collect()
}

pub(crate) fn dot_splat() -> Vec<Vec<u8>> {
    vec![splat(SplatFormat::Splat)]
}

pub(crate) fn gltf() -> Vec<Vec<u8>> {
    let glb = splat(SplatFormat::Gltf);
    // The same as text, of its nodes and with nothing in its buffer.
    let length = u32::from_le_bytes([glb[12], glb[13], glb[14], glb[15]]) as usize;
    let text = String::from_utf8_lossy(&glb[20..20 + length])
        .replace(r#"{"byteLength""#, r#"{"uri":"data:;base64,AAAA","byteLength""#);
    let node = r#""nodes":[{"mesh":0,"rotation":[0,0,0.6,0.8],"scale":[2,2,2]}]"#;
    vec![glb, text.replace(r#""nodes":[{"mesh":0}]"#, node).into_bytes()]
}

pub(crate) fn ply() -> Vec<Vec<u8>> {
    let g = gaussians();
    let lists = "ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int i\nelement vertex 2\nproperty float x\n\
                 property list uchar float l\nproperty float y\nproperty float z\nproperty ushort label\nend_header\n\
                 3 1 2 3\n1 4\n0.5 2 1 2 1 2 5\n1 0 2 3 6\n";
    let big = [
        &b"ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty list uint double l\nproperty double x\n\
           property short y\nproperty float z\nend_header\n"[..],
        &[0, 0, 0, 1],
        &[0; 8 + 8 + 2 + 4],
        &[0; 4 + 8 + 2 + 4],
    ];
    vec![
        made("a.ply", |p| ply::write_gaussians(p, &g, &["a comment".into()]).expect("written")),
        made("a.ply", |p| ply::write_points(p, &points(), &[]).expect("written")),
        lists.into(),
        big.concat(),
        splat(SplatFormat::CompressedPly),
    ]
}

/// A file of a COLMAP model behind a byte that says which of the three it is.
pub(crate) fn colmap_bin() -> Vec<Vec<u8>> {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let eye = glam::DVec3::new(3.0, 1.0, 1.0);
    let camera = Camera::look_at(eye, glam::DVec3::ZERO, glam::DVec3::Z, 20, 16, 1.0);
    let views: Vec<_> = (0..3).map(|i| (format!("{i}.png"), camera.clone())).collect();
    colmap::write_model(dir.path(), &views, &points()).expect("written");
    let part = |i: u8, name: &str| [vec![i], fs::read(dir.path().join(name)).expect("it was just written")].concat();
    vec![part(0, "cameras.bin"), part(1, "images.bin"), part(2, "points3D.bin")]
}

pub(crate) fn colmap_txt() -> Vec<Vec<u8>> {
    let parts = [
        "# c\n1 OPENCV 20 16 20 20 10 8 0.01 -0.01 0.001 0.001\n2 SIMPLE_RADIAL 20 16 20 10 8 0.01\n",
        "1 1 0 0 0 0 0 4 1 0.png\n1 2 -1 3 4 7\n2 1 0.1 0 0 0 0 4 1 1.png\n\n3 1 0 0.1 0 0 0 4 1 2.png\n\n",
        "1 0.5 1 2 9 8 7 0.1 1 2\n2 0.5 1 2 9 8 7 0.1\n",
    ];
    parts.iter().zip(0u8..).map(|(text, i)| [&[i][..], text.as_bytes()].concat()).collect()
}

pub(crate) fn transforms() -> Vec<Vec<u8>> {
    let pose = "[[0,0,1,2],[1,0,0,3],[0,1,0,4],[0,0,0,1]]";
    let frames = |ext: &str| -> String {
        let all: Vec<String> =
            (0..3).map(|i| format!("{{\"file_path\": \"./images/{i}{ext}\", \"transform_matrix\": {pose}}}")).collect();
        all.join(", ")
    };
    vec![
        format!("{{\"camera_angle_x\": 0.8, \"k1\": 0.01, \"frames\": [{}]}}", frames("")).into_bytes(),
        format!(
            "{{\"fl_x\": 20.0, \"fl_y\": 21.5, \"cx\": 10, \"cy\": 8, \"w\": 20, \"h\": 16, \"camera_model\": \"OPENCV\", \
             \"ply_file_path\": \"points.ply\", \"test_filenames\": [\"images/1.png\"], \"lost\": [NaN, -Infinity], \
             \"frames\": [{}]}}",
            frames(".png")
        )
        .into_bytes(),
    ]
}

pub(crate) fn npy() -> Vec<Vec<u8>> {
    let maps = MaskMaps { ids: Array3::from_shape_fn((4, 4, 5), |(l, y, x)| (20 * l + 5 * y + x) as i32 % 9 - 1) };
    let features = MaskFeatures { values: Array2::from_elem((3, 4), 0.5) };
    let halves: Vec<u8> = [
        &b"\x93NUMPY\x01\x00\x36\x00{'descr': '<f2', 'fortran_order': False, 'shape': (4,)}\n"[..],
        &[0, 0x3c, 1, 0, 0, 0x7c, 0, 0xc0],
    ]
    .concat();
    vec![
        made("a_s.npy", |p| maps.write(p).expect("written")),
        made("a_f.npy", |p| features.write(p).expect("written")),
        made("i.npy", |p| gs_io::npy::write_i32(p, &arr2(&[[-1, 0, 1], [2, 3, 4]])).expect("written")),
        halves,
    ]
}

pub(crate) fn npz() -> Vec<Vec<u8>> {
    let pack = |method: zip::CompressionMethod| {
        let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
        for (name, shape) in [("coffee mug", vec![4]), ("sheep", vec![1, 4])] {
            let array = ArrayView::from_shape(shape, &[1.0, 0.0, 0.5, 0.25]).expect("four numbers");
            let array = made("a.npy", |p| gs_io::npy::write_f32(p, &array).expect("written"));
            let options = zip::write::SimpleFileOptions::default().compression_method(method);
            archive.start_file(format!("{name}.npy"), options).expect("begun");
            archive.write_all(&array).expect("written");
        }
        archive.finish().expect("finished").into_inner()
    };
    vec![
        pack(zip::CompressionMethod::Stored),
        pack(zip::CompressionMethod::Deflated),
        br#"{"coffee mug": [1.0, 0.0], "sheep": [0.6, 0.8]}"#.to_vec(),
    ]
}

/// Two instances of four Gaussians.
pub(crate) fn instances() -> Instances {
    let edge = TreeEdge { parent: 4, child: 5, lambda: 1.0, size: 2, instance: 0 };
    Instances {
        label: vec![0, -1, 0, 1],
        descriptor: arr2(&[[1.0, 0.0], [0.0, 1.0]]),
        support: vec![1, 2],
        score: vec![0.5, 1.0],
        count: vec![2, 1],
        centroid: vec![[0.0; 3]; 2],
        bbox_min: vec![[0.0; 3]; 2],
        bbox_max: vec![[1.0; 3]; 2],
        views: vec!["a".into()],
        matches: vec![Match { instance: 1, view: 0, mask: 3, score: 0.5, visible: 2.0 }],
        tree: vec![edge, TreeEdge { parent: 5, child: 6, instance: 1, ..edge }],
        node: vec![5, -1, 5, 6],
        oriented: vec![OrientedBox::default(); 2],
        granules: vec![Granule { members: Members::Cluster(5), support: 3, fit: 0.5 }],
        granule_descriptor: arr2(&[[0.6, 0.8]]),
    }
}

/// One of each artifact.
pub(crate) fn artifact() -> Vec<Vec<u8>> {
    let provenance = || Provenance { program: "test 1".into(), ..Provenance::default() };
    let graph = Graph {
        kept: vec![0, 2, 3],
        anchors: vec![1, 0],
        knn: arr2(&[[0, 1], [2, 0]]),
        anchor_knn: arr2(&[[1, 1], [0, 0]]),
        nearest_anchor: vec![0, 0, 1],
        gaussian_knn: arr2(&[[1], [0], [0]]),
        seen_views: vec![1, 0, 2, 1],
        seen_weight: vec![0.5, 0.0, 1.0, 2.0],
    };
    let features = Features { kept: vec![0, 2, 3], values: Array2::from_elem((3, 2), 0.5) };
    let descriptors = Descriptors { kept: vec![0, 3], row: vec![1, 0], values: Array3::from_elem((2, 2, 2), 0.5) };
    let row = Row { view: 0, level: 3, mask: 1, pixels: 9, gated: 8, alpha: 0.9 };
    let footprints = FootprintsBuilder {
        views: vec!["a".into()],
        kept: vec![0, 2, 3],
        rows: vec![row, Row { mask: 2, ..row }],
        row_ptr: vec![0, 2, 3],
        col: vec![0, 2, 1],
        weight: vec![1.0, 0.5, 2.0],
        ..FootprintsBuilder::default()
    };
    let truth = TruePoints { position: vec![[0.0; 3]; 2], instance: vec![0, 1], part: vec![0, 0], class: vec![-1, 1] };
    vec![
        made("a", |p| graph.write(p, provenance()).expect("written")),
        made("a", |p| features.write(p, provenance()).expect("written")),
        made("a", |p| footprints.write(p, provenance()).expect("written")),
        made("a", |p| instances().write(p, provenance()).expect("written")),
        made("a", |p| truth.write(p, provenance()).expect("written")),
        made("a", |p| descriptors.write(p, provenance()).expect("written")),
    ]
}

pub(crate) fn labels() -> Vec<Vec<u8>> {
    vec![
        br#"{"info":{"description":"ISAT","name":"a.jpg","width":20,"height":10,"depth":3,"note":""},
"objects":[{"category":"cup","group":1,"segmentation":[[1.9,1.2],[4.7,1.9],[4.2,3.3],[1.1,3.9]],"bbox":[1,1,4,3]},
{"category":"../../cup","segmentation":[[10,1],[11,1],[30,2],[-10,20]]},{"category":"lid","segmentation":[]}]}"#
            .to_vec(),
        br#"{"format":"instances.edits","version":1,"instances":"ab","edits":[{"op":"rename","instance":1,"name":"kettle"},
{"op":"merge","instances":[0,1]},{"op":"split","instance":0},{"op":"note","instance":0,"text":"chipped"},
{"op":"assign","instance":-1,"gaussians":"1 2"},{"op":"scale","from":[0,0,0],"to":[1,0,0],"metres":0.3}]}"#
            .to_vec(),
        br#"{"format":"scene","version":1,"inputs":{"geometry":"ab"},"gaussians":9,"up":{"direction":[0,0,1],"from":"given"},
"metres_per_unit":0.5,"objects":[{"id":1,"name":{"text":"mug","from":"edits"},"score":0.5,"gaussians":4,"parent":{"cluster":7,
"gaussians":9,"objects":[1,2]},"parts":[{"cluster":8,"gaussians":2}],"centroid":[0,1,2],"box":{"center":[0,1,2],"half_size":[1,1,1],
"axes":[[1,0,0],[0,1,0],[0,0,1]],"upright":true},"volume":8,"best_view":{"view":"a","mask":3,"score":0.5,"visible":2}},{"id":2,
"name":null,"score":0,"gaussians":5,"parent":null,"parts":[],"centroid":[0,0,0],"box":{"center":[0,0,0],"half_size":[0,0,0],
"axes":[[1,0,0],[0,1,0],[0,0,1]],"upright":true},"volume":0,"best_view":null}],"relations":[{"subject":1,"relation":"on","object":2}]}"#
            .to_vec(),
        br#"{"format":"names","version":1,"instances":"ab","source":"CLIP","model":"cd","vocabulary":"ef","words":3,"by_chance":0.02,
"named":[{"instance":0,"names":[{"name":"mug","score":0.3},{"name":"cup","score":0.28}],"margin":0.01,"sure":false}]}"#
            .to_vec(),
        br#"{"facts":{"size":[4,3],"names":{"57":{"name":"chair","score":0.93},"58":{"name":"dining table","score":0.5}}}}"#.to_vec(),
        br#"{"format":"gaussian-ids","version":1,"splat":"ab","instance":[0,-1,3,2147483647]}"#.to_vec(),
    ]
}

/// A file of a ScanNet scan behind a byte that says which.
pub(crate) fn scannet() -> Vec<Vec<u8>> {
    let labelled = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
                    property uchar red\nproperty uchar green\nproperty uchar blue\nproperty ushort label\nend_header\n\
                    0 0 0 1 2 3 5\n1 0 0 1 2 3 5\n0 1 0 1 2 3 1\n0 0 1 1 2 3 0\n";
    let parts: [&[u8]; 5] = [
        br#"{"params":{},"sceneId":"x","segIndices":[5,5,7,9]}"#,
        br#"{"segGroups":[{"id":0,"objectId":0,"segments":[5],"label":"wall"},{"id":1,"objectId":1,"segments":[7,9],"label":"chair"}]}"#,
        labelled.as_bytes(),
        b"20 0 10 0\n0 20 8 0\n0 0 1 0\n0 0 0 1\n",
        b"0 0 1 2\n1 0 0 3\n0 1 0 4\n0 0 0 1\n",
    ];
    parts.iter().zip(0u8..).map(|(text, i)| [&[i][..], text].concat()).collect()
}

pub(crate) fn id_png() -> Vec<Vec<u8>> {
    let narrow = image::GrayImage::from_fn(9, 7, |x, y| image::Luma([(x * y % 5) as u8]));
    let wide = image::ImageBuffer::<image::Luma<u16>, _>::from_fn(6, 5, |x, y| image::Luma([(300 * x + y) as u16]));
    let colour = image::RgbImage::from_fn(6, 5, |x, y| image::Rgb([x as u8, y as u8, 9]));
    vec![
        made("a.png", |p| narrow.save(p).expect("written")),
        made("a.png", |p| wide.save(p).expect("written")),
        made("a.png", |p| colour.save(p).expect("written")),
        made("a.jpg", |p| colour.save(p).expect("written")),
    ]
}
