//! The tables of a plan: mean and 95% interval of each row over scenes and seeds, the difference from a row of reference
//! cell by cell, and the paper's numbers beside them.

use crate::cells::{Cell, METRICS, read};
use crate::interval::Interval;
use crate::plan::{Plan, Row, TablePlan};
use gs_io::{Error, Result};
use report::sheet::markdown;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A row with what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RowResult {
    /// The row.
    #[serde(flatten)]
    pub row: Row,
    /// Options of graph-precompute, feat-train and cluster-match.
    pub options: [String; 3],
    /// By p, then by metric: mean and 95% interval over scenes and seeds.
    pub results: BTreeMap<String, BTreeMap<String, Interval>>,
    /// By p, then by metric: the same of the difference from the row of reference, cell by cell.
    pub differences: BTreeMap<String, BTreeMap<String, Interval>>,
    /// Mean processor seconds of feat-train and cluster-match by p, over the scenes whose records have them.
    pub seconds: BTreeMap<String, f64>,
    /// Mean cosine of a mask's Gaussians with its centroid at the end of training, by p.
    pub alignment: BTreeMap<String, f64>,
    /// Bytes of the graph network per Gaussian, where there is one.
    pub network_bytes_per_gaussian: Option<f64>,
}

/// A table with what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    /// Its name.
    pub name: String,
    /// Its title.
    pub title: String,
    /// Probabilities of other granularity.
    pub p: Vec<String>,
    /// Id of the row of reference.
    pub reference: Option<String>,
    /// Scenes.
    pub scenes: Vec<String>,
    /// Seeds of each.
    pub seeds: Vec<u64>,
    /// Runs that are planned but not there.
    pub missing: usize,
    /// Its rows.
    pub rows: Vec<RowResult>,
}

/// Reads all cells of a plan.
///
/// # Errors
/// When a score is damaged, or a reference is no row.
pub fn results(plan: &Plan, folder: &Path) -> Result<Vec<Table>> {
    plan.tables.iter().map(|table| result(plan, folder, table)).collect()
}

fn result(plan: &Plan, folder: &Path, table: &TablePlan) -> Result<Table> {
    let mut missing: Vec<PathBuf> = Vec::new();
    let mut rows: Vec<RowResult> = Vec::new();
    let mut cells: Vec<BTreeMap<&str, Vec<Cell>>> = Vec::new();
    for row in &table.rows {
        let mut by_p = BTreeMap::new();
        for p in &table.p {
            let (found, lacking) = read(plan, folder, row, p)?;
            missing.extend(lacking);
            by_p.insert(p.as_str(), found);
        }
        let all = || by_p.values().flatten();
        let mean = |values: &[f64]| Interval::of(values).map(|i| i.mean);
        let by_p_mean = |of: &dyn Fn(&Cell) -> Option<f64>| -> BTreeMap<String, f64> {
            let values = |cells: &[Cell]| cells.iter().filter_map(of).collect::<Vec<_>>();
            by_p.iter().filter_map(|(p, cells)| Some((p.to_string(), mean(&values(cells))?))).collect()
        };
        let footprints = plan.footprints_of.get(&row.features).map_or("", |f| f);
        rows.push(RowResult {
            options: [("footprints", footprints), ("features", &row.features), ("clustering", &row.clustering)]
                .map(|(keyword, name)| plan.options_of(keyword, name).to_string()),
            results: intervals(&by_p, |c, m| c.values[m]),
            differences: BTreeMap::new(),
            seconds: by_p_mean(&|c| c.seconds),
            alignment: by_p_mean(&|c| c.alignment),
            network_bytes_per_gaussian: mean(&all().filter_map(|c| c.network).collect::<Vec<_>>()),
            row: row.clone(),
        });
        cells.push(by_p);
    }
    if let Some(reference) = &table.reference {
        let at = table.rows.iter().position(|r| r.id() == *reference).ok_or_else(|| {
            Error::new("no such row").field(format!("table {}", table.name)).found(reference).hint("fix the plan")
        })?;
        let base = cells[at].clone();
        for (row, by_p) in rows.iter_mut().zip(&cells).enumerate().filter(|(i, _)| *i != at).map(|(_, r)| r) {
            let same = |p: &str, c: &Cell| base[p].iter().find(|b| b.scene == c.scene).cloned();
            row.differences = table
                .p
                .iter()
                .flat_map(|p| {
                    let paired: Vec<(Cell, Cell)> =
                        by_p[p.as_str()].iter().filter_map(|c| Some((c.clone(), same(p, c)?))).collect();
                    intervals(&BTreeMap::from([(p.as_str(), paired)]), |(c, b), m| Some(c.values[m]? - b.values[m]?))
                })
                .collect();
        }
    }
    Ok(Table {
        name: table.name.clone(),
        title: table.title.clone(),
        p: table.p.clone(),
        reference: table.reference.clone(),
        scenes: plan.scenes.iter().map(|s| s.name.clone()).collect(),
        seeds: plan.seeds.clone(),
        missing: missing.len(),
        rows,
    })
}

