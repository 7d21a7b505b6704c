//! COLMAP sparse models: `cameras`, `images` and `points3D`, `.bin` or `.txt`.

use crate::distortion::Distortion;
use crate::{Camera, PointCloud};
use glam::{DMat3, DQuat, DVec3};
use gs_io::{Error, IoContext, Result, write_atomic};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A camera's intrinsics as COLMAP gives them.
#[derive(Debug, Clone, PartialEq)]
pub struct Intrinsics {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// fx, fy, cx, cy in pixels.
    pub focal_center: [f64; 4],
    /// Lens distortion; zero for pinhole models.
    pub distortion: Distortion,
}

/// A registered image.
#[derive(Debug, Clone, PartialEq)]
pub struct Registered {
    /// File name relative to the images folder.
    pub name: String,
    /// Key of its camera.
    pub camera: u32,
    /// Rotation, camera from world.
    pub rotation: DMat3,
    /// Translation, camera from world.
    pub translation: DVec3,
}

/// A sparse model.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Intrinsics by camera id.
    pub cameras: BTreeMap<u32, Intrinsics>,
    /// Registered images, in file order.
    pub images: Vec<Registered>,
    /// Sparse points; empty when the file is missing.
    pub points: PointCloud,
}

const AGAIN: &str = "export the COLMAP model again";

/// The folder that holds a sparse model within a scene, if any: `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself.
pub fn find_model(scene: &Path) -> Option<PathBuf> {
    ["sparse/0", "sparse", "colmap/sparse/0", "."]
        .into_iter()
        .map(|p| scene.join(p))
        .find(|p| ["bin", "txt"].iter().any(|e| p.join(format!("cameras.{e}")).is_file()))
}

/// Reads the model in `folder`; `.bin` where there is one, else `.txt`.
///
/// # Errors
/// When a file is missing, damaged, or uses a camera model that is not supported.
pub fn read_model(folder: &Path) -> Result<Model> {
    let part = |name: &str| -> Result<(PathBuf, bool, Vec<u8>)> {
        let binary = folder.join(format!("{name}.bin"));
        let (path, is_binary) =
            if binary.is_file() { (binary, true) } else { (folder.join(format!("{name}.txt")), false) };
        let bytes = std::fs::read(&path).at("read", &path)?;
        Ok((path, is_binary, bytes))
    };
    let (path, binary, bytes) = part("cameras")?;
    let cameras = if binary { cameras_bin(&bytes) } else { cameras_txt(&bytes) }.map_err(|e| e.file(&path))?;
    let (path, binary, bytes) = part("images")?;
    let images = if binary { images_bin(&bytes) } else { images_txt(&bytes) }.map_err(|e| e.file(&path))?;
    for image in &images {
        if !cameras.contains_key(&image.camera) {
            return Err(Error::new("unknown camera").file(&path).field(&image.name).found(image.camera).hint(AGAIN));
        }
        if !(image.rotation.is_finite() && image.translation.is_finite()) {
            return Err(Error::new("the pose is not finite").file(&path).field(&image.name).hint(AGAIN));
        }
    }
    let has_points = ["bin", "txt"].iter().any(|e| folder.join(format!("points3D.{e}")).is_file());
    let points = if has_points {
        let (path, binary, bytes) = part("points3D")?;
        if binary { points_bin(&bytes) } else { points_txt(&bytes) }.map_err(|e| e.file(&path))?
    } else {
        PointCloud::default()
    };
    Ok(Model { cameras, images, points })
}

/// Reads little-endian numbers from the front of a slice, and refuses to run past its end.
struct Cursor<'a> {
    rest: &'a [u8],
    total: usize,
}

