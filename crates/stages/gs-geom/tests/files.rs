//! `gs-geom inspect` and `gs-geom convert` through the program.

mod common;

use common::world::balls;
use common::{Folder, refused, run};
use gs_scene::splat::{self, Extra, System};
use gs_scene::{Gaussians, Image, ply};
use serde_json::{Value, json};
use std::fs;
use std::path::PathBuf;
#[cfg(unix)]
use std::process::{Command, Stdio};

/// Runs to exit code 0; what it printed to standard output.
fn succeeds(arguments: &[&str]) -> String {
    let o = run(arguments);
    assert!(o.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&o.stderr));
    String::from_utf8_lossy(&o.stdout).into_owned()
}

/// Gaussians on a line, the later the fainter; one is not a number, one of infinite opacity.
fn gaussians() -> Gaussians {
    let n = 40;
    let mut g = Gaussians {
        means: (0..n).map(|i| [i as f32 * 0.25, 1.0, -2.0]).collect(),
        log_scales: vec![[-3.0, -4.0, -3.0]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: (0..n).map(|i| 3.0 - 0.2 * i as f32).collect(),
        sh: (0..n * 48).map(|i| (i as f32).sin()).collect(),
        sh_degree: 3,
        ..Gaussians::default()
    };
    g.means[7][1] = f32::NAN;
    g.opacity_logits[0] = f32::INFINITY;
    g
}

fn written(dir: &Folder) -> String {
    let path = dir.path("in.ply");
    ply::write_gaussians(&path, &gaussians(), &[]).unwrap();
    path
}

#[test]
fn a_file_is_inspected_in_text_and_json() {
    let dir = Folder::new();
    let file = written(&dir);
    let text = succeeds(&["inspect", &file]);
    for wanted in ["gaussians                 40", "sh degree                 3", "\"means\":1"] {
        assert!(text.contains(wanted), "{text}");
    }
    let json = succeeds(&["inspect", &file, "--json"]);
    assert_eq!(json.lines().count(), 1);
    let v: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&v["gaussians"], &v["non_finite"]["means"]), (&40.into(), &1.into()));
    assert_eq!(v["bounds"]["high"][0], 9.75);
    assert_eq!(v["file_bytes"], fs::metadata(&file).unwrap().len());
    assert!(refused(&["inspect", &file, "--threads", "1025"]).contains("1025 is not in 0..=1024"));
    assert!(refused(&["inspect", "no/such.ply"]).contains("no/such.ply"));
    fs::write(&file, "ply\nformat ascii 1.0\nelement vertex 9\nend_header\n").unwrap();
    assert!(refused(&["inspect", &file]).contains("in.ply"));
}

#[test]
fn a_training_writes_no_other_format() {
    let said = refused(&["train", "--scene", "s", "--out", "g.spz"]);
    assert!(said.contains("--out: a training writes PLY; found g.spz"), "{said}");
}

#[test]
fn the_files_of_a_dataset_are_listed() {
    let dir = Folder::new();
    let root = PathBuf::from(dir.path("my scene"));
    let (photograph, scene) = (root.join("train/cam0/a 1.png"), root.to_string_lossy().into_owned());
    Image { width: 8, height: 6, rgb: vec![0.5; 8 * 6 * 3], alpha: None }.write_png(&photograph).unwrap();
    fs::write(root.join("notes.txt"), "not read").unwrap();
    let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let frames = json!([{"file_path": "train/cam0/a 1.png", "transform_matrix": pose}]);
    fs::write(root.join("transforms.json"), json!({"fl_x": 8.0, "frames": frames}).to_string()).unwrap();
    let list = || succeeds(&["inspect", &scene]);
    let before = list();
    let lines: Vec<&str> = before.lines().collect();
    assert!(lines.len() == 2 && lines[0].ends_with("/my scene/transforms.json"), "{before}");
    let bytes = fs::metadata(&photograph).unwrap().len();
    assert!(lines[1].starts_with(&format!("{bytes} ")) && lines[1].ends_with("/train/cam0/a 1.png"), "{before}");
    assert_eq!(list(), before);
    let facts: Value = serde_json::from_str(succeeds(&["inspect", &scene, "--json"]).lines().last().unwrap()).unwrap();
    assert_eq!(facts["bytes"], bytes);
    // Edited: the same size, a later time.
    fs::write(&photograph, fs::read(&photograph).unwrap()).unwrap();
    assert_ne!(list(), before);
}

