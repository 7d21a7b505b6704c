//! How sure it is that an instance is one whole thing: what average precision ranks by.

/// Of two that masks fit as well, the smaller one is more often a mere part: a power of the number of Gaussians. Chosen on four scenes with
/// real masks. Without it AP50 is the same on six rendered scans, and 0.7 points less on 12 synthetic scenes.
const SIZE: f64 = 0.2;

/// The confidence of each instance, 0 to 1: its fit times (count / largest count)^0.2. `fit` is how well masks fit it, 0 to 1.
pub fn confidence(count: &[u32], fit: &[f32]) -> Vec<f32> {
    let largest = f64::from(count.iter().copied().max().unwrap_or(0).max(1));
    let of = |(&count, &fit): (&u32, &f32)| ((f64::from(count) / largest).powf(SIZE) * f64::from(fit)) as f32;
    count.iter().zip(fit).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_larger_of_two_that_fit_alike_comes_first() {
        let found = confidence(&[32, 1, 32, 0], &[0.8, 0.8, 0.4, 0.0]);
        assert_eq!(found, [0.8, 0.4, 0.4, 0.0]);
        assert!(confidence(&[], &[]).is_empty());
    }
}
