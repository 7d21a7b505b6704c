//! Islands and holes of a mask.

/// Removes connected islands of fewer than `min` pixels, except the largest, from a mask `[height][width]`, and fills holes
/// of fewer than `min` pixels. Neighbours share an edge.
pub fn clean(mask: &mut [bool], width: usize, min: usize) {
    remove_small(mask, width, min, true);
    remove_small(mask, width, min, false);
}

/// Flips connected regions of `value` with fewer than `min` pixels; the largest island stays.
fn remove_small(mask: &mut [bool], width: usize, min: usize, value: bool) {
    let mut seen = vec![false; mask.len()];
    let mut stack = Vec::new();
    let mut small: Vec<Vec<usize>> = Vec::new();
    let mut largest = 0;
    for start in 0..mask.len() {
        if seen[start] || mask[start] != value {
            continue;
        }
        let mut region = Vec::new();
        let mut count = 0;
        seen[start] = true;
        stack.push(start);
        while let Some(i) = stack.pop() {
            count += 1;
            if region.len() < min {
                region.push(i);
            }
            let x = i % width;
            let mut visit = |n: usize| {
                if !seen[n] && mask[n] == value {
                    seen[n] = true;
                    stack.push(n);
                }
            };
            if x > 0 {
                visit(i - 1);
            }
            if x + 1 < width {
                visit(i + 1);
            }
            if i >= width {
                visit(i - width);
            }
            if i + width < mask.len() {
                visit(i + width);
            }
        }
        largest = largest.max(count);
        if count < min {
            small.push(region);
        }
    }
    // Without this a mask of crumbs would vanish as a whole.
    let spared = if value && largest < min { small.iter().position(|r| r.len() == largest) } else { None };
    for (_, region) in small.iter().enumerate().filter(|(k, _)| Some(*k) != spared) {
        for &i in region {
            mask[i] = !value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(picture: &[&str], min: usize) -> Vec<String> {
        let width = picture[0].len();
        let mut mask: Vec<bool> = picture.concat().bytes().map(|b| b == b'#').collect();
        clean(&mut mask, width, min);
        mask.chunks(width).map(|r| r.iter().map(|&m| if m { '#' } else { '.' }).collect()).collect()
    }

    #[test]
    fn small_islands_go_and_small_holes_close() {
        let before = ["#####...", "#.###..#", "#####...", "#..##.##", "#..##..."];
        let after = ["#####...", "#####...", "#####...", "#..##...", "#..##..."];
        assert_eq!(run(&before, 3), after);
        assert_eq!(run(&before, 0), before);
        // The largest island stays even when it is small; diagonal neighbours are not connected.
        assert_eq!(run(&["#...", ".##.", "...."], 3), ["....", ".##.", "...."]);
        assert_eq!(run(&["####", "#.##"], 3), ["####", "####"]);
    }
}