fn intervals<C>(
    by_p: &BTreeMap<&str, Vec<C>>,
    value: impl Fn(&C, usize) -> Option<f64>,
) -> BTreeMap<String, BTreeMap<String, Interval>> {
    let of = |cells: &[C]| -> BTreeMap<String, Interval> {
        let of_metric = |m: usize| Interval::of(&cells.iter().filter_map(|c| value(c, m)).collect::<Vec<_>>());
        (0..METRICS.len()).filter_map(|m| Some((METRICS[m].name.to_string(), of_metric(m)?))).collect()
    };
    by_p.iter().filter(|(_, cells)| !cells.is_empty()).map(|(p, cells)| (p.to_string(), of(cells))).collect()
}

/// Holds the means against what the plan expects.
///
/// # Errors
/// When one is outside of its range, or there is no such result.
pub fn check(plan: &Plan, tables: &[Table]) -> Result<()> {
    for e in &plan.expected {
        let what = || format!("{} of {} at p {} in table {}", e.metric, e.row, e.p, e.table);
        let row = tables.iter().filter(|t| t.name == e.table).flat_map(|t| &t.rows).find(|r| r.row.id() == e.row);
        let found = row.and_then(|r| r.results.get(&e.p)).and_then(|r| r.get(&e.metric));
        let found = found.ok_or_else(|| Error::new("expected, but there is no such result").field(what()))?;
        if !(e.low..=e.high).contains(&found.mean) {
            return Err(Error::new("the result is not what the plan expects")
                .field(what())
                .found(format!("{:.4}", found.mean))
                .expected(format!("{} to {}", e.low, e.high)));
        }
    }
    Ok(())
}

/// The p whose results are shown in full: one half, where it is among them.
fn shown_p(table: &Table) -> &str {
    table.p.iter().find(|p| *p == "0.5").unwrap_or(&table.p[0])
}

/// An interval as text: shares in percent.
fn shown(interval: Option<&Interval>, share: bool, signed: bool) -> String {
    let Some(i) = interval else { return "–".into() };
    let scale = if share { 100.0 } else { 1.0 };
    let places = if share { 1 } else { 2 };
    let mean = i.mean * scale;
    let mean = if signed { format!("{mean:+.places$}") } else { format!("{mean:.places$}") };
    match i.half {
        Some(half) => format!("{mean} ± {:.places$}", half * scale),
        None => mean,
    }
}

/// A table with a title, a head and rows.
pub type Block = (String, Vec<String>, Vec<Vec<String>>);

