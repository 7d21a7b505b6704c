//! How much more two must agree to be one thing, because of their size and shape.

use crate::surface::{Rim, Touch};
use std::collections::BTreeMap;

/// How much more where the larger of them is e times as large as pieces commonly are: a large piece is more often a whole thing. Chosen on
/// scenes for tuning and the desk (docs/results/real-masks.md), as is [`BY_STEP`].
const BY_SIZE: f64 = 0.05;
/// How much more where one rises above the other in another colour all along their rim.
const BY_STEP: f64 = 0.28;

/// What makes it doubtful that two that agree are one thing.
pub struct Doubt {
    common_size: usize,
    /// The rims of each piece, by the other piece.
    rims: Vec<BTreeMap<u32, Rim>>,
}

impl Doubt {
    /// Of pieces with these `sizes`; a size of 0 is no piece. Half of all members are in pieces of the common size or smaller.
    pub fn new(sizes: &[usize], touches: impl IntoIterator<Item = Touch>) -> Self {
        let mut sorted = sizes.to_vec();
        sorted.sort_unstable();
        let half = sizes.iter().sum::<usize>().div_ceil(2);
        let mut members = 0;
        let common_size = sorted.into_iter().find(|size| {
            members += size;
            members >= half
        });
        let mut rims = vec![BTreeMap::new(); sizes.len()];
        for ((a, b), rim) in touches {
            rims[a as usize].insert(b, rim);
            rims[b as usize].insert(a, rim);
        }
        Self { common_size: common_size.unwrap_or(1).max(1), rims }
    }

    /// How much more pieces `a` and `b` must agree, whose larger one has `size` members: less than 0 where it is small.
    pub fn of(&self, a: u32, b: u32, size: usize) -> f64 {
        let rim = self.rims[a as usize].get(&b).copied().unwrap_or_default();
        let step = f64::from(rim.steps) / f64::from(rim.pairs.max(1));
        BY_SIZE * (size.max(1) as f64 / self.common_size as f64).ln() + BY_STEP * step
    }

    /// Piece `i` becomes one of `to`.
    pub fn join(&mut self, i: u32, to: u32) {
        for (other, rim) in std::mem::take(&mut self.rims[i as usize]) {
            self.rims[other as usize].remove(&i);
            if other != to {
                let joined = self.rims[to as usize].get(&other).map_or(rim, |r| r.joined(rim));
                self.rims[to as usize].insert(other, joined);
                self.rims[other as usize].insert(to, joined);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Rim = Rim { pairs: 1000, steps: 1000 };
    const FLAT: Rim = Rim { pairs: 1000, steps: 0 };

    #[test]
    fn the_common_size_is_that_of_the_middle_member() {
        let doubt = Doubt::new(&[1, 90, 0, 60, 29], [((0, 1), FLAT)]);
        assert!(doubt.common_size == 60 && doubt.of(0, 1, 60).abs() < 1e-9);
        assert!(doubt.of(0, 1, 90) > 0.01 && doubt.of(0, 1, 29) < -0.01);
        assert_eq!(Doubt::new(&[0], []).common_size, 1);
    }

    #[test]
    fn what_rises_along_its_rim_must_agree_more() {
        let half = Rim { pairs: 10, steps: 5 };
        let doubt = Doubt::new(&[1; 5], [((0, 1), STEP), ((0, 2), half), ((0, 3), FLAT)]);
        let of = |b| doubt.of(0, b, 1);
        assert_eq!([1, 2, 3, 4].map(of), [BY_STEP, BY_STEP / 2.0, 0.0, 0.0]);
        assert_eq!(of(1), doubt.of(1, 0, 1));
    }

    #[test]
    fn rims_of_joined_pieces_are_joined() {
        let mut doubt = Doubt::new(&[1; 4], [((0, 1), STEP), ((0, 2), STEP), ((1, 2), FLAT), ((1, 3), FLAT)]);
        doubt.join(1, 0);
        let rims = |i: usize| doubt.rims[i].iter().map(|(&j, r)| (j, r.pairs, r.steps)).collect::<Vec<_>>();
        assert_eq!(rims(0), [(2, 2000, 1000), (3, 1000, 0)]);
        assert_eq!((rims(1), rims(2), rims(3)), (vec![], vec![(0, 2000, 1000)], vec![(0, 1000, 0)]));
    }
}
