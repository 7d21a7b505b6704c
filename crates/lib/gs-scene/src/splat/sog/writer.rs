//! Writing SOG, version 2, in a zip.

use super::tables::{Codebook, palette};
use super::{META, PALETTE_COLUMNS};
use crate::splat::packing::{fraction, smallest_three};
use crate::{Gaussians, sh_coefficients};
use gs_io::{Error, IoContext, Result};
use image_webp::{ColorType, EncoderParams, EncodingError, WebPEncoder};
use rayon::prelude::*;
use serde_json::json;
use std::fmt::Display;
use std::io::{Cursor, Write};
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// A picture of numbers.
struct Picture {
    name: &'static str,
    width: usize,
    pixels: Vec<[u8; 4]>,
    /// Whether the fourth number is written.
    alpha: bool,
}

impl Picture {
    /// As a WebP without loss, with what is above taken for a pixel's prediction where that is smaller.
    fn webp(&self) -> std::result::Result<Vec<u8>, EncodingError> {
        let height = self.pixels.len().div_ceil(self.width);
        let (channels, color) = if self.alpha { (4, ColorType::Rgba8) } else { (3, ColorType::Rgb8) };
        let mut data: Vec<u8> = self.pixels.iter().flat_map(|p| &p[..channels]).copied().collect();
        data.resize(self.width * height * channels, 0);
        let encode = |predict: bool| {
            let (mut bytes, mut params) = (Vec::new(), EncoderParams::default());
            params.use_predictor_transform = predict;
            let mut encoder = WebPEncoder::new(&mut bytes);
            encoder.set_params(params);
            encoder.encode(&data, self.width as u32, height as u32, color).map(|()| bytes)
        };
        let (plain, predicted) = (encode(false)?, encode(true)?);
        Ok(if predicted.len() < plain.len() { predicted } else { plain })
    }
}

/// Writes a SOG, which errors call `place`, in the order of `g`.
pub(in crate::splat) fn write(w: &mut dyn Write, place: &Path, g: &Gaussians, antialias: bool) -> Result<()> {
    let each = |f: &(dyn Fn(usize) -> [u8; 4] + Sync)| (0..g.len()).into_par_iter().map(f).collect();
    // About as wide as high, and a multiple of four.
    let width = 4 * (0.25 * (g.len() as f64).sqrt()).ceil() as usize;
    let picture = |name, pixels, alpha| Picture { name, width, pixels, alpha };

    // Positions: shares of a range of sign(x) ln(1 + |x|).
    let log = |v: f32| f64::from(v).abs().ln_1p().copysign(v.into()) as f32;
    let logs = |k: usize| g.means.iter().map(move |m| log(m[k]));
    let low = [0, 1, 2].map(|k| logs(k).fold(f32::INFINITY, f32::min));
    let high = [0, 1, 2].map(|k| logs(k).fold(f32::NEG_INFINITY, f32::max));
    let place_of = |i: usize, byte: usize| {
        let steps = |k: usize| fraction(log(g.means[i][k]), low[k], high[k], 65535);
        [steps(0).to_le_bytes()[byte], steps(1).to_le_bytes()[byte], steps(2).to_le_bytes()[byte], 255]
    };
    let rotation = |i: usize| {
        let most = std::f32::consts::FRAC_1_SQRT_2;
        let (largest, small) = smallest_three(g.rotations[i]);
        let [a, b, c] = small.map(|v| fraction(v, -most, most, 255) as u8);
        [a, b, c, 252 + largest as u8]
    };
    let scales = Codebook::of(g.log_scales.as_flattened().to_vec());
    let scale = |i: usize| {
        let [x, y, z] = g.log_scales[i].map(|s| scales.byte(s));
        [x, y, z, 255]
    };
    let colors = Codebook::of((0..g.len()).flat_map(|i| &g.sh_of(i)[..3]).copied().collect());
    let color = |i: usize| {
        let rgb = g.sh_of(i);
        let opacity = fraction(g.opacity(i), 0.0, 1.0, 255) as u8;
        [colors.byte(rgb[0]), colors.byte(rgb[1]), colors.byte(rgb[2]), opacity]
    };
    let mut pictures = vec![
        picture("means_l.webp", each(&|i| place_of(i, 0)), false),
        picture("means_u.webp", each(&|i| place_of(i, 1)), false),
        picture("scales.webp", each(&scale), false),
        picture("quats.webp", each(&rotation), true),
        picture("sh0.webp", each(&color), true),
    ];
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": concat!("cags ", env!("CARGO_PKG_VERSION")) },
        "count": g.len(),
        "model": if antialias { "antialiased" } else { "default" },
        "means": { "mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": scales.0, "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colors.0, "files": ["sh0.webp"] },
    });
    if g.sh_degree > 0 {
        let (rows, label) = palette(g);
        let codebook = Codebook::of(rows.concat());
        let entry = |rgb: &[f32]| [codebook.byte(rgb[0]), codebook.byte(rgb[1]), codebook.byte(rgb[2]), 255];
        let rows_wide = PALETTE_COLUMNS * (sh_coefficients(g.sh_degree) - 1);
        let entries = rows.iter().flat_map(|row| row.chunks_exact(3).map(entry)).collect();
        pictures.push(Picture { name: "shN_centroids.webp", width: rows_wide, pixels: entries, alpha: false });
        // Nobody reads blue. WebP writes the difference to green, which is nothing so.
        let labels = label.iter().map(|l| l.to_le_bytes()).map(|[low, high]| [low, high, high, 255]).collect();
        pictures.push(picture("shN_labels.webp", labels, false));
        meta["shN"] = json!({
            "count": rows.len(),
            "bands": g.sh_degree,
            "codebook": codebook.0,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }

    let failed = |e: &dyn Display| Error::new(format!("cannot be written: {e}")).file(place);
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    // Pictures are packed already.
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut put = |name: &str, bytes: &[u8]| -> Result<()> {
        zip.start_file(name, stored.last_modified_time(zip::DateTime::default())).map_err(|e| failed(&e))?;
        zip.write_all(bytes).map_err(|e| failed(&e))
    };
    put(META, meta.to_string().as_bytes())?;
    let packed: Vec<_> = pictures.par_iter().map(|p| (p.name, p.webp())).collect();
    for (name, bytes) in packed {
        put(name, &bytes.map_err(|e| failed(&e))?)?;
    }
    let bytes = zip.finish().map_err(|e| failed(&e))?.into_inner();
    w.write_all(&bytes).at("write", place)
}
