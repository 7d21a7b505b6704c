//! How far two labellings of the same Gaussians agree.

use std::collections::BTreeMap;

/// Adjusted Rand index (Hubert and Arabie 1985) of two labellings; noise (-1) is a label like others. 1 for the same
/// partition, about 0 for unrelated ones.
///
/// # Panics
/// When the lengths differ.
pub fn adjusted_rand(a: &[i32], b: &[i32]) -> f64 {
    assert_eq!(a.len(), b.len(), "labels of the same things");
    let pairs = |n: u64| n as f64 * (n as f64 - 1.0) / 2.0;
    let mut cells = BTreeMap::<(i32, i32), u64>::new();
    let (mut rows, mut columns) = (BTreeMap::<i32, u64>::new(), BTreeMap::<i32, u64>::new());
    for (&x, &y) in a.iter().zip(b) {
        *cells.entry((x, y)).or_default() += 1;
        *rows.entry(x).or_default() += 1;
        *columns.entry(y).or_default() += 1;
    }
    let sum = |counts: &mut dyn Iterator<Item = u64>| counts.map(pairs).sum::<f64>();
    let together = sum(&mut cells.values().copied());
    let (of_a, of_b) = (sum(&mut rows.values().copied()), sum(&mut columns.values().copied()));
    let expected = of_a * of_b / pairs(a.len() as u64).max(1.0);
    let most = 0.5 * (of_a + of_b);
    if most == expected { 1.0 } else { (together - expected) / (most - expected) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_not_matter_and_values_are_known() {
        assert_eq!(adjusted_rand(&[0, 0, 1, 1, -1], &[5, 5, 2, 2, 0]), 1.0);
        // scikit-learn's documentation: adjusted_rand_score([0, 0, 1, 2], [0, 0, 1, 1]) = 0.571...
        assert!((adjusted_rand(&[0, 0, 1, 2], &[0, 0, 1, 1]) - 4.0 / 7.0).abs() < 1e-12);
        assert!((adjusted_rand(&[0, 0, 1, 1], &[0, 1, 0, 1]) + 0.5).abs() < 1e-12);
        assert_eq!(adjusted_rand(&[1, 1, 1], &[2, 2, 2]), 1.0);
        assert_eq!(adjusted_rand(&[], &[]), 1.0);
    }
}
