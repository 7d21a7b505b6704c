//! Tables of an ablation, as JSON and as Markdown.

use super::interval::Interval;
use super::plan::{Plan, Row, TablePlan};
use super::run::{Cell, METRICS, Runs};
use gs_io::{Error, IoContext, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A row with what came of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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

impl Table {
    /// Reads the tables that `eval ablation` wrote into a folder, by name.
    ///
    /// # Errors
    /// When there is none, or one is damaged.
    pub fn read_all(folder: &Path) -> Result<Vec<Self>> {
        let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
            .at("list", folder)?
            .flatten()
            .map(|e| e.path())
            .filter(|p| {
                let name = p.to_string_lossy();
                name.ends_with(".json") && !name.ends_with(".run.json")
            })
            .collect();
        paths.sort();
        if paths.is_empty() {
            return Err(Error::new("no table of an ablation").file(folder).hint("make them with make ablation"));
        }
        let read = |path: &PathBuf| {
            let bytes = std::fs::read(path).at("read", path)?;
            serde_json::from_slice(&bytes)
                .map_err(|e| Error::new(format!("not a table of an ablation: {e}")).file(path))
        };
        paths.iter().map(read).collect()
    }
}

/// Reads all runs of a plan; with the tables come the scores that are not there.
///
/// # Errors
/// When a score is damaged, a mean is outside of what the plan expects, or there is no score at all.
pub fn results(runs: &Runs<'_>) -> Result<(Vec<Table>, Vec<PathBuf>)> {
    let (mut tables, mut missing, mut found) = (Vec::new(), Vec::new(), 0);
    for plan in &runs.plan.tables {
        let (table, lacking) = result(runs, plan)?;
        found += table.rows.iter().flat_map(|r| r.results.values()).count();
        tables.push(table);
        missing.extend(lacking);
    }
    if found == 0 {
        return Err(Error::new("no run of the plan").file(runs.folder).hint("run make ablation"));
    }
    missing.sort();
    missing.dedup();
    check(runs.plan, &tables)?;
    Ok((tables, missing))
}

fn result(runs: &Runs<'_>, table: &TablePlan) -> Result<(Table, Vec<PathBuf>)> {
    let mut missing = Vec::new();
    let mut rows: Vec<RowResult> = Vec::new();
    let mut cells: Vec<BTreeMap<&str, Vec<Cell>>> = Vec::new();
    for row in &table.rows {
        let mut by_p = BTreeMap::new();
        for p in &table.p {
            let (found, lacking) = runs.cells(row, p)?;
            missing.extend(lacking);
            by_p.insert(p.as_str(), found);
        }
        let all = || by_p.values().flatten();
        let mean = |values: &[f64]| Interval::of(values).map(|i| i.mean);
        let by_p_mean = |of: &dyn Fn(&Cell) -> Option<f64>| -> BTreeMap<String, f64> {
            let values = |cells: &[Cell]| cells.iter().filter_map(of).collect::<Vec<_>>();
            by_p.iter().filter_map(|(p, cells)| Some((p.to_string(), mean(&values(cells))?))).collect()
        };
        let footprints = runs.plan.footprints_of.get(&row.features).map_or("", |f| f);
        rows.push(RowResult {
            options: [("footprints", footprints), ("features", &row.features), ("clustering", &row.clustering)]
                .map(|(keyword, name)| runs.plan.options_of(keyword, name).to_string()),
            results: intervals(&by_p, |c, m| c.values[m]),
            differences: BTreeMap::new(),
            seconds: by_p_mean(&|c| c.seconds),
            alignment: by_p_mean(&|c| c.alignment),
            network_bytes_per_gaussian: mean(&all().filter_map(|c| Some(c.network?.1)).collect::<Vec<_>>()),
            row: row.clone(),
        });
        cells.push(by_p);
    }
    if let Some(reference) = &table.reference {
        let at = table.rows.iter().position(|r| r.id() == *reference).ok_or_else(|| {
            Error::new("no such row").field(format!("table {}", table.name)).found(reference).hint("mend the plan")
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
    let gone = missing.len();
    let table = Table {
        name: table.name.clone(),
        title: table.title.clone(),
        p: table.p.clone(),
        reference: table.reference.clone(),
        scenes: runs.plan.scenes.iter().map(|s| s.0.clone()).collect(),
        seeds: runs.plan.seeds.clone(),
        missing: gone,
        rows,
    };
    Ok((table, missing))
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
fn check(plan: &Plan, tables: &[Table]) -> Result<()> {
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
fn text(interval: Option<&Interval>, share: bool, signed: bool) -> String {
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

/// A table with a head and rows of text.
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
                let cells = table.p.iter().map(|p| text(r.results.get(p).and_then(|r| r.get(metric)), m.share, false));
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
        cells.extend(METRICS.iter().map(|m| text(results.and_then(|r| r.get(m.name)), m.share, false)));
        if table.reference.is_some() {
            let gains = r.differences.get(p);
            cells.extend(["instance_miou", "query_miou"].map(|m| text(gains.and_then(|g| g.get(m)), true, true)));
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
        "Mean ± 95% interval (Student's t) over {runs} scenes: {} with {} seed{} each.",
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
pub fn markdown(table: &Table) -> String {
    let mut s = String::new();
    for (title, head, rows) in blocks(table) {
        let _ = write!(s, "{title}:\n\n| {} |\n|{}\n", head.join(" | "), "---|".repeat(head.len()));
        for row in rows {
            let _ = writeln!(s, "| {} |", row.join(" | "));
        }
        s += "\n";
    }
    s + &remark(table) + "\n"
}

/// Replaces, in a document, what stands between `<!-- ablation NAME -->` and `<!-- end -->` by the table of that name. Gives
/// the names it found no table for.
///
/// # Errors
/// When a block has no end.
pub fn fill(document: &str, tables: &[Table]) -> Result<(String, Vec<String>)> {
    const BEGIN: &str = "<!-- ablation ";
    const END: &str = "<!-- end -->";
    let (mut out, mut unknown, mut rest) = (String::new(), Vec::new(), document);
    while let Some(at) = rest.find(BEGIN) {
        let (head, block) = rest.split_at(at);
        let name = block[BEGIN.len()..].split(" -->").next().unwrap_or_default();
        let Some(end) = block.find(END) else {
            return Err(Error::new("a block without end").field(name).expected(END));
        };
        out += head;
        match tables.iter().find(|t| t.name == name) {
            Some(table) => out += &format!("{BEGIN}{name} -->\n\n{}\n{END}", markdown(table)),
            None => {
                out += &block[..end + END.len()];
                unknown.push(name.to_string());
            }
        }
        rest = &block[end + END.len()..];
    }
    Ok((out + rest, unknown))
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
