//! One run at a time for each output.

use crate::{Error, IoContext, Result, create_dir};
use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};

/// The right to write an output, held by one process at a time: `.<name>.lock` beside it, locked by the operating system,
/// which takes the lock back however the process ends.
#[derive(Debug)]
pub struct Lock {
    /// None where the file system knows no locks.
    held: Option<(File, PathBuf)>,
}

impl Lock {
    /// Takes the right to write `output` (a file or a folder) and whatever is named after it, and removes what killed
    /// runs left of it: `.<name>.*.partial`.
    ///
    /// # Errors
    /// When another process holds it, or the folder cannot be written.
    pub fn take(output: impl AsRef<Path>) -> Result<Self> {
        let output = output.as_ref();
        let folder = match output.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        create_dir(folder)?;
        let name = output.file_name().unwrap_or_default().to_string_lossy();
        let path = folder.join(format!(".{name}.lock"));
        let open = || OpenOptions::new().write(true).create(true).truncate(false).open(&path);
        let file = loop {
            let file = open().at("create", &path)?;
            match file.try_lock() {
                Ok(()) if is_at(&file, &path) => break file,
                // Its holder ended, and removed it, between our opening and locking it.
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    return Err(Error::new("another run is writing this output")
                        .file(output)
                        .hint("wait until it ends, or stop it; then run this again"));
                }
                Err(TryLockError::Error(_)) => return Ok(Self { held: None }),
            }
        };
        let stale = |n: &str| n.starts_with(&format!(".{name}.")) && n.ends_with(".partial");
        for entry in std::fs::read_dir(folder).at("list", folder)?.flatten() {
            if entry.file_name().to_str().is_some_and(stale) {
                // What cannot be removed does no harm.
                let _ = std::fs::remove_file(entry.path());
            }
        }
        Ok(Self { held: Some((file, path)) })
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        if let Some((_, path)) = &self.held {
            // Still locked: whoever opened it meanwhile finds it gone and makes another.
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Whether `file` is what `path` names.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |m: std::io::Result<std::fs::Metadata>| m.map(|m| (m.dev(), m.ino())).ok();
    id(file.metadata()).is_some_and(|f| id(std::fs::metadata(path)) == Some(f))
}

/// An open file cannot be removed there.
#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_holder_at_a_time_and_no_litter() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("new/a.ply");
        let first = Lock::take(&out).unwrap();
        // Another open file is another holder, in this process too.
        let e = Lock::take(&out).unwrap_err().to_string();
        assert!(e.contains("a.ply: another run is writing this output"), "{e}");
        Lock::take(dir.path().join("new/b.ply")).unwrap();
        drop(first);
        std::fs::write(dir.path().join("new/.a.ply.x1Yz.partial"), "left").unwrap();
        std::fs::write(dir.path().join("new/.b.ply.x1Yz.partial"), "another's").unwrap();
        drop(Lock::take(&out).unwrap());
        let left: Vec<_> = std::fs::read_dir(dir.path().join("new")).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left, [".b.ply.x1Yz.partial"]);
    }
}
