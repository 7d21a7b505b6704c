//! Work on several photographs at a time.

use gs_io::{Error, Result};
use rayon::ThreadPoolBuilder;
use std::sync::mpsc;

/// Calls `make` for every item, `lanes` of them at a time, and `take` for what it made, in the items' order. The lanes share
/// the program's threads among them. `take` works beside them; where the program has one thread, in turns.
pub(crate) fn ahead<I: Copy + Send + Sync, T: Send>(
    items: &[I],
    lanes: usize,
    make: impl Fn(I) -> Result<T> + Sync,
    mut take: impl FnMut(T) -> Result<()>,
) -> Result<()> {
    let threads = rayon::current_num_threads();
    if threads <= 1 {
        return items.iter().copied().map(make).try_for_each(|made| take(made?));
    }
    let lanes = lanes.clamp(1, threads.min(items.len().max(1)));
    let failed = |e: &dyn std::fmt::Display| Error::new(format!("cannot start a thread: {e}")).hint("give --threads 1");
    std::thread::scope(|scope| {
        let mut made = Vec::new();
        for lane in 0..lanes {
            let own = threads / lanes + usize::from(lane < threads % lanes);
            let pool = ThreadPoolBuilder::new().num_threads(own).build().map_err(|e| failed(&e))?;
            // Among several, a lane that is ahead goes on with its next item meanwhile.
            let (send, receive) = mpsc::sync_channel(usize::from(lanes > 1));
            // It ends after an error, and when nobody receives any more.
            let (make, own) = (&make, items.iter().copied().skip(lane).step_by(lanes));
            let work = move || {
                for item in own {
                    let made = pool.install(|| make(item));
                    if made.is_err() | send.send(made).is_err() {
                        break;
                    }
                }
            };
            std::thread::Builder::new().spawn_scoped(scope, work).map_err(|e| failed(&e))?;
            made.push(receive);
        }
        // A lane that has no more to give has failed before, or has done all of its items.
        (0..items.len()).filter_map(|i| made[i % lanes].recv().ok()).try_for_each(|made| take(made?))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_are_taken_in_order_up_to_the_first_error() {
        let run = |lanes: usize, bad: usize, refused: usize| {
            let (made, mut taken) = (std::sync::atomic::AtomicUsize::new(0), Vec::new());
            let make = |i: usize| {
                made.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                if i == bad { Err(Error::new("not made")) } else { Ok(i) }
            };
            let take = |i| {
                taken.push(i);
                if i == refused { Err(Error::new("not taken")) } else { Ok(()) }
            };
            let items: Vec<usize> = (0..100).collect();
            let error = ahead(&items, lanes, make, take).err().map(|e| e.to_string());
            (error, taken, made.into_inner())
        };
        let pool = ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        for lanes in 1..5 {
            pool.install(|| {
                let (error, taken, made) = run(lanes, usize::MAX, usize::MAX);
                assert_eq!((error, taken, made), (None, (0..100).collect(), 100));
                let (error, taken, made) = run(lanes, 7, usize::MAX);
                assert_eq!((error.as_deref(), taken), (Some("not made"), (0..7).collect()));
                assert!(made <= 8 + 3 * lanes, "{made}");
                let (error, taken, made) = run(lanes, usize::MAX, 7);
                assert_eq!((error.as_deref(), taken), (Some("not taken"), (0..8).collect()));
                assert!(made <= 8 + 3 * lanes, "{made}");
            });
        }
    }
}
