//! Few numbers that stand for many: tables of 256, and rows of harmonics.

use crate::Gaussians;
use rayon::prelude::*;

/// Rows of a palette at most: what 16 bits tell apart.
const MOST_ROWS: usize = 1 << 16;
/// Up to so many Gaussians each has a row of its own.
const OWN_ROWS: usize = 1024;
/// Rounds in which Gaussians change between the two halves of a part.
const ROUNDS: usize = 3;
/// Times that a part is cut by distance; deeper ones are halved, so that a few Gaussians far out do not take the stack.
const DEEPEST: u32 = 64;

/// 256 numbers, ascending, of which a byte chooses one.
pub(super) struct Codebook(pub Vec<f32>);

impl Codebook {
    /// For at least one number. Half of the entries go by where the numbers lie, half by their range: none is farther from an
    /// entry than 2/255 of the range.
    pub fn of(mut numbers: Vec<f32>) -> Self {
        numbers.par_sort_unstable_by(f32::total_cmp);
        let last = numbers.len() - 1;
        let low = f64::from(numbers[0]);
        let range = (f64::from(numbers[last]) - low).max(f64::MIN_POSITIVE);
        let share = |at: usize| 0.5 * (at as f64 / last.max(1) as f64 + (f64::from(numbers[at]) - low) / range);
        let mut at = 0;
        let entry = |k: u32| {
            while at < last && share(at) < f64::from(k) / 255.0 {
                at += 1;
            }
            numbers[at]
        };
        Self((0..256).map(entry).collect())
    }

    /// The entry that is nearest to a number.
    pub fn byte(&self, v: f32) -> u8 {
        let above = self.0.partition_point(|entry| *entry < v).min(255);
        let below = above.saturating_sub(1);
        (if v - self.0[below] < self.0[above] - v { below } else { above }) as u8
    }
}

/// Rows of coefficients `[coefficients - 1][rgb]` that Gaussians share, and the row of each Gaussian.
pub(super) fn palette(g: &Gaussians) -> (Vec<Vec<f32>>, Vec<u16>) {
    let n = g.len();
    let rows = if n <= OWN_ROWS { n } else { 1 << n.ilog2().min(MOST_ROWS.ilog2()) };
    let mut all: Vec<u32> = (0..n as u32).collect();
    let points = Points(g);
    let spread = points.spread(&all);
    let parts = points.divide(&mut all, rows, spread, 0);
    let mut label = vec![0; n];
    for (row, (_, members)) in parts.iter().enumerate() {
        members.iter().for_each(|&at| label[at as usize] = row as u16);
    }
    (parts.into_iter().map(|(mean, _)| mean.iter().map(|v| *v as f32).collect()).collect(), label)
}

/// Coefficients beyond the constant one as points.
struct Points<'a>(&'a Gaussians);

/// The mean of some points, and how much they differ from it: sums of squares, by coefficient.
struct Spread {
    mean: Vec<f64>,
    squares: Vec<f64>,
}

impl Spread {
    fn total(&self) -> f64 {
        self.squares.iter().sum()
    }
}

