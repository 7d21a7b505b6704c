//! Which of many overlapping masks stay: SAM's suppression by boxes and LangSplat's by masks.

/// A set of pixels of a small picture, one bit each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Pixels {
    words: Vec<u64>,
    /// Number of pixels in the set.
    pub area: usize,
    /// First column and row, one past the last column and row; zeros for the empty set.
    pub bounds: [usize; 4],
}

impl Pixels {
    /// The pixels of a `width`-wide picture where `inside` is true.
    pub fn new(width: usize, inside: impl ExactSizeIterator<Item = bool>) -> Self {
        let mut words = vec![0u64; inside.len().div_ceil(64)];
        let (mut area, mut bounds) = (0, [usize::MAX, usize::MAX, 0, 0]);
        for (i, _) in inside.enumerate().filter(|(_, inside)| *inside) {
            words[i / 64] |= 1 << (i % 64);
            area += 1;
            let (x, y) = (i % width, i / width);
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x + 1), bounds[3].max(y + 1)];
        }
        Self { words, area, bounds: if area == 0 { [0; 4] } else { bounds } }
    }

    /// Number of pixels in both sets.
    pub fn overlap(&self, other: &Self) -> usize {
        self.words.iter().zip(&other.words).map(|(a, b)| (a & b).count_ones() as usize).sum()
    }

    /// Pixels of either set; both of the same picture.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        if self.area == 0 {
            return other.clone();
        } else if other.area == 0 {
            return self.clone();
        }
        let words: Vec<u64> = self.words.iter().zip(&other.words).map(|(a, b)| a | b).collect();
        let area = words.iter().map(|w| w.count_ones() as usize).sum();
        let (a, b) = (self.bounds, other.bounds);
        let bounds = [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])];
        Self { words, area, bounds }
    }

    /// Whether pixel `index` is in the set.
    pub fn contains(&self, index: usize) -> bool {
        self.words.get(index / 64).is_some_and(|w| w >> (index % 64) & 1 == 1)
    }

    fn box_iou(&self, other: &Self) -> f64 {
        let ([ax0, ay0, ax1, ay1], [bx0, by0, bx1, by1]) = (self.bounds, other.bounds);
        let area = |x0: usize, y0: usize, x1: usize, y1: usize| x1.saturating_sub(x0) * y1.saturating_sub(y0);
        let both = area(ax0.max(bx0), ay0.max(by0), ax1.min(bx1), ay1.min(by1));
        let either = area(ax0, ay0, ax1, ay1) + area(bx0, by0, bx1, by1) - both;
        both as f64 / either.max(1) as f64
    }
}

/// A mask and its score.
pub type Rated<'a> = (&'a Pixels, f32);

/// Least score of a good mask: LangSplat's is 0.7; this one suits MobileSAM's soft edges.
pub const GOOD: f32 = 0.6;
/// Of masks that overlap by more than this (IoU) LangSplat keeps the better one.
const SAME: f64 = 0.8;
/// How much of a fragment and of the mask around it may be shared before it is no fragment: see [`mask_nms`].
const INNER: f64 = 0.5;

/// Indices by descending score; equal scores keep their order, so that the result depends on nothing else.
fn by_score(masks: &[Rated]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..masks.len()).collect();
    order.sort_by(|&a, &b| masks[b].1.total_cmp(&masks[a].1));
    order
}

/// Suppression by boxes: of masks whose boxes overlap by more than `threshold` (IoU) the one of best score stays.
/// Gives the indices that stay, best first.
pub fn box_nms(masks: &[Rated], threshold: f64) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::new();
    for i in by_score(masks) {
        if kept.iter().all(|&k| masks[k].0.box_iou(masks[i].0) <= threshold) {
            kept.push(i);
        }
    }
    kept
}

/// LangSplat's suppression by masks within a level. A mask is dropped when its score is low; when it overlaps a better one too
/// much; or when it is a fragment: with a = the part of it that lies in another mask and b = the part of the other that
/// lies in it, a >= 0.85, b < 0.5 and a b < `INNER`. Unlike there, a mask of low score is dropped first and so removes nothing
/// itself. Gives the indices that stay, best first.
pub fn mask_nms(masks: &[Rated]) -> Vec<usize> {
    let mut order = by_score(masks);
    order.retain(|&i| masks[i].0.area > 0 && masks[i].1 > GOOD);
    let mut keep = vec![true; order.len()];
    for (p, &i) in order.iter().enumerate() {
        for (q, &j) in order.iter().enumerate().skip(p + 1) {
            let both = masks[i].0.overlap(masks[j].0) as f64;
            if both == 0.0 {
                continue;
            }
            let (ai, aj) = (masks[i].0.area as f64, masks[j].0.area as f64);
            if both / (ai + aj - both) > SAME {
                keep[q] = false;
            }
            let (of_i, of_j) = (both / ai, both / aj);
            if of_i * of_j < INNER {
                if of_i < 0.5 && of_j >= 0.85 {
                    keep[q] = false;
                }
                if of_i >= 0.85 && of_j < 0.5 {
                    keep[p] = false;
                }
            }
        }
    }
    order.into_iter().zip(keep).filter_map(|(i, k)| k.then_some(i)).collect()
}

