//! Polygons around the pixels of a mask, as people draw labels: one closed line per connected piece.
//!
//! The line runs through the centres of border pixels, as OpenCV's contours do, so that OpenCV's `fillPoly` (which
//! paints the line itself) gives back the very pixels. A hole is cut out by running to it, around it and back along
//! the same way.

/// A closed line through pixel centres, given as whole pixel coordinates.
pub type Polygon = Vec<[i32; 2]>;

/// The eight neighbours of a pixel, clockwise in the image from the right.
const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];

/// Polygons around the pixels where `inside`, one per 8-connected piece of at least `smallest` pixels, from the top.
pub fn trace(inside: &[bool], width: usize, height: usize, smallest: usize) -> Vec<Polygon> {
    // With a frame of empty pixels around the image, so that neighbours need no checks.
    let (w, h) = (width + 2, height + 2);
    let mut piece = vec![0u32; w * h];
    let filled = |x: i32, y: i32| {
        (0..width as i32).contains(&x) && (0..height as i32).contains(&y) && inside[y as usize * width + x as usize]
    };
    let at = |p: [i32; 2]| (p[1] + 1) as usize * w + (p[0] + 1) as usize;
    let mut polygons = Vec::new();
    let all = (0..height as i32).flat_map(|y| (0..width as i32).map(move |x| [x, y]));
    for (count, start) in (1u32..).zip(all) {
        let pixels = flood(start, &AROUND, |p| {
            let new = filled(p[0], p[1]) && piece[at(p)] == 0;
            if new {
                piece[at(p)] = count;
            }
            new
        });
        if pixels.len() >= smallest {
            polygons.push(outline(&pixels, |p| piece[at(p)] == count));
        }
    }
    polygons
}

/// The pixels that `start` is connected with, itself first. `take` says whether a pixel belongs to them and is new.
fn flood(start: [i32; 2], steps: &[[i32; 2]], mut take: impl FnMut([i32; 2]) -> bool) -> Vec<[i32; 2]> {
    let mut pixels = Vec::from_iter(take(start).then_some(start));
    let mut next = 0;
    while let Some(&[x, y]) = pixels.get(next) {
        next += 1;
        pixels.extend(steps.iter().map(|[dx, dy]| [x + dx, y + dy]).filter(|&q| take(q)));
    }
    pixels
}

/// The line around one connected piece, holes cut out.
fn outline(pixels: &[[i32; 2]], own: impl Fn([i32; 2]) -> bool + Copy) -> Polygon {
    let Some(&start) = pixels.iter().min_by_key(|p| (p[1], p[0])) else { return Vec::new() };
    let mut line = border(start, [start[0] - 1, start[1]], own);
    for (hole_left, y) in holes(pixels, own) {
        // The pixel left of the hole's leftmost column lies on the hole's border. Going left from it meets the border
        // of what is already drawn: the outer line, or a hole that begins further left.
        let first = [hole_left - 1, y];
        let mut last = first;
        while own([last[0] - 1, y]) {
            last[0] -= 1;
        }
        let Some(joint) = line.iter().position(|&p| p == last) else { continue };
        let around = border(first, [hole_left, y], own);
        let way: Vec<[i32; 2]> = (last[0]..=first[0]).map(|x| [x, y]).collect();
        let detour = way.iter().copied().chain(around).chain([first]).chain(way.iter().rev().copied());
        line.splice(joint + 1..joint + 1, detour.collect::<Vec<_>>());
    }
    straightened(&line)
}

/// Holes of a piece: the leftmost column and a row of it, ordered from the left.
fn holes(pixels: &[[i32; 2]], own: impl Fn([i32; 2]) -> bool) -> Vec<(i32, i32)> {
    let min = |i: usize| pixels.iter().map(|p| p[i]).min().unwrap_or(0) - 1;
    let max = |i: usize| pixels.iter().map(|p| p[i]).max().unwrap_or(0) + 1;
    let (x0, y0, x1, y1) = (min(0), min(1), max(0), max(1));
    let w = (x1 - x0 + 1) as usize;
    let at = |x: i32, y: i32| (y - y0) as usize * w + (x - x0) as usize;
    let mut seen = vec![false; w * (y1 - y0 + 1) as usize];
    let mut found = Vec::new();
    // The first region met is the outside. Empty pixels connect by their sides, filled ones by corners too.
    for (y, x) in (y0..=y1).flat_map(|y| (x0..=x1).map(move |x| (y, x))) {
        let hole = flood([x, y], &[[1, 0], [-1, 0], [0, 1], [0, -1]], |[x, y]| {
            let new = (x0..=x1).contains(&x) && (y0..=y1).contains(&y) && !own([x, y]) && !seen[at(x, y)];
            if new {
                seen[at(x, y)] = true;
            }
            new
        });
        let outside = x == x0 && y == y0;
        found.extend(hole.into_iter().map(|[x, y]| (x, y)).min().filter(|_| !outside));
    }
    found.sort_unstable();
    found
}

