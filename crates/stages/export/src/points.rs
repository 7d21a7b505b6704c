//! Centres of Gaussians as a point cloud with colours and ids.

use gs_io::{Error, IoContext, Result, write_atomic, write_bytes};
use gs_scene::{Gaussians, ply};
use las::point::Format;
use las::{Builder, Color, Point, Transform, Vector, Vlr, Writer};
use std::io::Cursor;
use std::path::Path;

/// File formats of point clouds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PointFormat {
    Las,
    Ply,
}

impl PointFormat {
    /// The format of an output by its extension.
    ///
    /// # Errors
    /// When there is no such format.
    pub fn of(path: &Path) -> Result<Self> {
        match path.extension().unwrap_or_default().to_string_lossy().to_lowercase().as_str() {
            "las" => Ok(Self::Las),
            "ply" => Ok(Self::Ply),
            _ => Err(Error::new("no format of points has this extension").file(path).expected(".las or .ply")),
        }
    }
}

/// Writes the centres of the Gaussians `which` with their colours and the object of each, -1 for none.
///
/// # Errors
/// When the file cannot be written.
pub fn write(to: &Path, format: PointFormat, g: &Gaussians, label: &[i32], which: &[u32]) -> Result<()> {
    match format {
        PointFormat::Las => {
            let bytes = las_bytes(g, label, which).map_err(|e| Error::new(format!("cannot make LAS: {e}")).file(to))?;
            write_bytes(to, &bytes)
        }
        PointFormat::Ply => write_ply(to, g, label, which),
    }
}

/// What LAS can't tell of these points: its coordinates are steps of what spans all of them.
pub fn coarse(g: &Gaussians, which: &[u32]) -> Option<String> {
    let (step, size) = (transforms(g, which).x.scale, g.spread());
    (step > 1e-3 * size).then(|| {
        format!("LAS has coordinates in steps of {step}, and the scene's size is {size:.3}: crop what is far with gs-geom convert --crop")
    })
}

/// Colour of a Gaussian, 8 bits a channel.
fn color(g: &Gaussians, i: usize) -> [u8; 3] {
    g.base_color(i).map(|v| (255.0 * v.clamp(0.0, 1.0)).round() as u8)
}

fn write_ply(to: &Path, g: &Gaussians, label: &[i32], which: &[u32]) -> Result<()> {
    write_atomic(to, |w| {
        let shift = ply::shift_comment(g.shift).map_or(String::new(), |shift| format!("comment {shift}\n"));
        let header = format!(
            "ply\nformat binary_little_endian 1.0\n{shift}element vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int instance\nend_header\n",
            which.len()
        );
        w.write_all(header.as_bytes()).at("write", to)?;
        for i in which.iter().map(|&i| i as usize) {
            let [x, y, z] = g.means[i].map(f32::to_le_bytes);
            let row = [&x[..], &y, &z, &color(g, i), &label[i].to_le_bytes()].concat();
            w.write_all(&row).at("write", to)?;
        }
        Ok(())
    })
}

/// LAS 1.4, point format 2 (colours). The object is the extra dimension `instance`, a 32-bit whole number, -1 for none; for
/// programs that don't read extra dimensions the point source is the object plus 1, 0 for none and from 65,535 on.
/// Coordinates are steps of a power of ten, the finest of which 2^30 span the scene.
fn las_bytes(g: &Gaussians, label: &[i32], which: &[u32]) -> las::Result<Vec<u8>> {
    let mut builder = Builder::from((1, 4));
    builder.point_format = Format::new(2)?;
    builder.point_format.extra_bytes = 4;
    builder.vlrs.push(instance_dimension());
    builder.transforms = transforms(g, which);
    builder.generating_software = format!("cags export {}", env!("CARGO_PKG_VERSION"));
    let mut writer = Writer::new(Cursor::new(Vec::new()), builder.into_header()?)?;
    for i in which.iter().map(|&i| i as usize) {
        let [x, y, z] = [0, 1, 2].map(|c| place(g, i, c));
        let [red, green, blue] = color(g, i).map(|c| 257 * u16::from(c));
        writer.write_point(Point {
            x,
            y,
            z,
            return_number: 1,
            number_of_returns: 1,
            color: Some(Color { red, green, blue }),
            point_source_id: u16::try_from(label[i] + 1).unwrap_or(0),
            extra_bytes: label[i].to_le_bytes().to_vec(),
            ..Point::default()
        })?;
    }
    writer.close()?;
    Ok(writer.into_inner()?.into_inner())
}

/// What describes the four bytes behind each point: LAS 1.4's Extra Bytes record.
fn instance_dimension() -> Vlr {
    let mut data = vec![0; 192];
    // Type 6: a signed 32-bit whole number. Bit 0 of the options: there is a value for no data, -1.
    (data[2], data[3]) = (6, 1);
    data[4..12].copy_from_slice(b"instance");
    data[40..48].copy_from_slice(&(-1i64).to_le_bytes());
    let description = b"object of the Gaussian";
    data[160..160 + description.len()].copy_from_slice(description);
    Vlr { user_id: "LASF_Spec".into(), record_id: 4, description: "Extra Bytes".into(), data }
}

