//! The comment of a PLY that says what was subtracted from its positions: `comment shift 448262 5411932 114`.

use super::table;
use gs_io::Result;

const WORD: &str = "shift";

/// The comment of a shift; none for zeros.
pub fn comment(shift: [f64; 3]) -> Option<String> {
    (shift != [0.0; 3]).then(|| format!("{WORD} {}", crate::say_shift(shift)))
}

/// The shift that a file's comments give: zeros where none does.
pub(super) fn of(bytes: &[u8]) -> Result<[f64; 3]> {
    Ok(among(&table::read_header(bytes, [])?.0))
}

pub(super) fn among(comments: &[&str]) -> [f64; 3] {
    let parse = |comment: &&str| {
        let (WORD, numbers) = comment.split_once(' ')? else { return None };
        let numbers: Option<Vec<f64>> = numbers.split_ascii_whitespace().map(|w| w.parse().ok()).collect();
        <[f64; 3]>::try_from(numbers?).ok().filter(|s| s.iter().all(|v| v.is_finite()))
    };
    comments.iter().find_map(parse).unwrap_or_default()
}

pub(super) fn sum(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|c| a[c] + b[c])
}
