//! What makes a program a stage: arguments that mean the same everywhere, logging, progress, a record of the run, and
//! exit codes.
//!
//! A stage's `main.rs` names the [`Allocator`] and has one line: `fn main() -> ExitCode { stage::main::<Args>() }` for a clap
//! parser `Args` that implements [`Program`]. Exit codes: 0 done; 2 an error, said in one line on standard error; 130 interrupted.
//!
//! `PROGRAM --generate man DIR` writes manual pages, `PROGRAM --generate bash DIR` (zsh, fish, ...) completions.

mod allocator;
mod generate;
mod log;
mod machine;
mod memory;
mod progress;
mod range;
mod record;
mod run_folder;
mod signals;

pub use allocator::Allocator;
pub use log::Stage;
pub use machine::Machine;
pub use memory::Bytes;
pub use progress::Progress;
pub use range::{at_least, positive, within};
pub use record::{RunRecord, cpu_seconds, peak_rss_bytes};
pub use run_folder::input_of_run;

use clap::builder::RangedU64ValueParser;
use clap::error::ContextValue;
use gs_io::{Error, Result, escaped};
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The git revision that the programs were built from: the commit that was checked out, or `CAGS_REVISION` of the build's
/// environment, or `unknown` where there is neither.
pub const REVISION: &str = env!("CAGS_REVISION");

/// Most worker threads: more than a machine has cores only take memory.
const MOST_THREADS: u64 = 1024;

/// Arguments that every stage has, with one meaning.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Common options")]
pub struct CommonArgs {
    /// Worker threads, at most 1024; 0 means one per core. They do not change the results
    #[arg(long, global = true, default_value_t = 0, value_name = "COUNT", value_parser = RangedU64ValueParser::<usize>::new().range(..=MOST_THREADS))]
    pub threads: usize,
    /// Seed of every random choice: the same seed gives the same bytes
    #[arg(long, global = true, default_value_t = 0, value_name = "NUMBER")]
    pub seed: u64,
    /// Say nothing but warnings and errors
    #[arg(long, global = true)]
    pub quiet: bool,
    /// Write events as JSON lines to standard output instead of text to standard error
    #[arg(long, global = true)]
    pub json: bool,
    /// Also overwrite files that this command did not write. Inputs are never overwritten
    #[arg(long, global = true)]
    pub overwrite: bool,
    /// Most memory the run may take, such as 4G. A stage that forecasts more refuses to start [a quarter more
    /// than the machine or the control group has]
    #[arg(long, global = true, value_name = "BYTES")]
    pub memory_limit: Option<Bytes>,
    /// Check the options and do nothing else: no file is read or written, but the records of --run-dir
    #[arg(long, global = true)]
    pub check: bool,
    /// Folder of a run, such as OUT of make. Inputs that are not given are those of the run: dataset, Gaussians, instances, CLIP
    /// and so on
    #[arg(long, global = true, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
}

/// Whether a stage skips what a scene does not need, for the stages that do.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::Args, serde::Serialize)]
pub struct SkipArgs {
    /// Skip nothing: keep what no view shows, such as Gaussians that are never seen or too faint (docs/performance.md)
    #[arg(long)]
    pub no_skip: bool,
}

/// Which views are held out, for the stages that learn from views or are measured on those left.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::Args, serde::Serialize)]
pub struct HoldoutArgs {
    /// Hold out every n-th view, from the first; 0 holds none out [as the Gaussians were trained; 8 where they are not, or do not
    /// say it]
    #[arg(long, value_name = "N")]
    pub holdout: Option<usize>,
}

/// What `--version` says: the version and the git revision.
const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("CAGS_REVISION"), ")");

/// A stage program: its arguments, and what it does with them.
pub trait Program: clap::Parser {
    /// The program's name, such as `gs-geom`.
    const NAME: &'static str;

    /// Options that name outputs though they have the name of an input of other programs: `--run-dir` leaves them alone.
    const OUTPUTS: &'static [&'static str] = &[];

    /// The common arguments within.
    fn common(&self) -> &CommonArgs;

    /// Whether the command forecasts its memory, so that `--memory-limit` means something; where not, it is refused.
    fn forecasts(&self) -> bool {
        true
    }

    /// Refuses options that no input can fix, such as a value out of its range. [`main`] asks before [`Self::run`].
    fn check(&self) -> Result<()> {
        Ok(())
    }

    /// Does the work.
    ///
    /// # Errors
    /// Whatever the person who started the program has to fix.
    fn run(self, stage: &Stage) -> Result<()>;
}

/// [`run`] with the command line of this process.
pub fn main<P: Program>() -> ExitCode {
    run::<P>(std::env::args_os().collect())
}

