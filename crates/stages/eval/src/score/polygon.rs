//! Filled polygons, pixel for pixel as OpenCV's `fillPoly` fills them.
//!
//! The LERF-OVS truth is polygons, and its published scores were computed on masks that `cv2.fillPoly` drew: even-odd
//! inside *and* the 8-connected lines of the border. A scan line through pixel centres gives slightly smaller masks
//! (docs/protocols.md). The rules below are those of OpenCV 4.8 to 4.10, from the years of the published numbers;
//! earlier and later versions differ from them by single pixels on some borders. The masks in
//! `testdata/fillpoly.json` were made by 4.10 (4.8.1 gives the same).

use crate::Mask;

/// Fractional bits of OpenCV's fixed-point x.
const SHIFT: u32 = 16;
const HALF: i64 = 1 << (SHIFT - 1);

/// Largest coordinate that is drawn; beyond it, fixed-point products could overflow. Callers clamp to it.
pub const MAX_COORDINATE: i64 = 1 << 24;

/// A side of the polygon, for scan lines `y0 <= y < y1`.
struct Edge {
    y0: i64,
    y1: i64,
    /// Fixed-point x on scan line `y0`.
    x: i64,
    /// Fixed-point change of x per scan line.
    dx: i64,
}

/// Adds the polygon with these vertices (x, y) to the mask, border included. Vertices may lie outside the image.
pub fn fill_polygon(mask: &mut Mask, vertices: &[[i64; 2]]) {
    let (w, h) = (mask.width as i64, mask.height as i64);
    let Some(&last) = vertices.last() else { return };
    if w == 0 || h == 0 {
        return;
    }
    let clamp = |[x, y]: [i64; 2]| [x, y].map(|c| c.clamp(-MAX_COORDINATE, MAX_COORDINATE));
    let mut edges = Vec::with_capacity(vertices.len());
    let mut a = clamp(last);
    for &vertex in vertices {
        let b = clamp(vertex);
        draw_line(mask, a, b);
        if a[1] != b[1] {
            edges.push(edge(a, b, w, h));
        }
        a = b;
    }
    let (Some(top), Some(bottom)) = (edges.iter().map(|e| e.y0).min(), edges.iter().map(|e| e.y1).max()) else {
        return;
    };
    let mut crossings = Vec::with_capacity(edges.len());
    for y in top.max(0)..bottom.min(h) {
        crossings.clear();
        crossings.extend(edges.iter().filter(|e| e.y0 <= y && y < e.y1).map(|e| e.x + (y - e.y0) * e.dx));
        crossings.sort_unstable();
        for pair in crossings.chunks_exact(2) {
            let (x0, x1) = ((pair[0] >> SHIFT).max(0), (pair[1] >> SHIFT).min(w - 1));
            if x0 <= x1 {
                let row = (y * w) as usize;
                mask.bits[row + x0 as usize..=row + x1 as usize].fill(true);
            }
        }
    }
}

/// The side from `a` to `b`, which differ in y. A side that leaves the image takes its slope from the clipped ends, and
/// only then is not rounded to the nearest pixel: so does OpenCV.
fn edge(a: [i64; 2], b: [i64; 2], w: i64, h: i64) -> Edge {
    let inside = |[x, y]: [i64; 2]| (0..w).contains(&x) && (0..h).contains(&y);
    let fixed = |[x, y]: [i64; 2], add: i64| [(x << SHIFT) + add, y];
    let (from, to) = if inside(a) && inside(b) {
        (fixed(a, HALF), fixed(b, HALF))
    } else {
        match clip(a, b, w, h) {
            (c, d, _) if c[1] != d[1] => (fixed(c, 0), fixed(d, 0)),
            _ => (fixed(a, 0), fixed(b, 0)),
        }
    };
    let dx = (to[0] - from[0]) / (to[1] - from[1]);
    if a[1] < b[1] {
        Edge { y0: a[1], y1: b[1], x: from[0] + (a[1] - from[1]) * dx, dx }
    } else {
        Edge { y0: b[1], y1: a[1], x: to[0] + (b[1] - to[1]) * dx, dx }
    }
}

