//! What this process expects to stand where it writes: what another program puts there meanwhile stays.

use crate::place::{Stamp, folder_of, place, stamp};
use crate::{Error, ErrorKind, IoContext, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};
use tempfile::NamedTempFile;

/// What was there when the right to write was taken, by place; None where nothing was.
#[derive(Debug, Default)]
struct Expected {
    files: BTreeMap<PathBuf, Option<Stamp>>,
    /// In these, and in the folders in them, nothing else was.
    folders: Vec<PathBuf>,
}

static EXPECTED: Mutex<Expected> = Mutex::new(Expected { files: BTreeMap::new(), folders: Vec::new() });

fn expected() -> MutexGuard<'static, Expected> {
    EXPECTED.lock().expect("no panic holds this lock")
}

/// As long as this is held, nothing but what was expected is replaced by what this process writes there.
#[derive(Debug)]
pub struct Expecting {
    files: Vec<PathBuf>,
    folders: Vec<PathBuf>,
}

impl Expecting {
    /// These files, by place, as they are now, and nothing else in these folders.
    pub(crate) fn new(files: &BTreeMap<PathBuf, Option<Stamp>>, folders: Vec<PathBuf>) -> Self {
        let mut all = expected();
        all.files.extend(files.iter().map(|(path, stamp)| (path.clone(), *stamp)));
        all.folders.extend(folders.iter().cloned());
        Self { files: files.keys().cloned().collect(), folders }
    }

    /// Whether this process, or nobody, wrote what is at a place: the file is as it was expected, or left.
    pub(crate) fn is_own(&self, place: &Path, now: Option<Stamp>) -> bool {
        now.is_none() || lookup(&expected(), place) == Some(now)
    }
}

/// Expects that nothing is at `path`: what comes there is not replaced.
pub fn expect_new(path: impl AsRef<Path>) -> Expecting {
    Expecting::new(&BTreeMap::from([(place(path.as_ref()), None)]), Vec::new())
}

impl Drop for Expecting {
    fn drop(&mut self) {
        let mut all = expected();
        all.files.retain(|path, _| !self.files.contains(path) && !self.folders.iter().any(|f| path.starts_with(f)));
        for folder in &self.folders {
            if let Some(at) = all.folders.iter().position(|f| f == folder) {
                all.folders.swap_remove(at);
            }
        }
    }
}

fn lookup(all: &Expected, place: &Path) -> Option<Option<Stamp>> {
    let name = place.file_name().unwrap_or_default().to_string_lossy();
    // Records and hidden files are no outputs.
    let counts = || !name.starts_with('.') && !name.ends_with(".run.json");
    let inside = || (counts() && all.folders.iter().any(|f| place.starts_with(f))).then_some(None);
    all.files.get(place).copied().or_else(inside)
}

/// Puts a finished file at `target`, which `path` leads to, unless something unexpected stands there.
pub(crate) fn put(file: NamedTempFile, path: &Path, target: &Path) -> Result<()> {
    let place = place(path);
    let before = lookup(&expected(), &place);
    let now = || std::fs::metadata(target).ok().map(|m| stamp(&m));
    let done = match (before, now()) {
        (None, _) => file.persist(target),
        (Some(before), now @ Some(_)) if before == now => file.persist(target),
        (Some(_), Some(_)) => return Err(taken(path)),
        // The system looks and renames in one step.
        (Some(_), None) => match file.persist_noclobber(target) {
            Err(e) if e.error.kind() == std::io::ErrorKind::AlreadyExists => return Err(taken(path)),
            // A file system that cannot: nothing was there a moment ago.
            Err(e) if now().is_none() => e.file.persist(target),
            done => done,
        },
    };
    let file = done.map_err(|e| e.error).at("rename into place", path)?;
    if before.is_some() {
        let stamp = file.metadata().ok().map(|m| stamp(&m));
        expected().files.insert(place, stamp);
    }
    // The rename itself lives in the folder: without this a power cut could undo it.
    if let Ok(folder) = std::fs::File::open(folder_of(target)) {
        let _ = folder.sync_all();
    }
    Ok(())
}

