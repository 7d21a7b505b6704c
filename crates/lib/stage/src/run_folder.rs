//! `--run-dir`: options that a command was not given, from the folder of a run.
//!
//! The records beside the outputs of a run hold the command lines that wrote them: these name the dataset, the Gaussians and the
//! model. The other inputs lie in the folder under their usual names.

use crate::{Program, RunRecord};
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Command};
use gs_io::{Error, Result};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

/// Outputs of a run that have a record. The first that names an option and a path that is still there is believed.
const RECORDED: [&str; 9] = [
    "instances.safetensors",
    "features.safetensors",
    "graph.safetensors",
    "geometry.ply",
    "score.json",
    "protocol/metrics.json",
    "query/query.json",
    "masks/features.json",
    "masks/masks.json",
];

/// How an input of a command is found.
enum Place {
    /// As the records name it, else under this name in the folder.
    Recorded(Option<&'static str>),
    /// Under this name in the folder; as the records name it otherwise.
    Folder(&'static str),
}

/// An option that names an input of a run.
struct Input {
    id: &'static str,
    place: Place,
    /// Also given where the command can do without.
    always: bool,
}

const INPUTS: [Input; 9] = [
    Input { id: "scene", place: Place::Recorded(None), always: true },
    Input { id: "geometry", place: Place::Recorded(Some("geometry.ply")), always: true },
    Input { id: "masks", place: Place::Recorded(Some("masks")), always: false },
    Input { id: "graph", place: Place::Folder("graph.safetensors"), always: false },
    Input { id: "footprints", place: Place::Folder("footprints.safetensors"), always: false },
    Input { id: "features", place: Place::Folder("features.safetensors"), always: false },
    Input { id: "instances", place: Place::Folder("instances.safetensors"), always: true },
    Input { id: "clip", place: Place::Recorded(None), always: true },
    Input { id: "text_features", place: Place::Recorded(None), always: true },
];

/// What lies beside the instances and is about them: what a person changed, and what they are called.
const BESIDE: [(&str, &str); 2] = [("edits", "instances.edits.json"), ("names", "names.json")];

/// The options that the folder of a run tells, to be added to `arguments` (the program's name first). Empty without `--run-dir`, and where the
/// command line is wrong, which the parser then says.
///
/// # Errors
/// When there is no such folder, the command reads nothing of a run, or what it must have is not there.
pub(crate) fn told<P: Program>(arguments: &[OsString]) -> Result<Vec<OsString>> {
    let mut root = P::command();
    root.build();
    let Ok(matches) = root.clone().ignore_errors(true).try_get_matches_from(arguments) else { return Ok(Vec::new()) };
    let (mut command, mut matches) = (&root, &matches);
    while let Some((name, sub)) = matches.subcommand() {
        let Some(found) = command.find_subcommand(name) else { return Ok(Vec::new()) };
        (command, matches) = (found, sub);
    }
    let Ok(Some(dir)) = matches.try_get_one::<PathBuf>("run_dir") else { return Ok(Vec::new()) };
    if command.has_subcommands() {
        return Ok(Vec::new());
    }
    Asked { command, matches, dir, outputs: P::OUTPUTS }.tell()
}

/// The file or folder that an option of the programs, such as `geometry` or `text-features`, had in a run, or that lies in its folder
/// under its usual name; none where the run tells of none.
pub fn input_of_run(dir: &Path, option: &str) -> Option<PathBuf> {
    let input = INPUTS.iter().find(|input| input.id.replace('_', "-") == option)?;
    find(&input.place, &format!("--{option}"), dir, &records(dir))
}

/// The command lines that wrote what is in a folder.
fn records(dir: &Path) -> Vec<Vec<String>> {
    RECORDED.iter().filter_map(|file| RunRecord::read(dir.join(file)).ok()).map(|r| r.arguments).collect()
}

fn find(place: &Place, option: &str, dir: &Path, records: &[Vec<String>]) -> Option<PathBuf> {
    let recorded = || records.iter().find_map(|line| existing(&value(line, option)?, dir));
    let here = |name: &str| Some(dir.join(name)).filter(|path| path.exists());
    match place {
        Place::Recorded(name) => recorded().or_else(|| here((*name)?)),
        Place::Folder(name) => here(name).or_else(recorded),
    }
}

/// A command with the options that it was given.
struct Asked<'a> {
    command: &'a Command,
    matches: &'a ArgMatches,
    dir: &'a Path,
    outputs: &'a [&'a str],
}