impl<'a> Cursor<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, total: bytes.len() }
    }

    fn take(&mut self, n: usize, field: &str) -> Result<&'a [u8]> {
        if self.rest.len() < n {
            return Err(Error::new("the file is cut short or a count in it lies")
                .field(field)
                .found(format!("the end of the file after {} bytes", self.total))
                .hint(AGAIN));
        }
        let (head, tail) = self.rest.split_at(n);
        self.rest = tail;
        Ok(head)
    }

    fn u32(&mut self, field: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.take(4, field)?.try_into().expect("four bytes")))
    }

    fn u64(&mut self, field: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.take(8, field)?.try_into().expect("eight bytes")))
    }

    fn f64(&mut self, field: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.take(8, field)?.try_into().expect("eight bytes")))
    }

    /// A count of things that take at least `size` bytes each.
    fn count(&mut self, size: usize, field: &str) -> Result<usize> {
        let n = self.u64(field)?;
        let most = (self.rest.len() / size) as u64;
        if n > most {
            return Err(Error::new("the count does not fit the file's length")
                .field(field)
                .found(n)
                .expected(format!("at most {most}"))
                .hint(AGAIN));
        }
        Ok(n as usize)
    }
}

/// Names and numbers of parameters of COLMAP's camera models, by id.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

fn intrinsics(model: &str, width: u64, height: u64, p: &[f64], field: &str) -> Result<Intrinsics> {
    let fail = |what: &str| Error::new(what).field(field);
    let d = Distortion::default();
    let (focal_center, distortion) = match (model, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f, cx, cy], d),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy, cx, cy], d),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f, cx, cy], Distortion { k: [k, 0.0, 0.0], ..d }),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f, cx, cy], Distortion { k: [k1, k2, 0.0], ..d }),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy, cx, cy], Distortion { k: [k1, k2, 0.0], p: [p1, p2], ..d })
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            ([fx, fy, cx, cy], Distortion { k: [k1, k2, k3], denominator: [k4, k5, k6], p: [p1, p2] })
        }
        _ => {
            return Err(fail("unsupported camera model")
                .found(format!("{model} with {} parameters", p.len()))
                .expected("PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV")
                .hint("run COLMAP's image_undistorter"));
        }
    };
    let sane = |v: u64| (1..=1 << 20).contains(&v);
    let finite = p.iter().all(|v| v.is_finite());
    if !sane(width) || !sane(height) || !finite || focal_center[0] <= 0.0 || focal_center[1] <= 0.0 {
        return Err(fail("impossible intrinsics").found(format!("{width}x{height} {p:?}")).hint(AGAIN));
    }
    Ok(Intrinsics { width: width as u32, height: height as u32, focal_center, distortion })
}

fn cameras_bin(bytes: &[u8]) -> Result<BTreeMap<u32, Intrinsics>> {
    let mut c = Cursor::new(bytes);
    let n = c.count(48, "camera count")?;
    let mut out = BTreeMap::new();
    for i in 0..n {
        let field = format!("camera {i}");
        let (id, model) = (c.u32(&field)?, c.u32(&field)?);
        let (w, h) = (c.u64(&field)?, c.u64(&field)?);
        let Some(&(name, count)) = MODELS.get(model as usize) else {
            return Err(Error::new("unknown camera model").field(field).found(model).expected("0 to 10").hint(AGAIN));
        };
        let p = (0..count).map(|_| c.f64(&field)).collect::<Result<Vec<_>>>()?;
        out.insert(id, intrinsics(name, w, h, &p, &field)?);
    }
    Ok(out)
}

fn pose(q: [f64; 4], t: [f64; 3], field: &str) -> Result<(DMat3, DVec3)> {
    let quat = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    let norm = quat.length();
    if !(norm.is_finite() && norm > 1e-9 && t.iter().all(|v| v.is_finite())) {
        return Err(Error::new("impossible pose").field(field).found(format!("{q:?} {t:?}")).hint(AGAIN));
    }
    Ok((DMat3::from_quat(quat.normalize()), DVec3::from_array(t)))
}

