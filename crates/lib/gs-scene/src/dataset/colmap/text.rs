//! COLMAP's text model files.

use super::super::MARK;
use super::{AGAIN, Points, Registered, intrinsics, pose, push_camera, push_point};
use crate::lens::Lens;
use gs_io::{Error, Result};
use std::collections::BTreeMap;

/// Lines of a text model with their numbers, without comments and, where `keep_empty` is not set, empty lines.
fn lines(bytes: &[u8], keep_empty: bool) -> Result<impl Iterator<Item = (usize, &str)>> {
    let text = std::str::from_utf8(bytes).map_err(|_| Error::new("not a text file").hint(AGAIN))?;
    let text = text.strip_prefix(MARK).unwrap_or(text);
    let all = text.lines().map(str::trim).enumerate().map(|(i, l)| (i + 1, l));
    Ok(all.filter(move |(_, l)| !l.starts_with('#') && (keep_empty || !l.is_empty())))
}

fn numbers<T: std::str::FromStr>(words: &[&str], line: usize) -> Result<Vec<T>> {
    let parse = |w: &&str| {
        let wrong = |_| Error::new("not a number of its kind").field(format!("line {line}")).found(w).hint(AGAIN);
        w.parse().map_err(wrong)
    };
    words.iter().map(parse).collect()
}

fn too_few(line: usize, text: &str, expected: &str) -> Error {
    let found: String = text.chars().take(60).collect();
    Error::new("the line is too short").field(format!("line {line}")).found(found).expected(expected).hint(AGAIN)
}

/// `cameras.txt`.
pub(super) fn cameras(bytes: &[u8]) -> Result<BTreeMap<u32, Lens>> {
    let mut out = BTreeMap::new();
    for (line, text) in lines(bytes, false)? {
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let [id, model, w, h, params @ ..] = &words[..] else {
            return Err(too_few(line, text, "id, model, width, height, parameters"));
        };
        let id = numbers::<u32>(&[id], line)?[0];
        let size = numbers::<u64>(&[w, h], line)?;
        let p = numbers::<f64>(params, line)?;
        let field = format!("line {line}");
        push_camera(&mut out, id, intrinsics(model, size[0], size[1], &p, &field)?, &field)?;
    }
    Ok(out)
}

/// `images.txt`; which points each image sees is skipped.
pub(super) fn images(bytes: &[u8]) -> Result<Vec<Registered>> {
    // Two lines an image; the second lists its points as triples, and may be empty or, where empty lines were dropped, missing.
    let mut all = lines(bytes, true)?.peekable();
    let mut out = Vec::new();
    while let Some((line, text)) = all.next() {
        if text.is_empty() {
            continue;
        }
        let (words, name) =
            head::<9>(text).ok_or_else(|| too_few(line, text, "id, qw qx qy qz, tx ty tz, camera, name"))?;
        let v = numbers::<f64>(&words[1..8], line)?;
        let (rotation, translation) = pose([v[0], v[1], v[2], v[3]], [v[4], v[5], v[6]], &format!("line {line}"))?;
        let camera = numbers::<u32>(&words[8..], line)?[0];
        out.push(Registered { name: name.to_string(), camera, rotation, translation });
        let Some((line, points)) = all.next_if(|(_, next)| !is_image(next)) else { continue };
        if points.split_ascii_whitespace().count() % 3 != 0 {
            return Err(Error::new("not a list of an image's points")
                .field(format!("line {line}"))
                .expected("triples x y id, or an empty line, after each image")
                .hint(AGAIN));
        }
    }
    Ok(out)
}

/// Whether a line is of an image and no list of points, which ends with a number.
fn is_image(line: &str) -> bool {
    head::<9>(line).is_some_and(|(_, name)| name.rsplit(' ').next().is_some_and(|end| end.parse::<f64>().is_err()))
}

/// The first words of a line and what follows them, which may hold blanks; none where either is missing.
fn head<const N: usize>(line: &str) -> Option<([&str; N], &str)> {
    let mut words = [""; N];
    let mut rest = line.trim();
    for word in &mut words {
        (*word, rest) = rest.split_once(|c: char| c.is_ascii_whitespace())?;
        rest = rest.trim_start();
    }
    (!rest.is_empty()).then_some((words, rest))
}

/// `points3D.txt`; errors and tracks are skipped.
pub(super) fn points(bytes: &[u8]) -> Result<Points> {
    let mut out = Points::default();
    for (line, text) in lines(bytes, false)? {
        let words: Vec<&str> = text.split_ascii_whitespace().take(7).collect();
        if words.len() < 7 {
            return Err(too_few(line, text, "id, x y z, r g b"));
        }
        let p = numbers::<f64>(&words[1..4], line)?;
        let c = numbers::<u8>(&words[4..7], line)?;
        push_point(&mut out, [p[0], p[1], p[2]], [c[0], c[1], c[2]], &format!("line {line}"))?;
    }
    Ok(out)
}
