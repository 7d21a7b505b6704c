//! The plan of an ablation: one text file that `make` and `eval` both read.
//!
//! A line is a keyword, a name for most, then fields with `|` between; `#` begins a comment line:
//!
//! | line | meaning |
//! |---|---|
//! | `scene NAME \| options` | a scene: options of synth-scene |
//! | `seeds \| 0 1 2` | seeds of every scene |
//! | `geometry \| options` | options of gs-geom train |
//! | `masks \| options` | faults of all masks but their granularity: options of synth-scene |
//! | `footprints NAME \| options` | options of graph-precompute |
//! | `features NAME \| footprints \| options` | options of feat-train |
//! | `clustering NAME \| options` | options of cluster-match |
//! | `table NAME \| p values \| row of reference \| title` | a table, at granularity noise of these p; `-`: no reference |
//! | `row TABLE \| features \| clustering \| paper \| label` | a row; paper: its mIoU, mAcc and perhaps memory in GB, or `-` |
//! | `expect TABLE \| features.clustering \| p \| metric \| low \| high` | the mean must lie in this range |

use gs_io::{Error, IoContext, Result};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// What the paper prints for a row, on LERF-OVS, in percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Paper {
    /// mIoU.
    pub miou: f64,
    /// mAcc.
    pub macc: f64,
    /// Memory in GB.
    pub memory: Option<f64>,
}

/// A row of a table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Name of a way of making features.
    pub features: String,
    /// Name of a way of clustering.
    pub clustering: String,
    /// The paper's numbers.
    pub paper: Option<Paper>,
    /// What it is called.
    pub label: String,
}

impl Row {
    /// `features.clustering`: the name of its files.
    pub fn id(&self) -> String {
        format!("{}.{}", self.features, self.clustering)
    }
}

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub struct TablePlan {
    /// Its name.
    pub name: String,
    /// Probabilities of other granularity, as written.
    pub p: Vec<String>,
    /// The row that others are compared with, by id.
    pub reference: Option<String>,
    /// Its title.
    pub title: String,
    /// Its rows.
    pub rows: Vec<Row>,
}

/// A range that a mean must lie in.
#[derive(Debug, Clone, PartialEq)]
pub struct Expected {
    /// Table.
    pub table: String,
    /// Row, by id.
    pub row: String,
    /// Probability of other granularity, as written.
    pub p: String,
    /// Name of a metric.
    pub metric: String,
    /// Least value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
}

/// A plan.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// Scenes: name and options of synth-scene.
    pub scenes: Vec<(String, String)>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Options by `keyword name`, or by keyword alone.
    pub options: BTreeMap<String, String>,
    /// Which footprints features are made from.
    pub footprints_of: BTreeMap<String, String>,
    /// Tables.
    pub tables: Vec<TablePlan>,
    /// What must come out.
    pub expected: Vec<Expected>,
}