/// Whether a mask merges several things: at least three of the `things`, apart from each other, lie in it (85% of each)
/// and have a score that is no more than 0.1 below its own. SAM's largest masks are now and then half the room, which
/// [`mask_nms`] would keep and drop everything in it.
pub fn merges_things(mask: &Pixels, score: f32, things: &[Rated]) -> bool {
    let mut apart: Vec<&Pixels> = Vec::new();
    for k in by_score(things) {
        let (thing, good) = (things[k].0, things[k].1 > score - 0.1);
        let most_of = |part: usize, whole: &Pixels| part as f64 >= 0.85 * whole.area as f64;
        let inside = good && thing.area < mask.area && most_of(thing.overlap(mask), thing);
        if inside && apart.iter().all(|a| (a.overlap(thing) as f64) < 0.15 * a.area.min(thing.area) as f64) {
            apart.push(thing);
        }
    }
    apart.len() >= 3
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rectangle x0..x1, y0..y1 of a 20 x 10 picture.
    fn rect(x0: usize, y0: usize, x1: usize, y1: usize) -> Pixels {
        Pixels::new(20, (0..200).map(|i| (x0..x1).contains(&(i % 20)) && (y0..y1).contains(&(i / 20))))
    }

    #[test]
    fn pixels_count_and_overlap() {
        let a = rect(2, 3, 12, 8);
        assert_eq!((a.area, a.bounds), (50, [2, 3, 12, 8]));
        assert_eq!(a.overlap(&rect(10, 0, 20, 5)), 4);
        assert_eq!(
            a.union(&rect(10, 0, 20, 5)),
            Pixels::new(20, (0..200).map(|i| a.contains(i) || (i < 100 && i % 20 >= 10)))
        );
        assert_eq!(a.union(&rect(0, 0, 0, 0)), a);
        assert!(a.contains(3 * 20 + 2) && !a.contains(3 * 20 + 1) && !a.contains(100_000));
        assert!((a.box_iou(&rect(2, 3, 12, 4)) - 0.2).abs() < 1e-12);
        assert_eq!((rect(5, 5, 5, 9).bounds, rect(5, 5, 5, 9).box_iou(&a)), ([0; 4], 0.0));
    }

    #[test]
    fn boxes_that_overlap_leave_the_best() {
        let m = [rect(0, 0, 10, 10), rect(1, 0, 10, 10), rect(10, 0, 20, 10)];
        let kept = |scores: [f32; 3], iou| box_nms(&m.iter().zip(scores).collect::<Vec<_>>(), iou);
        assert_eq!(kept([0.8, 0.9, 0.7], 0.7), [1, 2]);
        assert_eq!(kept([0.8, 0.9, 0.7], 0.95), [1, 0, 2]);
        // Equal scores: the first stays.
        assert_eq!(kept([0.9, 0.9, 0.9], 0.7), [0, 2]);
    }

    #[test]
    fn masks_that_overlap_score_low_or_are_fragments_go() {
        let (whole, same, part, other) = (rect(0, 0, 10, 10), rect(0, 0, 10, 9), rect(0, 0, 4, 4), rect(12, 0, 20, 10));
        let kept =
            |scores: [f32; 4]| mask_nms(&[&whole, &same, &part, &other].into_iter().zip(scores).collect::<Vec<_>>());
        // `same` overlaps `whole` by 0.9; `part` is a fragment of both, whatever its score.
        assert_eq!(kept([0.95, 0.9, 0.8, 0.75]), [0, 3]);
        assert_eq!(kept([0.8, 0.75, 0.99, 0.9]), [3, 0]);
        assert_eq!(kept([0.95, 0.9, 0.8, 0.55]), [0]);
        // More than half of the larger is no fragment; nor is a mask that lies half outside.
        let (big_part, half_out) = (rect(0, 0, 10, 6), rect(8, 0, 12, 4));
        assert_eq!(mask_nms(&[(&whole, 0.9), (&big_part, 0.85), (&half_out, 0.8)]), [0, 1, 2]);
        assert!(mask_nms(&[(&rect(3, 3, 3, 3), 0.9)]).is_empty());
        assert!(mask_nms(&[]).is_empty());
    }

    #[test]
    fn a_mask_around_three_good_things_merges_them() {
        let room = rect(0, 0, 20, 10);
        let (a, b, c) = (rect(0, 0, 4, 4), rect(6, 0, 10, 4), rect(12, 0, 18, 9));
        let things = |scores: [f32; 3]| [(&a, scores[0]), (&b, scores[1]), (&c, scores[2])];
        assert!(merges_things(&room, 0.6, &things([0.7, 0.9, 0.8])));
        assert!(!merges_things(&room, 0.85, &things([0.7, 0.9, 0.8])));
        assert!(!merges_things(&rect(0, 0, 11, 10), 0.6, &things([0.7, 0.9, 0.8])));
        // Three masks of one thing are one thing.
        let same = rect(6, 0, 10, 3);
        assert!(!merges_things(&room, 0.6, &[(&a, 0.9), (&b, 0.9), (&same, 0.8)]));
        assert!(!merges_things(&room, 0.6, &[]));
    }
}
