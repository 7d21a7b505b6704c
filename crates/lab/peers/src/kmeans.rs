//! k-means: Lloyd's rounds from starts that are drawn apart (k-means++).

use rand::RngExt;
use rayon::prelude::*;

/// Points that one task handles.
const CHUNK: usize = 1024;

/// Clusters points, `[n][dim]`, in at most `count` clusters by Euclidean distance, in at most `rounds` rounds: the cluster of each
/// point, and how many there are. A cluster that loses all its points keeps its place and may get others. Fewer
/// clusters than asked for come out where there are fewer places.
pub fn k_means(points: &[f32], dim: usize, count: usize, rounds: usize, rng: &mut impl RngExt) -> (Vec<u32>, usize) {
    let n = points.len() / dim.max(1);
    let row = |i: usize| &points[i * dim..(i + 1) * dim];
    let mut centres: Vec<f32> = Vec::new();
    let mut far = vec![f64::INFINITY; n];
    while n > 0 && centres.len() < count * dim {
        let next = if centres.is_empty() { rng.random_range(0..n) } else { drawn(&far, rng.random::<f64>()) };
        if far[next] == 0.0 {
            break;
        }
        centres.extend(row(next));
        let centre = row(next);
        far.par_chunks_mut(CHUNK).zip(points.par_chunks(CHUNK * dim)).for_each(|(far, rows)| {
            far.iter_mut().zip(rows.chunks_exact(dim)).for_each(|(f, p)| *f = f.min(square(p, centre)));
        });
    }
    let nearest = |centres: &[f32]| -> Vec<u32> {
        let of = |p: &[f32]| {
            let distances = centres.chunks_exact(dim).map(|c| square(p, c)).enumerate();
            distances.fold((0, f64::INFINITY), |b, (k, d)| if d < b.1 { (k as u32, d) } else { b }).0
        };
        points.par_chunks(dim.max(1)).with_min_len(CHUNK).map(of).collect()
    };
    let mut labels = nearest(&centres);
    for _ in 0..rounds {
        let (mut sums, mut sizes) = (vec![0.0f64; centres.len()], vec![0usize; centres.len() / dim.max(1)]);
        for (i, &label) in labels.iter().enumerate() {
            let at = label as usize;
            sums[at * dim..(at + 1) * dim].iter_mut().zip(row(i)).for_each(|(s, &v)| *s += f64::from(v));
            sizes[at] += 1;
        }
        for (k, &size) in sizes.iter().enumerate().filter(|(_, size)| **size > 0) {
            (0..dim).for_each(|c| centres[k * dim + c] = (sums[k * dim + c] / size as f64) as f32);
        }
        let new = nearest(&centres);
        if new == labels {
            break;
        }
        labels = new;
    }
    (labels, centres.len() / dim.max(1))
}

fn square(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum()
}

/// The place that a share of the sum of all weights falls on.
fn drawn(weights: &[f64], share: f64) -> usize {
    let mut left = share * weights.iter().sum::<f64>();
    for (i, weight) in weights.iter().enumerate() {
        left -= weight;
        if left < 0.0 {
            return i;
        }
    }
    // Rounding may leave a rest beyond the last: then the farthest point.
    weights.iter().enumerate().fold(0, |best, (i, w)| if *w > weights[best] { i } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn groups_on_a_line_are_found_whatever_the_seed() {
        let points: Vec<f32> = [0.0, 10.0, 30.0].iter().flat_map(|c| [c - 1.0, *c, c + 1.0]).collect();
        for seed in 0..20 {
            let (labels, count) = k_means(&points, 1, 3, 50, &mut ChaCha8Rng::seed_from_u64(seed));
            assert_eq!(count, 3);
            let of = |i: usize| labels[3 * i..3 * i + 3].iter().all(|&l| l == labels[3 * i]);
            assert!((0..3).all(of) && labels[0] != labels[3] && labels[3] != labels[6], "{labels:?}");
        }
    }

    #[test]
    fn there_are_no_more_clusters_than_places() {
        let (labels, count) = k_means(&[1.0, 5.0, 1.0, 5.0], 1, 9, 50, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!((count, labels[0] == labels[2], labels[0] == labels[1]), (2, true, false));
        assert_eq!(k_means(&[], 3, 4, 5, &mut ChaCha8Rng::seed_from_u64(1)), (vec![], 0));
    }
}
