//! What every reader of files must withstand: files that are cut short, flipped, spliced, or lie about how much they hold.
//! No panic, no memory out of proportion to the file, no name inside a file that leads out of its folder.
//!
//! Each [`Format`] is one entry point, shared by the property tests of `cargo test` and the fuzz targets in `fuzz/`. The
//! crate is for tests only: it replaces the allocator by one that counts.

mod formats;
mod meter;
mod mutate;
mod seeds;

pub use formats::{FORMATS, Format};
pub use mutate::mutate;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The counters are those of the process: while a reader is measured, no other thread makes, reads or measures files.
fn turn() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    // A finding of another test, caught by its harness, says nothing of this one.
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The format of this name.
///
/// # Panics
/// When there is none.
pub fn format(name: &str) -> &'static Format {
    FORMATS.iter().find(|f| f.name == name).expect("a format of that name")
}

/// Small good files of a format, made once.
pub fn seeds(format: &Format) -> Vec<Vec<u8>> {
    static MADE: Mutex<BTreeMap<&str, Vec<Vec<u8>>>> = Mutex::new(BTreeMap::new());
    let _turn = turn();
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    made.entry(format.name).or_insert_with(format.seeds).clone()
}

/// Small files of a format that reached more of its readers' code than the seeds did, kept from ten minutes of fuzzing:
/// two hundred, evenly chosen by size.
///
/// # Panics
/// When `testdata/corpus.zip` is missing or damaged.
pub fn corpus(format: &Format) -> Vec<Vec<u8>> {
    let _turn = turn();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/corpus.zip");
    let mut zip = zip::ZipArchive::new(File::open(path).expect("testdata/corpus.zip")).expect("a zip file");
    let folder = format!("{}/", format.name);
    let names: Vec<String> =
        zip.file_names().map(|n| n.expect("a name").into()).filter(|n: &String| n.starts_with(&folder)).collect();
    let mut read = |name: &String| {
        let mut bytes = Vec::new();
        zip.by_name(name).and_then(|mut f| Ok(f.read_to_end(&mut bytes)?)).expect("a whole entry");
        bytes
    };
    names.iter().map(&mut read).collect()
}

/// Files of a format that once were findings.
///
/// # Panics
/// When one cannot be read.
pub fn findings(format: &Format) -> Vec<Vec<u8>> {
    let _turn = turn();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(format.name);
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    entries.map(|e| std::fs::read(e.expect("an entry").path()).expect("a finding")).collect()
}

/// The most memory that `work` held, in bytes.
pub fn held(work: impl FnOnce()) -> usize {
    let _turn = turn();
    meter::peak(work).0
}

/// Gives a file of these bytes to the readers of a format and returns the most memory they held, in bytes.
///
/// # Panics
/// When a reader panics, takes more memory than the format allows, or lets a name out of its folder: a finding.
pub fn run(format: &Format, bytes: &[u8]) -> usize {
    let _turn = turn();
    // What stands beside damaged files is made now, so that it is not counted.
    formats::folder();
    let (held, ()) = meter::peak(|| (format.check)(bytes));
    let most = format.memory.0 + format.memory.1 * bytes.len();
    assert!(held <= most, "{}: {held} bytes of memory for a file of {}, at most {most}", format.name, bytes.len());
    held
}
