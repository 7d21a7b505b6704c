//! `cags`: all programs of the pipeline as one, and the pipeline itself.
//!
//! `cags gs-geom train ...` is the program `gs-geom`; `cags train ...` is short for it. Under the name of a program, as a link to
//! it, it is that program: so `pipeline` runs the rules of make with nothing else installed.

mod pipeline;

use clap::{Arg, Command, CommandFactory};
use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::process::ExitCode;

/// A program of the pipeline.
struct Program {
    name: &'static str,
    main: fn(Vec<OsString>) -> ExitCode,
    command: fn() -> Command,
}

/// The program whose command line is `A`.
const fn program<A: stage::Program>() -> Program {
    Program { name: A::NAME, main: stage::run::<A>, command: <A as CommandFactory>::command }
}

const PROGRAMS: [Program; 9] = [
    program::<gs_geom::Args>(),
    program::<mask_embed::Args>(),
    program::<graph_precompute::Args>(),
    program::<feat_train::Args>(),
    program::<cluster_match::Args>(),
    program::<eval::Args>(),
    program::<explore::Args>(),
    program::<export::Args>(),
    program::<synth_scene::Args>(),
];

/// Short words: what they stand for, a program and one of its commands, if it has any.
const SHORT: [(&str, &str, &str); 17] = [
    ("inspect", "gs-geom", "inspect"),
    ("convert", "gs-geom", "convert"),
    ("train", "gs-geom", "train"),
    ("views", "gs-geom", "views"),
    ("render", "gs-geom", "render"),
    ("masks", "mask-embed", "masks"),
    ("embed", "mask-embed", "embed"),
    ("graph", "graph-precompute", ""),
    ("features", "feat-train", ""),
    ("cluster", "cluster-match", ""),
    ("query", "eval", "query"),
    ("inventory", "eval", "names"),
    ("score", "eval", "score"),
    ("report", "eval", "report"),
    ("serve", "explore", "serve"),
    ("page", "explore", "page"),
    ("mcp", "explore", "mcp"),
];

/// Runs what the command line asks for, its first word being the name that this program was called by.
pub fn main(mut arguments: Vec<OsString>) -> ExitCode {
    let called = arguments.first().and_then(|path| Path::new(path).file_stem()).map(OsStr::to_os_string);
    if let Some(program) = called.and_then(|name| find(&name)) {
        return (program.main)(arguments);
    }
    let Some(word) = arguments.get(1).cloned() else { return stage::run::<pipeline::Args>(arguments) };
    if let Some(program) = find(&word) {
        arguments.remove(0);
        return (program.main)(arguments);
    }
    if let Some(&(_, name, command)) = SHORT.iter().find(|(short, ..)| word == *short) {
        let long = [name, command].into_iter().filter(|part| !part.is_empty()).map(OsString::from);
        arguments.splice(..2, long);
        return find(name.as_ref()).map_or(ExitCode::FAILURE, |program| (program.main)(arguments));
    }
    stage::run::<pipeline::Args>(arguments)
}

fn find(name: &OsStr) -> Option<&'static Program> {
    PROGRAMS.iter().find(|p| name == p.name)
}

/// Every other command beside `run`, for help, manual pages and completions.
fn others() -> Vec<Command> {
    let short = SHORT.iter().filter_map(|&(word, name, command)| {
        let whole = (find(name.as_ref())?.command)();
        if command.is_empty() {
            return Some(whole.name(word));
        }
        let common: Vec<Arg> = whole.get_arguments().filter(|a| a.is_global_set()).cloned().collect();
        Some(whole.find_subcommand(command)?.clone().name(word).args(common))
    });
    short.chain(PROGRAMS.iter().map(|p| (p.command)().name(p.name))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_short_word_is_a_command() {
        assert_eq!(others().len(), SHORT.len() + PROGRAMS.len());
        for word in SHORT {
            assert!(find(word.0.as_ref()).is_none(), "{} would hide a program", word.0);
        }
    }

    #[test]
    fn the_command_line_is_sound() {
        pipeline::Args::command().debug_assert();
    }
}