/// What a table shows: titles, heads and rows. First the two main metrics by p, then all metrics at one p.
pub fn blocks(table: &Table) -> Vec<Block> {
    let mut out = Vec::new();
    let paper = table.rows.iter().any(|r| r.row.paper.is_some());
    let papers = |r: &RowResult| r.row.paper.map_or("–".into(), |p| format!("{:.2} / {:.2}", p.miou, p.macc));
    if table.p.len() > 1 {
        for metric in ["instance_miou", "query_miou"] {
            let m = METRICS.iter().find(|m| m.name == metric).expect("a metric");
            let mut head = vec![String::new()];
            head.extend(table.p.iter().map(|p| format!("p = {p}")));
            let row = |r: &RowResult| {
                let cells = table.p.iter().map(|p| shown(r.results.get(p).and_then(|r| r.get(metric)), m.share, false));
                [r.row.label.clone()].into_iter().chain(cells).collect()
            };
            out.push((format!("{}, %", m.title), head, table.rows.iter().map(row).collect()));
        }
    }
    let p = shown_p(table);
    let memory = table.rows.iter().any(|r| r.row.paper.is_some_and(|p| p.memory.is_some()));
    let mut head = vec![String::new()];
    if paper {
        head.push("paper: mIoU / mAcc".into());
    }
    head.extend(METRICS.iter().map(|m| format!("{}{}", m.title, if m.share { ", %" } else { "" })));
    if table.reference.is_some() {
        head.extend(["gain, instance mIoU".into(), "gain, query mIoU".into()]);
    }
    let aligned = table.rows.iter().any(|r| !r.alignment.is_empty());
    if aligned {
        head.push("alignment".into());
    }
    head.push("seconds".into());
    if memory {
        head.extend(["network, MB per million Gaussians".into(), "paper, GB".into()]);
    }
    let row = |r: &RowResult| {
        let mut cells = vec![r.row.label.clone()];
        if paper {
            cells.push(papers(r));
        }
        let results = r.results.get(p);
        cells.extend(METRICS.iter().map(|m| shown(results.and_then(|r| r.get(m.name)), m.share, false)));
        if table.reference.is_some() {
            let gains = r.differences.get(p);
            cells.extend(["instance_miou", "query_miou"].map(|m| shown(gains.and_then(|g| g.get(m)), true, true)));
        }
        if aligned {
            cells.push(r.alignment.get(p).map_or("–".into(), |a| format!("{a:.2}")));
        }
        cells.push(r.seconds.get(p).map_or("–".into(), |s| format!("{s:.1}")));
        if memory {
            cells.push(r.network_bytes_per_gaussian.map_or("–".into(), |b| format!("{b:.0}")));
            cells.push(r.row.paper.and_then(|p| p.memory).map_or("–".into(), |m| m.to_string()));
        }
        cells
    };
    out.push((format!("All metrics at p = {p}"), head, table.rows.iter().map(row).collect()));
    out
}

/// What stands under a table: over what the means are, and what is missing.
pub fn remark(table: &Table) -> String {
    let runs = table.scenes.len() * table.seeds.len();
    let mut s = format!(
        "Mean ± 95% interval (Student's t) over {runs} runs: scenes {}, {} seed{} each.",
        table.scenes.join(", "),
        table.seeds.len(),
        if table.seeds.len() == 1 { "" } else { "s" },
    );
    if let Some(r) = &table.reference {
        let label = table.rows.iter().find(|row| row.row.id() == *r).map_or(r.as_str(), |row| &row.row.label);
        let _ = write!(s, " Gains are differences from \"{label}\" scene by scene, in points.");
    }
    if table.missing > 0 {
        let _ = write!(s, " {} runs are missing.", table.missing);
    }
    s
}