#[test]
fn a_file_is_trimmed_and_cropped() {
    let dir = Folder::new();
    let file = written(&dir);
    let out = dir.path("new/out.ply");
    succeeds(&["convert", &file, &out, "--sh-degree", "1", "--crop", "-1,0,-2,5,2,-2"]);
    let (g, all) = (ply::read_gaussians(&out).unwrap(), gaussians());
    // 0 to 20 lie inside, 7 is broken.
    assert_eq!((g.len(), g.sh_degree, g.opacity_logits[0]), (20, 1, 50.0));
    for (i, from) in (0..21).filter(|&i| i != 7).enumerate() {
        assert_eq!((g.means[i], g.sh_of(i)), (all.means[from], &all.sh_of(from)[..12]));
    }
    let record: Value = serde_json::from_slice(&fs::read(format!("{out}.run.json")).unwrap()).unwrap();
    assert_eq!((&record["summary"]["damaged"], &record["summary"]["of"]), (&1.into(), &40.into()));
    assert_eq!(record["skipped"].as_array().unwrap().len(), 2);

    // Back to degree 3: the 62 properties of the original code.
    let full = dir.path("full.ply");
    succeeds(&["convert", &out, &full, "--sh-degree", "3", "--quiet"]);
    let header = String::from_utf8_lossy(&fs::read(&full).unwrap()[..3000]).into_owned();
    assert_eq!(header.matches("property float").count(), 62);
    assert!(!header.contains(&dir.path("")));
    assert_eq!(ply::read_gaussians(&full).unwrap().len(), 20);
}

#[test]
fn a_file_is_converted_by_the_name_of_the_output_and_its_format_is_said() {
    let dir = Folder::new();
    let file = written(&dir);
    let inspect = |file: &str| -> Value { serde_json::from_str(&succeeds(&["inspect", file, "--json"])).unwrap() };
    assert_eq!(inspect(&file)["format"], "PLY");
    let mut from = file;
    for (name, format, degree) in [
        ("a.compressed.ply", "compressed PLY", 3),
        ("a.glb", "glTF 2.0 with KHR_gaussian_splatting", 3),
        ("a.spz", "SPZ version 3", 3),
        ("a.sog", "SOG version 2, bundled", 3),
        ("a.splat", ".splat", 0),
        ("b.ply", "PLY", 0),
    ] {
        let out = dir.path(name);
        succeeds(&["convert", &from, &out, "--quiet"]);
        let facts = inspect(&out);
        // The one that is not a number was dropped on the first way.
        assert_eq!(
            (&facts["format"], &facts["gaussians"], &facts["sh_degree"]),
            (&format.into(), &39.into(), &degree.into())
        );
        assert_eq!(facts["file_bytes"], fs::metadata(&out).unwrap().len());
        from = out;
    }
    let (g, all) = (ply::read_gaussians(&from).unwrap(), gaussians());
    // Centres on a line, in the order of the compressed PLY; within its steps.
    let mut along: Vec<f32> = g.means.iter().map(|m| m[0]).collect();
    along.sort_unstable_by(f32::total_cmp);
    let wanted = all.means.iter().filter(|m| m[1].is_finite()).map(|m| m[0]);
    assert!(along.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 0.005), "{along:?}");
    let record: Value = serde_json::from_slice(&fs::read(format!("{from}.run.json")).unwrap()).unwrap();
    assert_eq!(record["summary"]["from"], ".splat");
    // Nothing is guessed from another name.
    assert!(
        refused(&["convert", &from, &dir.path("c.gltf")])
            .contains("ends in .ply, .compressed.ply, .spz, .sog, .splat or .glb")
    );
    fs::write(dir.path("d.spz"), "no splat").unwrap();
    assert!(refused(&["convert", &dir.path("d.spz"), &dir.path("d.ply")]).contains("not a file of Gaussians"));
    assert!(refused(&["inspect", &dir.path("d.spz")]).contains("d.spz: not a file of Gaussians"));
}

/// Runs what a shell does before the program, such as `ulimit -f 1;`, and then the program.
#[cfg(unix)]
fn in_shell(before: &str, arguments: &[&str]) -> Command {
    let mut c = Command::new("sh");
    c.args(["-c", &format!("{before} exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_gs-geom")]).args(arguments);
    c
}