fn taken(path: &Path) -> Error {
    Error::of(ErrorKind::Refused, "another program wrote this file meanwhile: it stays, and nothing is written")
        .file(path)
        .hint("choose another name, or move the file away; then run this again")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Outputs, record_path, write_bytes};
    use std::fs;
    use std::io::Write;

    /// Writes as another program that overwrites nothing; whether it could.
    fn other(path: &Path) -> bool {
        fs::File::create_new(path).and_then(|mut f| f.write_all(b"theirs")).is_ok()
    }

    #[test]
    fn of_two_programs_that_write_one_new_file_one_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        for round in 0..100 {
            let path = dir.path().join(format!("{round}.ply"));
            let claim = Outputs::new("a", false, &path).file(&path).claim().unwrap();
            let (written, came) = std::thread::scope(|s| {
                let racing = s.spawn(|| {
                    (0..round % 50 * 20).for_each(|_| std::hint::spin_loop());
                    other(&path)
                });
                (write_bytes(&path, b"ours"), racing.join().unwrap())
            });
            assert_eq!(written.is_err(), came, "{round}: one of them, never both");
            let content = fs::read(&path).unwrap();
            assert_eq!(content, if came { &b"theirs"[..] } else { b"ours" });
            drop(claim);
            // Theirs is not taken for that of a run that was cut off.
            let next = Outputs::new("a", false, &path).file(&path).claim();
            assert_eq!(next.is_err(), came);
        }
    }

    #[test]
    fn what_comes_after_the_claim_stays() {
        let dir = tempfile::tempdir().unwrap();
        let [new, old, link, folder] = ["new", "old", "link", "folder"].map(|n| dir.path().join(n));
        fs::write(&old, "an artifact of ours").unwrap();
        let finish = |mut claim: crate::Claim| {
            claim.finish(|main, written| {
                let json = serde_json::json!({"written": written});
                fs::write(record_path(main), json.to_string()).at("write", main)
            })
        };
        finish(Outputs::new("a", true, &old).file(&old).claim().unwrap()).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink("target", &link).unwrap();
        let claim = || Outputs::new("a", false, &old).files([&new, &old, &link]).folder(&folder).claim();
        let held = claim().unwrap();
        fs::write(&old, "theirs, and longer than before").unwrap();
        fs::create_dir_all(folder.join("deep")).unwrap();
        for path in [&new, &link, &folder.join("deep/1.ply")] {
            fs::write(path, "theirs").unwrap();
        }
        for path in [&new, &old, &link, &folder.join("deep/1.ply")] {
            let e = write_bytes(path, b"ours").unwrap_err();
            assert!(e.to_string().contains("another program wrote this file meanwhile"), "{e}");
            assert_eq!((e.kind(), fs::read(path).unwrap()[0]), (ErrorKind::Refused, b't'));
        }
        // One's own files are replaced as often as one likes, also one that was taken away.
        let own = folder.join("deep/2.ply");
        for round in ["1", "22"] {
            write_bytes(&own, round.as_bytes()).unwrap();
        }
        fs::remove_file(&own).unwrap();
        write_bytes(&own, b"333").unwrap();
        finish(held).unwrap();
        // What is written down as this command's is what it wrote.
        let record = fs::read_to_string(record_path(&old)).unwrap();
        assert!(record.contains("2.ply") && !record.contains("1.ply") && !record.contains("new"), "{record}");
        assert!(claim().is_err());
        // Afterwards anybody may write.
        write_bytes(&new, b"later").unwrap();
        let expecting = expect_new(&own);
        assert!(write_bytes(&own, b"x").is_err());
        drop(expecting);
        write_bytes(&own, b"x").unwrap();
    }
}