/// The table in Markdown.
pub fn text(table: &Table) -> String {
    let blocks = blocks(table).into_iter().map(|(title, head, rows)| {
        let head: Vec<&str> = head.iter().map(String::as_str).collect();
        format!("{title}:\n\n{}\n", markdown(&head, &rows))
    });
    blocks.collect::<String>() + &remark(table) + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAN: &str = "scene a | |\nscene b | |\nseeds | 0 1\nfootprints gated | --gate 0.7\nfeatures paper | gated | --preset paper\n\
        features ours | gated | --method spectral\nclustering free | --cluster free\ntable t | 0 0.5 | paper.free | A table\n\
        row t | paper | free | 50.79 69.62 2.1 | full\nrow t | ours | free | - | ours\n";

    /// A folder with a plan and scores; instance mIoU is 0.1 to 0.4 for the paper's row, and 0.3 more for ours.
    fn runs(expect: &str) -> (tempfile::TempDir, Plan) {
        let dir = tempfile::tempdir().unwrap();
        for (i, cell) in ["a-0", "a-1", "b-0", "b-1"].iter().enumerate() {
            for p in ["p0", "p0.5"] {
                let folder = dir.path().join(cell).join(p);
                std::fs::create_dir_all(&folder).unwrap();
                for (row, more) in [("paper", 0.0), ("ours", 0.3)] {
                    let miou = 0.1 * (i + 1) as f64 + more;
                    let scores =
                        format!("{{\"instance_miou\": {miou}, \"instances_per_thing\": 2, \"gaussians\": null}}");
                    std::fs::write(folder.join(format!("{row}.free.score.json")), scores).unwrap();
                }
            }
        }
        (dir, Plan::parse(&format!("{PLAN}{expect}")).unwrap())
    }

    fn read(dir: &tempfile::TempDir, plan: &Plan) -> Result<Vec<Table>> {
        let tables = results(plan, dir.path())?;
        check(plan, &tables)?;
        Ok(tables)
    }

    #[test]
    fn rows_have_means_intervals_and_paired_gains() {
        let (dir, plan) = runs("expect t | ours.free | 0.5 | instance_miou | 0.5 | 0.6\n");
        let tables = read(&dir, &plan).unwrap();
        assert_eq!(tables[0].missing, 0);
        let rows = &tables[0].rows;
        let miou = rows[0].results["0.5"]["instance_miou"];
        // Values 0.1, 0.2, 0.3, 0.4: deviation sqrt(0.05 / 3), over sqrt(4), times t of 3.
        assert!((miou.mean - 0.25).abs() < 1e-12 && miou.n == 4);
        assert!((miou.half.unwrap() - 3.1824 * (0.05f64 / 3.0).sqrt() / 2.0).abs() < 1e-9);
        let gain = rows[1].differences["0.5"]["instance_miou"];
        assert!((gain.mean - 0.3).abs() < 1e-12 && gain.half.unwrap() < 1e-9, "the same in every scene: {gain:?}");
        assert!(rows[0].differences.is_empty() && !rows[0].results["0"].contains_key("query_miou"));
        assert_eq!(rows[1].options, ["--gate 0.7", "--method spectral", "--cluster free"]);
        let md = text(&tables[0]);
        assert!(md.contains("| full | 50.79 / 69.62 | 25.0 ± 20.5 |") && md.contains("| +30.0 ± 0.0 |"), "{md}");
        assert!(md.contains("| ours | 55.0 ± 20.5 | 55.0 ± 20.5 |"), "by p: {md}");
    }

    #[test]
    fn what_is_missing_is_counted_and_what_is_not_expected_is_refused() {
        let (dir, plan) = runs("");
        std::fs::remove_file(dir.path().join("b-1/p0.5/ours.free.score.json")).unwrap();
        let tables = read(&dir, &plan).unwrap();
        assert_eq!(tables[0].missing, 1);
        let (result, gain) = (&tables[0].rows[1].results["0.5"], &tables[0].rows[1].differences["0.5"]);
        assert_eq!((result["instance_miou"].n, gain["instance_miou"].n), (3, 3));
        assert!((gain["instance_miou"].mean - 0.3).abs() < 1e-12, "pairs only");
        assert!(text(&tables[0]).contains("1 runs are missing"));

        for (expect, word) in [
            ("expect t | ours.free | 0.5 | instance_miou | 0.6 | 0.9\n", "found 0.5500, expected 0.6 to 0.9"),
            ("expect t | ours.free | 0.5 | query_miou | 0 | 1\n", "no such result"),
            ("expect t | other.free | 0.5 | instance_miou | 0 | 1\n", "no such result"),
        ] {
            let (dir, plan) = runs(expect);
            let e = read(&dir, &plan).unwrap_err().to_string();
            assert!(e.contains(word), "{e}");
        }
        std::fs::write(dir.path().join("a-0/p0/ours.free.score.json"), "{").unwrap();
        assert!(read(&dir, &plan).unwrap_err().to_string().contains("ours.free.score.json"));
    }
}