impl Points<'_> {
    fn of(&self, at: u32) -> &[f32] {
        &self.0.sh_of(at as usize)[3..]
    }

    fn mean(&self, part: &[u32]) -> Vec<f64> {
        let mut sum = vec![0.0; self.0.sh_stride() - 3];
        part.iter().for_each(|&at| sum.iter_mut().zip(self.of(at)).for_each(|(s, v)| *s += f64::from(*v)));
        sum.iter_mut().for_each(|s| *s /= part.len() as f64);
        sum
    }

    fn spread(&self, part: &[u32]) -> Spread {
        let mean = self.mean(part);
        let mut squares = vec![0.0; mean.len()];
        for &at in part {
            let differences = self.of(at).iter().zip(&mean).map(|(v, m)| f64::from(*v) - m);
            squares.iter_mut().zip(differences).for_each(|(s, d)| *s += d * d);
        }
        Spread { mean, squares }
    }

    /// Parts of near points, `rows` at most: two at a time, each of which gets rows by its sum of squares. With each part its mean.
    fn divide<'b>(&self, part: &'b mut [u32], rows: usize, spread: Spread, depth: u32) -> Vec<(Vec<f64>, &'b [u32])> {
        let cut = match rows > 1 && spread.total() > 0.0 {
            true if depth < DEEPEST => self.cut(part, &spread),
            true => part.len() / 2,
            false => 0,
        };
        if cut == 0 || cut == part.len() {
            return vec![(spread.mean, part)];
        }
        let (one, other) = part.split_at_mut(cut);
        let [first, second] = [&*one, &*other].map(|half| self.spread(half));
        let share = first.total() / (first.total() + second.total()).max(f64::MIN_POSITIVE);
        let least = rows.saturating_sub(other.len()).max(1);
        let own = ((share * rows as f64).round() as usize).clamp(least, (rows - 1).min(one.len()));
        let (mut parts, more) = rayon::join(
            || self.divide(one, own, first, depth + 1),
            || self.divide(other, rows - own, second, depth + 1),
        );
        parts.extend(more);
        parts
    }

    /// Puts the points of the nearer of two means first, and says how many they are. It begins with the coefficient that differs most.
    fn cut(&self, part: &mut [u32], spread: &Spread) -> usize {
        let widest =
            (0..spread.mean.len()).max_by(|&a, &b| spread.squares[a].total_cmp(&spread.squares[b])).unwrap_or(0);
        let mut direction = vec![0.0; spread.mean.len()];
        direction[widest] = 1.0;
        let mut limit = spread.mean[widest];
        let mut cut = 0;
        for round in 0..ROUNDS {
            cut = 0;
            for at in 0..part.len() {
                let along: f64 = self.of(part[at]).iter().zip(&direction).map(|(v, d)| f64::from(*v) * d).sum();
                if along <= limit {
                    part.swap(cut, at);
                    cut += 1;
                }
            }
            if cut == 0 || cut == part.len() || round + 1 == ROUNDS {
                break;
            }
            let [low, high] = [&part[..cut], &part[cut..]].map(|half| self.mean(half));
            limit = low.iter().zip(&high).map(|(a, b)| 0.5 * (b * b - a * a)).sum();
            direction.iter_mut().zip(low.iter().zip(&high)).for_each(|(d, (a, b))| *d = b - a);
        }
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::testing::cloud;
    use crate::splat::{Extra, Format, encode};

    #[test]
    fn a_table_has_few_numbers_as_they_are_and_many_within_its_steps() {
        for numbers in [vec![2.5], vec![-1.0, 0.0, 1e30], (0..100).map(|i| (i as f32).exp2()).collect()] {
            let table = Codebook::of(numbers.clone());
            assert!(table.0.len() == 256 && numbers.iter().all(|v| table.0[usize::from(table.byte(*v))] == *v));
        }
        // Nearly all at 0, as coefficients are.
        let many: Vec<f32> = (-5000..=5000).map(|i| (i as f32 / 5000.0).powi(9)).collect();
        let table = Codebook::of(many.clone());
        let off = |v: &f32| (table.0[usize::from(table.byte(*v))] - v).abs();
        assert!(many.iter().all(|v| off(v) <= 4.0 / 255.0));
        assert!(many.iter().map(off).sum::<f32>() / 10_001.0 < 1e-3, "finer where they are");
    }

    #[test]
    fn gaussians_share_the_rows_of_those_near_them() {
        // 1,500 Gaussians: 40 groups of one row each, and one far beyond.
        let mut g = cloud(1500, 2);
        let rows = cloud(41, 2);
        let group = |i: usize| if i == 77 { 40 } else { i % 40 };
        for i in 0..g.len() {
            let stride = g.sh_stride();
            g.sh[i * stride + 3..(i + 1) * stride].copy_from_slice(&rows.sh_of(group(i))[3..]);
        }
        let (palette, label) = palette(&g);
        assert!(palette.len() <= 1024);
        for i in 0..g.len() {
            assert_eq!(palette[usize::from(label[i])], rows.sh_of(group(i))[3..], "{i}");
        }
        // Numbers each twice the last, and all of one coefficient: cut by distance they would lie one below the other.
        for i in 0..g.len() {
            let stride = g.sh_stride();
            g.sh[i * stride + 3..(i + 1) * stride].fill(0.0);
            g.sh[i * stride + 3] = (i as f32 / 8.0 - 90.0).exp2();
        }
        assert_eq!(super::palette(&g).0.len(), 1024);
    }

    #[test]
    fn any_number_of_threads_writes_the_same_bytes() {
        let g = cloud(3000, 3);
        let of = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| encode(Format::Sog, &g, &Extra::default()).unwrap())
        };
        assert!(of(1) == of(3));
    }
}