/// Clips a segment to the image by region codes. Returns the ends (moved as far as clipping went) and whether anything
/// is left inside.
fn clip(mut a: [i64; 2], mut b: [i64; 2], w: i64, h: i64) -> ([i64; 2], [i64; 2], bool) {
    let (right, bottom) = (w - 1, h - 1);
    let horizontal = |p: [i64; 2]| u8::from(p[0] < 0) + 2 * u8::from(p[0] > right);
    let code = |p: [i64; 2]| horizontal(p) + 4 * u8::from(p[1] < 0) + 8 * u8::from(p[1] > bottom);
    // The double quotient truncated: OpenCV's arithmetic.
    let along = |step: i64, run: i64, rise: i64| (step as f64 * run as f64 / rise as f64) as i64;
    let (mut ca, mut cb) = (code(a), code(b));
    if ca & cb == 0 && ca | cb != 0 {
        if ca & 12 != 0 {
            let y = if ca < 8 { 0 } else { bottom };
            a[0] += along(y - a[1], b[0] - a[0], b[1] - a[1]);
            a[1] = y;
            ca = horizontal(a);
        }
        if cb & 12 != 0 {
            let y = if cb < 8 { 0 } else { bottom };
            b[0] += along(y - b[1], b[0] - a[0], b[1] - a[1]);
            b[1] = y;
            cb = horizontal(b);
        }
        if ca & cb == 0 && ca | cb != 0 {
            if ca != 0 {
                let x = if ca == 1 { 0 } else { right };
                a[1] += along(x - a[0], b[1] - a[1], b[0] - a[0]);
                a[0] = x;
                ca = 0;
            }
            if cb != 0 {
                let x = if cb == 1 { 0 } else { right };
                b[1] += along(x - b[0], b[1] - a[1], b[0] - a[0]);
                b[0] = x;
                cb = 0;
            }
        }
    }
    (a, b, ca | cb == 0)
}

/// An 8-connected line (Bresenham), drawn from left to right, both ends included.
fn draw_line(mask: &mut Mask, a: [i64; 2], b: [i64; 2]) {
    let (w, h) = (mask.width as i64, mask.height as i64);
    let (a, b, visible) = clip(a, b, w, h);
    if !visible {
        return;
    }
    let (a, b) = if b[0] < a[0] { (b, a) } else { (a, b) };
    let (dx, dy) = (b[0] - a[0], (b[1] - a[1]).abs());
    let down = if b[1] < a[1] { -1 } else { 1 };
    let steep = dy > dx;
    let (major, minor) = if steep { (dy, dx) } else { (dx, dy) };
    let mut error = major - 2 * minor;
    let [mut x, mut y] = a;
    for _ in 0..=major {
        mask.bits[(y * w + x) as usize] = true;
        let aside = i64::from(error < 0);
        error += 2 * (major * aside - minor);
        if steep {
            y += down;
            x += aside;
        } else {
            x += 1;
            y += down * aside;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize)]
    struct Case {
        name: String,
        width: usize,
        height: usize,
        polygon: Vec<[f64; 2]>,
        runs: Vec<[usize; 3]>,
    }

    #[test]
    fn every_pixel_is_as_opencv_fills_it() {
        let cases: Vec<Case> = serde_json::from_str(include_str!("../../testdata/fillpoly.json")).unwrap();
        assert!(cases.len() >= 20);
        for case in cases {
            let mut expected = Mask::new(case.width, case.height);
            for [y, x0, x1] in case.runs {
                expected.bits[y * case.width + x0..=y * case.width + x1].fill(true);
            }
            let mut mask = Mask::new(case.width, case.height);
            let vertices: Vec<[i64; 2]> = case.polygon.iter().map(|&[x, y]| [x as i64, y as i64]).collect();
            fill_polygon(&mut mask, &vertices);
            let wrong = mask.bits.iter().zip(&expected.bits).filter(|(a, b)| a != b).count();
            assert_eq!(wrong, 0, "{}: {wrong} pixels differ", case.name);
        }
    }

    #[test]
    fn huge_coordinates_neither_panic_nor_spill() {
        let mut mask = Mask::new(8, 6);
        fill_polygon(
            &mut mask,
            &[[i64::MIN, i64::MIN], [i64::MAX, i64::MIN], [i64::MAX, i64::MAX], [i64::MIN, i64::MAX]],
        );
        assert_eq!(mask.count(), 48, "the square around everything covers everything");
        fill_polygon(&mut Mask::new(0, 0), &[[0, 0], [3, 3]]);
    }
}
