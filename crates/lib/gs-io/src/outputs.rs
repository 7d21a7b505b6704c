//! What a run may write, checked before it works: nothing that somebody else made is overwritten.

use crate::expected::Expecting;
use crate::place::{Identity, Stamp, folder_of, identity, place, stamp, with_suffix};
use crate::{Error, ErrorKind, IoContext, Lock, Result, artifact, hash_file};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Which run wrote which files; part of the record `<output>.run.json`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Written {
    /// Program and command, such as `gs-geom train`.
    pub by: String,
    /// Content hash of each file, by its name relative to the record's folder (absolute where it lies elsewhere). None where
    /// the file was written after the record.
    pub files: BTreeMap<String, Option<String>>,
}

/// Where the record of `output` lies: `<output>.run.json`.
pub fn record_path(output: impl AsRef<Path>) -> PathBuf {
    with_suffix(output, ".run.json")
}

/// The files and folders that a run will write, and the files that it reads. [`Self::claim`] checks them.
#[derive(Debug, Clone)]
pub struct Outputs {
    by: String,
    overwrite: bool,
    drop_stale: bool,
    mains: Vec<PathBuf>,
    /// With the format of an artifact, by which it is known without a record.
    files: Vec<(PathBuf, Option<&'static str>)>,
    /// True where every file in the folder must be of this program: their names are not known before the work.
    folders: Vec<(PathBuf, bool)>,
    inputs: Vec<PathBuf>,
    known: Option<fn(&Path) -> bool>,
}

impl Outputs {
    /// Outputs of the command `by`, whose record lies beside `main`. `overwrite` gives up files that `by` did not write.
    pub fn new(by: &str, overwrite: bool, main: impl AsRef<Path>) -> Self {
        let mains = vec![main.as_ref().to_path_buf()];
        let by = by.to_string();
        Self { by, overwrite, drop_stale: false, mains, files: vec![], folders: vec![], inputs: vec![], known: None }
    }

    /// A second file with a record of its own.
    #[must_use]
    pub fn main(mut self, main: impl AsRef<Path>) -> Self {
        self.mains.push(main.as_ref().to_path_buf());
        self
    }

    /// Will write this file.
    #[must_use]
    pub fn file(self, path: impl AsRef<Path>) -> Self {
        self.files([path])
    }

    /// Will write these files, or some of them.
    #[must_use]
    pub fn files<P: AsRef<Path>>(mut self, paths: impl IntoIterator<Item = P>) -> Self {
        self.files.extend(paths.into_iter().map(|p| (p.as_ref().to_path_buf(), None)));
        self
    }

    /// Will write this artifact; an older one of the same format may be replaced, also without a record.
    #[must_use]
    pub fn artifact(mut self, path: impl AsRef<Path>, format: &'static str) -> Self {
        self.files.push((path.as_ref().to_path_buf(), Some(format)));
        self
    }

    /// Will write files of these names into a folder, where others may lie too, but none that the run reads.
    #[must_use]
    pub fn files_in(mut self, folder: impl AsRef<Path>, names: impl IntoIterator<Item = impl AsRef<Path>>) -> Self {
        let folder = folder.as_ref();
        self.folders.push((folder.to_path_buf(), false));
        self.files(names.into_iter().map(|n| folder.join(n)))
    }

    /// Will write files of any names into a folder: nothing but what this command wrote may lie there.
    #[must_use]
    pub fn folder(mut self, folder: impl AsRef<Path>) -> Self {
        self.folders.push((folder.as_ref().to_path_buf(), true));
        self
    }

    /// Reads these files.
    #[must_use]
    pub fn reads<P: AsRef<Path>>(mut self, paths: impl IntoIterator<Item = P>) -> Self {
        self.inputs.extend(paths.into_iter().map(|p| p.as_ref().to_path_buf()));
        self
    }

    /// Files of this command are known by this, too, where a cut-off run left neither record nor signed lock.
    #[must_use]
    pub fn known_by(mut self, known: fn(&Path) -> bool) -> Self {
        self.known = Some(known);
        self
    }

    /// What the last run of this command wrote, and this one did not, goes at the end: it would be taken for this run's.
    #[must_use]
    pub fn drop_stale(mut self) -> Self {
        self.drop_stale = true;
        self
    }

