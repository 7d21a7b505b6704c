//! PLY files: 3DGS Gaussians and coloured point clouds.
//!
//! The reader takes any property order, ascii and both binary byte orders, other elements and lists (skipped); the
//! writer writes what the original 3DGS code writes. Read by hand because a million Gaussians are 248 MB and generic
//! readers need many times that.

use crate::{Gaussians, PointCloud, sh_coefficients};
use gs_io::{Error, IoContext, Result, write_atomic};
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    fn value(self, bytes: &[u8], big: bool) -> f64 {
        macro_rules! get {
            ($t:ty) => {{
                let mut b = [0u8; size_of::<$t>()];
                b.copy_from_slice(&bytes[..size_of::<$t>()]);
                f64::from(if big { <$t>::from_be_bytes(b) } else { <$t>::from_le_bytes(b) })
            }};
        }
        match self {
            Self::I8 => get!(i8),
            Self::U8 => get!(u8),
            Self::I16 => get!(i16),
            Self::U16 => get!(u16),
            Self::I32 => get!(i32),
            Self::U32 => get!(u32),
            Self::F32 => get!(f32),
            Self::F64 => get!(f64),
        }
    }
}

#[derive(Debug, Clone)]
enum Property {
    Scalar(String, Scalar),
    List(Scalar, Scalar),
}

#[derive(Debug, Clone)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

struct Header<'a> {
    encoding: Encoding,
    elements: Vec<Element>,
    body: &'a [u8],
}

/// Scalar columns of the vertices, by property name.
struct Vertices {
    count: usize,
    columns: BTreeMap<String, Vec<f32>>,
}

const AGAIN: &str = "export the PLY again";

fn parse_header(bytes: &[u8]) -> Result<Header<'_>> {
    let fail = |what: &str| Error::new(what).field("header").hint(AGAIN);
    let mut rest = bytes;
    let mut next_line = || -> Result<&str> {
        let end = rest.iter().take(65_536).position(|&b| b == b'\n').ok_or_else(|| fail("the header does not end"))?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| fail("the header is not text"))?;
        rest = &rest[end + 1..];
        Ok(line.trim_end_matches('\r').trim())
    };
    if next_line()? != "ply" {
        return Err(fail("not a PLY file"));
    }
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let line = next_line()?;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["end_header"] => break,
            [] | ["comment" | "obj_info", ..] => {}
            ["format", kind, _] => {
                encoding = Some(match kind {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return Err(fail("unknown format").found(kind)),
                });
            }
            ["element", name, count] => {
                let count =
                    count.parse().map_err(|_| fail("not a count").field(format!("element {name}")).found(count))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", "list", count, item, _] => {
                let (Some(count), Some(item)) = (Scalar::parse(count), Scalar::parse(item)) else {
                    return Err(fail("unknown type").found(line));
                };
                let e = elements.last_mut().ok_or_else(|| fail("a property before any element"))?;
                e.properties.push(Property::List(count, item));
            }
            ["property", kind, name] => {
                let kind = Scalar::parse(kind).ok_or_else(|| fail("unknown type").found(line))?;
                let e = elements.last_mut().ok_or_else(|| fail("a property before any element"))?;
                e.properties.push(Property::Scalar(name.into(), kind));
            }
            _ => return Err(fail("not understood").found(line)),
        }
    }
    let encoding = encoding.ok_or_else(|| fail("no format line"))?;
    Ok(Header { encoding, elements, body: rest })
}

fn cut_short(element: &str, row: usize, count: usize) -> Error {
    Error::new("the file is cut short or its count lies")
        .field(format!("element {element}"))
        .found(format!("{row} rows"))
        .expected(format!("{count}"))
        .hint(AGAIN)
}

