//! Labels that another program gave the vertices of a scan: a file of one integer a vertex.

use gs_io::{Error, IoContext, Result, npy};
use std::path::Path;

/// Reads the label of every vertex: an npy of `[vertices]` or `[vertices, 1]`, any real dtype with whole numbers, or a text of
/// one whole number a line (or with spaces between). Negative ones are 0, which is no class.
///
/// # Errors
/// When the file is neither, a label is no whole number below 2^24, or there are not as many as `vertices`.
pub fn read(path: &Path, vertices: usize) -> Result<Vec<u32>> {
    let bytes = std::fs::read(path).at("read", path)?;
    let labels = if bytes.starts_with(b"\x93NUMPY") { of_npy(&bytes) } else { of_text(&bytes) };
    let labels = labels.map_err(|e| e.file(path))?;
    if labels.len() != vertices {
        return Err(Error::new("not a label per vertex")
            .file(path)
            .found(labels.len())
            .expected(format!("{vertices}, as many as the scan has vertices"))
            .hint("write the labels in the order of the vertices of *_vh_clean_2.labels.ply"));
    }
    Ok(labels)
}

/// Whole numbers from here on are not told apart in an npy of f32.
const LARGEST: f64 = 16_777_216.0;

fn of_npy(bytes: &[u8]) -> Result<Vec<u32>> {
    let array = npy::parse(bytes)?;
    if !matches!(array.shape(), [_] | [_, 1]) {
        let e = Error::new("not a list of labels").field("shape").found(format!("{:?}", array.shape()));
        return Err(e.expected("[vertices]"));
    }
    array.iter().enumerate().map(|(at, &v)| label(f64::from(v), at, &v)).collect()
}

fn of_text(bytes: &[u8]) -> Result<Vec<u32>> {
    let text = std::str::from_utf8(bytes)
        .map_err(|_| Error::new("neither an npy nor a text").expected("one NYU40 id a vertex"))?;
    let words = text.split_whitespace().enumerate();
    words.map(|(at, word)| label(word.parse().unwrap_or(f64::NAN), at, &word)).collect()
}

/// The label of a vertex, which a file says in these words.
fn label(value: f64, vertex: usize, said: &dyn std::fmt::Display) -> Result<u32> {
    if value.fract() == 0.0 && value.abs() < LARGEST {
        return Ok(value.max(0.0) as u32);
    }
    let e = Error::new("not a label").field(format!("vertex {vertex}")).found(said);
    Err(e.expected("a whole number: the NYU40 id of the vertex's class, 0 for none"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{arr1, arr2};

    #[test]
    fn labels_are_read_from_npy_and_text() {
        let dir = tempfile::tempdir().unwrap();
        let (array, text) = (dir.path().join("l.npy"), dir.path().join("l.txt"));
        npy::write_i32(&array, &arr1(&[5, -1, 40])).unwrap();
        std::fs::write(&text, "5\n-1\n40\n").unwrap();
        assert_eq!(read(&array, 3).unwrap(), [5, 0, 40]);
        assert_eq!(read(&text, 3).unwrap(), [5, 0, 40]);
        let bad = |path: &Path, parts: &[&str]| {
            let e = read(path, 3).unwrap_err().to_string();
            assert!(parts.iter().all(|p| e.contains(p)), "{parts:?}: {e}");
        };
        npy::write_f32(&array, &arr2(&[[1.0], [2.5], [3.0]])).unwrap();
        bad(&array, &["l.npy: vertex 1: not a label; found 2.5"]);
        npy::write_i32(&array, &arr2(&[[1, 2, 3]])).unwrap();
        bad(&array, &["shape: not a list of labels; found [1, 3], expected [vertices]"]);
        npy::write_i32(&array, &arr1(&[1, 2])).unwrap();
        bad(&array, &["not a label per vertex; found 2, expected 3"]);
        for (said, part) in
            [("1 2 wall", "vertex 2: not a label; found wall"), ("1 2 inf", "found inf"), ("", "found 0")]
        {
            std::fs::write(&text, said).unwrap();
            bad(&text, &[part]);
        }
        std::fs::write(&text, [0xff, 0xfe]).unwrap();
        bad(&text, &["neither an npy nor a text"]);
    }
}