/// Follows the border from pixel `start`, whose neighbour `empty` is not filled, until it comes round: Moore
/// neighbour tracing, stopped when start is left the same way again.
fn border(start: [i32; 2], empty: [i32; 2], own: impl Fn([i32; 2]) -> bool) -> Polygon {
    let direction =
        |from: [i32; 2], to: [i32; 2]| AROUND.iter().position(|d| [from[0] + d[0], from[1] + d[1]] == to).unwrap_or(0);
    let step = |p: [i32; 2], from: usize| {
        (1..=8).map(|k| (from + k) % 8).find(|&k| own([p[0] + AROUND[k][0], p[1] + AROUND[k][1]]))
    };
    let mut line = vec![start];
    let Some(first) = step(start, direction(start, empty)) else { return line };
    let (mut here, mut way) = (start, first);
    loop {
        here = [here[0] + AROUND[way][0], here[1] + AROUND[way][1]];
        // Search on from the empty neighbour that the last search passed just before it found this pixel.
        let Some(next) = step(here, (way + if way.is_multiple_of(2) { 5 } else { 4 }) % 8) else { return line };
        if here == start && next == first {
            return line;
        }
        line.push(here);
        way = next;
    }
}

/// The line without points in the middle of straight runs.
fn straightened(line: &[[i32; 2]]) -> Polygon {
    let n = line.len();
    let toward = |a: [i32; 2], b: [i32; 2]| [(b[0] - a[0]).signum(), (b[1] - a[1]).signum()];
    let bends = |i: usize| {
        let (before, here, after) = (line[(i + n - 1) % n], line[i], line[(i + 1) % n]);
        before != here && toward(before, here) != toward(here, after)
    };
    let kept: Polygon = (0..n).filter(|&i| bends(i)).map(|i| line[i]).collect();
    if kept.is_empty() { line[..1].to_vec() } else { kept }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::fill;
    use rand::{RngExt, SeedableRng};

    fn back(inside: &[bool], width: usize, height: usize) -> Vec<bool> {
        let mut all = vec![false; width * height];
        for p in trace(inside, width, height, 1) {
            for (a, b) in all.iter_mut().zip(fill(&p, width, height)) {
                *a |= b;
            }
        }
        all
    }

    fn picture(rows: &[&str]) -> (Vec<bool>, usize, usize) {
        (rows.iter().flat_map(|r| r.bytes().map(|b| b == b'#')).collect(), rows[0].len(), rows.len())
    }

    #[test]
    fn pictures_come_back_exactly() {
        let pictures: [&[&str]; 6] = [
            &["#"],
            &["####", "####"],
            &["..#..", ".###.", "#####"],
            &["######", "#....#", "#.##.#", "#....#", "######"],
            &["########", "#.##.###", "########", "##.#..##", "########"],
            &["#..##.", ".#..##", "..#...", "......", "######"],
        ];
        for p in pictures {
            let (inside, w, h) = picture(p);
            assert_eq!(back(&inside, w, h), inside, "{p:?}");
        }
    }

    #[test]
    fn random_blobs_come_back_exactly() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        for density in [0.3, 0.5, 0.7, 0.9] {
            for _ in 0..200 {
                let (w, h) = (rng.random_range(1..20), rng.random_range(1..20));
                let inside: Vec<bool> = (0..w * h).map(|_| rng.random::<f64>() < density).collect();
                assert_eq!(back(&inside, w, h), inside, "{w} x {h}: {inside:?}");
            }
        }
    }

    #[test]
    fn small_pieces_are_left_out() {
        let (inside, w, h) = picture(&["###...#", "###....", "###...."]);
        let polygons = trace(&inside, w, h, 4);
        assert_eq!(polygons, [vec![[0, 0], [2, 0], [2, 2], [0, 2]]]);
    }
}
