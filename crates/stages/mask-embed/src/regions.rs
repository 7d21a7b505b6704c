//! Islands and holes of a mask.

/// A mask where it can have pixels: a rectangle of a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// First column and row in the picture.
    pub x: usize,
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// `[height][width]`; outside there is nothing.
    pub mask: Vec<bool>,
}

impl Patch {
    /// Columns and rows in the picture of the mask's pixels.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let rows = self.mask.chunks(self.width.max(1)).enumerate();
        rows.flat_map(move |(y, row)| {
            row.iter().enumerate().filter(|(_, m)| **m).map(move |(x, _)| (self.x + x, self.y + y))
        })
    }

    /// Removes connected islands of fewer than `min` pixels, except the largest, and fills holes of fewer than `min` pixels.
    /// Neighbours share an edge. What lies beyond the rectangle in the `picture`, width and height, is taken to be large.
    pub fn clean(&mut self, picture: [usize; 2], min: usize) {
        let (width, height) = (self.width, self.mask.len() / self.width.max(1));
        let open = [self.x > 0, self.y > 0, self.x + width < picture[0], self.y + height < picture[1]];
        remove_small(&mut self.mask, width, min, true, [false; 4]);
        remove_small(&mut self.mask, width, min, false, open);
    }
}

/// Flips connected regions of `value` with fewer than `min` pixels; the largest island stays. Regions go on beyond the `open`
/// sides: left, top, right, bottom.
fn remove_small(mask: &mut [bool], width: usize, min: usize, value: bool, open: [bool; 4]) {
    let mut seen = vec![false; mask.len()];
    let mut stack = Vec::new();
    let mut small: Vec<Vec<usize>> = Vec::new();
    let mut largest = 0;
    for start in 0..mask.len() {
        if seen[start] || mask[start] != value {
            continue;
        }
        let mut region = Vec::new();
        let (mut count, mut goes_on) = (0, false);
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
            let inner = [x > 0, i >= width, x + 1 < width, i + width < mask.len()];
            for (side, to) in [i.wrapping_sub(1), i.wrapping_sub(width), i + 1, i + width].into_iter().enumerate() {
                if inner[side] {
                    visit(to);
                } else {
                    goes_on |= open[side];
                }
            }
        }
        largest = largest.max(count);
        if count < min && !goes_on {
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
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_patch_is_cleaned_as_the_whole_picture(
            inside in prop::collection::vec(prop::bool::weighted(0.6), 8 * 7),
            (x, y) in (0usize..=16, 0usize..=17),
            min in 0usize..12,
        ) {
            let picture = [24, 24];
            let mut patch = Patch { x, y, width: 8, mask: inside };
            let mut whole = Patch { x: 0, y: 0, width: 24, mask: vec![false; 24 * 24] };
            patch.pixels().for_each(|(x, y)| whole.mask[y * 24 + x] = true);
            patch.clean(picture, min);
            whole.clean(picture, min);
            prop_assert!(patch.pixels().eq(whole.pixels()));
        }
    }

    fn run(picture: &[&str], min: usize) -> Vec<String> {
        let width = picture[0].len();
        let mask = picture.concat().bytes().map(|b| b == b'#').collect();
        let mut patch = Patch { x: 0, y: 0, width, mask };
        patch.clean([width, picture.len()], min);
        patch.mask.chunks(width).map(|r| r.iter().map(|&m| if m { '#' } else { '.' }).collect()).collect()
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
