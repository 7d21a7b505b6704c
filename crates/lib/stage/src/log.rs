//! What a stage says, and the facts of its run.

use crate::{CommonArgs, Machine, Progress, RunRecord, signals};
use gs_io::{Claim, Error, IoContext, Outputs, Provenance, Result, escaped, write_json};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// A running stage: its voice, its clock, its seed and the record of its run.
pub struct Stage {
    name: &'static str,
    pub(crate) command: Option<String>,
    /// The command line, without the program.
    pub(crate) arguments: Vec<String>,
    pub(crate) common: CommonArgs,
    started: Instant,
    skipped: Mutex<Vec<String>>,
    /// Bytes that the run was forecast to take at its peak.
    pub(crate) predicted: Mutex<Option<u64>>,
    interrupted: OnceLock<Arc<AtomicBool>>,
    /// Why an event could not be written, if one could not.
    pub(crate) unwritten: OnceLock<Error>,
}

impl Stage {
    /// A stage that starts now. [`crate::main`] makes one; tests of stage libraries may too.
    pub fn new(name: &'static str, common: &CommonArgs) -> Self {
        Self {
            name,
            command: None,
            arguments: std::env::args_os().skip(1).map(|a| a.to_string_lossy().into_owned()).collect(),
            common: common.clone(),
            started: Instant::now(),
            skipped: Mutex::default(),
            predicted: Mutex::default(),
            interrupted: OnceLock::new(),
            unwritten: OnceLock::new(),
        }
    }

    /// A stage that says nothing, for tests of stage libraries.
    pub fn silent(name: &'static str) -> Self {
        Self::new(name, &CommonArgs { quiet: true, ..CommonArgs::default() })
    }

    /// The program's name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The seed of every random choice.
    pub fn seed(&self) -> u64 {
        self.common.seed
    }

    /// Says what is going on.
    pub fn info(&self, message: &str) {
        if self.common.json {
            self.event("info", &[("message", json!(message))]);
        } else if !self.common.quiet {
            self.line(message);
        }
    }

    /// Says what is odd but not fatal. Not silenced by `--quiet`.
    pub fn warn(&self, message: &str) {
        if self.common.json {
            self.event("warning", &[("message", json!(message))]);
        } else {
            self.line(&format!("warning: {message}"));
        }
    }

    /// Says what was skipped because the scene does not need it, such as "212 of 1,004 Gaussians: never seen". It is
    /// also kept in the record of the run.
    pub fn skipped(&self, what: &str) {
        self.info(&format!("skipped {what}"));
        self.skipped.lock().expect("no panic holds this lock").push(what.to_string());
    }

    /// Says why the stage failed.
    pub fn error(&self, error: &Error) {
        if self.common.json {
            self.event("error", &[("message", json!(error.to_string()))]);
        }
        self.line(&format!("error: {error}"));
    }

    /// A progress line or bar over `total` steps.
    pub fn progress(&self, label: &'static str, total: u64) -> Progress<'_> {
        Progress::new(self, label, total)
    }

    /// Whether Ctrl-C or a termination signal has come. The first call begins to catch them, so a stage that never
    /// asks dies at once, as any program does; a second signal ends the process whatever it does. Signals that were ignored
    /// when the program started stay ignored.
    pub fn interrupted(&self) -> bool {
        let flag = self.interrupted.get_or_init(|| {
            let flag = Arc::new(AtomicBool::new(false));
            signals::catch(&flag);
            flag
        });
        flag.load(Ordering::SeqCst)
    }

    /// Asks whether the work may go on.
    pub fn go_on(&self) -> Result<()> {
        if self.interrupted() { Err(Error::of(gs_io::ErrorKind::Interrupted, "interrupted")) } else { Ok(()) }
    }

    /// Marks the stage as interrupted, as a signal would: whatever error ends it now, the exit code is 130.
    pub fn stop(&self) {
        self.interrupted();
        if let Some(flag) = self.interrupted.get() {
            flag.store(true, Ordering::SeqCst);
        }
    }

    /// The provenance of an artifact of this stage.
    pub fn provenance(
        &self,
        format: &str,
        version: u32,
        parameters: Value,
        inputs: BTreeMap<String, String>,
    ) -> Provenance {
        Provenance {
            format: format.into(),
            version,
            program: format!("{} {}", self.name, env!("CARGO_PKG_VERSION")),
            parameters,
            inputs,
            extra: Value::Null,
        }
    }

    /// Time since the stage began.
    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }

    /// What this run will write, to be completed and claimed before the work; its record will lie beside `main`.
    pub fn outputs(&self, main: impl AsRef<Path>) -> Outputs {
        let by = [Some(self.name), self.command.as_deref()].into_iter().flatten().collect::<Vec<_>>().join(" ");
        Outputs::new(&by, self.common.overwrite, main)
    }

    /// Writes `<output>.run.json`, the whole of [`RunRecord`]: what ran on what and where, what it took, a summary of the
    /// result, and what it wrote.
    /// Call it last; it is not an artifact, its content differs from run to run.
    pub fn record(
        &self,
        claim: &mut Claim,
        parameters: Value,
        inputs: BTreeMap<String, String>,
        summary: Value,
    ) -> Result<()> {
        let elapsed = self.elapsed();
        let began = SystemTime::now() - elapsed;
        let mut record = RunRecord {
            program: self.name.into(),
            version: env!("CARGO_PKG_VERSION").into(),
            revision: crate::REVISION.into(),
            program_hash: crate::record::program_hash(),
            arguments: self.arguments.clone(),
            parameters,
            inputs,
            seed: self.common.seed,
            threads: rayon::current_num_threads(),
            machine: Machine::here(),
            started: began.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs()),
            wall_seconds: elapsed.as_secs_f64(),
            cpu_seconds: crate::cpu_seconds(),
            peak_rss_bytes: crate::peak_rss_bytes(),
            memory_predicted_bytes: *self.predicted.lock().expect("no panic holds this lock"),
            skipped: self.skipped.lock().expect("no panic holds this lock").clone(),
            summary,
            written: Default::default(),
        };
        claim.finish(|main, written| {
            record.written = written;
            write_json(RunRecord::path(main), &record)
        })
    }

    pub(crate) fn event(&self, kind: &str, fields: &[(&str, Value)]) {
        let mut o = serde_json::Map::from_iter([("event".into(), json!(kind)), ("stage".into(), json!(self.name))]);
        o.extend(fields.iter().map(|(k, v)| ((*k).to_string(), v.clone())));
        // The work goes on without the event; the program says in the end that it is missing.
        if let Err(e) = self.print(&format!("{}\n", Value::Object(o))) {
            self.unwritten.get_or_init(|| e);
        }
    }

    /// Writes what a command tells to standard output; whether somebody still reads it. A closed pipe is the reader's choice,
    /// not an error.
    ///
    /// # Errors
    /// When it cannot be written, as on a full disk.
    pub fn print(&self, text: &str) -> Result<bool> {
        let mut out = std::io::stdout().lock();
        told(out.write_all(text.as_bytes()).and_then(|()| out.flush()))
    }

    pub(crate) fn line(&self, message: &str) {
        let _ = writeln!(std::io::stderr().lock(), "{}: {}", self.name, escaped(message));
    }
}

/// What became of a text on standard output, for [`Stage::print`].
pub(crate) fn told(written: std::io::Result<()>) -> Result<bool> {
    match written {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(false),
        written => written.at("write", "standard output").map(|()| true),
    }
}
