//! Manual pages and completions for shells, from the programs' own options.

use clap::{CommandFactory, ValueEnum};
use clap_complete::Shell;
use gs_io::{Error, IoContext, Result, create_dir};
use std::path::Path;

/// What the help says of it.
pub(crate) const HELP: &str = "Manual pages and completions: --generate man|bash|zsh|fish|elvish|powershell FOLDER";

/// Writes what `PROGRAM --generate KIND DIR` asks for: `man`, or a shell whose completions are wanted.
pub(crate) fn generate<P: CommandFactory>(name: &'static str, arguments: &[String]) -> Result<()> {
    let shells = Shell::value_variants().iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let usage = || {
        Error::new("what to generate, and where")
            .field("--generate")
            .expected(format!("man or one of {shells}, then a folder"))
    };
    let [kind, folder] = arguments else {
        return Err(usage().found(if arguments.is_empty() { "nothing".into() } else { arguments.join(" ") }));
    };
    let folder = Path::new(folder);
    create_dir(folder)?;
    let command = P::command().name(name);
    if kind == "man" {
        return clap_mangen::generate_to(command, folder).at("write", folder);
    }
    let shell = Shell::from_str(kind, true).map_err(|_| usage().found(kind))?;
    clap_complete::generate_to(shell, &mut command.clone(), name, folder).at("write", folder).map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A program.
    #[derive(clap::Parser)]
    struct Args {
        /// How many
        #[arg(long, default_value_t = 3)]
        count: usize,
    }

    #[test]
    fn pages_and_completions_name_the_options() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("new").to_string_lossy().into_owned();
        for kind in ["man", "bash", "zsh", "fish"] {
            generate::<Args>("some-stage", &[kind.into(), folder.clone()]).unwrap();
        }
        let text = |file: &str| std::fs::read_to_string(Path::new(&folder).join(file)).unwrap();
        assert!(text("some-stage.1").contains("count") && text("some-stage.bash").contains("--count"));
        assert!(text("_some-stage").contains("--count") && text("some-stage.fish").contains("-l count"));
        let e = generate::<Args>("some-stage", &["tcsh".into(), folder]).unwrap_err().to_string();
        assert!(e.contains("bash") && e.contains("tcsh"), "{e}");
        assert!(generate::<Args>("some-stage", &[]).is_err());
        let _ = Args { count: 1 }.count;
    }
}
