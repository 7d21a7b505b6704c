//! PlayCanvas's compressed PLY: 16 bytes a Gaussian, and a byte for each further coefficient of its harmonics.
//!
//! Gaussians lie in chunks of 256; a number is a fraction of the range of its chunk (element `chunk`). Element `vertex` packs
//! the position in 11, 10 and 11 bits, the logarithms of the scales likewise, the rotation in 2 bits and three times 10, and
//! colour and opacity in four times 8; element `sh` has the rest of the harmonics.

use super::packing;
use crate::ply::table::{Column, Table};
use crate::{Gaussians, SH_C0, logit, ply, sh_coefficients};
use gs_io::{Error, IoContext, Result};
use std::io::Write;
use std::path::Path;

/// Gaussians of a chunk.
pub const CHUNK: usize = 256;
/// The properties that the vertices of a compressed PLY have.
const PACKED: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Coefficients beyond the constant one lie in -4 to 4.
const SH_RANGE: f32 = 8.0;

/// Whether these are the vertices of a compressed PLY.
pub(crate) fn is_compressed(vertices: &Table<'_>) -> bool {
    vertices.find(PACKED[0]).is_some()
}

/// The number of coefficients `[coefficients - 1][rgb]` that tells the degree.
pub(crate) fn degree_of_rest(count: usize) -> Option<u8> {
    (0..4).find(|&degree| 3 * (sh_coefficients(degree) - 1) == count)
}

/// The Gaussians of a compressed PLY's elements `vertex`, `chunk` and `sh`.
pub(crate) fn read(vertices: &Table<'_>, chunks: Option<&Table<'_>>, sh: Option<&Table<'_>>) -> Result<Gaussians> {
    let chunks = chunks.ok_or_else(|| Error::new("a compressed PLY without chunks").field("element chunk"))?;
    let n = vertices.count;
    if chunks.count != n.div_ceil(CHUNK) {
        return Err(Error::new("not a chunk for each 256 vertices")
            .field("element chunk")
            .found(chunks.count)
            .expected(format!("{} for {n} vertices", n.div_ceil(CHUNK)))
            .hint("export the PLY again"));
    }
    let positions = Ranges::of(chunks, "", ["x", "y", "z"])?;
    let scales = Ranges::of(chunks, "scale_", ["x", "y", "z"])?;
    // The first files of this kind have no ranges of colours: 0 to 1.
    let colors = match chunks.find("min_r") {
        Some(_) => Some(Ranges::of(chunks, "", ["r", "g", "b"])?),
        None => None,
    };
    let packed = vertices.words(PACKED)?;
    let rest = Rest::of(sh, n)?;
    let sh_degree = rest.as_ref().map_or(0, |r| r.degree);
    let mut g = Gaussians {
        means: Vec::with_capacity(n),
        log_scales: Vec::with_capacity(n),
        rotations: Vec::with_capacity(n),
        opacity_logits: Vec::with_capacity(n),
        sh: Vec::with_capacity(n * 3 * sh_coefficients(sh_degree)),
        sh_degree,
        shift: [0.0; 3],
    };
    let mut rest_rows = rest.as_ref().map(|r| r.table.rows());
    for (i, row) in vertices.rows().enumerate() {
        let [position, rotation, scale, color] = packed.map(|c| c.word(row));
        let chunk = i / CHUNK;
        g.means.push(positions.at(chunk, three(position)));
        g.log_scales.push(scales.at(chunk, three(scale)));
        g.rotations.push(rotation_of(rotation));
        let [r, green, b, a] = color.to_be_bytes().map(|v| f32::from(v) / 255.0);
        g.opacity_logits.push(logit(a));
        let rgb = colors.as_ref().map_or([r, green, b], |c| c.at(chunk, [r, green, b]));
        g.sh.extend(rgb.map(|c| (c - 0.5) / SH_C0));
        if let (Some(rest), Some(row)) = (&rest, rest_rows.as_mut().and_then(Iterator::next)) {
            // Channel by channel in the file, coefficient by coefficient in memory.
            let k = rest.columns.len() / 3;
            g.sh.extend((0..3 * k).map(|j| coefficient(rest.columns[j % 3 * k + j / 3].byte(row))));
        }
    }
    Ok(g)
}

/// The coefficients beyond the constant one.
struct Rest<'a> {
    table: &'a Table<'a>,
    columns: Vec<Column>,
    degree: u8,
}