/// What is said by a run that ends with exit code 2 and one line.
#[cfg(unix)]
fn one_line(command: &mut Command) -> String {
    let o = command.stderr(Stdio::piped()).spawn().unwrap().wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert_eq!((o.status.code(), said.lines().count()), (Some(2), 1), "{said}");
    said
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_standard_output_is_an_error_and_a_closed_one_is_not() {
    let dir = Folder::new();
    let file = written(&dir);
    for arguments in [&["inspect", &file][..], &["inspect", &file, "--json"], &["--help"], &["--version"]] {
        let said = one_line(in_shell("", arguments).stdout(fs::File::options().write(true).open("/dev/full").unwrap()));
        assert!(said.contains("standard output: cannot write: No space left"), "{said}");
        let mut child = in_shell("", arguments).stdout(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        assert!(child.wait().unwrap().success(), "{arguments:?}");
    }
    // What events tell is lost, what is made is not.
    let out = dir.path("out.ply");
    let full = fs::File::options().write(true).open("/dev/full").unwrap();
    let said = one_line(in_shell("", &["convert", &file, &out, "--json"]).stdout(full));
    assert!(said.contains("standard output: cannot write: No space left"), "{said}");
    assert_eq!(ply::read_gaussians(&out).unwrap().len(), 39);
}

#[test]
#[cfg(unix)]
fn a_limit_on_the_length_of_files_is_an_error() {
    let dir = Folder::new();
    let (file, out) = (written(&dir), dir.path("out.ply"));
    let said = one_line(&mut in_shell("ulimit -f 1;", &["convert", &file, &out, "--quiet"]));
    assert!(said.contains("out.ply: cannot write: File too large") && said.contains("ulimit -f"), "{said}");
    assert!(!PathBuf::from(&out).exists());
    let told = fs::File::create(dir.path("told.txt")).unwrap();
    let said = one_line(in_shell("ulimit -f 1;", &["inspect", &file]).stdout(told));
    assert!(said.contains("standard output: cannot write: File too large"), "{said}");
}

#[test]
#[cfg(unix)]
fn names_with_control_characters_are_escaped() {
    let dir = Folder::new();
    let odd = |name: &str| dir.path(&format!("a\nb\t\x1b[31m{name}"));
    let (file, out) = (odd("in.ply"), odd("out.ply"));
    fs::rename(written(&dir), &file).unwrap();
    let o = run(&["convert", &file, &out]);
    let said = String::from_utf8(o.stderr).unwrap();
    assert!(o.status.success() && said.contains(r"a\nb\t\u{1b}[31mout.ply"), "{said}");
    assert_eq!(said.lines().count(), 3, "memory, what was skipped, what was written: {said}");
    let missing = one_line(&mut in_shell("", &["inspect", &odd("none.ply")]));
    assert!(missing.contains(r"a\nb\t\u{1b}[31mnone.ply: "), "{missing}");
    // What the command line itself is refused for.
    for arguments in [&["inspect", "x.ply", &odd("")][..], &["inspect", "x.ply", "--threads", &odd("")]] {
        let said = refused(arguments);
        assert!(said.contains(r"a\nb\t\u{1b}[31m") && !said.contains(['\t', '\x1b']), "{said}");
    }
}

#[test]
fn the_input_is_never_overwritten() {
    let dir = Folder::new();
    let file = written(&dir);
    let before = fs::read(&file).unwrap();
    let roundabout = format!("{}/./in.ply", dir.path("."));
    let mut names = vec![file.clone(), roundabout];
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&file, dir.path("link.ply")).unwrap();
        fs::hard_link(&file, dir.path("hard.ply")).unwrap();
        names.extend([dir.path("link.ply"), dir.path("hard.ply")]);
    }
    let out = dir.path("out.ply");
    for name in &names {
        assert!(refused(&["convert", &file, name]).contains("the output is one of the inputs"), "{name}");
    }
    assert!(refused(&["convert", &file, &out, "--sh-degree", "4"]).contains("--sh-degree"));
    assert!(refused(&["convert", &file, &out, "--crop", "90,90,90,91,91,91"]).contains("no Gaussian is left"));
    assert!(refused(&["convert", &file, &out, "--crop", "1,2"]).contains("not a box"));
    assert!(refused(&["convert", &dir.path("none.ply"), &out]).contains("none.ply"));
    assert_eq!(fs::read(&file).unwrap(), before);
    assert!(!PathBuf::from(out).exists());
}

