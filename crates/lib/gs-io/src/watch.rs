//! Inputs that change while a stage works on them.

use crate::place::{Stamp, stamp};
use crate::{Error, Result, hash_file};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Files as they were when a stage began. A stage that reads a file twice (for its hash, then for its content) or late (a
/// photograph, when its turn comes) asks whether they are still the same: otherwise its output would name parents that it was
/// not made from.
#[derive(Debug, Default)]
pub struct Watched {
    files: Vec<File>,
}

#[derive(Debug)]
struct File {
    path: PathBuf,
    stamp: Mutex<Stamp>,
    /// Content hash, where a file that was only touched has not changed.
    hash: Option<String>,
}

impl File {
    /// Whether the file is another now, where it is there.
    fn changed(&self) -> Option<bool> {
        let now = stamp(&std::fs::metadata(&self.path).ok()?);
        let mut then = self.stamp.lock().expect("no panic holds this lock");
        let same = *then == now
            || self.hash.as_ref().is_some_and(|hash| hash_file(&self.path).is_ok_and(|found| found == *hash));
        if same {
            *then = now;
        }
        Some(!same)
    }
}

impl Watched {
    /// Notes how these files are now. Call it before they are read; those that are not there are left out.
    pub fn new<P: AsRef<Path>>(files: impl IntoIterator<Item = P>) -> Self {
        let noted = files.into_iter().filter_map(|path| {
            let path = path.as_ref().to_path_buf();
            let stamp = Mutex::new(stamp(&std::fs::metadata(&path).ok()?));
            Some(File { path, stamp, hash: None })
        });
        Self { files: noted.collect() }
    }

    /// The same, with the files' content, which is read now: for a stage that runs for hours, in which files may be touched or
    /// copied over themselves.
    pub fn by_content<P: AsRef<Path>>(files: impl IntoIterator<Item = P>) -> Self {
        let mut noted = Self::new(files);
        for file in &mut noted.files {
            file.hash = hash_file(&file.path).ok();
        }
        noted
    }

    /// Adds the files of another.
    #[must_use]
    pub fn and(mut self, other: Self) -> Self {
        self.files.extend(other.files);
        self
    }

    /// Checks that all files are still there and the same.
    pub fn check(&self) -> Result<()> {
        first(self.files.iter(), true)
    }

    /// Checks that no file has become another, for a stage that cannot go on without one of them: what it has read so far
    /// was there, and it says itself which it misses.
    pub fn check_those_left(&self) -> Result<()> {
        first(self.files.iter(), false)
    }

    /// The same for one of the files, after it was read again.
    pub fn check_one(&self, path: &Path) -> Result<()> {
        first(self.files.iter().filter(|f| f.path == path), false)
    }
}

/// The first of the files that changed is an error, and where `gone` counts as a change the first that is gone.
fn first<'a>(mut files: impl Iterator<Item = &'a File>, gone: bool) -> Result<()> {
    match files.find(|f| f.changed().unwrap_or(gone)) {
        None => Ok(()),
        Some(file) => Err(Error::new("the file changed while this run was reading it")
            .file(&file.path)
            .hint("put it back as it was, or run the same command again")),
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
    #[test]
    fn a_touched_file_is_the_same_by_its_content() {
        let dir = tempfile::tempdir().unwrap();
        let [a, b] = ["a", "b"].map(|n| dir.path().join(n));
        std::fs::write(&a, "one").unwrap();
        let (stamp, content) = (Watched::new([&a]), Watched::by_content([&a]));
        // Another file with another time under the same name, twice.
        for _ in 0..2 {
            std::fs::write(&b, "one").unwrap();
            std::fs::File::options()
                .write(true)
                .open(&b)
                .unwrap()
                .set_modified(std::time::SystemTime::UNIX_EPOCH)
                .unwrap();
            std::fs::rename(&b, &a).unwrap();
            assert!(stamp.check_those_left().is_err());
            content.check().unwrap();
            content.check_one(&a).unwrap();
        }
        std::fs::write(&a, "two").unwrap();
        assert!(content.check().is_err() && content.check_one(&a).is_err());
        content.check_one(&b).unwrap();
        std::fs::write(&a, "one").unwrap();
        content.check().unwrap();
    }
}
