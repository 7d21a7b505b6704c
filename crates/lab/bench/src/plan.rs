//! What to run and to measure: a text file of lines, a keyword with a name for most, then fields with `|` between; `#` begins
//! a comment line. `@FILE` among the options of footprints, features or clustering stands for those that FILE, a `.conf` of the
//! pipelines beside the plan, gives this stage.
//!
//! | line | meaning |
//! |---|---|
//! | `scene NAME \| options \| options` | a scene: options of synth-scene, and of gs-geom train |
//! | **tables** | scores of features and clusterings, on every scene with every seed |
//! | `seeds \| tuning \| 0 1 2` | seeds of every scene. What is chosen is chosen on `tuning` seeds, below 10; what is claimed is measured on `reporting` seeds, 10 and more |
//! | `masks \| options` | faults of all masks but their granularity: options of synth-scene |
//! | `footprints NAME \| options` | options of graph-precompute |
//! | `features NAME \| footprints \| options` | options of feat-train; `peers SYSTEM options`: made by that; `-`: none |
//! | `clustering NAME \| options` | options of cluster-match; `peers SYSTEM options`: a rival, which gets the features where there are some |
//! | `scoring CLUSTERING \| product \| options` | what it makes, `instances`, `descriptors` or `both`, and options of eval score; without this line `instances` and none |
//! | `table NAME \| masks \| reference row \| title` | a table, at granularity noise of these p, or with masks of `exact` or `sam`; `-`: no reference |
//! | `row TABLE \| features \| clustering \| paper \| label` | a row; paper: its mIoU, mAcc and perhaps memory in GB, or `-` |
//! | `expect TABLE \| features.clustering \| p \| metric \| low \| high` | the mean must lie in this range |
//! | **trade-offs** | run time against error, on every scene |
//! | `repeats \| COUNT` | how often each point is timed, in turns; 3 where it is not given |
//! | `knob NAME \| STAGE \| title` | an approximation of a stage: `geometry`, `graph`, `features`, `instances` or `pipeline` |
//! | `point KNOB \| label \| options \| role` | a setting; role: `exact`, `default`, both or none. Options of more than the knob's stage: `stage: options; stage: options` |
//! | **growth** | run time against size |
//! | `axis NAME \| title \| STAGE ...` | a size that stages are timed against |
//! | `size AXIS \| value \| options \| options` | one size: options of synth-scene and of gs-geom train |

use crate::chain::{Options, Stage};
use gs_io::{Error, IoContext, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scene {
    pub name: String,
    /// Options of synth-scene.
    pub scene: String,
    /// Options of gs-geom train.
    pub geometry: String,
}

/// What the paper prints for a row, on LERF-OVS, in percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Paper {
    pub miou: f64,
    pub macc: f64,
    pub memory: Option<f64>,
}

/// What a clustering makes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Product {
    #[default]
    Instances,
    Descriptors,
    Both,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Name of a way of making features.
    pub features: String,
    /// Name of a way of clustering.
    pub clustering: String,
    pub paper: Option<Paper>,
    pub label: String,
}

impl Row {
    /// `features.clustering`: the name of its files.
    pub fn id(&self) -> String {
        format!("{}.{}", self.features, self.clustering)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct TablePlan {
    pub name: String,
    /// Probabilities of other granularity, as written.
    pub p: Vec<String>,
    /// The row that others are compared with, by id.
    pub reference: Option<String>,
    pub title: String,
    pub rows: Vec<Row>,
}

/// A range that a mean must lie in.
#[derive(Debug, Clone, PartialEq)]
pub struct Expected {
    pub table: String,
    pub row: String,
    /// Probability of other granularity, as written.
    pub p: String,
    pub metric: String,
    pub low: f64,
    pub high: f64,
}

/// A setting of a knob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Point {
    pub label: String,
    pub options: Options,
    /// Whether the others' errors are differences from it.
    pub exact: bool,
    /// Whether it is what the stage does by itself.
    pub default: bool,
}

/// An approximation, with the settings to compare.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Knob {
    pub name: String,
    /// The first stage that it changes; `None` for the whole pipeline.
    pub stage: Option<Stage>,
    pub title: String,
    /// Its settings, one of them exact.
    pub points: Vec<Point>,
}

