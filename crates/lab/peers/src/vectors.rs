//! Unit vectors: of single Gaussians, averaged over neighbours, and the means that they are most like.

use ndarray::Array2;
use rayon::prelude::*;

/// Brings a vector to unit length; one of length zero stays.
pub fn unit(v: &mut [f32]) {
    let length = v.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
    if length > 1e-12 {
        v.iter_mut().for_each(|x| *x = (f64::from(*x) / length) as f32);
    }
}

/// A vector at unit length; none where it is zero.
pub fn normalised(v: &[f64]) -> Option<Vec<f32>> {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length > 1e-12).then(|| v.iter().map(|x| (x / length) as f32).collect())
}

/// [`normalised`]; zero stays.
pub fn normed(v: &[f64]) -> Vec<f32> {
    normalised(v).unwrap_or_else(|| vec![0.0; v.len()])
}

/// Adds a vector to a sum.
pub fn add(sum: &mut [f64], v: &[f32]) {
    sum.iter_mut().zip(v).for_each(|(s, &v)| *s += f64::from(v));
}

/// Means of `count` vectors, `[n][dim]`, each one's own and its nearest neighbours', at unit length; rows of `knn` are nearest
/// first, padded with itself. Fewer are averaged where there are fewer neighbours.
pub fn smoothed(rows: &[f32], dim: usize, knn: &Array2<u32>, count: usize) -> Vec<f32> {
    let row = |i: usize| &rows[i * dim..(i + 1) * dim];
    let of = |i: usize| {
        let mut sum = vec![0.0f64; dim];
        let near = knn.row(i).into_iter().take(count.saturating_sub(1)).map(|&j| j as usize).filter(|&j| j != i);
        near.chain([i]).for_each(|j| add(&mut sum, row(j)));
        normed(&sum)
    };
    (0..rows.len() / dim.max(1)).into_par_iter().flat_map_iter(of).collect()
}

/// The unit mean of the vectors of each of `count` groups, `[count][dim]`; zeros for a group without any. Vectors of group -1 are in
/// none.
pub fn group_means<'a>(of: impl Iterator<Item = (i32, &'a [f32])>, dim: usize, count: usize) -> Vec<f32> {
    let mut sums = vec![0.0f64; count * dim];
    for (group, v) in of {
        if let Ok(group) = usize::try_from(group) {
            add(&mut sums[group * dim..(group + 1) * dim], v);
        }
    }
    sums.chunks_exact(dim).flat_map(normed).collect()
}

/// The group of each unit vector, `[n][dim]`: the one whose mean, of those that are not zero, has the largest cosine with it, of equals
/// the first. -1 for a zero vector, and where that cosine is below `least`; -1 sets no bound.
pub fn most_alike(rows: &[f32], dim: usize, means: &[f32], least: f32) -> Vec<i32> {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>();
    let is_some = |v: &[f32]| v.iter().any(|&x| x != 0.0);
    let nearest = |v: &[f32]| {
        let mut best = (-1, f64::NEG_INFINITY);
        for (group, mean) in means.chunks_exact(dim).enumerate().filter(|(_, mean)| is_some(mean)) {
            let cosine = dot(v, mean);
            best = if cosine > best.1 { (group as i32, cosine) } else { best };
        }
        // Cosines of -1 may come out a little lower.
        if !is_some(v) || (least > -1.0 && best.1 < f64::from(least)) { -1 } else { best.0 }
    };
    rows.par_chunks_exact(dim).map(nearest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_is_the_mean_with_the_neighbours() {
        // Along x, along y, along x; the middle one is everybody's neighbour, rows are padded with themselves.
        let f = [1.0, 0.0, 0.0, 1.0, 1.0, 0.0];
        let knn = ndarray::arr2(&[[1, 0], [0, 2], [1, 2]]);
        let s = smoothed(&f, 2, &knn, 3);
        let [a, b] = [0.5f32.sqrt(), 0.2f32.sqrt()];
        for (found, expected) in s.iter().zip([a, a, 2.0 * b, b, a, a]) {
            assert!((found - expected).abs() < 1e-6, "{s:?}");
        }
        assert_eq!(smoothed(&f, 2, &knn, 1), [1.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn vectors_go_to_the_mean_that_they_are_most_like() {
        // Two of group 0 along x, one of group 2 along y; group 1 is empty, and the last is nobody's.
        let rows: [&[f32]; 4] = [&[1.0, 0.0], &[1.0, 0.0], &[0.0, 1.0], &[0.0, -1.0]];
        let means = group_means([0, 0, 2, -1].into_iter().zip(rows), 2, 3);
        assert_eq!(means, [1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        // The third is as far from both, the fourth away from both, the last has no direction.
        let all = [1.0, 0.0, 0.6, 0.8, 0.7, 0.7, -0.8, -0.6, 0.0, 0.0];
        assert_eq!(most_alike(&all, 2, &means, -1.0), [0, 2, 0, 2, -1]);
        assert_eq!(most_alike(&all, 2, &means, 0.75), [0, 2, -1, -1, -1]);
        assert_eq!(most_alike(&all, 2, &[], -1.0), [-1; 5]);
    }
}
