//! NumPy `.npy` arrays (format versions 1 to 3, C order), little-endian.

use crate::{Error, IoContext, Result, write_atomic};
use ndarray::{ArrayD, ArrayRef, Dimension};
use std::fs;
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";

/// Reads an array of any real dtype (`f2 f4 f8 i1 i2 i4 i8 u1 u2 u4 u8 b1`) as f32.
///
/// # Errors
/// Names file and field when the file is not an npy, is cut short or longer than its header says, is in Fortran order,
/// big-endian, or of another dtype.
pub fn read_f32(path: impl AsRef<Path>) -> Result<ArrayD<f32>> {
    let path = path.as_ref();
    let bytes = fs::read(path).at("read", path)?;
    parse(&bytes).map_err(|e| e.file(path))
}

/// Parses an npy from memory; see [`read_f32`].
pub fn parse(bytes: &[u8]) -> Result<ArrayD<f32>> {
    let bad = |what: &str| Error::new(what).hint("write it again with numpy.save");
    if bytes.len() < 10 || &bytes[..6] != MAGIC {
        return Err(bad("not an npy file").field("magic"));
    }
    let (start, header_len) = match bytes[6] {
        1 => (10usize, usize::from(u16::from_le_bytes([bytes[8], bytes[9]]))),
        2 | 3 if bytes.len() >= 12 => (12, u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize),
        v => return Err(bad("unknown npy version").field("version").found(v).expected("1, 2 or 3")),
    };
    let end = start.checked_add(header_len).filter(|&e| e <= bytes.len());
    let Some(end) = end else {
        return Err(bad("the header runs past the end of the file").field("header length").found(header_len));
    };
    let header = std::str::from_utf8(&bytes[start..end]).map_err(|_| bad("the header is not text").field("header"))?;
    let value = |key: &str| -> Result<&str> {
        let at = header.find(&format!("'{key}'")).ok_or_else(|| bad("missing from the header").field(key))?;
        let rest = &header[at + key.len() + 2..];
        Ok(rest.trim_start().trim_start_matches(':').trim_start())
    };
    if !value("fortran_order")?.starts_with("False") {
        return Err(Error::new("Fortran order is not supported")
            .field("fortran_order")
            .found("True")
            .expected("False")
            .hint("save numpy.ascontiguousarray(array)"));
    }
    let descr = value("descr")?;
    let descr = descr.strip_prefix('\'').and_then(|d| d.split('\'').next()).unwrap_or(descr);
    let shape_text = value("shape")?;
    let inner = shape_text.strip_prefix('(').and_then(|s| s.split(')').next());
    let Some(inner) = inner else { return Err(bad("not a tuple").field("shape").found(shape_text.trim())) };
    let mut shape = Vec::new();
    for part in inner.split(',').map(str::trim).filter(|p| !p.is_empty()) {
        shape.push(part.parse::<usize>().map_err(|_| bad("not a whole number").field("shape").found(part))?);
    }
    // An array without elements takes no room whatever its other extents say; nothing real is wider than this.
    if let Some(&wide) = shape.iter().find(|&&extent| extent > bytes.len().max(1 << 16)) {
        return Err(bad("an extent is out of proportion to the file").field("shape").found(wide));
    }
    let count = shape.iter().try_fold(1usize, |a, &b| a.checked_mul(b));
    let body = &bytes[end..];
    // A first character that is none of ASCII's is no byte order either.
    let (order, kind) = descr.split_at_checked(1).unwrap_or((descr, ""));
    let size: usize = kind.get(1..).and_then(|s| s.parse().ok()).unwrap_or(0);
    if order == ">" {
        return Err(bad("big-endian arrays are not supported").field("descr").found(descr).expected("little-endian"));
    }
    macro_rules! read {
        ($t:ty) => {
            |body| {
                body.chunks_exact(size_of::<$t>()).map(|c| <$t>::from_le_bytes(c.try_into().unwrap()) as f32).collect()
            }
        };
    }
    let read: fn(&[u8]) -> Vec<f32> = match kind {
        "f4" => read!(f32),
        "f8" => read!(f64),
        "f2" => |body| body.chunks_exact(2).map(|c| half::f16::from_le_bytes([c[0], c[1]]).to_f32()).collect(),
        "i1" => read!(i8),
        "i2" => read!(i16),
        "i4" => read!(i32),
        "i8" => read!(i64),
        "u1" | "b1" => read!(u8),
        "u2" => read!(u16),
        "u4" => read!(u32),
        "u8" => read!(u64),
        _ => return Err(bad("unsupported dtype").field("descr").found(descr).expected("a real number type")),
    };
    let expected_bytes = count.and_then(|c| c.checked_mul(size));
    if expected_bytes != Some(body.len()) {
        return Err(Error::new("the file's length does not fit its shape")
            .field("shape")
            .found(format!("{} bytes of data", body.len()))
            .expected(format!("{descr} x {shape:?}"))
            .hint("the file is cut short or was overwritten: make it again"));
    }
    ArrayD::from_shape_vec(shape, read(body))
        .map_err(|e| bad(&format!("not the shape of an array: {e}")).field("shape"))
}