/// A size of the work.
#[derive(Debug, Clone, PartialEq)]
pub struct Size {
    pub value: f64,
    pub scene: Scene,
}

/// Something that the work grows with.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub name: String,
    pub title: String,
    /// The stages whose growth is fitted.
    pub stages: Vec<Stage>,
    pub sizes: Vec<Size>,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// Scenes of tables and knobs.
    pub scenes: Vec<Scene>,
    /// Seeds of the tables.
    pub seeds: Vec<u64>,
    /// Options by `keyword name`, or by keyword alone.
    options: BTreeMap<String, String>,
    /// Which footprints features are made from.
    pub footprints_of: BTreeMap<String, String>,
    /// What clusterings make that do not make instances alone.
    products: BTreeMap<String, Product>,
    pub tables: Vec<TablePlan>,
    pub expected: Vec<Expected>,
    /// How often each point is timed.
    pub repeats: usize,
    pub knobs: Vec<Knob>,
    pub axes: Vec<Axis>,
}

/// Masks that are no probability of other granularity, but `--corruption` of synth-scene.
pub const NAMED_MASKS: [&str; 2] = ["exact", "sam"];

/// Seeds below this are for choosing settings, the others for measuring what was chosen.
const FIRST_REPORTING: u64 = 10;

/// Keywords with the number of fields after them, and whether they have a name.
const KEYWORDS: [(&str, usize, bool); 15] = [
    ("scene", 2, true),
    ("seeds", 2, false),
    ("masks", 1, false),
    ("footprints", 1, true),
    ("features", 2, true),
    ("clustering", 1, true),
    ("scoring", 2, true),
    ("table", 3, true),
    ("row", 4, true),
    ("expect", 5, true),
    ("repeats", 1, false),
    ("knob", 2, true),
    ("point", 3, true),
    ("axis", 2, true),
    ("size", 3, true),
];

