//! The same thing in another view: positives for [`crate::options::Loss::CrossView`].
//!
//! A mask's counterpart in another view is the mask with the highest IoU, both counted in the Gaussians that both views
//! show. Its centroid is the positive and is held constant, as a momentum encoder's keys are: the other view has its own
//! turn.

use super::masks::MaskSet;

/// Masks that overlap less than this are not of one thing.
const LEAST_IOU: f64 = 0.5;

/// For each mask of `a`, its counterpart in `b`, if any.
pub fn counterparts(a: &MaskSet, b: &MaskSet) -> Vec<Option<usize>> {
    let (rows, columns) = (a.rows.len(), b.rows.len());
    let mut both = vec![0u32; rows * columns];
    let (mut of_a, mut of_b) = (vec![0u32; rows], vec![0u32; columns]);
    let masks = |set: &MaskSet, c: usize| set.start[c] as usize..set.start[c + 1] as usize;
    let (mut i, mut j) = (0, 0);
    while i < a.columns.len() && j < b.columns.len() {
        match a.columns[i].cmp(&b.columns[j]) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => j += 1,
            std::cmp::Ordering::Equal => {
                let (ka, kb) = (&a.mask[masks(a, i)], &b.mask[masks(b, j)]);
                ka.iter().for_each(|&k| of_a[k as usize] += 1);
                kb.iter().for_each(|&k| of_b[k as usize] += 1);
                for &k in ka {
                    kb.iter().for_each(|&l| both[k as usize * columns + l as usize] += 1);
                }
                (i, j) = (i + 1, j + 1);
            }
        }
    }
    (0..rows)
        .map(|k| {
            let iou = |l: usize| {
                let inter = both[k * columns + l];
                f64::from(inter) / f64::from((of_a[k] + of_b[l] - inter).max(1))
            };
            // The first of equals.
            let best = (0..columns).reduce(|best, l| if iou(l) > iou(best) { l } else { best });
            best.filter(|&l| iou(l) >= LEAST_IOU)
        })
        .collect()
}

/// The counterparts' rows of `centroids` `[masks of b][d]`, or zeros for masks without; `[masks of a][d]`.
pub fn positives(a: &MaskSet, b: &MaskSet, centroids: &[f64], d: usize) -> Vec<f64> {
    let rows = counterparts(a, b).into_iter();
    rows.flat_map(|l| l.map_or_else(|| vec![0.0; d], |l| centroids[l * d..(l + 1) * d].to_vec())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contrastive::testing::context;
    use crate::options::Neighbours;

    #[test]
    fn counterparts_overlap_most_among_what_both_views_show() {
        let context = context(40, Neighbours::Gaussians, true);
        let set = |masks: &[std::ops::Range<u32>]| {
            let entries =
                masks.iter().enumerate().flat_map(|(k, r)| r.clone().map(move |p| (p, k as u16, 1.0))).collect();
            MaskSet::from_entries(vec![0; masks.len()], vec![1.0; masks.len()], entries, &context)
        };
        let a = set(&[0..10, 10..20, 20..30]);
        // The first mask again, shifted by one; the others merged, of which b does not show the end; one of its own.
        let b = set(&[11..24, 1..11, 35..40]);
        assert_eq!(counterparts(&a, &b), [Some(1), Some(0), None]);
        assert_eq!(positives(&a, &b, &[1.0, 2.0, 3.0], 1), [2.0, 1.0, 0.0]);
        assert_eq!(counterparts(&b, &a), [Some(1), Some(0), None]);
    }
}