fn write<T: bytemuck::Pod, D: Dimension>(path: &Path, descr: &str, array: &ArrayRef<T, D>) -> Result<()> {
    let shape = array.shape();
    let tuple = format!("{shape:?}").replace('[', "(").replace(']', if shape.len() == 1 { ",)" } else { ")" });
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {tuple}, }}");
    // Data begin at a multiple of 64 bytes: 10 come before the header, and a line break ends it.
    let width = (header.len() + 11).next_multiple_of(64) - 11;
    let header = format!("{header:<width$}\n");
    let ordered = array.as_standard_layout();
    let body = bytemuck::cast_slice(ordered.as_slice().expect("standard layout"));
    let parts = [MAGIC, &[1, 0], &(header.len() as u16).to_le_bytes(), header.as_bytes(), body];
    write_atomic(path, |w| parts.iter().try_for_each(|part| w.write_all(part)).at("write", path))
}

/// Writes an f32 array, in C order whatever its layout in memory.
pub fn write_f32<D: Dimension>(path: impl AsRef<Path>, array: &ArrayRef<f32, D>) -> Result<()> {
    write(path.as_ref(), "<f4", array)
}

/// Writes an i32 array as [`write_f32`] does.
pub fn write_i32<D: Dimension>(path: impl AsRef<Path>, array: &ArrayRef<i32, D>) -> Result<()> {
    write(path.as_ref(), "<i4", array)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, arr1, arr2};

    #[test]
    fn round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.npy");
        for shape in [vec![6], vec![2, 3], vec![1, 2, 3], vec![0, 4]] {
            let data: Vec<f32> = (0..shape.iter().product::<usize>()).map(|i| i as f32 - 1.5).collect();
            let array = ArrayD::from_shape_vec(shape, data).unwrap();
            write_f32(&p, &array).unwrap();
            assert_eq!(read_f32(&p).unwrap(), array);
            assert_eq!(fs::read(&p).unwrap().iter().position(|&b| b == b'\n').unwrap() % 64, 63);
        }
        write_i32(&p, &arr1(&[-1, 0, 7])).unwrap();
        assert_eq!(read_f32(&p).unwrap(), arr1(&[-1.0, 0.0, 7.0]).into_dyn());
        let table = arr2(&[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        write_f32(&p, &table.t()).unwrap();
        assert_eq!(read_f32(&p).unwrap(), table.t().into_dyn(), "in C order whatever lies in memory");
    }

    #[test]
    fn a_shape_beyond_memory_is_an_error_even_without_elements() {
        let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 65536, 65536, 65536, 65536)}";
        let bytes = [MAGIC, &[1, 0, header.len() as u8, 0], header.as_bytes()].concat();
        assert!(parse(&bytes).unwrap_err().to_string().starts_with("shape: not the shape of an array"));
    }

    #[test]
    fn damaged_files_are_refused_or_hold_what_their_header_says() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.npy");
        write_f32(&p, &Array2::<f32>::ones((4, 4))).unwrap();
        let good = fs::read(&p).unwrap();
        assert!((0..good.len()).all(|length| parse(&good[..length]).is_err()));
        for bit in 0..8 * good.len() {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            // A flipped bit can make another shape, such as (0, 4), which a cut file can fill.
            for length in (0..=bytes.len()).rev().step_by(4) {
                if let Ok(a) = parse(&bytes[..length]) {
                    assert_eq!(a.shape().iter().product::<usize>(), a.len());
                }
            }
        }
    }
}