impl Plan {
    /// Reads a plan.
    ///
    /// # Errors
    /// When the file is missing, a line is not one of the above, or names something that no line before it defines.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).at("read", path)?;
        let mut plan = Self::default();
        for (i, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            plan.take(line).map_err(|e| e.file(path).field(format!("line {}", i + 1)))?;
        }
        let missing = match () {
            () if plan.scenes.is_empty() => Some("scene"),
            () if plan.seeds.is_empty() => Some("seeds"),
            () if plan.tables.iter().all(|t| t.rows.is_empty()) => Some("row"),
            () => None,
        };
        match missing {
            Some(keyword) => {
                Err(Error::new("the plan is incomplete").file(path).expected(format!("a line {keyword:?}")))
            }
            None => Ok(plan),
        }
    }

    fn take(&mut self, line: &str) -> Result<()> {
        let fields: Vec<&str> = line.split('|').map(str::trim).collect();
        let mut head = fields[0].split_whitespace();
        let (keyword, name) = (head.next().unwrap_or_default(), head.next().unwrap_or_default());
        let rest = &fields[1..];
        let wrong = || Error::new("not a line of a plan").found(line);
        let (named, count) = match keyword {
            "scene" | "footprints" | "clustering" => (true, 1),
            "seeds" | "geometry" | "masks" => (false, 1),
            "features" => (true, 2),
            "table" => (true, 3),
            "row" => (true, 4),
            "expect" => (true, 5),
            _ => return Err(wrong()),
        };
        if head.next().is_some() || name.is_empty() == named || rest.len() != count {
            return Err(
                wrong().expected(format!("{count} fields after {keyword}{}", if named { " and a name" } else { "" }))
            );
        }
        if !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-') {
            return Err(Error::new("not a name").found(name).expected("letters, digits and -"));
        }
        let unknown = |what: &str, name: &str| Error::new(format!("no such {what}")).found(name);
        match keyword {
            "seeds" => {
                self.seeds =
                    rest[0].split_whitespace().map(|s| s.parse().map_err(|_| wrong())).collect::<Result<_>>()?;
            }
            "table" => {
                let p: Vec<String> = rest[0].split_whitespace().map(String::from).collect();
                let sound = |p: &String| p.parse::<f64>().is_ok_and(|p| (0.0..=1.0).contains(&p));
                if p.is_empty() || !p.iter().all(sound) {
                    return Err(wrong().expected("probabilities"));
                }
                let reference = (rest[1] != "-").then(|| rest[1].to_string());
                let (name, title) = (name.to_string(), rest[2].to_string());
                self.tables.push(TablePlan { name, p, reference, title, rows: Vec::new() });
            }
            "row" => {
                for (what, name) in [("features", rest[0]), ("clustering", rest[1])] {
                    if !self.options.contains_key(&format!("{what} {name}")) {
                        return Err(unknown(what, name));
                    }
                }
                let row = Row {
                    features: rest[0].into(),
                    clustering: rest[1].into(),
                    paper: paper(rest[2]).ok_or_else(|| wrong().expected("numbers of the paper, or -"))?,
                    label: rest[3].into(),
                };
                let table = self.tables.iter_mut().find(|t| t.name == name).ok_or_else(|| unknown("table", name))?;
                table.rows.push(row);
            }
            "expect" => {
                let number = |s: &str| s.parse::<f64>().map_err(|_| wrong().expected("numbers as bounds"));
                let (table, row, p, metric) = (name.into(), rest[0].into(), rest[1].into(), rest[2].into());
                self.expected.push(Expected { table, row, p, metric, low: number(rest[3])?, high: number(rest[4])? });
            }
            _ => {
                if keyword == "scene" {
                    self.scenes.push((name.into(), rest[0].into()));
                }
                if keyword == "features" {
                    if !self.options.contains_key(&format!("footprints {}", rest[0])) {
                        return Err(unknown("footprints", rest[0]));
                    }
                    self.footprints_of.insert(name.into(), rest[0].into());
                }
                let key = format!("{keyword} {name}").trim().to_string();
                if self.options.insert(key, rest[count - 1].into()).is_some() {
                    return Err(Error::new("defined twice").found(line));
                }
            }
        }
        Ok(())
    }

    /// The options of a line, by `keyword name`; empty where there are none.
    pub fn options_of(&self, keyword: &str, name: &str) -> &str {
        self.options.get(&format!("{keyword} {name}")).map_or("", |s| s)
    }

    /// All p of all tables, ascending.
    pub fn probabilities(&self) -> BTreeSet<&str> {
        self.tables.iter().flat_map(|t| t.p.iter().map(String::as_str)).collect()
    }
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

    const GOOD: &str = "# a plan\nscene table | --objects 9\nseeds | 0 1\ngeometry | --iterations 9\nmasks | --missing 0\n\
        footprints gated | --pixel-samples 16\nfeatures paper | gated | --preset paper\nclustering free | --cluster free\n\
        table t | 0 0.5 | paper.free | A title\nrow t | paper | free | 50.79 69.62 2.1 | full\nrow t | paper | free | - | ours\n\
        expect t | paper.free | 0.5 | instance_miou | 0.1 | 0.9\n";

    fn read(text: &str) -> Result<Plan> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.plan");
        std::fs::write(&path, text).unwrap();
        Plan::read(&path)
    }

    #[test]
    fn a_plan_reads() {
        let plan = read(GOOD).unwrap();
        assert_eq!(plan.seeds, [0, 1]);
        assert_eq!(
            (plan.options_of("features", "paper"), plan.options_of("scene", "table")),
            ("--preset paper", "--objects 9")
        );
        let row = &plan.tables[0].rows[0];
        assert_eq!(row.paper, Some(Paper { miou: 50.79, macc: 69.62, memory: Some(2.1) }));
        assert_eq!((row.id().as_str(), plan.tables[0].rows[1].paper), ("paper.free", None));
        assert_eq!(plan.expected[0].high, 0.9);
        assert_eq!(plan.probabilities().into_iter().collect::<Vec<_>>(), ["0", "0.5"]);
    }

    #[test]
    fn what_is_no_plan_is_said_with_its_line() {
        for (from, to, word) in [
            ("row t | paper", "row t | papers", "papers"),
            ("row t | paper", "row u | paper", "no such table"),
            ("| gated | --preset", "| gate | --preset", "no such footprints"),
            ("0 0.5 |", "0 1.5 |", "probabilities"),
            ("50.79 69.62 2.1", "50.79", "numbers of the paper"),
            ("scene table", "scenery table", "not a line of a plan"),
            ("scene table", "scene", "a name"),
            ("seeds | 0 1", "seeds | a", "seeds"),
            ("seeds | 0 1\n", "", "seeds"),
        ] {
            assert!(GOOD.contains(from), "{from}");
            let e = read(&GOOD.replace(from, to)).unwrap_err().to_string();
            assert!(e.contains(word) && e.contains("a.plan"), "{to}: {e}");
        }
        assert!(Plan::read(Path::new("/nowhere")).is_err());
    }
}