/// Parses the arguments, the program's name first, sets up threads and logging, runs the program and turns its result into an exit
/// code.
pub fn run<P: Program>(mut given: Vec<OsString>) -> ExitCode {
    signals::outlive_long_files();
    let _ = allocator::NAME.set(P::NAME);
    let mut arguments = readable(&given);
    let failed = |stage: &Stage, e: &Error| {
        stage.error(e);
        ExitCode::from(2)
    };
    if arguments.first().is_some_and(|a| a == "--generate") {
        let stage = Stage::new(P::NAME, &CommonArgs::default());
        let generated = generate::generate::<P>(P::NAME, &arguments[1..]);
        return generated.map_or_else(|e| failed(&stage, &e), |()| ExitCode::SUCCESS);
    }
    let told = match run_folder::told::<P>(&given) {
        Ok(told) => told,
        Err(e) => return failed(&Stage::silent(P::NAME), &e),
    };
    if !told.is_empty() {
        let end = given.iter().position(|a| a == "--").unwrap_or(given.len());
        given.splice(end..end, told.iter().cloned());
        arguments = readable(&given);
    }
    let matches = P::command().version(VERSION).after_help(generate::HELP).try_get_matches_from(given);
    let parsed = matches.and_then(|mut m| {
        let command = m.subcommand_name().map(String::from);
        P::from_arg_matches_mut(&mut m).map(|program| (program, command))
    });
    let (program, command) = match parsed {
        Ok(parsed) => parsed,
        Err(e) => {
            let told = of_the_command_line(e);
            return told.map_or_else(|e| failed(&Stage::silent(P::NAME), &e), |_| ExitCode::SUCCESS);
        }
    };
    let mut stage = Stage::new(P::NAME, program.common());
    stage.command = command;
    if let (false, Some(dir)) = (told.is_empty(), &program.common().run_dir) {
        let options = told.iter().map(|a| a.to_string_lossy()).collect::<Vec<_>>().join(" ");
        stage.info(&format!("from {}: {options}", dir.display()));
    }
    stage.arguments.clone_from(&arguments);
    if program.common().memory_limit.is_some() && !program.forecasts() {
        let e = Error::new("this command does not forecast its memory").field("--memory-limit").hint("leave it out");
        return failed(&stage, &e);
    }
    let threads = program.common().threads;
    if let Err(e) = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global() {
        // rayon has no pool to fall back on: whoever asks for it later would panic.
        let e = Error::new(format!("cannot start the worker threads: {e}")).field("--threads").found(threads);
        return failed(&stage, &e.hint("give fewer threads, or the process more memory"));
    }
    match carry_out(program, &stage) {
        Ok(()) => stage.unwritten.get().map_or(ExitCode::SUCCESS, |e| failed(&stage, e)),
        Err(_) if stage.interrupted() => {
            stage.warn("interrupted");
            ExitCode::from(130)
        }
        // As it was typed: the option, then its value.
        Err(e) => match e.at_fault().and_then(|file| given_by(&arguments, file)) {
            Some(option) => failed(&stage, &Error::new(format!("{option} {e}"))),
            None => failed(&stage, &e),
        },
    }
}

/// A command line without the program, as it is kept and shown.
fn readable(given: &[OsString]) -> Vec<String> {
    given.iter().skip(1).map(|a| a.to_string_lossy().into_owned()).collect()
}

/// Prints help or version as [`Stage::print`] does; ends the program with exit code 2 and clap's few lines where the command
/// line is wrong.
fn of_the_command_line(mut e: clap::Error) -> Result<bool> {
    if !e.use_stderr() {
        return log::told(e.print().and_then(|()| std::io::stdout().flush()));
    }
    // What was typed may hold control characters, as names of files do.
    let typed = e.context().filter_map(|(kind, value)| match value {
        ContextValue::String(s) => Some((kind, ContextValue::String(escaped(s)))),
        _ => None,
    });
    for (kind, value) in typed.collect::<Vec<_>>() {
        e.insert(kind, value);
    }
    e.exit()
}

/// Checks the options, and runs the program unless `--check` asks for no more.
fn carry_out<P: Program>(program: P, stage: &Stage) -> Result<()> {
    program.check()?;
    if program.common().check { Ok(()) } else { program.run(stage) }
}

/// The option whose value this very path is: whoever reads an error about it knows which one to fix.
fn given_by<'a>(arguments: &'a [String], path: &Path) -> Option<&'a str> {
    let options = arguments.iter().zip(arguments.iter().skip(1).map(Some).chain([None]));
    options.filter(|(option, _)| option.starts_with("--")).find_map(|(option, next)| match option.split_once('=') {
        Some((option, value)) => (Path::new(value) == path).then_some(option),
        None => next.filter(|value| Path::new(value) == path).map(|_| option.as_str()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    /// A program that cannot work.
    #[derive(clap::Parser)]
    struct Idle {
        /// How many
        #[arg(long, default_value_t = 3)]
        count: usize,
        #[command(flatten)]
        common: CommonArgs,
    }

    impl Program for Idle {
        const NAME: &'static str = "idle";

        fn common(&self) -> &CommonArgs {
            &self.common
        }

        fn check(&self) -> Result<()> {
            if self.count > 0 { Ok(()) } else { Err(Error::new("nothing").field("--count")) }
        }

        fn run(self, _: &Stage) -> Result<()> {
            Err(Error::new("it ran"))
        }
    }

    #[test]
    fn a_check_is_of_the_options_alone() {
        let said = |arguments: &[&str]| {
            let program = Idle::parse_from([&["idle"], arguments].concat());
            carry_out(program, &Stage::silent("idle")).map_err(|e| e.to_string())
        };
        assert_eq!(said(&["--check"]), Ok(()));
        assert!(said(&[]).unwrap_err().contains("it ran"));
        for arguments in [&["--count", "0", "--check"][..], &["--count", "0"]] {
            assert!(said(arguments).unwrap_err().contains("--count"));
        }
    }

    #[test]
    fn a_path_is_known_by_its_option() {
        let arguments = ["train", "--quiet", "--scene", "a/b/", "--out=c", "--threads"].map(String::from);
        let of = |path: &str| given_by(&arguments, Path::new(path));
        assert_eq!((of("a/b"), of("c")), (Some("--scene"), Some("--out")));
        assert_eq!((of("a/b/images"), of("train"), of("")), (None, None, None));
    }
}