    /// Checks everything, then takes the right to write: call it before the work.
    ///
    /// # Errors
    /// When an output is one of the inputs or an output folder is one of theirs, is named twice, is not a regular file, exists and
    /// was not written by this command (unless it may be overwritten), cannot be written, or is being written by another run.
    pub fn claim(self) -> Result<Claim> {
        let files: Vec<PathBuf> = self.files.iter().map(|(p, _)| p.clone()).collect();
        self.check_names(&files)?;
        let inputs: BTreeSet<Identity> = self.inputs.iter().filter_map(|p| identity(p)).collect();
        let input_folders: BTreeSet<Identity> = self.inputs.iter().filter_map(|p| identity(folder_of(p))).collect();
        for path in &files {
            if identity(path).is_some_and(|i| inputs.contains(&i)) {
                return Err(Error::of(ErrorKind::Refused, "the output is one of the inputs")
                    .file(path)
                    .hint("choose another name"));
            }
        }
        for (folder, _) in &self.folders {
            if identity(folder).is_some_and(|i| input_folders.contains(&i)) {
                return Err(Error::new("the output folder is one of the inputs'")
                    .file(folder)
                    .hint("choose another folder, that holds no photographs or masks"));
            }
        }
        let past = Past::of(&self.by, &self.mains);
        if !self.overwrite {
            for (path, format) in &self.files {
                self.check_own(&past, path, *format)?;
            }
            for (folder, _) in self.folders.iter().filter(|(_, all)| *all) {
                for path in files_below(folder)? {
                    self.check_own(&past, &path, None)?;
                }
            }
            let mut records = self.mains.iter().map(record_path);
            if let Some(other) = records.find(|r| r.exists() && read_record(r).is_none()) {
                return Err(not_own(&self.by, &other, "not a record of a run"));
            }
        }
        let mut locks = self.mains.iter().map(Lock::take).collect::<Result<Vec<_>>>()?;
        locks.iter_mut().try_for_each(|lock| lock.sign(&self.by))?;
        remove_partial(&files);
        let mut claim = Claim { outputs: self, locks, past, before: BTreeMap::new(), expecting: None, finished: false };
        claim.before = claim.stamps();
        if !claim.outputs.overwrite {
            let whole = claim.outputs.folders.iter().filter(|(_, all)| *all);
            let folders = whole.map(|(folder, _)| place(&folder.join("x"))).map(|p| folder_of(&p).to_path_buf());
            claim.expecting = Some(Expecting::new(&claim.before, folders.collect()));
        }
        Ok(claim)
    }

    /// Checks that `path` is free, or of this command.
    fn check_own(&self, past: &Past, path: &Path, format: Option<&str>) -> Result<()> {
        past.check_own(&self.by, path, format)
            .or_else(|e| if self.known.is_some_and(|of| of(path)) { Ok(()) } else { Err(e) })
    }

    fn check_names(&self, files: &[PathBuf]) -> Result<()> {
        let mut seen = BTreeSet::new();
        for path in files {
            let shown = path.as_os_str().as_encoded_bytes();
            if path.file_name().is_none() || shown.ends_with(b"/") || shown.ends_with(b"/.") {
                return Err(Error::new("not the name of a file")
                    .file(path)
                    .expected("a name that ends without a slash"));
            }
            match std::fs::metadata(path) {
                Ok(m) if m.is_dir() => {
                    return Err(Error::new("a folder is in the way").file(path).expected("the name of a file"));
                }
                Ok(m) if !m.is_file() => {
                    return Err(Error::new("the output is not a regular file")
                        .file(path)
                        .found("a device, a pipe or a socket")
                        .expected("a new name, or an earlier output"));
                }
                _ => {}
            }
            if !seen.insert(identity(path).unwrap_or_else(|| Identity::Path(place(path)))) {
                return Err(Error::new("two outputs would have this name")
                    .file(path)
                    .hint("give them different names"));
            }
        }
        for (folder, _) in &self.folders {
            if folder.exists() && !folder.is_dir() {
                return Err(Error::new("a file is in the way").file(folder).expected("a folder, or a new name"));
            }
        }
        Ok(())
    }
}

/// The right to write the outputs of [`Outputs::claim`], held until it is dropped.
#[derive(Debug)]
pub struct Claim {
    outputs: Outputs,
    locks: Vec<Lock>,
    past: Past,
    before: BTreeMap<PathBuf, Option<Stamp>>,
    /// None where everything may be overwritten.
    expecting: Option<Expecting>,
    finished: bool,
}

impl Claim {
    /// Ends the work: removes what is stale, and hands the list of what was written to `record`, once for each main output.
    pub fn finish(&mut self, mut record: impl FnMut(&Path, Written) -> Result<()>) -> Result<()> {
        let claimed: BTreeSet<PathBuf> = self.outputs.files.iter().map(|(p, _)| place(p)).collect();
        if self.outputs.drop_stale {
            self.remove_stale(&claimed);
        }
        let mains: BTreeSet<PathBuf> = self.outputs.mains.iter().map(|main| place(main)).collect();
        // What earlier runs wrote here stays theirs, hence this command's.
        let mut files: BTreeMap<PathBuf, Option<String>> = self.past.files.clone();
        files.retain(|path, _| path.exists());
        for (path, stamp) in self.own_stamps() {
            let changed = self.before.get(&path).copied().flatten() != stamp;
            // What stood here and was given up, or is of an unfinished run, counts as written.
            let adopted = self.past.unfinished || self.outputs.overwrite && claimed.contains(&path);
            if mains.contains(&path) && (!changed || stamp.is_none()) {
                // Written after this: its hash is not known yet, and that of its predecessor no longer holds.
                files.insert(path, None);
            } else if stamp.is_some() && (changed || adopted && !files.contains_key(&path)) {
                let hash = hash_file(&path)?;
                files.insert(path, Some(hash));
            }
        }
        for main in &self.outputs.mains {
            let place = place(main);
            let name = |p: &Path| p.strip_prefix(folder_of(&place)).unwrap_or(p).to_string_lossy().into_owned();
            let files = files.iter().map(|(path, hash)| (name(path), hash.clone())).collect();
            record(main, Written { by: self.outputs.by.clone(), files })?;
        }
        self.finished = true;
        Ok(())
    }