fn read_vertices(bytes: &[u8]) -> Result<Vertices> {
    let header = parse_header(bytes)?;
    let mut body = header.body;
    for element in &header.elements {
        let wanted = element.name == "vertex";
        let names: Vec<&str> = element
            .properties
            .iter()
            .filter_map(|p| if let Property::Scalar(n, _) = p { Some(n.as_str()) } else { None })
            .collect();
        // The smallest row the encoding allows bounds how many rows the file can hold.
        let least: usize = element
            .properties
            .iter()
            .map(|p| match (header.encoding, p) {
                (Encoding::Ascii, _) => 2,
                (_, Property::Scalar(_, s) | Property::List(s, _)) => s.size(),
            })
            .sum::<usize>()
            .max(1);
        if element.count > (body.len() + 1) / least {
            return Err(cut_short(&element.name, body.len() / least, element.count));
        }
        let mut columns: Vec<Vec<f32>> =
            names.iter().map(|_| Vec::with_capacity(if wanted { element.count } else { 0 })).collect();
        match header.encoding {
            Encoding::Ascii => {
                for row in 0..element.count {
                    let end = body.iter().position(|&b| b == b'\n').unwrap_or(body.len());
                    let line = std::str::from_utf8(&body[..end])
                        .map_err(|_| Error::new("not text").field(format!("{} {row}", element.name)))?;
                    body = &body[(end + 1).min(body.len())..];
                    let mut words = line.split_ascii_whitespace();
                    let mut number = || -> Result<f64> {
                        let w = words.next().ok_or_else(|| cut_short(&element.name, row, element.count))?;
                        w.parse().map_err(|_| {
                            Error::new("not a number").field(format!("{} {row}", element.name)).found(w).hint(AGAIN)
                        })
                    };
                    let mut column = 0;
                    for p in &element.properties {
                        match p {
                            Property::Scalar(..) => {
                                let v = number()?;
                                if wanted {
                                    columns[column].push(v as f32);
                                }
                                column += 1;
                            }
                            Property::List(..) => {
                                for _ in 0..number()? as usize {
                                    number()?;
                                }
                            }
                        }
                    }
                }
            }
            Encoding::Little | Encoding::Big => {
                let big = header.encoding == Encoding::Big;
                let fixed = element.properties.iter().all(|p| matches!(p, Property::Scalar(..)));
                let scalars: Vec<Scalar> = element
                    .properties
                    .iter()
                    .filter_map(|p| if let Property::Scalar(_, s) = p { Some(*s) } else { None })
                    .collect();
                if fixed {
                    let stride: usize = scalars.iter().map(|s| s.size()).sum();
                    let total = stride.checked_mul(element.count).filter(|&t| t <= body.len());
                    let Some(total) = total else {
                        return Err(cut_short(&element.name, body.len() / stride.max(1), element.count));
                    };
                    if wanted {
                        let all_f32 = !big && scalars.iter().all(|&s| s == Scalar::F32);
                        for row in body[..total].chunks_exact(stride.max(1)) {
                            let mut at = 0;
                            for (column, s) in columns.iter_mut().zip(&scalars) {
                                let value = if all_f32 {
                                    f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
                                } else {
                                    s.value(&row[at..], big) as f32
                                };
                                column.push(value);
                                at += s.size();
                            }
                        }
                    }
                    body = &body[total..];
                } else {
                    for row in 0..element.count {
                        let mut column = 0;
                        let mut take = |s: Scalar| -> Result<f64> {
                            if body.len() < s.size() {
                                return Err(cut_short(&element.name, row, element.count));
                            }
                            let v = s.value(body, big);
                            body = &body[s.size()..];
                            Ok(v)
                        };
                        for p in &element.properties {
                            match p {
                                Property::Scalar(_, s) => {
                                    let v = take(*s)?;
                                    if wanted {
                                        columns[column].push(v as f32);
                                    }
                                    column += 1;
                                }
                                Property::List(count, item) => {
                                    for _ in 0..take(*count)? as usize {
                                        take(*item)?;
                                    }
                                }
                            }
                        }
                    }
                }
            }
        }
        if wanted {
            let columns = names.into_iter().map(String::from).zip(columns).collect();
            return Ok(Vertices { count: element.count, columns });
        }
    }
    Err(Error::new("no vertices").field("element vertex").hint(AGAIN))
}

