//! Product quantisation: a vector becomes one byte for each of its parts, the number of the part's nearest centre.

use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::ops::Range;

/// How vectors are quantised.
#[derive(Debug, Clone, Copy)]
pub struct Codebook {
    /// Parts that a vector is cut into: bytes of a code. No more than the vector has numbers.
    pub parts: usize,
    /// Centres of each part, at most 256.
    pub centres: usize,
    /// Rounds of k-means.
    pub rounds: usize,
    /// Vectors that k-means sees, at most: drawn by `seed`.
    pub most: usize,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Centres whose distances are worked out at a time, in vector registers.
const LANES: usize = 16;

/// The centres of a part, `[block of lanes][coordinate][lane]`; the lanes left over in the last block are infinitely
/// far.
struct Centres {
    values: Vec<f32>,
    count: usize,
    width: usize,
}

impl Centres {
    fn new(starts: &[&[f32]], width: usize) -> Self {
        let count = starts.len();
        let mut made = Self { values: vec![f32::INFINITY; count.next_multiple_of(LANES) * width], count, width };
        for (k, start) in starts.iter().enumerate() {
            start.iter().enumerate().for_each(|(c, &x)| *made.at(k, c) = x);
        }
        made
    }

    /// A coordinate of a centre.
    fn at(&mut self, centre: usize, coordinate: usize) -> &mut f32 {
        &mut self.values[(centre / LANES * self.width + coordinate) * LANES + centre % LANES]
    }

    /// The centre nearest to a part of a vector, of equals the first; `distances` is room for as many as there are
    /// lanes.
    fn nearest(&self, part: &[f32], distances: &mut [[f32; LANES]]) -> usize {
        let mut least = [f32::INFINITY; LANES];
        for (block, distances) in self.values.chunks_exact(self.width * LANES).zip(&mut *distances) {
            let mut sums = [0.0; LANES];
            for (&x, row) in part.iter().zip(block.chunks_exact(LANES)) {
                sums.iter_mut().zip(row).for_each(|(s, c)| *s += (x - c) * (x - c));
            }
            // Only minima here: a search that remembers the place can't use vector instructions.
            least.iter_mut().zip(&sums).for_each(|(l, s)| *l = if s < l { *s } else { *l });
            *distances = sums;
        }
        let least = least.into_iter().fold(f32::INFINITY, f32::min);
        distances.iter().flatten().position(|&d| d == least).unwrap_or(0)
    }

    /// Room for [`Self::nearest`].
    fn room(&self) -> Vec<[f32; LANES]> {
        vec![[0.0; LANES]; self.count.div_ceil(LANES)]
    }

    fn coordinate(&self, centre: usize) -> impl Iterator<Item = f32> + '_ {
        let first = centre / LANES * self.width * LANES + centre % LANES;
        self.values[first..].iter().step_by(LANES).take(self.width).copied()
    }
}

