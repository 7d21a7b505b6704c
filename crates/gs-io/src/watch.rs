//! Inputs that change while a stage works on them.

use crate::{Error, Result};
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Files as they were when a stage began. A stage that reads a file twice (for its hash, then for its content) or late (a
/// photograph, when its turn comes) asks in the end whether they are still the same: otherwise its output would name parents
/// that it was not made from.
#[derive(Debug, Clone, Default)]
pub struct Watched {
    files: Vec<(PathBuf, Stamp)>,
}

/// Length, time of the last change and, where there is one, number of the file: a copy under the same name is another file.
type Stamp = (u64, Option<SystemTime>, u64);

fn stamp(m: &Metadata) -> Stamp {
    #[cfg(unix)]
    let number = std::os::unix::fs::MetadataExt::ino(m);
    #[cfg(not(unix))]
    let number = 0;
    (m.len(), m.modified().ok(), number)
}

impl Watched {
    /// Notes how these files are now. Call it before they are read; those that are not there are left out.
    pub fn new<P: AsRef<Path>>(files: impl IntoIterator<Item = P>) -> Self {
        let noted = files.into_iter().filter_map(|path| {
            let path = path.as_ref();
            Some((path.to_path_buf(), stamp(&std::fs::metadata(path).ok()?)))
        });
        Self { files: noted.collect() }
    }

    /// Adds the files of another.
    #[must_use]
    pub fn and(mut self, other: Self) -> Self {
        self.files.extend(other.files);
        self
    }

    /// Checks that all files are still there and the same.
    ///
    /// # Errors
    /// Names the first file that changed or is gone.
    pub fn check(&self) -> Result<()> {
        self.first(|path, then| std::fs::metadata(path).map_or(true, |m| stamp(&m) != then))
    }

    /// Checks that no file has become another, for a stage that cannot go on without one of them: what it has read so far
    /// was there, and it says itself which it misses.
    ///
    /// # Errors
    /// Names the first file that changed.
    pub fn check_those_left(&self) -> Result<()> {
        self.first(|path, then| std::fs::metadata(path).is_ok_and(|m| stamp(&m) != then))
    }

    fn first(&self, changed: impl Fn(&Path, Stamp) -> bool) -> Result<()> {
        match self.files.iter().find(|(path, then)| changed(path, *then)) {
            None => Ok(()),
            Some((path, _)) => Err(Error::new("the file changed while this run was reading it")
                .file(path)
                .hint("nothing was written; run the same command again")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_seen_and_absence_is_one_where_it_counts() {
        let dir = tempfile::tempdir().unwrap();
        let [a, b] = ["a", "b"].map(|n| dir.path().join(n));
        std::fs::write(&a, "one").unwrap();
        let w = Watched::new([&a]).and(Watched::new([&b]));
        w.check().unwrap();
        std::fs::write(&b, "two").unwrap();
        std::fs::rename(&b, &a).unwrap();
        let e = w.check().unwrap_err().to_string();
        assert!(e.contains("a: the file changed while this run was reading it"), "{e}");
        assert!(w.check_those_left().is_err());
        std::fs::remove_file(&a).unwrap();
        assert!(w.check().is_err());
        w.check_those_left().unwrap();
        std::fs::write(&a, "longer than before").unwrap();
        assert!(w.check_those_left().is_err());
    }
}
