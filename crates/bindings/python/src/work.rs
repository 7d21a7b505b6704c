//! Long work beside the interpreter.

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rayon::ThreadPoolBuilder;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::thread;
use std::time::Duration;

/// How often it is asked whether somebody pressed Ctrl-C.
const ASK_EVERY: Duration = Duration::from_millis(50);

/// Runs `work` without the interpreter lock on `threads` threads, 0 for one per core. Ctrl-C sets what `work` is given, and is
/// an error here as soon as `work` ends.
///
/// The threads are made anew each time: those of a pool for all calls would be missing in a process that was forked.
pub fn run<T: Send>(py: Python<'_>, threads: usize, work: impl FnOnce(&AtomicBool) -> T + Send) -> PyResult<T> {
    let pool = ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| PyRuntimeError::new_err(format!("cannot start {threads} threads: {e}")))?;
    let (stop, done) = (AtomicBool::new(false), AtomicBool::new(false));
    let caller = thread::current();
    thread::scope(|scope| {
        let worker = scope.spawn(|| {
            let out = catch_unwind(AssertUnwindSafe(|| pool.install(|| work(&stop))));
            done.store(true, Release);
            caller.unpark();
            out
        });
        let mut interrupted = Ok(());
        while !done.load(Acquire) && interrupted.is_ok() {
            py.detach(|| thread::park_timeout(ASK_EVERY));
            interrupted = py.check_signals();
        }
        stop.store(interrupted.is_err(), Relaxed);
        let out = py.detach(|| worker.join().expect("it catches panics"));
        interrupted.and_then(|()| out.map_err(|panic| resume_unwind(panic)))
    })
}
