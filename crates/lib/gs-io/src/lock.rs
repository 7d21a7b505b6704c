//! One run at a time for each output.

use crate::place::{folder_of, node, resolve};
use crate::{Error, ErrorKind, IoContext, Result, create_dir};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The right to write an output, held by one process at a time: `.<name>.lock` beside it, locked by the operating system,
/// which takes the lock back however the process ends. A signed one that is left behind says whose run was cut off.
#[derive(Debug)]
pub struct Lock {
    /// None where the file system knows no locks.
    held: Option<(File, PathBuf)>,
    keep: bool,
    /// Folders that were made for it, innermost first.
    made: Vec<PathBuf>,
}

impl Lock {
    /// Takes the right to write `output` (a file or a folder) and whatever is named after it.
    ///
    /// # Errors
    /// When another process holds it, or the folder cannot be written.
    pub fn take(output: impl AsRef<Path>) -> Result<Self> {
        let output = output.as_ref();
        let path = Self::path(output);
        let folder = folder_of(&path);
        let mut made: Vec<PathBuf> = folder.ancestors().take_while(|f| !f.exists()).map(Path::to_path_buf).collect();
        made.retain(|f| !f.as_os_str().is_empty());
        create_dir(folder)?;
        let open = || OpenOptions::new().write(true).create(true).truncate(false).open(&path);
        let file = loop {
            let file = open().at("create", &path)?;
            match file.try_lock() {
                Ok(()) if is_at(&file, &path) => break file,
                // Its holder ended, and removed it, between our opening and locking it.
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    return Err(Error::of(ErrorKind::Refused, "another run is writing this output")
                        .file(output)
                        .hint("wait until it ends, or stop it; then run this again"));
                }
                Err(TryLockError::Error(_)) => return Ok(Self { held: None, keep: false, made }),
            }
        };
        // A run that is refused leaves the signature of the one that was cut off.
        let keep = file.metadata().is_ok_and(|m| m.len() > 0);
        Ok(Self { held: Some((file, path)), keep, made })
    }

    /// [`Self::take`], after waiting for another holder to end, at most so long.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub fn wait(output: impl AsRef<Path>, most: Duration) -> Result<Self> {
        let begun = Instant::now();
        loop {
            match Self::take(&output) {
                Err(e) if e.kind() == ErrorKind::Refused && begun.elapsed() < most => {
                    std::thread::sleep(Duration::from_millis(2));
                }
                taken => return taken,
            }
        }
    }

    /// `.<name>.lock` beside what `output` leads to.
    fn path(output: &Path) -> PathBuf {
        let output = resolve(output);
        let name = output.file_name().unwrap_or_default().to_string_lossy().into_owned();
        output.with_file_name(format!(".{name}.lock"))
    }

    /// Writes into the lock who holds it.
    pub(crate) fn sign(&mut self, by: &str) -> Result<()> {
        if let Some((file, path)) = &self.held {
            // Never empty for a moment: a kill right then would leave files that are nobody's.
            if std::fs::read(path).ok().as_deref() != Some(by.as_bytes()) {
                let mut out = file;
                out.write_all(by.as_bytes()).and_then(|()| file.set_len(by.len() as u64)).at("write", path)?;
            }
        }
        self.keep = false;
        Ok(())
    }

    /// Who signed the lock that lies beside `output`.
    pub(crate) fn signature(output: &Path) -> Option<String> {
        std::fs::read_to_string(Self::path(output)).ok().filter(|by| !by.is_empty())
    }

    /// Leaves the signed lock behind, open for the next run.
    pub(crate) fn keep(&mut self) {
        self.keep = true;
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        if let Some((_, path)) = self.held.as_ref().filter(|_| !self.keep) {
            // Still locked: whoever opened it meanwhile finds it gone and makes another.
            let _ = std::fs::remove_file(path);
            // A run that wrote nothing leaves no folder. One that holds something is not removed.
            self.made.iter().for_each(|folder| _ = std::fs::remove_dir(folder));
        }
    }
}

/// Whether `file` is what `path` names; where files have no numbers an open one cannot be removed.
fn is_at(file: &File, path: &Path) -> bool {
    file.metadata().is_ok_and(|open| std::fs::metadata(path).is_ok_and(|named| node(&open) == node(&named)))
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
        assert!(Lock::wait(&out, Duration::from_millis(5)).is_err());
        let second = std::thread::spawn({
            let out = out.clone();
            move || Lock::wait(out, Duration::from_secs(60)).map(drop)
        });
        drop(first);
        second.join().unwrap().unwrap();
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        let mut cut_off = Lock::take(&out).unwrap();
        cut_off.sign("gs-geom train").unwrap();
        cut_off.keep();
        drop(cut_off);
        assert_eq!(Lock::signature(&out).as_deref(), Some("gs-geom train"));
        for by in ["gs-geom train", "gs-geom", "gs-geom convert"] {
            let mut next = Lock::take(&out).unwrap();
            next.sign(by).unwrap();
            assert_eq!(Lock::signature(&out).as_deref(), Some(by));
            next.keep();
        }
        drop(Lock::take(&out).unwrap());
        assert!(Lock::signature(&out).is_some(), "one that wrote nothing leaves what it found");
        let mut last = Lock::take(&out).unwrap();
        last.sign("gs-geom").unwrap();
        drop(last);
        assert_eq!(Lock::signature(&out), None);
    }
}
