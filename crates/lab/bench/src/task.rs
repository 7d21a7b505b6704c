//! A run of a program that makes one file, done again only when its command line or what it reads was made another way.

use crate::chain::Programs;
use gs_io::{Result, create_dir, with_suffix, write_bytes};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// One run.
#[derive(Debug, Clone)]
pub struct Task {
    /// The file that it makes.
    output: PathBuf,
    /// Its command line, the program first.
    command: Vec<String>,
    /// Its command line after those of the tasks that make what it reads.
    how: String,
}

impl Task {
    /// A run that reads what other tasks make.
    pub fn new(output: PathBuf, command: Vec<String>, reads: &[&Self]) -> Self {
        let mut how: Vec<&str> = reads.iter().flat_map(|t| t.how.lines()).collect();
        let own = command.join(" ");
        how.push(&own);
        Self { how: how.join("\n"), output, command }
    }

    /// Where it is kept how the output was made.
    fn note(&self) -> PathBuf {
        with_suffix(&self.output, ".how")
    }

    /// Whether the output is there and was made this way.
    fn is_done(&self) -> bool {
        self.output.exists() && std::fs::read_to_string(self.note()).is_ok_and(|how| how == self.how)
    }

    /// Runs it unless it is done; returns whether it ran.
    pub fn run(&self, programs: &Programs) -> Result<bool> {
        if self.is_done() {
            return Ok(false);
        }
        create_dir(self.output.parent().unwrap_or(Path::new(".")))?;
        // What is half made another way must not pass for done.
        let _ = std::fs::remove_file(self.note());
        programs.run(&self.command)?;
        write_bytes(self.note(), self.how.as_bytes())?;
        Ok(true)
    }
}

/// Tasks by output, rank by rank: a task reads only what tasks of earlier ranks make.
#[derive(Debug, Default)]
pub struct Tasks(Vec<BTreeMap<PathBuf, Task>>);

impl Tasks {
    /// Adds a task after those that it reads from, unless one makes that output already; returns it.
    pub fn add(&mut self, rank: usize, task: Task) -> Task {
        self.0.resize_with(self.0.len().max(rank + 1), BTreeMap::new);
        self.0[rank].entry(task.output.clone()).or_insert_with(|| task.clone());
        task
    }

    /// Runs what is not done, as many at a time as there are worker threads. `after` is called when a task has run.
    pub fn run(&self, programs: &Programs, stage: &stage::Stage, after: impl Fn(&Path) + Sync) -> Result<()> {
        let left: usize = self.0.iter().flat_map(BTreeMap::values).filter(|t| !t.is_done()).count();
        stage.info(&format!("{left} of {} runs to do", self.0.iter().map(BTreeMap::len).sum::<usize>()));
        let progress = Mutex::new(stage.progress("runs", left as u64));
        for rank in &self.0 {
            rank.values().collect::<Vec<_>>().into_par_iter().try_for_each(|task| {
                if !stage.interrupted() && task.run(programs)? {
                    after(&task.output);
                    progress.lock().unwrap_or_else(std::sync::PoisonError::into_inner).step();
                }
                Ok(())
            })?;
            stage.go_on()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_changed_runs_again() {
        let dir = tempfile::tempdir().unwrap();
        // A program that ignores --quiet and --threads.
        let script = dir.path().join("put");
        std::fs::write(&script, "#!/bin/sh\necho \"$2\" >> \"$1\"\n").unwrap();
        std::fs::set_permissions(&script, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        let programs = Programs { folder: dir.path().into(), threads: 1 };
        let run = |first: &str| {
            let path = |name: &str| dir.path().join(name);
            let put = |name: &str, text: &str| vec!["put".into(), path(name).display().to_string(), text.into()];
            let mut tasks = Tasks::default();
            let a = tasks.add(0, Task::new(path("a"), put("a", first), &[]));
            let other = tasks.add(0, Task::new(path("other"), put("other", "x"), &[]));
            tasks.add(1, Task::new(path("b"), put("b", "y"), &[&a]));
            tasks.add(1, Task::new(path("c"), put("c", "z"), &[&a, &other]));
            tasks.run(&programs, &stage::Stage::silent("bench"), |_| ()).unwrap();
            ["a", "b", "c", "other"].map(|name| std::fs::read_to_string(path(name)).unwrap().lines().count())
        };
        assert_eq!(run("1"), [1, 1, 1, 1]);
        assert_eq!(run("1"), [1, 1, 1, 1], "nothing changed");
        assert_eq!(run("2"), [2, 2, 2, 1], "what follows from a runs again");
        std::fs::remove_file(dir.path().join("b")).unwrap();
        assert_eq!(run("2"), [2, 1, 2, 1], "what is gone is made again");
    }
}