#[test]
#[ignore = "needs shared/data/splats; run make test-data"]
fn real_files_are_inspected_and_converted() {
    let splats = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data/splats");
    let dir = Folder::new();
    for (name, n, degree) in
        [("guitar.ply", 90_854, 0), ("inria_layout_9k.ply", 9_080, 3), ("inria_train_1000.ply", 1_000, 3)]
    {
        let file = splats.join(name).to_string_lossy().into_owned();
        let v: Value = serde_json::from_str(&succeeds(&["inspect", &file, "--json"])).unwrap();
        assert_eq!((&v["gaussians"], &v["sh_degree"]), (&n.into(), &degree.into()), "{name}");
        assert_eq!(v["non_finite"]["gaussians"], 0);
        let sum: u64 = v["opacity"].as_array().unwrap().iter().map(|b| b["count"].as_u64().unwrap()).sum();
        assert_eq!(sum, n);
        let out = dir.path(name);
        succeeds(&["convert", &file, &out, "--sh-degree", "3"]);
        let (a, b) = (ply::read_gaussians(&file).unwrap(), ply::read_gaussians(&out).unwrap());
        let sum = |g: &Gaussians| g.opacity_logits.iter().map(|&v| f64::from(v)).sum::<f64>();
        assert!(a.len() == b.len() && b.sh_degree == 3 && (sum(&a) - sum(&b)).abs() < 1e-6 * sum(&a).abs());
    }
}

/// Turns the axes y and z of Gaussians round, as a packer does that takes a PLY for what its format says.
fn half_turned(g: &Gaussians) -> Gaussians {
    let mut turned = g.clone();
    splat::turn(&mut turned, System::PLY, System::SPZ);
    turned
}

#[test]
fn photographs_tell_the_axes_of_a_file() {
    let dir = Folder::new();
    let truth = balls(60);
    let scene = common::world::scene();
    // An SPZ of Niantic's library, and one of its packer, which keeps numbers as they lie; a PLY that was made of the one by what keeps numbers.
    for (name, g, axes) in [
        ("turned.spz", truth.clone(), "RUB, as its format says"),
        ("kept.spz", half_turned(&truth), "RDF, not as its format says"),
        ("turned.ply", half_turned(&truth), "RUB, not as its format says"),
    ] {
        let (file, out) = (dir.path(name), dir.path(&format!("{name}.out.ply")));
        splat::write(&file, &g, &Extra::default()).unwrap();
        let said = common::succeeds(&["convert", &file, &out, "--scene", scene]);
        assert!(said.contains(&format!("{name}: axes {axes}: ")), "{said}");
        let read = ply::read_gaussians(&out).unwrap();
        let off = read.means.iter().zip(&truth.means).flat_map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).abs()));
        assert!(off.fold(0.0, f32::max) < 1e-4, "{name}");
        // Whoever knows says so.
        let told = dir.path(&format!("{name}.told.ply"));
        succeeds(&["convert", &file, &told, "--axes", &axes[..3]]);
        assert_eq!(ply::read_gaussians(&told).unwrap(), read, "{name}");
    }
    // A PLY that fits is copied, with all that we know nothing of; damaged Gaussians stay what they are.
    let mut damaged = truth.clone();
    damaged.rotations[7] = [0.0; 4];
    let (file, out) = (dir.path("fits.ply"), dir.path("copy.ply"));
    ply::write_gaussians(&file, &damaged, &["theirs".into()]).unwrap();
    succeeds(&["convert", &file, &out, "--scene", scene]);
    assert_eq!(fs::read(&file).unwrap(), fs::read(&out).unwrap());

    // Gaussians of something else are refused, with what was found.
    let mut other = truth;
    other.means.iter_mut().for_each(|m| *m = [m[0] * 0.2, 1.5 + m[1] * 0.1, 1.4]);
    ply::write_gaussians(&file, &other, &[]).unwrap();
    let said = refused(&["convert", &file, &dir.path("no.ply"), "--scene", scene]);
    for part in [
        "fits.ply: the Gaussians do not show these photographs; found with axes RDF ",
        " with RUB ",
        "plain colour has ",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!dir.names().contains(&"no.ply".to_string()));
    succeeds(&["convert", &file, &dir.path("yes.ply"), "--axes", "rdf"]);
    assert!(refused(&["convert", &file, &dir.path("no.ply"), "--axes", "XYZ"]).contains("no axes"));
}