impl<'a> Rest<'a> {
    fn of(table: Option<&'a Table<'a>>, vertices: usize) -> Result<Option<Self>> {
        let Some(table) = table else { return Ok(None) };
        let count = table.count_of("f_rest_");
        let fail = |what: &str| Error::new(what).field("element sh").hint("export the PLY again");
        if table.count != vertices {
            return Err(fail("not a row for each vertex").found(table.count).expected(vertices));
        }
        let degree = degree_of_rest(count)
            .ok_or_else(|| fail("impossible number of properties").found(count).expected("0, 9, 24 or 45"))?;
        let names: Vec<String> = (0..count).map(|i| format!("f_rest_{i}")).collect();
        Ok(Some(Self { table, columns: table.bytes(&names)?, degree }))
    }
}

/// The ranges of three numbers, a chunk at a time.
struct Ranges(Vec<[f32; 6]>);

impl Ranges {
    fn of(chunks: &Table<'_>, group: &str, names: [&str; 3]) -> Result<Self> {
        let names: Vec<String> = ["min", "max"].iter().flat_map(|m| names.map(|n| format!("{m}_{group}{n}"))).collect();
        Ok(Self(chunks.values(&names)?.as_chunks().0.to_vec()))
    }

    /// Where shares from 0 to 1 of the ranges lie.
    fn at(&self, chunk: usize, share: [f32; 3]) -> [f32; 3] {
        let range = &self.0[chunk];
        [0, 1, 2].map(|k| range[k] * (1.0 - share[k]) + range[k + 3] * share[k])
    }
}

/// Three shares from 0 to 1 in 11, 10 and 11 bits.
fn three(word: u32) -> [f32; 3] {
    [(word >> 21) as f32 / 2047.0, (word >> 11 & 1023) as f32 / 1023.0, (word & 2047) as f32 / 2047.0]
}

/// The rotation w x y z: which part is largest, and the three others.
fn rotation_of(word: u32) -> [f32; 4] {
    let small = [20, 10, 0].map(|shift| ((word >> shift & 1023) as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2);
    from_three(small, (word >> 30) as usize)
}

/// A unit quaternion from three of its parts in order, without part `largest`, which is positive.
pub(crate) fn from_three(small: [f32; 3], largest: usize) -> [f32; 4] {
    let other = (1.0 - small.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    std::array::from_fn(|k| match k.cmp(&largest) {
        std::cmp::Ordering::Less => small[k],
        std::cmp::Ordering::Equal => other,
        std::cmp::Ordering::Greater => small[k - 1],
    })
}

/// The middle of the step that a byte stands for; the outermost bytes stand for the ends of the range.
fn coefficient(byte: u8) -> f32 {
    let share = match byte {
        0 => 0.0,
        255 => 1.0,
        b => (f32::from(b) + 0.5) / 256.0,
    };
    (share - 0.5) * SH_RANGE
}

/// Writes a compressed PLY, which errors call `place`, in the order of `g`: the nearer its neighbours, the finer the steps.
pub(super) fn write(w: &mut dyn Write, place: &Path, g: &Gaussians, comments: &[String]) -> Result<()> {
    let all: Vec<u32> = (0..g.len() as u32).collect();
    let packed = packing::pack(g, &all);
    let rest = 3 * (sh_coefficients(g.sh_degree) - 1);
    let mut header = ply::header_start(comments, g.shift);
    header += &format!("element chunk {}\n", packed.chunks.len());
    for (group, names) in [("", ["x", "y", "z"]), ("scale_", ["x", "y", "z"]), ("", ["r", "g", "b"])] {
        for most in ["min", "max"] {
            header.extend(names.map(|name| format!("property float {most}_{group}{name}\n")));
        }
    }
    header += &format!("element vertex {}\n", g.len());
    header.extend(PACKED.map(|name| format!("property uint {name}\n")));
    if rest > 0 {
        header += &format!("element sh {}\n", g.len());
        header.extend((0..rest).map(|i| format!("property uchar f_rest_{i}\n")));
    }
    header += "end_header\n";
    let mut put = |bytes: &[u8]| w.write_all(bytes).at("write", place);
    put(header.as_bytes())?;
    packed.chunks.iter().try_for_each(|chunk| put(chunk.map(f32::to_le_bytes).as_flattened()))?;
    packed.words.iter().try_for_each(|words| put(words.map(u32::to_le_bytes).as_flattened()))?;
    if rest > 0 {
        let (k, mut row) = (rest / 3, vec![0; rest]);
        for i in 0..g.len() {
            // Channel by channel in the file, coefficient by coefficient in memory.
            let sh = &g.sh_of(i)[3..];
            row.iter_mut().enumerate().for_each(|(j, byte)| *byte = byte_of(sh[j % k * 3 + j / k]));
            put(&row)?;
        }
    }
    Ok(())
}

/// The byte whose [`coefficient`] is nearest.
fn byte_of(v: f32) -> u8 {
    ((v / SH_RANGE + 0.5) * 256.0).floor().clamp(0.0, 255.0) as u8
}
