//! Some of N Gaussians as a short text.

use gs_io::{Error, Result};
use std::ops::Range;

/// Ascending indices as numbers: so many are left out, so many taken, in turn. `[120, 121, 122, 128]` is `"120 3 5 1"`.
pub fn runs_of(gaussians: &[u32]) -> String {
    let mut numbers = Vec::new();
    let mut end = 0;
    for run in gaussians.chunk_by(|a, b| a + 1 == *b) {
        numbers.extend([run[0] - end, run.len() as u32]);
        end = run[0] + run.len() as u32;
    }
    numbers.iter().map(u32::to_string).collect::<Vec<_>>().join(" ")
}

/// The indices that [`runs_of`] wrote, of so many Gaussians.
///
/// # Errors
/// When the text is no such list, is empty, or names more Gaussians than there are.
pub fn ranges_of(runs: &str, gaussians: usize) -> Result<Vec<Range<u32>>> {
    let ranges = || {
        let numbers: Vec<u32> = runs.split(' ').map(str::parse).collect::<Result<_, _>>().ok()?;
        let (pairs, []) = numbers.as_chunks() else { return None };
        let mut end = 0u32;
        let range = |&[out, taken]: &[u32; 2]| {
            let start = end.checked_add(out)?;
            end = start.checked_add(taken)?;
            (taken > 0 && end as usize <= gaussians).then_some(start..end)
        };
        pairs.iter().map(range).collect()
    };
    ranges().ok_or_else(|| {
        let start: String = runs.chars().take(40).collect();
        let e = Error::new("not a list of Gaussians").found(format!("{start:?}"));
        e.expected(format!("how many of {gaussians} are left out, taken, left out, taken, ..., such as \"120 3 5 1\""))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_reads_as_it_was_written() {
        for (list, text) in [(&[120, 121, 122, 128][..], "120 3 5 1"), (&[0], "0 1"), (&[0, 2], "0 1 1 1")] {
            assert_eq!(runs_of(list), text);
            assert_eq!(ranges_of(text, 129).unwrap().into_iter().flatten().collect::<Vec<_>>(), list);
        }
        // Every other one of many: the worst there is.
        let scattered: Vec<u32> = (0..200_000).map(|i| 2 * i).collect();
        assert!(runs_of(&scattered).len() <= 4 * scattered.len());
    }

    #[test]
    fn what_is_no_such_list_is_refused() {
        for bad in ["", "3", "0 1 2", "0 0", "a b", "0  1", "-1 2", "9 2", "4294967295 1", "0 4294967296", "0 5 0 6"] {
            let e = ranges_of(bad, 10).unwrap_err().to_string();
            assert!(e.contains("not a list of Gaussians") && e.contains("how many of 10"), "{bad}: {e}");
        }
    }
}
