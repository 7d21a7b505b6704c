//! The tables of a plan: mean and 95% interval of each row over scenes and seeds, the difference from a row of reference
//! cell by cell, and the paper's numbers beside them.

use crate::cells::{Cell, METRICS, read};
use crate::interval::Interval;
use crate::plan::{NAMED_MASKS, Plan, Row, TablePlan};
use gs_io::{Error, Result};
use report::sheet::markdown;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RowResult {
    #[serde(flatten)]
    pub row: Row,
    /// Options of graph-precompute, feat-train and cluster-match.
    pub options: [String; 3],
    /// By p, then by metric: mean and 95% interval over scenes and seeds.
    pub results: BTreeMap<String, BTreeMap<String, Interval>>,
    /// By p, then by metric: the same of the difference from the row of reference, cell by cell.
    pub differences: BTreeMap<String, BTreeMap<String, Interval>>,
    /// Mean processor seconds of features and clustering by p, over the scenes whose records have them.
    pub seconds: BTreeMap<String, f64>,
    /// Most memory that either takes in any scene, in bytes, by p.
    pub peak_rss_bytes: BTreeMap<String, u64>,
    /// Mean cosine of a mask's Gaussians with its centroid at the end of training, by p.
    pub alignment: BTreeMap<String, f64>,
    /// Bytes of the graph network per Gaussian, where there is one.
    pub network_bytes_per_gaussian: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    pub name: String,
    pub title: String,
    pub p: Vec<String>,
    /// Id of the row of reference.
    pub reference: Option<String>,
    pub scenes: Vec<String>,
    pub seeds: Vec<u64>,
    pub rows: Vec<RowResult>,
}

/// Reads all cells of a plan.
pub fn results(plan: &Plan, folder: &Path) -> Result<Vec<Table>> {
    plan.tables.iter().map(|table| result(plan, folder, table)).collect()
}

