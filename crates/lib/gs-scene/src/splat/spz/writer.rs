//! Writing SPZ, version 3: the last in gzip, which all readers know.

use super::super::axes::{Axes, System};
use super::super::packing::smallest_three;
use super::{ANTIALIASED, COLOR_FACTOR, MAGIC};
use crate::Gaussians;
use flate2::Compression;
use flate2::write::GzEncoder;
use gs_io::{Error, IoContext, Result};
use std::io::Write;
use std::path::Path;

/// Fractional bits of positions at most: steps of 1/65,536 where the scene reaches to 128.
const MOST_BITS: i32 = 16;
/// What 24 bits hold.
const MOST_STEPS: f32 = 8_388_607.0;
/// Steps of a byte that coefficients of degree 1, and of the others, are rounded to: Niantic's choice, which packs well.
const STEPS: [i32; 2] = [8, 16];

/// Writes an SPZ, which errors call `place`, in the order of `g`.
pub(in crate::splat) fn write(w: &mut dyn Write, place: &Path, g: &Gaussians, antialias: bool) -> Result<()> {
    let mut out = GzEncoder::new(w, Compression::default());
    let axes = System::SPZ.to_ours();
    let bits = fractional_bits(g)?;
    let mut header = MAGIC.to_vec();
    header.extend(3u32.to_le_bytes());
    header.extend((g.len() as u32).to_le_bytes());
    header.extend([g.sh_degree, bits, if antialias { ANTIALIASED } else { 0 }, 0]);
    let n = 0..g.len();
    let mut put = |bytes: &[u8]| out.write_all(bytes).at("write", place);
    put(&header)?;
    n.clone().try_for_each(|i| put(&position(&axes, g.means[i], bits)))?;
    n.clone().try_for_each(|i| put(&[byte(255.0 * g.opacity(i))]))?;
    n.clone().try_for_each(|i| put(&[0, 1, 2].map(|c| byte(255.0 * (COLOR_FACTOR * g.sh_of(i)[c] + 0.5)))))?;
    n.clone().try_for_each(|i| put(&g.log_scales[i].map(|s| byte(16.0 * (s + 10.0)))))?;
    n.clone().try_for_each(|i| put(&rotation(axes.rotation(g.rotations[i]))))?;
    let (mut sh, mut row) = (Vec::new(), Vec::new());
    for i in n {
        sh.clear();
        sh.extend_from_slice(g.sh_of(i));
        axes.harmonics(&mut sh);
        row.clear();
        row.extend(sh.iter().enumerate().skip(3).map(|(at, v)| coefficient(*v, STEPS[usize::from(at >= 12)])));
        put(&row)?;
    }
    out.finish().map(drop).at("write", place)
}

/// As many bits behind the point as leave room for the farthest centre.
fn fractional_bits(g: &Gaussians) -> Result<u8> {
    let farthest = g.means.as_flattened().iter().fold(0.0f32, |most, v| most.max(v.abs()));
    (0..=MOST_BITS).rev().find(|bits| farthest * 2f32.powi(*bits) <= MOST_STEPS).map(|bits| bits as u8).ok_or_else(
        || {
            Error::new("a centre is too far from the origin for SPZ")
                .field("x, y, z")
                .found(farthest)
                .expected(format!("at most {MOST_STEPS}"))
                .hint("write a PLY, or crop the scene first")
        },
    )
}

fn byte(v: f32) -> u8 {
    v.round().clamp(0.0, 255.0) as u8
}

fn position(axes: &Axes, p: [f32; 3], bits: u8) -> [u8; 9] {
    let mut bytes = [0; 9];
    for (to, v) in bytes.as_chunks_mut::<3>().0.iter_mut().zip(axes.point(p)) {
        let steps = (v * 2f32.powi(bits.into())).round() as i32;
        to.copy_from_slice(&steps.to_le_bytes()[..3]);
    }
    bytes
}

/// Which part of x y z w is largest, and of the others a sign and 9 bits each.
fn rotation([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let (largest, small) = smallest_three([x, y, z, w]);
    let word = small.into_iter().fold(largest as u32, |word, v| {
        let size = (511.0 * v.abs() * std::f32::consts::SQRT_2).round().min(511.0) as u32;
        word << 10 | u32::from(v < 0.0) << 9 | size
    });
    word.to_le_bytes()
}

/// The nearest multiple of `step` to a share of 128.
fn coefficient(v: f32, step: i32) -> u8 {
    let whole = (128.0 * v).round() as i32 + 128;
    ((whole + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}