    /// The same without what another program wrote meanwhile: that is as it was before, to this run.
    fn own_stamps(&self) -> BTreeMap<PathBuf, Option<Stamp>> {
        let own = |(path, now): (PathBuf, Option<Stamp>)| {
            let foreign = self.expecting.as_ref().is_some_and(|e| !e.is_own(&path, now));
            let now = if foreign { self.before.get(&path).copied().flatten() } else { now };
            (path, now)
        };
        self.stamps()
            .into_iter()
            .map(own)
            .filter(|(path, now)| now.is_some() || self.before.contains_key(path))
            .collect()
    }

    /// Every claimed file, by its place, and how it is now.
    fn stamps(&self) -> BTreeMap<PathBuf, Option<Stamp>> {
        let whole = self.outputs.folders.iter().filter(|(_, all)| *all);
        let inside = whole.flat_map(|(folder, _)| files_below(folder).unwrap_or_default());
        let files = self.outputs.files.iter().map(|(p, _)| p.clone()).chain(inside);
        files.map(|p| (place(&p), std::fs::metadata(&p).ok().map(|m| stamp(&m)))).collect()
    }

    /// Removes what an earlier run wrote and this one did not, as long as it is as that run left it.
    fn remove_stale(&self, claimed: &BTreeSet<PathBuf>) {
        let now = self.stamps();
        for (path, hash) in &self.past.files {
            let untouched = || self.before.get(path).copied().flatten() == now.get(path).copied().flatten();
            let same = || hash.is_some() && hash_file(path).ok() == *hash;
            if !claimed.contains(path) && untouched() && same() {
                // What cannot be removed does little harm.
                let _ = std::fs::remove_file(path);
            }
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Without a record nothing but the signed lock says whose the new files are.
        if !self.finished && (self.past.unfinished || self.own_stamps() != self.before) {
            self.locks.iter_mut().for_each(Lock::keep);
        }
    }
}

/// What earlier runs of a command left at its outputs.
#[derive(Debug, Default)]
struct Past {
    /// A run of this command was killed or failed: the files are its own.
    unfinished: bool,
    /// Files of the records, by place.
    files: BTreeMap<PathBuf, Option<String>>,
    /// The same of records of another command.
    others: BTreeMap<PathBuf, String>,
}

impl Past {
    fn of(by: &str, mains: &[PathBuf]) -> Self {
        let mut past = Self::default();
        for main in mains {
            past.unfinished |= Lock::signature(main).as_deref() == Some(by);
            let Some(written) = read_record(&record_path(main)) else { continue };
            let folder = folder_of(&place(main)).to_path_buf();
            for (name, hash) in written.files {
                match written.by == by {
                    true => _ = past.files.insert(folder.join(name), hash),
                    false => _ = past.others.insert(folder.join(name), written.by.clone()),
                }
            }
        }
        past
    }

