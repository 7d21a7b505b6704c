//! Disjoint sets: every member names one above it, the root of a set itself.

/// The root of the set that `i` is in; the way there becomes shorter.
pub fn root(above: &mut [u32], mut i: u32) -> u32 {
    while above[i as usize] != i {
        above[i as usize] = above[above[i as usize] as usize];
        i = above[i as usize];
    }
    i
}
