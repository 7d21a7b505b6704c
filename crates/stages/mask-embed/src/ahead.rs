//! Work on one photograph while the next is made ready.

use gs_io::{Error, Result};
use std::sync::mpsc;

/// Calls `make` for every item and `take` for what it made, in order. Where the program has more threads than one, the next item
/// is made while the last is taken.
pub(crate) fn one_ahead<I, T: Send>(
    items: impl Iterator<Item = I> + Send,
    make: impl FnMut(I) -> Result<T> + Send,
    mut take: impl FnMut(T) -> Result<()>,
) -> Result<()> {
    let mut made = items.map(make);
    if rayon::current_num_threads() <= 1 {
        return made.try_for_each(|made| take(made?));
    }
    std::thread::scope(|scope| {
        let (send, receive) = mpsc::sync_channel(0);
        // It ends after an error, and when nobody receives any more.
        let work = move || made.all(|made| made.is_ok() & send.send(made).is_ok());
        let thread = std::thread::Builder::new().spawn_scoped(scope, work);
        thread.map_err(|e| Error::new(format!("cannot start a thread: {e}")).hint("give --threads 1"))?;
        receive.iter().try_for_each(|made| take(made?))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_are_taken_in_order_up_to_the_first_error() {
        let run = |bad: usize, refused: usize| {
            let (made, mut taken) = (std::sync::atomic::AtomicUsize::new(0), Vec::new());
            let make = |i| {
                made.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                if i == bad { Err(Error::new("not made")) } else { Ok(i) }
            };
            let take = |i| {
                taken.push(i);
                if i == refused { Err(Error::new("not taken")) } else { Ok(()) }
            };
            let error = one_ahead(0..100, make, take).err().map(|e| e.to_string());
            (error, taken, made.into_inner())
        };
        let (error, taken, made) = run(usize::MAX, usize::MAX);
        assert_eq!((error, taken, made), (None, (0..100).collect(), 100));
        let (error, taken, made) = run(7, usize::MAX);
        assert_eq!((error.as_deref(), taken, made), (Some("not made"), (0..7).collect(), 8));
        let (error, taken, made) = run(usize::MAX, 7);
        assert_eq!((error.as_deref(), taken), (Some("not taken"), (0..8).collect()));
        assert!(made <= 10, "{made}");
    }
}