    /// Checks that `path` is free, or of this command.
    fn check_own(&self, by: &str, path: &Path, format: Option<&str>) -> Result<()> {
        if !path.exists() || self.unfinished {
            return Ok(());
        }
        // Nobody edits an artifact: it is as it was written, or damaged.
        if format.is_some() && artifact::format_of(path).as_deref() == format {
            return Ok(());
        }
        let place = place(path);
        match self.files.get(&place) {
            Some(None) => return Ok(()),
            Some(Some(hash)) if hash_file(path)? == *hash => return Ok(()),
            Some(Some(_)) => return Err(not_own(by, path, &format!("a file that was changed since {by} wrote it"))),
            None => {}
        }
        let other = self.others.get(&place).map_or("a file of somebody else".into(), |o| format!("a file of {o}"));
        Err(not_own(by, path, &other))
    }
}

fn not_own(by: &str, path: &Path, found: &str) -> Error {
    Error::of(ErrorKind::Refused, "the output exists and would be lost")
        .file(path)
        .found(found)
        .expected(format!("nothing, or a file that {by} wrote"))
        .hint("choose another name, delete the file, or give --overwrite")
}

fn read_record(path: &Path) -> Option<Written> {
    let record: serde_json::Value = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    Written::deserialize(&record["written"]).ok()
}

/// Removes temporary files that killed runs left of these: `.<name>.*.partial`.
fn remove_partial(files: &[PathBuf]) {
    let mut names = BTreeMap::<&Path, Vec<String>>::new();
    for path in files {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        names.entry(folder_of(path)).or_default().push(format!(".{name}."));
    }
    for (folder, prefixes) in names {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.ends_with(".partial") && prefixes.iter().any(|p| name.starts_with(p)) {
                // What cannot be removed does no harm.
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// All files in a folder and the folders in it, without hidden ones and records, sorted.
fn files_below(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop().filter(|f| f.is_dir()) {
        for entry in std::fs::read_dir(&folder).at("list", &folder)? {
            let entry = entry.at("list", &folder)?;
            let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            if entry.file_type().is_ok_and(|t| t.is_dir()) {
                folders.push(path);
            } else if name.starts_with('.') || name.ends_with(".run.json") && read_record(&path).is_some() {
                // Locks, temporary files and records are no outputs.
            } else {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ArtifactWriter, Provenance, write_bytes};
    use std::fs;

    /// Ends a run with its record, as a stage does.
    fn finish(mut claim: Claim) {
        claim
            .finish(|main, written| {
                let json = serde_json::json!({"program": "p", "written": written});
                write_bytes(record_path(main), json.to_string().as_bytes())
            })
            .unwrap();
    }

    fn text(result: Result<Claim>) -> String {
        result.map(drop).unwrap_err().to_string()
    }

    #[test]
    fn own_files_are_replaced_and_those_of_others_are_not() {
        let dir = tempfile::tempdir().unwrap();
        let [out, side] = ["out.json", "out.csv"].map(|n| dir.path().join(n));
        let outputs = |by: &str, overwrite: bool| Outputs::new(by, overwrite, &out).file(&out).file(&side);
        fs::write(&side, "of the user").unwrap();
        let e = text(outputs("eval score", false).claim());
        assert!(e.contains("out.csv: the output exists and would be lost") && e.contains("--overwrite"), "{e}");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        let claim = outputs("eval score", true).claim().unwrap();
        write_bytes(&out, b"one").unwrap();
        finish(claim);
        drop(outputs("eval score", false).claim().unwrap());
        let e = text(outputs("eval query", false).claim());
        assert!(e.contains("found a file of eval score, expected nothing, or a file that eval query wrote"), "{e}");
        fs::write(&out, "edited by hand").unwrap();
        let e = text(outputs("eval score", false).claim());
        assert!(e.contains("changed since eval score wrote it"), "{e}");
    }

    #[test]
    fn a_run_that_was_cut_off_owns_what_it_wrote() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out.json");
        let claim = Outputs::new("a", false, &out).file(&out).claim().unwrap();
        write_bytes(&out, b"half of the files").unwrap();
        drop(claim);
        assert!(Outputs::new("b", false, &out).file(&out).claim().is_err());
        // One that fails before it writes leaves that as it is.
        drop(Outputs::new("a", false, &out).file(&out).claim().unwrap());
        // The second run keeps what the first wrote.
        finish(Outputs::new("a", false, &out).file(&out).claim().unwrap());
        drop(Outputs::new("a", false, &out).file(&out).claim().unwrap());
        // One that wrote nothing leaves nothing.
        let new = dir.path().join("new.json");
        drop(Outputs::new("a", false, &new).file(&new).claim().unwrap());
        let left: BTreeSet<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left, BTreeSet::from(["out.json".into(), "out.json.run.json".into()]));
    }

    #[test]
    fn inputs_are_never_written_whatever_they_are_called() {
        let dir = tempfile::tempdir().unwrap();
        let at = |n: &str| dir.path().join(n);
        fs::create_dir(at("images")).unwrap();
        fs::write(at("images/1.png"), "a photograph").unwrap();
        let outputs = || Outputs::new("a", true, at("o")).reads([at("images/1.png")]);
        assert!(text(outputs().file(at("images/../images/1.png")).claim()).contains("one of the inputs"));
        assert!(text(outputs().files_in(at("images"), ["2.png"]).claim()).contains("one of the inputs'"));
        #[cfg(unix)]
        for link in ["soft", "hard"] {
            match link {
                "soft" => std::os::unix::fs::symlink("images/1.png", at(link)).unwrap(),
                _ => fs::hard_link(at("images/1.png"), at(link)).unwrap(),
            }
            assert!(text(outputs().file(at(link)).claim()).contains("one of the inputs"));
        }
        assert_eq!(fs::read(at("images/1.png")).unwrap(), b"a photograph");
    }

    #[test]
    fn names_that_are_no_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let out = |name: &str| {
            let path = PathBuf::from(format!("{}/{name}", dir.path().display()));
            text(Outputs::new("a", true, &path).file(&path).claim())
        };
        fs::create_dir(dir.path().join("folder")).unwrap();
        assert!(out("folder").contains("a folder is in the way"));
        for name in ["new/", "..", "new/."] {
            assert!(out(name).contains("not the name of a file"), "{name}: {}", out(name));
        }
        #[cfg(unix)]
        {
            let socket = std::os::unix::net::UnixListener::bind(dir.path().join("socket")).unwrap();
            assert!(out("socket").contains("not a regular file"));
            drop(socket);
            assert!(text(Outputs::new("a", true, "x").file("/dev/null").claim()).contains("not a regular file"));
        }
        let [a, b] = ["a", "./a"].map(|n| dir.path().join(n));
        assert!(text(Outputs::new("a", true, &a).files([&a, &b]).claim()).contains("two outputs"));
    }

    #[test]
    fn a_folder_of_unknown_names_holds_only_what_the_command_wrote() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("query");
        let outputs = |stale: bool| {
            let outputs = Outputs::new("a", false, folder.join("query.json")).folder(&folder);
            if stale { outputs.drop_stale() } else { outputs }
        };
        let claim = outputs(false).claim().unwrap();
        for name in ["01-mug.ply", "parts/1.ply"] {
            write_bytes(folder.join(name), b"mug").unwrap();
        }
        finish(claim);
        // The next run adds a file and keeps the others, or drops them where it says so.
        for (stale, left) in [(false, true), (true, false)] {
            let claim = outputs(stale).claim().unwrap();
            write_bytes(folder.join("01-spoon.ply"), b"spoon").unwrap();
            finish(claim);
            assert_eq!(folder.join("parts/1.ply").exists(), left);
        }
        fs::write(folder.join("notes.txt"), "of the user").unwrap();
        assert!(text(outputs(false).claim()).contains("notes.txt"));
    }

    #[test]
    fn an_artifact_is_known_by_its_format() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a.safetensors");
        let provenance = Provenance { format: "features".into(), version: 1, ..Provenance::default() };
        ArtifactWriter::new(provenance).tensor("a", &[1], &[1f32]).write(&out).unwrap();
        drop(Outputs::new("feat-train", false, &out).artifact(&out, "features").claim().unwrap());
        assert!(Outputs::new("cluster-match", false, &out).artifact(&out, "instances").claim().is_err());
        assert!(Outputs::new("eval score", false, &out).file(&out).claim().is_err());
    }

    #[test]
    fn temporary_files_of_a_killed_run_go() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a.ply");
        for name in [".a.ply.x1Yz.partial", ".b.ply.x1Yz.partial"] {
            fs::write(dir.path().join(name), "left").unwrap();
        }
        drop(Outputs::new("a", false, &out).file(&out).claim().unwrap());
        let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left, [".b.ply.x1Yz.partial"]);
    }
}
