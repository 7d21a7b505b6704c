//! `cags run` and `cags models`: the rules of make and the scripts that they call, which this program carries.
//!
//! They are the files of `pipelines/` and `scripts/`, so there is one pipeline: what `make scene` does.

use gs_io::{Error, IoContext, Result, create_dir};
use stage::{CommonArgs, Stage};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

macro_rules! carried {
    ($($path:literal),* $(,)?) => { [$(($path, include_str!(concat!("../../../", $path)))),*] };
}

const FILES: [(&str, &str); 16] = carried![
    "pipelines/custom.mk",
    "pipelines/custom.conf",
    "pipelines/paths.mk",
    "pipelines/poses.mk",
    "pipelines/poses.txt",
    "pipelines/quality.mk",
    "pipelines/quality/fast.conf",
    "pipelines/quality/balanced.conf",
    "pipelines/quality/exact.conf",
    "pipelines/settings.mk",
    "pipelines/stages.mk",
    "scripts/capture.py",
    "scripts/check_options.sh",
    "scripts/check_settings.sh",
    "scripts/fetch_models.sh",
    "scripts/poses.py",
];

/// Settings that name a folder or file.
const PATHS: [&str; 9] = ["GEOMETRY", "MASKS", "CLIP", "SAM", "PANOPTIC", "CONCEPTS", "NOUNS", "VOCABULARY", "CONF"];
/// All others.
const OTHERS: [&str; 15] = [
    "POSES_ARGS",
    "AXES",
    "QUALITY",
    "QUERIES",
    "RESOLUTION",
    "ITERATIONS",
    "GEOM_ARGS",
    "VIEW_ARGS",
    "MASK_ARGS",
    "EMBED_ARGS",
    "GRAPH_ARGS",
    "FEAT_ARGS",
    "CLUSTER_ARGS",
    "SCORE_ARGS",
    "REPORT_ARGS",
];

/// From photographs or a splat to instances: the whole pipeline, or one stage of it
#[derive(Debug, clap::Parser)]
#[command(name = "cags", version, arg_required_else_help = true, subcommands = crate::others())]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Commands,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Commands {
    /// Run every stage on photographs or on a splat, as make scene does; again, only what changed. Needs make and bash
    #[command(display_order = 0)]
    Run(RunOptions),
    /// Fetch the SAM model into a folder. Needs npm
    #[command(display_order = 0)]
    Models(ModelsOptions),
}

#[derive(Debug, clap::Args)]
struct RunOptions {
    /// Folder of photographs, with poses (COLMAP, transforms.json, ScanNet or 7-Scenes) or without, a video, or the file of a trained
    /// splat
    #[arg(value_name = "SCENE")]
    input: PathBuf,
    /// Settings of make scene, such as QUALITY=fast GEOMETRY=file.spz CLIP=folder "QUERIES=red_mug plate"
    #[arg(value_name = "NAME=VALUE", value_parser = setting)]
    settings: Vec<(String, String)>,
    /// Folder of everything made
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct ModelsOptions {
    /// Folder to write to
    #[arg(value_name = "DIR", default_value = "models")]
    folder: PathBuf,
}

/// `NAME=VALUE`.
fn setting(text: &str) -> Result<(String, String)> {
    let known = || PATHS.into_iter().chain(OTHERS);
    let e = || {
        Error::new("no setting")
            .found(text)
            .expected(format!("NAME=VALUE with one of {}", known().collect::<Vec<_>>().join(", ")))
    };
    let (name, value) = text.split_once('=').ok_or_else(e)?;
    if known().any(|k| k == name) { Ok((name.into(), value.into())) } else { Err(e()) }
}

impl stage::Program for Args {
    const NAME: &'static str = "cags";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        matches!(self.command, Commands::Run(_))
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match &self.command {
            Commands::Run(o) => run(o, &self.common, stage),
            Commands::Models(o) => {
                let home = tempfile::tempdir().at("create", "a temporary folder")?;
                write_files(home.path())?;
                let mut script = Command::new("bash");
                script.arg(home.path().join("scripts/fetch_models.sh")).arg(absolute(&o.folder)?);
                carry_out(script, stage)
            }
        }
    }
}

fn run(o: &RunOptions, common: &CommonArgs, stage: &Stage) -> Result<()> {
    if !o.input.exists() {
        return Err(Error::new("no such file or folder").file(&o.input).expected("photographs with poses, or a splat"));
    }
    let out = absolute(&o.out)?;
    let home = out.join(".cags");
    write_files(&home)?;
    link_programs(&home.join("bin"))?;
    let mut make = Command::new("make");
    make.args(["--no-print-directory", "-f", "pipelines/custom.mk", "-C"]).arg(&home).arg("all");
    make.args(settings(o, &out)?).arg(format!("BIN={}", home.join("bin").display()));
    if common.quiet {
        make.arg("-s");
    }
    if common.seed != 0 {
        make.arg(format!("SEED={}", common.seed));
    }
    make.arg(format!("COMMON={}", passed_on(common)));
    // Of a make that started this program.
    make.env_remove("MAKEFLAGS").env_remove("MAKELEVEL");
    carry_out(make, stage)
}

/// The common options for every stage.
fn passed_on(common: &CommonArgs) -> String {
    let CommonArgs { threads, quiet, json, overwrite, memory_limit, .. } = common;
    let flags = [(quiet, " --quiet"), (json, " --json"), (overwrite, " --overwrite")];
    let flags: String = flags.iter().filter(|(on, _)| **on).map(|(_, flag)| *flag).collect();
    let limit = memory_limit.map_or(String::new(), |bytes| format!(" --memory-limit {}", bytes.0));
    format!("--threads {threads}{flags}{limit}")
}

