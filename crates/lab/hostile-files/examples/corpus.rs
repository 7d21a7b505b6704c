//! Writes the seeds of every format, what earlier fuzzing kept and its findings of old, into a folder of each: where `cargo fuzz` starts from.

use hostile_files::{FORMATS, corpus, findings, seeds};
use std::error::Error;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args().nth(1).ok_or("give the folder to write to, such as fuzz/corpus")?);
    for format in &FORMATS {
        let folder = out.join(format.name);
        std::fs::create_dir_all(&folder)?;
        let (seeds, kept, found) = (seeds(format), corpus(format), findings(format));
        for (kind, files) in [("seed", seeds), ("kept", kept), ("found", found)] {
            for (i, bytes) in files.iter().enumerate() {
                std::fs::write(folder.join(format!("{kind}-{i}")), bytes)?;
            }
        }
    }
    Ok(())
}