impl Asked<'_> {
    fn tell(&self) -> Result<Vec<OsString>> {
        let records = records(self.dir);
        let (mut options, mut known) = (Vec::new(), Vec::new());
        for input in INPUTS {
            let Some(arg) = self.arg(input.id).filter(|_| !self.outputs.contains(&input.id)) else { continue };
            let wanted = arg.is_required_set() || input.always || (input.id == "features" && self.clusters_features());
            // A text is asked of one of both.
            let other = input.id == "text_features" && known.contains(&"clip");
            known.push(input.id);
            if !wanted || other || self.is_given(input.id) || self.excluded(arg) {
                continue;
            }
            // A run whose every input is given may still have to be made, as where options are only checked.
            if !self.dir.is_dir() {
                return Err(Error::new("no such folder").field("--run-dir").file(self.dir).expected("OUT of a run"));
            }
            let option = option(arg);
            match find(&input.place, &option, self.dir, &records) {
                Some(path) => options.extend([OsString::from(option), path.into_os_string()]),
                None if arg.is_required_set() => return Err(self.missing(input.id, &option, &records)),
                None => _ = known.pop(),
            }
        }
        if known.is_empty() {
            let e = Error::new("this command reads nothing of a run").field("--run-dir");
            return Err(e.hint("leave it out"));
        }
        let of_the_run = options.iter().any(|o| o == OsStr::new("--instances"));
        for (id, name) in BESIDE.into_iter().filter(|_| of_the_run) {
            let path = self.dir.join(name);
            let wanted = path.is_file() && !self.is_given(id) && !self.outputs.contains(&id);
            if let Some(arg) = self.arg(id).filter(|arg| wanted && !self.excluded(arg)) {
                options.extend([OsString::from(option(arg)), path.into_os_string()]);
            }
        }
        Ok(options)
    }

    /// Whether `--cluster` says that features are clustered, which then are required.
    fn clusters_features(&self) -> bool {
        let mut space = self.matches.try_get_raw("cluster").ok().flatten().into_iter().flatten();
        space.next().is_some_and(|space| space != "masks")
    }

    fn arg(&self, id: &str) -> Option<&Arg> {
        self.command.get_arguments().find(|a| a.get_id() == id)
    }

    fn is_given(&self, id: &str) -> bool {
        self.matches.try_contains_id(id).is_ok() && self.matches.value_source(id) == Some(ValueSource::CommandLine)
    }

    /// Whether another option was given that this one cannot stand beside, or that is given in its stead.
    fn excluded(&self, arg: &Arg) -> bool {
        let given = || self.command.get_arguments().filter(|a| a != &arg && self.is_given(a.get_id().as_str()));
        let conflict =
            |a: &Arg, b: &Arg| self.command.get_arg_conflicts_with(a).iter().any(|c| c.get_id() == b.get_id());
        let instead = |other: &Arg| {
            let groups = self.command.get_groups().filter(|g| g.is_required_set());
            groups
                .map(|g| g.get_args().collect::<Vec<_>>())
                .any(|g| g.contains(&arg.get_id()) && g.contains(&other.get_id()))
        };
        given().any(|other| conflict(arg, other) || conflict(other, arg) || instead(other))
    }

    fn missing(&self, id: &str, option: &str, records: &[Vec<String>]) -> Error {
        if id == "instances" {
            let there = ["features.safetensors", "graph.safetensors", "geometry.ply"];
            let last = there.iter().find(|f| self.dir.join(f).is_file());
            return Error::new("the run is not finished")
                .file(self.dir)
                .found(last.map_or("no file of a run".into(), |f| format!("{f}, but no instances.safetensors")))
                .expected("a folder with instances.safetensors")
                .hint("run make again with this OUT: it goes on where it was");
        }
        let e = match records.iter().find_map(|line| value(line, option)) {
            Some(path) => Error::new("what the run was made from is not there").found(path.display()),
            None => Error::new("the run does not name it"),
        };
        e.file(self.dir).field(option).hint(format!("give it with {option}"))
    }
}