fn images_bin(bytes: &[u8]) -> Result<Vec<Registered>> {
    let mut c = Cursor::new(bytes);
    let n = c.count(73, "image count")?;
    let mut out = Vec::with_capacity(n);
    for i in 0..n {
        let field = format!("image {i}");
        c.u32(&field)?;
        let mut numbers = [0.0; 7];
        for v in &mut numbers {
            *v = c.f64(&field)?;
        }
        let camera = c.u32(&field)?;
        let end =
            c.rest.iter().position(|&b| b == 0).ok_or_else(|| Error::new("the name does not end").field(&field))?;
        let name = String::from_utf8_lossy(c.take(end, &field)?).into_owned();
        c.take(1, &field)?;
        let points = c.count(24, &field)?;
        c.take(24 * points, &field)?;
        let (rotation, translation) =
            pose([numbers[0], numbers[1], numbers[2], numbers[3]], [numbers[4], numbers[5], numbers[6]], &field)?;
        out.push(Registered { name, camera, rotation, translation });
    }
    Ok(out)
}

fn points_bin(bytes: &[u8]) -> Result<PointCloud> {
    let mut c = Cursor::new(bytes);
    let n = c.count(51, "point count")?;
    let mut out = PointCloud::default();
    for i in 0..n {
        let field = format!("point {i}");
        c.u64(&field)?;
        let p = [c.f64(&field)?, c.f64(&field)?, c.f64(&field)?];
        let color = c.take(3, &field)?;
        c.f64(&field)?;
        let track = c.count(8, &field)?;
        c.take(8 * track, &field)?;
        push_point(&mut out, p, [color[0], color[1], color[2]], &field)?;
    }
    Ok(out)
}

fn push_point(out: &mut PointCloud, p: [f64; 3], color: [u8; 3], field: &str) -> Result<()> {
    if !p.iter().all(|v| v.is_finite()) {
        return Err(Error::new("the position is not finite").field(field).found(format!("{p:?}")).hint(AGAIN));
    }
    out.positions.push(p.map(|v| v as f32));
    out.colors.push(color);
    Ok(())
}

/// Lines of a text model with their numbers, without comments and, where `keep_empty` is not set, empty lines.
fn lines(bytes: &[u8], keep_empty: bool) -> Result<Vec<(usize, &str)>> {
    let text = std::str::from_utf8(bytes).map_err(|_| Error::new("not a text file").hint(AGAIN))?;
    let all = text.lines().map(str::trim).enumerate().map(|(i, l)| (i + 1, l));
    Ok(all.filter(|(_, l)| !l.starts_with('#') && (keep_empty || !l.is_empty())).collect())
}

fn numbers<T: std::str::FromStr>(words: &[&str], line: usize) -> Result<Vec<T>> {
    let parse =
        |w: &&str| w.parse().map_err(|_| Error::new("not a number").field(format!("line {line}")).found(w).hint(AGAIN));
    words.iter().map(parse).collect()
}

fn too_few(line: usize) -> Error {
    Error::new("too few words").field(format!("line {line}")).hint(AGAIN)
}

fn cameras_txt(bytes: &[u8]) -> Result<BTreeMap<u32, Intrinsics>> {
    let mut out = BTreeMap::new();
    for (line, text) in lines(bytes, false)? {
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let [id, model, w, h, params @ ..] = &words[..] else { return Err(too_few(line)) };
        let id = numbers::<u32>(&[id], line)?[0];
        let size = numbers::<u64>(&[w, h], line)?;
        let p = numbers::<f64>(params, line)?;
        out.insert(id, intrinsics(model, size[0], size[1], &p, &format!("line {line}"))?);
    }
    Ok(out)
}

