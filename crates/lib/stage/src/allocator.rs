//! What a program does when there is no more memory.

use crate::Bytes;
use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;
use std::sync::OnceLock;

/// The program's name, and what would take less memory.
pub(crate) static NAME: OnceLock<&str> = OnceLock::new();
pub(crate) static HINT: OnceLock<String> = OnceLock::new();

/// The system's allocator, for a program's `#[global_allocator]`. Where it has no memory left the program says so in one
/// line (no event with `--json`) and ends with exit code 2; Rust alone would abort it with SIGABRT.
pub struct Allocator;

/// Says what was asked for and ends the program at once. Nothing here allocates.
fn give_up(bytes: usize) -> ! {
    let name = NAME.get().copied().unwrap_or("stage");
    let hint = HINT.get().map_or("free some memory", String::as_str);
    // Locked to the end, so that one thread alone says it.
    let mut out = std::io::stderr().lock();
    let _ = writeln!(out, "{name}: error: memory: there is no more: {} asked for at once; {hint}", Bytes(bytes as u64));
    signal_hook::low_level::exit(2)
}

fn checked(block: *mut u8, bytes: usize) -> *mut u8 {
    if block.is_null() {
        give_up(bytes);
    }
    block
}

// SAFETY: every call goes to the system's allocator with the same arguments; a null pointer is never given back.
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        checked(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        checked(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as the caller promises.
        checked(unsafe { System.realloc(block, layout, size) }, size)
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(block, layout) }
    }
}