impl Plan {
    /// Reads a plan; an error names the line.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).at("read", path)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let lines = text
            .lines()
            .enumerate()
            .map(|(i, line)| with_files(line, folder).map_err(|e| e.field(format!("line {}", i + 1))));
        let lines = lines.collect::<Result<Vec<_>>>().map_err(|e| e.file(path))?;
        Self::parse(&lines.join("\n")).map_err(|e| e.file(path))
    }

    pub fn parse(text: &str) -> Result<Self> {
        let mut plan = Self { repeats: 3, ..Self::default() };
        for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#')) {
            plan.take(line).map_err(|e| e.field(format!("line {}", i + 1)))?;
        }
        for k in &plan.knobs {
            let count = |f: fn(&Point) -> bool| k.points.iter().filter(|p| f(p)).count();
            if count(|p| p.exact) != 1 || count(|p| p.default) != 1 {
                return Err(Error::new("a knob needs exactly one exact and one default point").field(&k.name));
            }
        }
        if !plan.tables.is_empty() && plan.seeds.is_empty() {
            return Err(Error::new("tables without seeds").expected("a line \"seeds | tuning | 0 1 2\""));
        }
        Ok(plan)
    }

    fn take(&mut self, line: &str) -> Result<()> {
        let fields: Vec<&str> = line.split('|').map(str::trim).collect();
        let (keyword, name) = fields[0].split_once(' ').map_or((fields[0], ""), |(k, n)| (k, n.trim()));
        let wrong = |expected: &str| Error::new("not a line of a plan").found(line).expected(expected);
        let known = KEYWORDS.iter().find(|k| k.0 == keyword);
        let &(_, count, named) = known.ok_or_else(|| wrong(&KEYWORDS.map(|k| k.0).join(", ")))?;
        // The role of a point may be left out.
        let rest = &fields[1..];
        let role = keyword == "point" && rest.len() == count - 1 || rest.len() == count;
        if !role || name.is_empty() == named {
            return Err(wrong(&format!("{count} fields after {keyword}{}", if named { " and a name" } else { "" })));
        }
        if !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-') {
            return Err(Error::new("not a name").found(name).expected("letters, digits and -"));
        }
        let part = ["row", "expect", "point", "size"].contains(&keyword);
        let last = rest[rest.len() - 1].to_string();
        if !part && self.options.insert(format!("{keyword} {name}"), last).is_some() {
            return Err(Error::new("defined twice").found(line));
        }
        match keyword {
            "scene" => self.scenes.push(scene(name, rest[0], rest[1])),
            "seeds" => {
                let seeds = rest[1].split_whitespace().map(|s| s.parse().map_err(|_| wrong("whole numbers")));
                self.seeds = seeds.collect::<Result<_>>()?;
                let (allowed, range) = match rest[0] {
                    "tuning" => (0..FIRST_REPORTING, format!("seeds below {FIRST_REPORTING} for tuning")),
                    "reporting" => {
                        (FIRST_REPORTING..u64::MAX, format!("seeds from {FIRST_REPORTING} on for reporting"))
                    }
                    _ => return Err(wrong("tuning or reporting, then seeds")),
                };
                if let Some(seed) = self.seeds.iter().find(|s| !allowed.contains(*s)) {
                    return Err(Error::new("a seed of the other kind").found(seed).expected(range));
                }
            }
            "scoring" => {
                self.defined("clustering", name)?;
                let product = match rest[0] {
                    "instances" => Product::Instances,
                    "descriptors" => Product::Descriptors,
                    "both" => Product::Both,
                    _ => return Err(wrong("instances, descriptors or both")),
                };
                self.products.insert(name.into(), product);
            }
            "table" => self.tables.push(table(name, rest)?),
            "row" => {
                self.defined("features", rest[0])?;
                self.defined("clustering", rest[1])?;
                let row = Row {
                    features: rest[0].into(),
                    clustering: rest[1].into(),
                    paper: paper(rest[2]).ok_or_else(|| wrong("numbers of the paper, or -"))?,
                    label: rest[3].into(),
                };
                let table = by_name(&mut self.tables, "table", name, |t| &t.name)?;
                if table.rows.iter().any(|r| r.id() == row.id()) {
                    return Err(Error::new("defined twice").found(line));
                }
                table.rows.push(row);
            }
            "expect" => {
                let number = |s: &str| s.parse::<f64>().map_err(|_| wrong("numbers as bounds"));
                let (table, row, p, metric) = (name.into(), rest[0].into(), rest[1].into(), rest[2].into());
                self.expected.push(Expected { table, row, p, metric, low: number(rest[3])?, high: number(rest[4])? });
            }
            "repeats" => self.repeats = stage::within(1usize..=1000)(rest[0]).map_err(|e| wrong(&e))?,
            "knob" => {
                let stage = (rest[0] != "pipeline").then(|| rest[0].parse()).transpose()?;
                self.knobs.push(Knob { name: name.into(), stage, title: rest[1].into(), points: Vec::new() });
            }
            "point" => {
                let knob = by_name(&mut self.knobs, "knob", name, |k| &k.name)?;
                let options = match knob.stage {
                    Some(stage) if !rest[1].contains(':') => Options::of(stage, rest[1]),
                    _ => Options::parse(rest[1])?,
                };
                let is = |role: &str| rest.get(2).is_some_and(|r| r.split(' ').any(|r| r == role));
                let (exact, default) = (is("exact"), is("default"));
                knob.points.push(Point { label: rest[0].into(), options, exact, default });
            }
            "axis" => {
                let stages = rest[1].split(' ').map(str::parse).collect::<Result<_>>()?;
                self.axes.push(Axis { name: name.into(), title: rest[0].into(), stages, sizes: Vec::new() });
            }
            "size" => {
                let value = stage::positive(rest[0]).map_err(|e| wrong(&e))?;
                let scene = scene(&format!("{name}-{}", rest[0]), rest[1], rest[2]);
                by_name(&mut self.axes, "axis", name, |a| &a.name)?.sizes.push(Size { value, scene });
            }
            "features" => {
                self.defined("footprints", rest[0])?;
                self.footprints_of.insert(name.into(), rest[0].into());
            }
            _ => {}
        }
        Ok(())
    }

    fn defined(&self, keyword: &str, name: &str) -> Result<()> {
        let known = self.options.contains_key(&format!("{keyword} {name}"));
        known.then_some(()).ok_or_else(|| Error::new(format!("no such {keyword}")).found(name))
    }

    /// The options of a line by keyword and name (empty for a keyword without); empty where there is no such line.
    pub fn options_of(&self, keyword: &str, name: &str) -> &str {
        self.options.get(&format!("{keyword} {name}")).map_or("", |s| s)
    }

    /// Whether any features or clustering are those of a rival.
    pub fn has_rivals(&self) -> bool {
        self.options.values().any(|o| o.starts_with("peers "))
    }

    /// What a clustering makes.
    pub fn product(&self, clustering: &str) -> Product {
        self.products.get(clustering).copied().unwrap_or_default()
    }

    /// Keeps only the tables, knobs and axes of these names, and of the other tables the rows with clusterings of these names; all
    /// where there is none.
    pub fn only(mut self, names: &[String]) -> Result<Self> {
        let (tables, knobs) = (self.tables.iter().map(|t| &t.name), self.knobs.iter().map(|k| &k.name));
        let rows = self.tables.iter().flat_map(|t| &t.rows).map(|r| &r.clustering);
        let mut all: Vec<&String> = tables.chain(knobs).chain(self.axes.iter().map(|a| &a.name)).collect();
        let named = all.len();
        all.extend(rows);
        if let Some(unknown) = names.iter().find(|n| !all.contains(n)) {
            let all: Vec<&str> = all[..named].iter().map(|n| n.as_str()).collect();
            let expected = all.join(", ") + ", or a clustering of theirs";
            return Err(Error::new("not in the plan").field("--only").found(unknown).expected(expected));
        }
        let wanted = |name: &String| names.is_empty() || names.contains(name);
        self.tables.iter_mut().filter(|t| !wanted(&t.name)).for_each(|t| {
            // What the others are compared with stays.
            let reference = t.reference.clone();
            t.rows.retain(|r| wanted(&r.clustering) || reference.as_ref() == Some(&r.id()));
            if !t.rows.iter().any(|r| wanted(&r.clustering)) {
                t.rows.clear();
            }
        });
        self.tables.retain(|t| !t.rows.is_empty());
        self.knobs.retain(|k| wanted(&k.name));
        self.axes.retain(|a| wanted(&a.name));
        self.expected.retain(|e| wanted(&e.table));
        Ok(self)
    }
}

