//! Content hashes, by which artifacts name their parents.

use crate::{IoContext, Result};
use std::fs::File;
use std::path::Path;

/// Content hash of `bytes`: BLAKE3, 64 hexadecimal digits.
pub fn hash_bytes(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

/// A well-mixed number from a counter (splitmix64), for choices that must not depend on the order of work.
pub fn mixed(counter: u64) -> u64 {
    let mut z = counter.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Content hash of a file, read in pieces.
pub fn hash_file(path: impl AsRef<Path>) -> Result<String> {
    let path = path.as_ref();
    let file = File::open(path).at("open", path)?;
    let mut h = blake3::Hasher::new();
    h.update_reader(file).at("read", path)?;
    Ok(h.finalize().to_hex().to_string())
}

/// One hash for several files: of their names (as given, not the path to them) and contents, in the order given.
pub fn hash_files<N: AsRef<str>, P: AsRef<Path>>(files: impl IntoIterator<Item = (N, P)>) -> Result<String> {
    let mut h = blake3::Hasher::new();
    for (name, path) in files {
        let name = name.as_ref().as_bytes();
        h.update(&(name.len() as u64).to_le_bytes()).update(name).update(hash_file(path)?.as_bytes());
    }
    Ok(h.finalize().to_hex().to_string())
}
