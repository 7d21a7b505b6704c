//! COLMAP's binary model files, in and out. Little-endian, without padding.

use super::{AGAIN, Points, Registered, intrinsics, pose, push_camera, push_point};
use crate::lens::Lens;
use crate::{Camera, PointCloud};
use glam::{DQuat, DVec3};
use gs_io::{Error, Result, write_bytes};
use std::collections::BTreeMap;
use std::path::Path;

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

    fn array<const N: usize>(&mut self, field: &str) -> Result<[u8; N]> {
        Ok(self.take(N, field)?.try_into().expect("so many bytes"))
    }

    fn u32(&mut self, field: &str) -> Result<u32> {
        self.array(field).map(u32::from_le_bytes)
    }

    fn u64(&mut self, field: &str) -> Result<u64> {
        self.array(field).map(u64::from_le_bytes)
    }

    fn f64(&mut self, field: &str) -> Result<f64> {
        self.array(field).map(f64::from_le_bytes)
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

    /// Refuses data behind the last of `n` things: the count lies.
    fn end(&self, field: &str, n: usize) -> Result<()> {
        if self.rest.is_empty() {
            return Ok(());
        }
        Err(Error::new("the count does not fit the file's length")
            .field(field)
            .found(format!("{n}, and {} more bytes after that", self.rest.len()))
            .expected("the end of the file")
            .hint(AGAIN))
    }
}

/// `cameras.bin`.
pub(super) fn cameras(bytes: &[u8]) -> Result<BTreeMap<u32, Lens>> {
    let mut c = Cursor::new(bytes);
    // A camera has at least its id, model and size: parameters are as many as its model has.
    let n = c.count(24, "camera count")?;
    let mut out = BTreeMap::new();
    for i in 0..n {
        let id = c.u32(&format!("the camera at position {i}"))?;
        let field = format!("camera {id}");
        let model = c.u32(&field)?;
        let (w, h) = (c.u64(&field)?, c.u64(&field)?);
        let Some(&(name, count)) = MODELS.get(model as usize) else {
            return Err(Error::new("unknown camera model")
                .field(field)
                .found(format!("model {model}"))
                .expected("0 to 10; those of newer versions are wide-angle or panoramic lenses (EQUIRECTANGULAR)")
                .hint("run COLMAP's image_undistorter, or reconstruct with the model PINHOLE or OPENCV"));
        };
        let p = (0..count).map(|_| c.f64(&field)).collect::<Result<Vec<_>>>()?;
        push_camera(&mut out, id, intrinsics(name, w, h, &p, &field)?, &field)?;
    }
    c.end("camera count", n)?;
    Ok(out)
}

/// `images.bin`; which points each image sees is skipped.
pub(super) fn images(bytes: &[u8]) -> Result<Vec<Registered>> {
    let mut c = Cursor::new(bytes);
    let n = c.count(73, "image count")?;
    let mut out = Vec::with_capacity(n);
    for i in 0..n {
        let field = format!("image {i}");
        c.u32(&field)?;
        let q = [c.f64(&field)?, c.f64(&field)?, c.f64(&field)?, c.f64(&field)?];
        let t = [c.f64(&field)?, c.f64(&field)?, c.f64(&field)?];
        let camera = c.u32(&field)?;
        let end = c.rest.iter().position(|&b| b == 0);
        let end = end.ok_or_else(|| Error::new("the image's name does not end").field(&field).hint(AGAIN))?;
        let name = String::from_utf8_lossy(c.take(end, &field)?).into_owned();
        c.take(1, &field)?;
        let points = c.count(24, &field)?;
        c.take(24 * points, &field)?;
        let (rotation, translation) = pose(q, t, &field)?;
        out.push(Registered { name, camera, rotation, translation });
    }
    c.end("image count", n)?;
    Ok(out)
}

/// `points3D.bin`; errors and tracks are skipped.
pub(super) fn points(bytes: &[u8]) -> Result<Points> {
    let mut c = Cursor::new(bytes);
    let n = c.count(51, "point count")?;
    let mut out = Points::default();
    for i in 0..n {
        let field = format!("point {i}");
        c.u64(&field)?;
        let p = [c.f64(&field)?, c.f64(&field)?, c.f64(&field)?];
        let color = c.array(&field)?;
        c.f64(&field)?;
        let track = c.count(8, &field)?;
        c.take(8 * track, &field)?;
        push_point(&mut out, p, color, &field)?;
    }
    c.end("point count", n)?;
    Ok(out)
}

/// Writes a binary model with one PINHOLE camera per view: `cameras.bin`, `images.bin`, `points3D.bin`. Equal
/// intrinsics share a camera. Cameras are those of the points less their shift, which the model's numbers have again.
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
    write_bytes(folder.join("cameras.bin"), &b)?;
    b.clear();
    b.extend((views.len() as u64).to_le_bytes());
    for (i, ((name, c), camera)) in views.iter().zip(&of_view).enumerate() {
        b.extend((i as u32 + 1).to_le_bytes());
        let q = DQuat::from_mat3(&c.rotation);
        let translation = c.translation - c.rotation * DVec3::from(points.shift);
        b.extend([q.w, q.x, q.y, q.z].iter().chain(&translation.to_array()).flat_map(|v| v.to_le_bytes()));
        b.extend(camera.to_le_bytes());
        b.extend(name.as_bytes());
        b.push(0);
        b.extend(0u64.to_le_bytes());
    }
    write_bytes(folder.join("images.bin"), &b)?;
    b.clear();
    b.extend((points.len() as u64).to_le_bytes());
    for (i, (p, c)) in points.positions.iter().zip(&points.colors).enumerate() {
        b.extend((i as u64 + 1).to_le_bytes());
        b.extend((0..3).flat_map(|k| (f64::from(p[k]) + points.shift[k]).to_le_bytes()));
        b.extend(c);
        b.extend(0f64.to_le_bytes());
        b.extend(0u64.to_le_bytes());
    }
    write_bytes(folder.join("points3D.bin"), &b)
}