fn images_txt(bytes: &[u8]) -> Result<Vec<Registered>> {
    // Two lines an image; the second lists its points and may be empty.
    let all = lines(bytes, true)?;
    let mut out = Vec::new();
    let mut at = 0;
    while at < all.len() {
        let (line, text) = all[at];
        if text.is_empty() {
            at += 1;
            continue;
        }
        let words: Vec<&str> = text.splitn(10, char::is_whitespace).collect();
        let [_, rest @ .., camera, name] = &words[..] else { return Err(too_few(line)) };
        if rest.len() != 7 {
            return Err(too_few(line));
        }
        let v = numbers::<f64>(rest, line)?;
        let (rotation, translation) = pose([v[0], v[1], v[2], v[3]], [v[4], v[5], v[6]], &format!("line {line}"))?;
        let camera = numbers::<u32>(&[camera], line)?[0];
        out.push(Registered { name: name.trim().to_string(), camera, rotation, translation });
        at += 2;
    }
    Ok(out)
}

fn points_txt(bytes: &[u8]) -> Result<PointCloud> {
    let mut out = PointCloud::default();
    for (line, text) in lines(bytes, false)? {
        let words: Vec<&str> = text.split_ascii_whitespace().take(7).collect();
        if words.len() < 7 {
            return Err(too_few(line));
        }
        let p = numbers::<f64>(&words[1..4], line)?;
        let c = numbers::<u8>(&words[4..7], line)?;
        push_point(&mut out, [p[0], p[1], p[2]], [c[0], c[1], c[2]], &format!("line {line}"))?;
    }
    Ok(out)
}

/// Writes a binary model with one PINHOLE camera per view: `cameras.bin`, `images.bin`, `points3D.bin`. Equal
/// intrinsics share a camera.
///
/// # Errors
/// When a file cannot be written.
pub fn write_model(folder: &Path, views: &[(String, Camera)], points: &PointCloud) -> Result<()> {
    let mut cameras: Vec<&Camera> = Vec::new();
    let same = |a: &Camera, b: &Camera| {
        (a.width, a.height) == (b.width, b.height) && [a.fx, a.fy, a.cx, a.cy] == [b.fx, b.fy, b.cx, b.cy]
    };
    let mut of_view = Vec::with_capacity(views.len());
    for (_, camera) in views {
        let at = cameras.iter().position(|c| same(c, camera)).unwrap_or_else(|| {
            cameras.push(camera);
            cameras.len() - 1
        });
        of_view.push(at as u32 + 1);
    }
    let mut b: Vec<u8> = Vec::new();
    b.extend((cameras.len() as u64).to_le_bytes());
    for (i, c) in cameras.iter().enumerate() {
        b.extend((i as u32 + 1).to_le_bytes());
        b.extend(1u32.to_le_bytes());
        b.extend(u64::from(c.width).to_le_bytes());
        b.extend(u64::from(c.height).to_le_bytes());
        b.extend([c.fx, c.fy, c.cx, c.cy].iter().flat_map(|v| v.to_le_bytes()));
    }
    write_part(&folder.join("cameras.bin"), &b)?;
    b.clear();
    b.extend((views.len() as u64).to_le_bytes());
    for (i, ((name, c), camera)) in views.iter().zip(&of_view).enumerate() {
        b.extend((i as u32 + 1).to_le_bytes());
        let q = DQuat::from_mat3(&c.rotation);
        b.extend([q.w, q.x, q.y, q.z].iter().chain(&c.translation.to_array()).flat_map(|v| v.to_le_bytes()));
        b.extend(camera.to_le_bytes());
        b.extend(name.as_bytes());
        b.push(0);
        b.extend(0u64.to_le_bytes());
    }
    write_part(&folder.join("images.bin"), &b)?;
    b.clear();
    b.extend((points.len() as u64).to_le_bytes());
    for (i, (p, c)) in points.positions.iter().zip(&points.colors).enumerate() {
        b.extend((i as u64 + 1).to_le_bytes());
        b.extend(p.iter().flat_map(|&v| f64::from(v).to_le_bytes()));
        b.extend(c);
        b.extend(0f64.to_le_bytes());
        b.extend(0u64.to_le_bytes());
    }
    write_part(&folder.join("points3D.bin"), &b)
}

fn write_part(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomic(path, |w| w.write_all(bytes).at("write", path))
}