/// An option as it is typed.
fn option(arg: &Arg) -> String {
    format!("--{}", arg.get_long().unwrap_or(arg.get_id().as_str()))
}

/// The value of an option in a command line.
fn value(arguments: &[String], option: &str) -> Option<PathBuf> {
    let joined = arguments.iter().find_map(|a| a.strip_prefix(option)?.strip_prefix('='));
    let next = || arguments.iter().skip_while(|a| *a != option).nth(1).map(String::as_str);
    joined.or_else(next).map(PathBuf::from)
}

/// A recorded path: as it stands, or from one of the folders above the run, where make may have been called.
fn existing(recorded: &Path, run: &Path) -> Option<PathBuf> {
    let run = run.canonicalize().ok()?;
    let places = run.ancestors().map(|folder| folder.join(recorded));
    std::iter::once(recorded.to_path_buf()).chain(places).find(|p| p.exists())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CommonArgs, Stage};
    use std::collections::BTreeMap;

    /// A program with commands of every kind.
    #[derive(clap::Parser)]
    struct Asker {
        #[command(subcommand)]
        command: Commands,
        #[command(flatten)]
        common: CommonArgs,
    }

    #[derive(clap::Subcommand)]
    #[allow(dead_code, reason = "only the command line is tested")]
    enum Commands {
        Query {
            #[arg(long)]
            scene: PathBuf,
            #[arg(long)]
            geometry: PathBuf,
            #[arg(long)]
            instances: PathBuf,
            #[arg(long)]
            edits: Option<PathBuf>,
            #[arg(long)]
            names: Option<PathBuf>,
            #[arg(long)]
            clip: Option<PathBuf>,
            #[arg(long, conflicts_with = "clip")]
            text_features: Option<PathBuf>,
            #[arg(long)]
            features: Option<PathBuf>,
            #[arg(long)]
            text: Vec<String>,
        },
        #[command(group(clap::ArgGroup::new("one").required(true).multiple(true).args(["instances", "descriptors"])))]
        Score {
            #[arg(long)]
            instances: Option<PathBuf>,
            #[arg(long)]
            descriptors: Option<PathBuf>,
            #[arg(long, conflicts_with = "scene")]
            predictions: Option<PathBuf>,
            #[arg(long)]
            scene: Option<PathBuf>,
        },
        Graph {
            #[arg(long)]
            masks: PathBuf,
            #[arg(long)]
            graph: PathBuf,
        },
        Idle,
    }

    impl Program for Asker {
        const NAME: &'static str = "asker";
        const OUTPUTS: &'static [&'static str] = &["graph"];

        fn common(&self) -> &CommonArgs {
            &self.common
        }

        fn run(self, _: &Stage) -> Result<()> {
            Ok(())
        }
    }

    /// A folder with a run whose instances were made from `scene` and `c d.ply`.
    fn run() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for file in ["c d.ply", "instances.safetensors", "features.safetensors"] {
            std::fs::write(at(file), "").unwrap();
        }
        ["scene", "masks"].iter().for_each(|folder| std::fs::create_dir(at(folder)).unwrap());
        let out = at("instances.safetensors");
        let mut stage = Stage::silent("cluster-match");
        stage.arguments = ["--scene", "scene", "--geometry=c d.ply", "--masks", "gone"].map(String::from).into();
        let mut claim = Stage::new("cluster-match", &CommonArgs { overwrite: true, ..CommonArgs::default() })
            .outputs(&out)
            .file(&out)
            .claim()
            .unwrap();
        gs_io::write_bytes(&out, b"instances").unwrap();
        stage.record(&mut claim, serde_json::json!({}), BTreeMap::new(), serde_json::json!({})).unwrap();
        dir
    }

    /// What a command line gets from the run, with the run's folder as `@`.
    fn of(dir: &Path, line: &[&str]) -> std::result::Result<String, String> {
        let run = dir.to_string_lossy().into_owned();
        let line = [&["asker"], line, &["--run-dir", &run]].concat();
        let told = told::<Asker>(&line.iter().map(OsString::from).collect::<Vec<_>>()).map_err(|e| e.to_string())?;
        let run = dir.canonicalize().unwrap().to_string_lossy().into_owned();
        Ok(told.iter().map(|o| o.to_string_lossy().replace(&run, "@")).collect::<Vec<_>>().join(" "))
    }

    #[test]
    fn what_is_not_given_comes_from_the_run() {
        let dir = run();
        let all = "--scene @/scene --geometry @/c d.ply --instances @/instances.safetensors";
        assert_eq!(of(dir.path(), &["query", "--text", "mug"]).unwrap(), all);
        let given = of(dir.path(), &["query", "--scene", "other", "--instances=mine"]).unwrap();
        assert_eq!(given, "--geometry @/c d.ply");
        BESIDE.iter().for_each(|(_, name)| std::fs::write(dir.path().join(name), "{}").unwrap());
        let beside = "--edits @/instances.edits.json --names @/names.json";
        assert_eq!(of(dir.path(), &["query"]).unwrap(), format!("{all} {beside}"));
        // Edits of other instances would be wrong.
        assert!(!of(dir.path(), &["query", "--instances=mine"]).unwrap().contains("edits"));
    }

    #[test]
    fn nothing_is_added_beside_what_excludes_it() {
        let dir = run();
        assert_eq!(of(dir.path(), &["score"]).unwrap(), "--scene @/scene --instances @/instances.safetensors");
        assert_eq!(of(dir.path(), &["score", "--descriptors", "d"]).unwrap(), "--scene @/scene");
        assert_eq!(of(dir.path(), &["score", "--predictions", "p"]).unwrap(), "--instances @/instances.safetensors");
        // An output is never taken for an input; a recorded folder that is gone, for one in its usual place.
        assert_eq!(of(dir.path(), &["graph"]).unwrap(), "--masks @/masks");
    }

    #[test]
    fn what_is_missing_is_said() {
        let dir = run();
        std::fs::remove_dir(dir.path().join("scene")).unwrap();
        let e = of(dir.path(), &["query"]).unwrap_err();
        assert!(e.contains("is not there") && e.contains("found scene") && e.contains("give it with --scene"), "{e}");
        std::fs::remove_file(dir.path().join("instances.safetensors")).unwrap();
        let e = of(dir.path(), &["query", "--scene", "s", "--geometry", "g"]).unwrap_err();
        assert!(e.contains("not finished; found features.safetensors, but no instances.safetensors"), "{e}");
        assert!(of(dir.path(), &["idle"]).unwrap_err().contains("leave it out"));
        assert!(of(&dir.path().join("none"), &["query"]).unwrap_err().contains("no such folder"));
    }

    #[test]
    fn a_wrong_command_line_is_left_to_the_parser() {
        let dir = run();
        assert_eq!(of(dir.path(), &["nonsense"]).unwrap(), "");
        assert_eq!(of(dir.path(), &[]).unwrap(), "");
        assert_eq!(told::<Asker>(&["asker".into(), "query".into()]).unwrap(), Vec::<OsString>::new());
    }
}