/// The setting that an input is for.
fn kind_of(input: &Path) -> &'static str {
    let extension = input.extension().unwrap_or_default().to_ascii_lowercase();
    let is_video = ["mp4", "mov", "m4v", "mkv", "webm", "avi"].iter().any(|video| extension == *video);
    match input.is_dir() {
        true if gs_scene::dataset::is_bare(input) => "PHOTOGRAPHS",
        true => "SCENE",
        false if is_video => "PHOTOGRAPHS",
        false => "GEOMETRY",
    }
}

/// What make is told. Paths are whole: make runs in another folder.
fn settings(o: &RunOptions, out: &Path) -> Result<Vec<OsString>> {
    let named = |name: &str, path: &Path| -> Result<OsString> {
        let mut text = OsString::from(format!("{name}="));
        text.push(absolute(path)?);
        Ok(text)
    };
    let mut all = vec![named(kind_of(&o.input), &o.input)?, named("OUT", out)?];
    for (name, value) in &o.settings {
        all.push(match PATHS.contains(&name.as_str()) && !value.is_empty() {
            true => named(name, Path::new(value))?,
            false => format!("{name}={value}").into(),
        });
    }
    // Where make scene looks for models, unless settings say another place.
    let given = |name: &str| o.settings.iter().any(|(n, _)| n == name || n == "CONF");
    if !given("SAM") {
        all.push(named("SAM", Path::new("models"))?);
    }
    let clip = Path::new("models/clip");
    if !given("CLIP") && clip.join("text.onnx").exists() {
        all.push(named("CLIP", clip)?);
    }
    Ok(all)
}

fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).at("find", path)
}

/// Runs make or a script, which say themselves what is wrong.
fn carry_out(mut command: Command, stage: &Stage) -> Result<()> {
    // From here on Ctrl-C ends the command, which tidies up, and not this program before it.
    stage.interrupted();
    let name = command.get_program().to_string_lossy().into_owned();
    let status = command.status().map_err(|e| {
        Error::new(format!("cannot run {name}: {e}")).hint(format!("install {name} (Debian: apt install {name})"))
    })?;
    stage.go_on()?;
    if status.success() { Ok(()) } else { Err(Error::new("it stopped: the lines above say why")) }
}

/// Writes the files that this program carries, those that are there already excepted.
fn write_files(home: &Path) -> Result<()> {
    for (name, text) in FILES {
        let path = home.join(name);
        if std::fs::read(&path).is_ok_and(|there| there == text.as_bytes()) {
            continue;
        }
        create_dir(path.parent().unwrap_or(home))?;
        gs_io::write_bytes(&path, text.as_bytes())?;
        #[cfg(unix)]
        if name.ends_with(".sh") {
            use std::os::unix::fs::PermissionsExt;
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).at("mark as a program", &path)?;
        }
    }
    Ok(())
}

/// Links to this program under the names of all programs.
fn link_programs(folder: &Path) -> Result<()> {
    create_dir(folder)?;
    let this = std::env::current_exe().at("find", "this program")?;
    for program in &crate::PROGRAMS {
        let link = folder.join(program.name);
        if std::fs::canonicalize(&link).is_ok_and(|to| to == this) {
            continue;
        }
        if link.symlink_metadata().is_ok() {
            std::fs::remove_file(&link).at("replace", &link)?;
        }
        #[cfg(unix)]
        std::os::unix::fs::symlink(&this, &link).at("link", &link)?;
        #[cfg(not(unix))]
        std::fs::copy(&this, &link).at("copy", &link).map(drop)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_have_known_names() {
        assert_eq!(setting("QUERIES=red_mug a=b").unwrap(), ("QUERIES".into(), "red_mug a=b".into()));
        for wrong in ["QUERIES", "QUERY=mug", "=x", "OUT=elsewhere"] {
            assert!(setting(wrong).unwrap_err().to_string().contains("QUALITY"), "{wrong}");
        }
    }

    #[test]
    fn paths_are_whole() {
        let dir = tempfile::tempdir().unwrap();
        let splat = dir.path().join("a b.spz");
        std::fs::write(&splat, "").unwrap();
        let of = |input: &Path, texts: &[&str]| {
            let settings = texts.iter().map(|t| setting(t).unwrap()).collect();
            let o = RunOptions { input: input.into(), settings, out: "out".into() };
            let all = super::settings(&o, Path::new("/out")).unwrap();
            all.iter().map(|s| s.to_string_lossy().into_owned()).collect::<Vec<_>>()
        };
        let here = std::env::current_dir().unwrap().display().to_string();
        let told = of(&splat, &["CLIP=c", "ITERATIONS=5"]);
        let expected = [format!("GEOMETRY={}", splat.display()), "OUT=/out".into(), format!("CLIP={here}/c")];
        assert_eq!(told[..3], expected);
        assert_eq!(told[3..], ["ITERATIONS=5".to_string(), format!("SAM={here}/models")]);
        assert!(of(dir.path(), &["CLIP="])[..].contains(&"CLIP=".to_string()));
        std::fs::write(dir.path().join("a.JPG"), "").unwrap();
        assert!(
            of(dir.path(), &[])[0].starts_with("PHOTOGRAPHS=")
                && of(&dir.path().join("a.MOV"), &[])[0].starts_with("PHOTOGRAPHS=")
        );
        std::fs::write(dir.path().join("transforms.json"), "").unwrap();
        assert!(of(dir.path(), &["CONF=x"])[0].starts_with("SCENE=") && of(dir.path(), &["CONF=x"]).len() == 3);
    }
}
