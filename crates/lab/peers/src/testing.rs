//! What tests of several systems share.

use clap::{Args, FromArgMatches};

/// The options of a system from what is typed behind its files.
pub fn options<T: Args + FromArgMatches>(text: &str) -> T {
    let command = T::augment_args(clap::Command::new("peers"));
    let files = ["scene", "geometry", "graph", "footprints", "masks", "out", "features"];
    let known = |name: &&str| command.get_arguments().any(|a| a.get_id() == *name);
    let files: Vec<String> = files.into_iter().filter(known).flat_map(|f| [format!("--{f}"), f.into()]).collect();
    let words = ["peers"].into_iter().chain(files.iter().map(String::as_str)).chain(text.split_whitespace());
    T::from_arg_matches(&command.get_matches_from(words)).expect("options of the system")
}