/// A coordinate of a Gaussian in the world.
fn place(g: &Gaussians, i: usize, axis: usize) -> f64 {
    f64::from(g.means[i][axis]) + g.shift[axis]
}

fn transforms(g: &Gaussians, which: &[u32]) -> Vector<Transform> {
    let axis = |c: usize| {
        let values = || which.iter().map(|&i| place(g, i as usize, c));
        let (low, high) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
        if low > high { (0.0, 0.0) } else { (low, high) }
    };
    let sides = [axis(0), axis(1), axis(2)];
    let longest = sides.iter().map(|(low, high)| high - low).fold(0.0, f64::max);
    // Not below what single precision tells of a scene of size 1.
    let scale = 10f64.powi((longest / f64::from(1 << 30)).log10().ceil().max(-7.0) as i32);
    let [x, y, z] = sides.map(|(low, _)| Transform { scale, offset: (low / scale).floor() * scale });
    Vector { x, y, z }
}

#[cfg(test)]
mod tests {
    use super::*;
    use las::Reader;

    fn sample() -> (Gaussians, Vec<i32>) {
        let means = vec![[0.5, -1.25, 2.0], [3.0, 4.0, 5.0], [-0.001, 0.25, 1e3], [9.0; 3]];
        let g = Gaussians {
            log_scales: vec![[0.0; 3]; 4],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            opacity_logits: vec![0.0; 4],
            sh: (0..12).map(|i| i as f32 * 0.3 - 2.0).collect(),
            sh_degree: 0,
            means,
            ..Gaussians::default()
        };
        (g, vec![-1, 0, 65_534, 70_000])
    }

    #[test]
    fn las_reads_back_as_it_was_written() {
        let (g, label) = sample();
        let bytes = las_bytes(&g, &label, &[0, 1, 2, 3]).unwrap();
        assert_eq!(bytes, las_bytes(&g, &label, &[0, 1, 2, 3]).unwrap(), "no date in it");
        let mut reader = Reader::new(Cursor::new(bytes)).unwrap();
        let header = reader.header().clone();
        assert_eq!(header.number_of_points(), 4);
        let described = header.all_vlrs().find(|v| (&v.user_id[..], v.record_id) == ("LASF_Spec", 4)).unwrap();
        assert_eq!((described.data.len(), &described.data[4..12]), (192, &b"instance"[..]));
        let all = reader.read_all().unwrap();
        let points: Vec<Point> = all.points().map(|p| p.unwrap()).collect();
        for (i, p) in points.iter().enumerate() {
            let apart = [p.x, p.y, p.z].into_iter().zip(g.means[i]).map(|(a, b)| (a - f64::from(b)).abs());
            assert!(apart.fold(0.0, f64::max) <= 0.5e-6 + 1e-9, "{p:?}");
            assert_eq!(p.extra_bytes, label[i].to_le_bytes());
            let c = color(&g, i).map(|c| 257 * u16::from(c));
            assert_eq!(p.color, Some(Color::new(c[0], c[1], c[2])));
        }
        assert_eq!(points.iter().map(|p| p.point_source_id).collect::<Vec<_>>(), [0, 1, 65_535, 0]);
    }

    #[test]
    fn a_scene_far_from_the_origin_is_where_it_is_in_the_world() {
        let (g, label) = sample();
        let shift = [448_262.0, 5_411_932.0, 114.0];
        let far = Gaussians { shift, ..g };
        let mut reader = Reader::new(Cursor::new(las_bytes(&far, &label, &[0, 1, 2, 3]).unwrap())).unwrap();
        let all = reader.read_all().unwrap();
        for (i, p) in all.points().enumerate() {
            let p = p.unwrap();
            let off = (0..3).map(|c| ([p.x, p.y, p.z][c] - shift[c] - f64::from(far.means[i][c])).abs());
            assert!(off.fold(0.0, f64::max) < 1e-5, "{p:?}");
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.ply");
        write(&path, PointFormat::Ply, &far, &label, &[1, 3]).unwrap();
        let points = ply::read_points(&path).unwrap();
        assert_eq!((points.positions, points.shift), (vec![far.means[1], far.means[3]], shift));
    }

    #[test]
    fn a_cloud_of_no_or_one_point_is_a_file_too() {
        let (g, label) = sample();
        for which in [&[][..], &[2]] {
            let mut reader = Reader::new(Cursor::new(las_bytes(&g, &label, which).unwrap())).unwrap();
            assert_eq!(reader.read_all().unwrap().len(), which.len());
        }
    }

    #[test]
    fn ply_reads_back_as_it_was_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.ply");
        let (g, label) = sample();
        write(&path, PointFormat::of(&path).unwrap(), &g, &label, &[1, 3]).unwrap();
        let points = ply::read_points(&path).unwrap();
        assert_eq!(points.positions, [g.means[1], g.means[3]]);
        assert_eq!(points.colors, [color(&g, 1), color(&g, 3)]);
        assert_eq!(ply::read_labels(&path, "instance", [0.0; 3]).unwrap().1, [0, 70_000]);
        assert!(PointFormat::of(Path::new("a.xyz")).unwrap_err().to_string().contains("expected .las or .ply"));
    }
}