/// Variables of a `.conf` with the options of a stage, by keyword.
const VARIABLES: [(&str, &str); 3] =
    [("footprints", "GRAPH_ARGS"), ("features", "FEAT_ARGS"), ("clustering", "CLUSTER_ARGS")];

/// A line with the options of files in `folder` in place of every `@FILE`.
fn with_files(line: &str, folder: &Path) -> Result<String> {
    let keyword = line.split(' ').next().unwrap_or("");
    let Some((_, variable)) = VARIABLES.iter().find(|v| v.0 == keyword) else { return Ok(line.into()) };
    let word = |word: &str| match word.strip_prefix('@') {
        Some(file) => {
            let path = folder.join(file);
            let text = std::fs::read_to_string(&path).at("read", &path)?;
            let value = text.lines().filter_map(|l| l.split_once('=')).find(|(name, _)| name.trim() == *variable);
            let no_line =
                || Error::new("no options for this stage").file(&path).expected(format!("a line {variable} = …"));
            Ok(value.ok_or_else(no_line)?.1.trim().to_string())
        }
        None => Ok(word.to_string()),
    };
    Ok(line.split(' ').map(word).collect::<Result<Vec<_>>>()?.join(" "))
}

fn scene(name: &str, scene: &str, geometry: &str) -> Scene {
    Scene { name: name.into(), scene: scene.into(), geometry: geometry.into() }
}