impl Vertices {
    fn take(&mut self, name: &str) -> Result<Vec<f32>> {
        self.columns.remove(name).ok_or_else(|| {
            Error::new("missing property")
                .field(name)
                .hint("this PLY is not what is wanted here: 3DGS Gaussians have opacity, scale_*, rot_*, f_dc_*")
        })
    }

    fn positions(&mut self) -> Result<Vec<[f32; 3]>> {
        let (x, y, z) = (self.take("x")?, self.take("y")?, self.take("z")?);
        let positions: Vec<[f32; 3]> = (0..self.count).map(|i| [x[i], y[i], z[i]]).collect();
        let bad = |p: &[f32; 3]| p.iter().any(|v| !v.is_finite());
        if let Some(first) = positions.iter().position(bad) {
            let all = positions.iter().filter(|p| bad(p)).count();
            return Err(Error::new("a position is not finite")
                .field(format!("vertex {first}"))
                .found(format!("{:?}; {all} of {} vertices are so", positions[first], self.count))
                .expected("finite x, y, z")
                .hint("remove these vertices"));
        }
        Ok(positions)
    }
}

/// Reads the Gaussians of a 3DGS PLY. Without `f_rest_*` the spherical harmonics have degree 0; normals are ignored.
///
/// # Errors
/// When the file is damaged or is no 3DGS PLY, or a parameter is not finite.
pub fn read_gaussians(path: impl AsRef<Path>) -> Result<Gaussians> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).at("read", path)?;
    parse_gaussians(&bytes).map_err(|e| e.file(path))
}