/// Replaces each of some vectors of `dim` numbers, where it is not zero, by the centres that its code stands for.
/// Centres are found by k-means on these vectors.
pub fn quantise(values: &mut [f32], dim: usize, codebook: &Codebook) {
    let vectors: Vec<&[f32]> = values.chunks_exact(dim.max(1)).filter(|v| v.iter().any(|&x| x != 0.0)).collect();
    if vectors.is_empty() {
        return;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(codebook.seed);
    // In the order in which they are drawn, so that the first of them are a draw too.
    let drawn = sample(&mut rng, vectors.len(), codebook.most.min(vectors.len()));
    let learning: Vec<&[f32]> = drawn.iter().map(|i| vectors[i]).collect();
    let parts = codebook.parts.clamp(1, dim);
    let ranges: Vec<Range<usize>> = (0..parts).map(|p| p * dim / parts..(p + 1) * dim / parts).collect();
    let centres: Vec<Centres> = ranges.par_iter().map(|range| means(&learning, range, codebook)).collect();
    let rooms: Vec<_> = centres.iter().map(Centres::room).collect();
    values.par_chunks_exact_mut(dim).filter(|v| v.iter().any(|&x| x != 0.0)).for_each_with(rooms, |rooms, v| {
        for ((range, centres), room) in ranges.iter().zip(&centres).zip(rooms) {
            let code = centres.nearest(&v[range.clone()], room);
            v[range.clone()].iter_mut().zip(centres.coordinate(code)).for_each(|(x, c)| *x = c);
        }
    });
}

/// K-means on one part of vectors. It starts from the first of them that differ there; a centre without vectors stays
/// where it is.
fn means(vectors: &[&[f32]], range: &Range<usize>, codebook: &Codebook) -> Centres {
    let mut starts: Vec<&[f32]> = Vec::new();
    let mut known = std::collections::BTreeSet::new();
    for v in vectors {
        let part = &v[range.clone()];
        if starts.len() < codebook.centres && known.insert(part.iter().map(|x| x.to_bits()).collect::<Vec<_>>()) {
            starts.push(part);
        }
    }
    let (count, width) = (starts.len(), range.len());
    let mut centres = Centres::new(&starts, width);
    let mut distances = centres.room();
    let mut codes = vec![usize::MAX; vectors.len()];
    for _ in 0..codebook.rounds {
        let mut sums = vec![0.0; width * count];
        let mut members = vec![0usize; count];
        let mut moved = false;
        for (v, code) in vectors.iter().zip(&mut codes) {
            let part = &v[range.clone()];
            let k = centres.nearest(part, &mut distances);
            moved |= std::mem::replace(code, k) != k;
            members[k] += 1;
            part.iter().enumerate().for_each(|(c, &x)| sums[k * width + c] += f64::from(x));
        }
        if !moved {
            break;
        }
        for k in (0..count).filter(|&k| members[k] > 0) {
            for c in 0..width {
                *centres.at(k, c) = (sums[k * width + c] / members[k] as f64) as f32;
            }
        }
    }
    centres
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: Codebook = Codebook { parts: 2, centres: 2, rounds: 10, most: 100, seed: 3 };

    #[test]
    fn parts_become_the_centres_of_their_groups() {
        // The first part has groups about 0.5 and 10, the second about 3 and 7; the zero vector stays.
        let mut values = vec![0.0, 3.0, 1.0, 7.0, 10.0, 3.0, 10.0, 7.0, 0.0, 0.0];
        quantise(&mut values, 2, &SMALL);
        // 0 is within the first part of a vector that is not zero, so it counts: its group is (0 + 1) / 2.
        assert_eq!(values, [0.5, 3.0, 0.5, 7.0, 10.0, 3.0, 10.0, 7.0, 0.0, 0.0]);
    }

    #[test]
    fn nothing_is_lost_where_there_are_as_many_centres_as_values() {
        let before: Vec<f32> = (0..40).map(|i| (i % 8) as f32 - 3.5).collect();
        let mut values = before.clone();
        quantise(&mut values, 5, &Codebook { parts: 3, centres: 256, ..SMALL });
        assert_eq!(values, before);
        let mut empty = vec![0.0; 6];
        quantise(&mut empty, 3, &SMALL);
        assert_eq!(empty, [0.0; 6]);
    }

    #[test]
    fn more_parts_than_numbers_are_as_many_as_numbers() {
        let mut values = vec![1.0, 2.0, 4.0, 8.0];
        quantise(&mut values, 2, &Codebook { parts: 128, centres: 1, ..SMALL });
        assert_eq!(values, [2.5, 5.0, 2.5, 5.0]);
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes() {
        let before: Vec<f32> = (0..600).map(|i| ((i * 7919) % 601) as f32 / 601.0).collect();
        let made = |seed| {
            let mut values = before.clone();
            quantise(&mut values, 6, &Codebook { parts: 3, centres: 8, rounds: 25, most: 50, seed });
            values
        };
        assert_eq!(made(1), made(1));
        assert_ne!(made(1), made(2));
    }
}