fn result(plan: &Plan, folder: &Path, table: &TablePlan) -> Result<Table> {
    let mut rows: Vec<RowResult> = Vec::new();
    let mut cells: Vec<BTreeMap<&str, Vec<Cell>>> = Vec::new();
    for row in &table.rows {
        let by_p = table.p.iter().map(|p| Ok((p.as_str(), read(plan, folder, row, p)?)));
        let by_p = by_p.collect::<Result<BTreeMap<&str, Vec<Cell>>>>()?;
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
            peak_rss_bytes: by_p
                .iter()
                .filter_map(|(p, cells)| Some((p.to_string(), cells.iter().filter_map(|c| c.peak).max()?)))
                .collect(),
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
        let base = &cells[at];
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

/// The main metrics.
const GAINS: [&str; 2] = ["instance_miou", "query_miou"];

/// Masks as a table names them.
fn masks_of(p: &str) -> String {
    if NAMED_MASKS.contains(&p) { format!("masks {p}") } else { format!("p = {p}") }
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

/// Title, head and rows.
type Block = (String, Vec<String>, Vec<Vec<String>>);

/// The two main metrics by p, then all metrics at one p.
pub fn blocks(table: &Table) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut block = |title: String, head: &[String], row: &dyn Fn(&RowResult) -> Vec<String>| {
        blocks.push((title, head.to_vec(), table.rows.iter().map(row).collect()));
    };
    if table.p.len() > 1 {
        let head: Vec<String> = [String::new()].into_iter().chain(table.p.iter().map(|p| masks_of(p))).collect();
        for m in METRICS.iter().filter(|m| GAINS.contains(&m.name)) {
            block(format!("{}, %", m.title), &head, &|r| {
                let cells = table.p.iter().map(|p| shown(r.results.get(p).and_then(|r| r.get(m.name)), m.share, false));
                [r.row.label.clone()].into_iter().chain(cells).collect()
            });
        }
    }
    // One half, where it is among them.
    let p = table.p.iter().find(|p| *p == "0.5").unwrap_or(&table.p[0]);
    let figure = |v: Option<f64>, places: usize| v.map_or("–".into(), |v| format!("{v:.places$}"));
    let paper = |r: &RowResult| r.row.paper.map_or("–".into(), |p| format!("{:.2} / {:.2}", p.miou, p.macc));
    let printed = |r: &RowResult| r.row.paper.and_then(|p| p.memory).map_or("–".into(), |m| m.to_string());
    type Column<'a> = (String, Box<dyn Fn(&RowResult) -> String + 'a>);
    let mut columns: Vec<Column<'_>> = vec![(String::new(), Box::new(|r| r.row.label.clone()))];
    if table.rows.iter().any(|r| r.row.paper.is_some()) {
        columns.push(("paper: mIoU / mAcc".into(), Box::new(paper)));
    }
    for m in &METRICS {
        let head = format!("{}{}", m.title, if m.share { ", %" } else { "" });
        let cell = |r: &RowResult| shown(r.results.get(p).and_then(|r| r.get(m.name)), m.share, false);
        columns.push((head, Box::new(cell)));
    }
    for (m, title) in GAINS.into_iter().zip(["instance", "query"]).filter(|_| table.reference.is_some()) {
        let cell = move |r: &RowResult| shown(r.differences.get(p).and_then(|g| g.get(m)), true, true);
        columns.push((format!("gain, {title} mIoU"), Box::new(cell)));
    }
    if table.rows.iter().any(|r| !r.alignment.is_empty()) {
        columns.push(("alignment".into(), Box::new(|r| figure(r.alignment.get(p).copied(), 2))));
    }
    columns.push(("seconds".into(), Box::new(|r| figure(r.seconds.get(p).copied(), 1))));
    let megabytes = |r: &RowResult| figure(r.peak_rss_bytes.get(p).map(|&bytes| bytes as f64 / 1e6), 0);
    columns.push(("peak MB".into(), Box::new(megabytes)));
    if table.rows.iter().any(|r| r.row.paper.is_some_and(|p| p.memory.is_some())) {
        let network = |r: &RowResult| figure(r.network_bytes_per_gaussian, 0);
        columns.push(("network, MB per million Gaussians".into(), Box::new(network)));
        columns.push(("paper, GB".into(), Box::new(printed)));
    }
    let head: Vec<String> = columns.iter().map(|c| c.0.clone()).collect();
    block(format!("All metrics at {}", masks_of(p)), &head, &|r| columns.iter().map(|c| c.1(r)).collect());
    blocks
}

/// Over what the means of a table are.
pub fn remark(table: &Table) -> String {
    let runs = table.scenes.len() * table.seeds.len();
    let mut out = format!(
        "Mean ± 95% interval (Student's t) over {runs} runs: scenes {}, {} seed{} each.",
        table.scenes.join(", "),
        table.seeds.len(),
        if table.seeds.len() == 1 { "" } else { "s" },
    );
    if let Some(r) = &table.reference {
        let label = table.rows.iter().find(|row| row.row.id() == *r).map_or(r.as_str(), |row| &row.row.label);
        let _ = write!(out, " Gains are differences from \"{label}\" scene by scene, in points.");
    }
    out
}

/// The table in Markdown.
pub fn text(table: &Table) -> String {
    let block = |(title, head, rows): Block| {
        let head: Vec<&str> = head.iter().map(String::as_str).collect();
        format!("{title}:\n\n{}\n", markdown(&head, &rows))
    };
    blocks(table).into_iter().map(block).collect::<String>() + &remark(table) + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAN: &str = "scene a | |\nscene b | |\nseeds | tuning | 0 1\nfootprints gated | --gate 0.7\nfeatures paper | gated | --preset paper\n\
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
    fn what_is_not_expected_is_refused() {
        for (expect, word) in [
            ("expect t | ours.free | 0.5 | instance_miou | 0.6 | 0.9\n", "found 0.5500, expected 0.6 to 0.9"),
            ("expect t | ours.free | 0.5 | query_miou | 0 | 1\n", "no such result"),
            ("expect t | other.free | 0.5 | instance_miou | 0 | 1\n", "no such result"),
        ] {
            let (dir, plan) = runs(expect);
            let e = read(&dir, &plan).unwrap_err().to_string();
            assert!(e.contains(word), "{e}");
        }
        let (dir, plan) = runs("");
        std::fs::write(dir.path().join("a-0/p0/ours.free.score.json"), "{").unwrap();
        assert!(read(&dir, &plan).unwrap_err().to_string().contains("ours.free.score.json"));
    }
}