fn table(name: &str, fields: &[&str]) -> Result<TablePlan> {
    let p: Vec<String> = fields[0].split_whitespace().map(String::from).collect();
    if p.is_empty() || !p.iter().all(|p| NAMED_MASKS.contains(&p.as_str()) || stage::within(0.0..=1.0)(p).is_ok()) {
        return Err(Error::new("not masks").found(fields[0]).expected("numbers from 0 to 1, exact or sam"));
    }
    let reference = (fields[1] != "-").then(|| fields[1].to_string());
    Ok(TablePlan { name: name.into(), p, reference, title: fields[2].into(), rows: Vec::new() })
}

fn by_name<'a, T>(all: &'a mut [T], what: &str, name: &str, of: fn(&T) -> &String) -> Result<&'a mut T> {
    all.iter_mut().find(|t| of(t) == name).ok_or_else(|| Error::new(format!("no such {what}")).found(name))
}

/// Numbers of the paper: Some(None) for `-`, None for nonsense.
fn paper(text: &str) -> Option<Option<Paper>> {
    if text == "-" {
        return Some(None);
    }
    let numbers: Vec<f64> = text.split_whitespace().map(str::parse).collect::<std::result::Result<_, _>>().ok()?;
    let (&[miou, macc], memory) = (numbers.get(..2)?, numbers.get(2).copied()) else { return None };
    Some(Some(Paper { miou, macc, memory }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# a comment
scene a | --size tiny | --iterations 10
seeds | tuning | 0 1
masks | --missing 0
footprints gated | --pixel-samples 16
features paper | gated | --preset paper
features ours | gated |
clustering free | --cluster free
table t | 0 0.5 | paper.free | A title
row t | paper | free | 50.79 69.62 2.1 | full
row t | ours | free | - | ours
expect t | paper.free | 0.5 | instance_miou | 0.1 | 0.9
repeats | 5
knob cut | graph | Footprint cut
point cut | none | | exact
point cut | small | --cut 0.01 | default
knob quality | pipeline | Quality
point quality | exact | geometry: --iterations 20; graph: --cut 0 | exact default
point quality | other | |
axis views | Photographs | graph features
size views | 8 | --size tiny --views 8 | --iterations 10
";

    #[test]
    fn a_plan_is_read() {
        let p = Plan::parse(TEXT).unwrap();
        assert_eq!((p.scenes.len(), p.repeats, p.knobs.len(), &p.seeds[..]), (1, 5, 2, &[0, 1][..]));
        let cut = &p.knobs[0];
        assert_eq!(cut.stage, Some(Stage::Graph));
        assert!(cut.points[0].exact && !cut.points[0].default && cut.points[1].default);
        assert_eq!(cut.points[1].options.get(Stage::Graph), ["--cut", "0.01"]);
        assert_eq!(p.knobs[1].points[0].options.get(Stage::Geometry), ["--iterations", "20"]);
        assert_eq!((p.axes[0].stages.len(), p.axes[0].sizes[0].value), (2, 8.0));
        assert_eq!(p.axes[0].sizes[0].scene.name, "views-8");
        assert_eq!((p.options_of("features", "paper"), p.options_of("masks", "")), ("--preset paper", "--missing 0"));
        let row = &p.tables[0].rows[0];
        assert_eq!(row.paper, Some(Paper { miou: 50.79, macc: 69.62, memory: Some(2.1) }));
        assert_eq!((row.id().as_str(), p.tables[0].rows[1].paper), ("paper.free", None));
        assert_eq!(p.expected[0].high, 0.9);
        let only = p.clone().only(&["cut".into(), "views".into()]).unwrap();
        assert_eq!((only.tables.len(), only.knobs.len(), only.axes.len(), only.expected.len()), (0, 1, 1, 0));
        let ours = p.clone().only(&["free".into()]).unwrap();
        assert_eq!((ours.tables[0].rows.len(), ours.knobs.len()), (2, 0), "rows by their clustering");
        let one = Plan::parse(
            &TEXT
                .replace("ours | free | -", "ours | graph | -")
                .replace("table t", "clustering graph |\nscoring graph | both | --threshold 0.5\ntable t"),
        );
        let one = one.unwrap();
        assert_eq!((one.product("graph"), one.product("free")), (Product::Both, Product::Instances));
        assert_eq!(one.options_of("scoring", "graph"), "--threshold 0.5");
        let rows = one.only(&["graph".into()]).unwrap().tables.remove(0).rows;
        assert_eq!(rows.iter().map(Row::id).collect::<Vec<_>>(), ["paper.free", "ours.graph"], "with the reference");
        assert!(p.only(&["cuts".into()]).unwrap_err().to_string().contains("t, cut, quality, views"));
    }

    #[test]
    fn the_options_of_a_stage_may_stand_in_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let (conf, plan) = (folder.path().join("paper.conf"), folder.path().join("a.plan"));
        std::fs::write(&conf, "# FEAT_ARGS = no\nGRAPH_ARGS = --levels large\nFEAT_ARGS = --preset paper\n").unwrap();
        std::fs::write(&plan, TEXT.replace("gated | --preset paper", "gated | @paper.conf --layers 0")).unwrap();
        assert_eq!(Plan::read(&plan).unwrap().options_of("features", "paper"), "--preset paper --layers 0");
        for (from, to, said) in [
            ("| --cluster free", "| @paper.conf", "CLUSTER_ARGS"),
            ("| --pixel-samples 16", "| @none.conf", "none.conf"),
        ] {
            std::fs::write(&plan, TEXT.replace(from, to)).unwrap();
            let e = Plan::read(&plan).unwrap_err().to_string();
            assert!(e.contains(said) && e.contains("line "), "{e}");
        }
    }

    #[test]
    fn mistakes_name_their_line() {
        for (from, to, said) in [
            ("repeats | 5", "repeats | x", "line 13"),
            ("knob cut | graph", "knob cut | grph", "line 14"),
            ("row t | ours", "row t | paper", "defined twice"),
            ("table t", "scoring free | things |\ntable t", "descriptors"),
            ("table t", "scoring fre | both |\ntable t", "no such clustering"),
            ("knob quality", "knob cut", "defined twice"),
            ("seeds | tuning | 0 1\n", "scene a | |\n", "defined twice"),
            ("point cut | none", "point cot | none", "no such knob; found cot"),
            ("| exact\npoint cut", "|\npoint cut", "exact"),
            ("axis views", "axes views", "not a line of a plan"),
            ("graph: --cut 0", "grph: --cut 0", "grph"),
            ("row t | paper", "row t | papers", "papers"),
            ("row t | paper", "row u | paper", "no such table"),
            ("| gated | --preset", "| gate | --preset", "no such footprints"),
            ("0 0.5 |", "0 1.5 |", "not masks"),
            ("50.79 69.62 2.1", "50.79", "numbers of the paper"),
            ("scene a", "scene", "a name"),
            ("tuning | 0 1", "tuning | a", "whole numbers"),
            ("tuning | 0 1", "tuning | 0 10", "below 10"),
            ("tuning | 0 1", "reporting | 9 10", "from 10 on"),
            ("tuning | 0 1", "both | 0 10", "tuning or reporting"),
            ("seeds | tuning | 0 1\n", "", "seeds"),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let e = Plan::parse(&TEXT.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(e.contains(said), "{to}: {e}");
        }
    }
}