fn parse_gaussians(bytes: &[u8]) -> Result<Gaussians> {
    let mut v = read_vertices(bytes)?;
    let n = v.count;
    let rest = (0..).take_while(|i| v.columns.contains_key(&format!("f_rest_{i}"))).count();
    let sh_degree = match rest {
        0 => 0,
        9 => 1,
        24 => 2,
        45 => 3,
        _ => {
            return Err(Error::new("another number of spherical-harmonics properties")
                .field("f_rest_*")
                .found(rest)
                .expected("0, 9, 24 or 45"));
        }
    };
    let means = v.positions()?;
    let mut group = |names: &[&str]| -> Result<Vec<Vec<f32>>> {
        let columns = names.iter().map(|n| v.take(n)).collect::<Result<Vec<_>>>()?;
        for (name, c) in names.iter().zip(&columns) {
            if let Some(i) = c.iter().position(|x| !x.is_finite() && (x.is_nan() || *name != "opacity")) {
                return Err(Error::new("not a finite number")
                    .field(format!("vertex {i}, {name}"))
                    .found(c[i])
                    .hint(AGAIN));
            }
        }
        Ok(columns)
    };
    let scale = group(&["scale_0", "scale_1", "scale_2"])?;
    let rot = group(&["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let opacity = group(&["opacity"])?.remove(0);
    let dc = group(&["f_dc_0", "f_dc_1", "f_dc_2"])?;
    let names: Vec<String> = (0..rest).map(|i| format!("f_rest_{i}")).collect();
    let rest_columns = group(&names.iter().map(String::as_str).collect::<Vec<_>>())?;
    let k = sh_coefficients(sh_degree);
    let mut sh = Vec::with_capacity(n * 3 * k);
    for i in 0..n {
        sh.extend(dc.iter().map(|c| c[i]));
        for coefficient in 0..k - 1 {
            sh.extend((0..3).map(|channel| rest_columns[channel * (k - 1) + coefficient][i]));
        }
    }
    Ok(Gaussians {
        means,
        log_scales: (0..n).map(|i| [scale[0][i], scale[1][i], scale[2][i]]).collect(),
        rotations: (0..n).map(|i| [rot[0][i], rot[1][i], rot[2][i], rot[3][i]]).collect(),
        // Fully opaque or transparent Gaussians are written as infinite logits by some tools.
        opacity_logits: opacity.into_iter().map(|o| o.clamp(-50.0, 50.0)).collect(),
        sh,
        sh_degree,
    })
}

/// Writes the standard 3DGS layout: little-endian floats, 62 properties at degree 3. `comments` become comment lines.
///
/// # Errors
/// When the arrays do not fit together or the file cannot be written.
pub fn write_gaussians(path: impl AsRef<Path>, gaussians: &Gaussians, comments: &[String]) -> Result<()> {
    let path = path.as_ref();
    gaussians.check().map_err(|e| e.file(path))?;
    let k = sh_coefficients(gaussians.sh_degree);
    let mut names: Vec<String> =
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into();
    names.extend((0..3 * (k - 1)).map(|i| format!("f_rest_{i}")));
    names.extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(String::from));
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header.extend(comments.iter().map(|c| format!("comment {}\n", c.replace(['\n', '\r'], " "))));
    header += &format!("element vertex {}\n", gaussians.len());
    header.extend(names.iter().map(|n| format!("property float {n}\n")));
    header += "end_header\n";
    write_atomic(path, |w| {
        w.write_all(header.as_bytes()).at("write", path)?;
        let mut row: Vec<f32> = Vec::with_capacity(names.len());
        for i in 0..gaussians.len() {
            row.clear();
            row.extend(gaussians.means[i]);
            row.extend([0.0; 3]);
            let sh = gaussians.sh_of(i);
            row.extend(&sh[..3]);
            for channel in 0..3 {
                row.extend((1..k).map(|c| sh[3 * c + channel]));
            }
            row.push(gaussians.opacity_logits[i]);
            row.extend(gaussians.log_scales[i]);
            row.extend(gaussians.rotations[i]);
            for v in &row {
                w.write_all(&v.to_le_bytes()).at("write", path)?;
            }
        }
        Ok(())
    })
}

/// Reads a coloured point cloud; white where the file has no colours.
///
/// # Errors
/// When the file is damaged, has no positions, or one is not finite.
pub fn read_points(path: impl AsRef<Path>) -> Result<PointCloud> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).at("read", path)?;
    let parse = || -> Result<PointCloud> {
        let mut v = read_vertices(&bytes)?;
        let positions = v.positions()?;
        let channel = |v: &mut Vertices, name: &str| v.take(name).unwrap_or_else(|_| vec![255.0; v.count]);
        let (r, g, b) = (channel(&mut v, "red"), channel(&mut v, "green"), channel(&mut v, "blue"));
        let colors = (0..v.count).map(|i| [r[i] as u8, g[i] as u8, b[i] as u8]).collect();
        Ok(PointCloud { positions, colors })
    };
    parse().map_err(|e| e.file(path))
}

/// Writes a coloured point cloud, little-endian.
///
/// # Errors
/// When the file cannot be written.
pub fn write_points(path: impl AsRef<Path>, points: &PointCloud, comments: &[String]) -> Result<()> {
    let path = path.as_ref();
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header.extend(comments.iter().map(|c| format!("comment {}\n", c.replace(['\n', '\r'], " "))));
    header += &format!("element vertex {}\n", points.len());
    header += "property float x\nproperty float y\nproperty float z\n";
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    write_atomic(path, |w| {
        w.write_all(header.as_bytes()).at("write", path)?;
        for (p, c) in points.positions.iter().zip(&points.colors) {
            for v in p {
                w.write_all(&v.to_le_bytes()).at("write", path)?;
            }
            w.write_all(c).at("write", path)?;
        }
        Ok(())
    })
}
