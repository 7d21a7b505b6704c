//! Writes the seeds of every format, what earlier fuzzing kept and its findings of old, into a folder of each: where `cargo fuzz` starts from.

use std::error::Error;
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args().nth(1).ok_or("give the folder to write to, such as fuzz/corpus")?);
    for format in &hostile_files::FORMATS {
        let folder = out.join(format.name);
        std::fs::create_dir_all(&folder)?;
        for (i, seed) in hostile_files::seeds(format).iter().enumerate() {
            std::fs::write(folder.join(format!("seed-{i}")), seed)?;
        }
        for (i, file) in hostile_files::corpus(format).iter().enumerate() {
            std::fs::write(folder.join(format!("kept-{i}")), file)?;
        }
        let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(format.name);
        for entry in std::fs::read_dir(found).into_iter().flatten() {
            let entry = entry?;
            std::fs::copy(entry.path(), folder.join(entry.file_name()))?;
        }
    }
    Ok(())
}
