//! Signals that a stage outlives, and those that ask it to end.

#[cfg(unix)]
use signal_hook::consts::{SIGHUP, SIGXFSZ};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Signals that ask a program to end.
#[cfg(unix)]
const ENDING: [i32; 3] = [SIGINT, SIGTERM, SIGHUP];
#[cfg(not(unix))]
const ENDING: [i32; 2] = [SIGINT, SIGTERM];

/// Sets `seen` when a signal asks the program to end; a second one ends it with exit code 130. A signal that was ignored
/// when the program started stays ignored: that is how `nohup`, and a shell in the background, ask for it.
pub(crate) fn catch(seen: &Arc<AtomicBool>) {
    for signal in ENDING.into_iter().filter(|&s| !is_ignored(s)) {
        // Where a handler cannot be set the signal ends the program, as it does any other. The order is that of the calls:
        // the first signal finds the flag not set.
        let _ = flag::register_conditional_shutdown(signal, 130, Arc::clone(seen));
        let _ = flag::register(signal, Arc::clone(seen));
    }
}

/// From here on a write past the limit on the length of files (`ulimit -f`) is an error and no longer the end of the program.
pub(crate) fn outlive_long_files() {
    #[cfg(unix)]
    let _ = flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)));
}

/// Whether the program ignores a signal. Only Linux tells; elsewhere it is taken not to.
fn is_ignored(signal: i32) -> bool {
    std::fs::read_to_string("/proc/self/status").is_ok_and(|status| ignores(&status, signal))
}

/// Whether a process ignores a signal, by its `/proc/<pid>/status`.
fn ignores(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|l| l.strip_prefix("SigIgn:"));
    mask.and_then(|m| u64::from_str_radix(m.trim(), 16).ok()).is_some_and(|m| m >> (signal - 1) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read() {
        // SIGHUP is 1, SIGINT 2, SIGPIPE 13, SIGTERM 15.
        let status =
            "Name:\tgs-geom\nSigBlk:\tffffffffffffffff\nSigIgn:\t0000000000001001\nSigCgt:\t0000000000004000\n";
        assert_eq!([1, 2, 13, 15, 64].map(|s| ignores(status, s)), [true, false, true, false, false]);
        assert!(!ignores("", 1) && !ignores("SigIgn:\tx\n", 1));
    }
}
