//! .splat of antimatter15: 32 bytes a Gaussian, without a header and without harmonics beyond the constant one.
//!
//! Position and scales as floats, colour and opacity in four bytes, the rotation w x y z in four bytes around 128.

use super::Splat;
use super::stream::Stream;
use crate::{Gaussians, SH_C0, logit};
use gs_io::{Error, IoContext, Result};
use std::fs::File;
use std::io::{BufReader, Write};
use std::path::Path;

/// Bytes of a Gaussian.
pub(super) const BYTES: u64 = 32;

/// Reads a .splat file; the caller names it in errors.
pub(super) fn read(path: &Path) -> Result<Splat> {
    let file = File::open(path).at("open", path)?;
    let bytes = file.metadata().at("read", path)?.len();
    if bytes % BYTES != 0 || bytes == 0 {
        return Err(Error::new("not a .splat file")
            .field("length")
            .found(format!("{bytes} bytes"))
            .expected("32 for each Gaussian"));
    }
    let n = (bytes / BYTES) as usize;
    let mut g = Gaussians {
        means: Vec::with_capacity(n),
        log_scales: Vec::with_capacity(n),
        rotations: Vec::with_capacity(n),
        opacity_logits: Vec::with_capacity(n),
        sh: Vec::with_capacity(3 * n),
        sh_degree: 0,
        shift: [0.0; 3],
    };
    let mut data = Stream::new(BufReader::with_capacity(1 << 16, file));
    for i in 0..n {
        let row: [u8; 32] = data.array("Gaussian").map_err(|e| e.field(format!("Gaussian {i}")))?;
        let (words, bytes) = (row.as_chunks::<4>().0, &row[24..]);
        let floats = |at: usize| [0, 1, 2].map(|k| f32::from_le_bytes(words[at + k]));
        g.means.push(floats(0));
        g.log_scales.push(floats(3).map(f32::ln));
        g.sh.extend([0, 1, 2].map(|k| (f32::from(bytes[k]) / 255.0 - 0.5) / SH_C0));
        g.opacity_logits.push(logit(f32::from(bytes[3]) / 255.0));
        g.rotations.push([4, 5, 6, 7].map(|k| (f32::from(bytes[k]) - 128.0) / 128.0));
    }
    Ok(Splat { gaussians: g, kind: ".splat".into(), ..Splat::default() })
}

/// Writes a .splat file, which errors call `place`, in the order of `g`.
pub(super) fn write(w: &mut dyn Write, place: &Path, g: &Gaussians) -> Result<()> {
    for i in 0..g.len() {
        let mut row = [0; BYTES as usize];
        let floats = g.means[i].into_iter().chain(g.log_scales[i].map(f32::exp));
        row.as_chunks_mut::<4>().0.iter_mut().zip(floats).for_each(|(word, v)| *word = v.to_le_bytes());
        let [r, green, b] = g.base_color(i);
        for (k, share) in [r, green, b, g.opacity(i)].into_iter().enumerate() {
            row[24 + k] = (255.0 * share).round().clamp(0.0, 255.0) as u8;
        }
        let q = g.rotations[i];
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        // 1 lies beyond the last byte, -1 does not.
        let sign = if q.iter().any(|v| *v / length > 127.0 / 128.0) { -1.0 } else { 1.0 };
        for (k, v) in q.into_iter().enumerate() {
            row[28 + k] = (sign * v / length * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8;
        }
        w.write_all(&row).at("write", place)?;
    }
    Ok(())
}
