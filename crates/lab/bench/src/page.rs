//! The measurements as tables and a page.

use crate::compare::Compared;
use crate::growth::Growth;
use crate::stress::Row;
use crate::tables::{self, Table};
use crate::tradeoff::{Curve, Measured};
use report::html::Page;
use report::plot::{Chart, Dot, number};
use report::sheet::markdown;
use serde::Serialize;
use std::fmt::Write;

fn with_spread([median, least, most]: [f64; 3]) -> String {
    format!("{median:.2} ({least:.2} to {most:.2})")
}

/// Head and rows of a knob's table.
fn curve_table(c: &Curve) -> (Vec<&'static str>, Vec<Vec<String>>) {
    let head = vec![
        "setting",
        "options",
        "CPU s",
        "wall s",
        "lost",
        "agreement",
        "instance mIoU, %",
        "query mIoU, %",
        "PSNR",
        "",
    ];
    let shown =
        |v: Option<f64>, scale: f64, digits: usize| v.map_or("–".into(), |v| format!("{:.digits$}", v * scale));
    let rows = c.points.iter().zip(&c.errors).zip(&c.front).map(|((p, error), &front)| {
        let roles = [(p.exact, "exact"), (p.default, "default"), (front, "front")];
        let q = &p.quality;
        vec![
            p.label.clone(),
            p.options.clone(),
            with_spread(p.cpu()),
            with_spread(p.wall()),
            format!("{error:.2}"),
            shown(q.agreement, 1.0, 3),
            shown(q.instance_miou, 100.0, 1),
            shown(q.query_miou, 100.0, 1),
            shown(q.psnr, 1.0, 2),
            roles.iter().filter(|(is, _)| *is).map(|(_, name)| *name).collect::<Vec<_>>().join(", "),
        ]
    });
    (head, rows.collect())
}

fn growth_table(all: &[Growth]) -> (Vec<&'static str>, Vec<Vec<String>>) {
    let head = vec!["along", "stage", "sizes", "Gaussians", "CPU s", "peak MB", "exponent of time", "of memory"];
    let list = |values: Vec<String>| values.join(" / ");
    let rows = all.iter().map(|g| {
        vec![
            g.title.clone(),
            g.stage.name().into(),
            list(g.sizes.iter().map(|s| number(*s)).collect()),
            list(g.gaussians.iter().map(u64::to_string).collect()),
            list(g.costs.iter().map(|c| format!("{:.2}", c.cpu)).collect()),
            list(g.costs.iter().map(|c| format!("{:.0}", c.peak as f64 / 1e6)).collect()),
            format!("{:.2}", g.time_exponent),
            format!("{:.2}", g.memory_exponent),
        ]
    });
    (head, rows.collect())
}

/// Head and rows of a comparison of builds.
pub fn compare_table(all: &[Compared]) -> (Vec<&'static str>, Vec<Vec<String>>) {
    let head = vec!["scene", "stage", "base, CPU s", "this, CPU s", "ratio", "memory", "same data"];
    let rows = all.iter().map(|c| {
        vec![
            c.scene.clone(),
            c.stage.name().into(),
            with_spread(c.base),
            with_spread(c.own),
            format!("{:.2}", c.ratio),
            format!("{:.2}", c.memory_ratio),
            if c.same_data { "yes" } else { "no" }.into(),
        ]
    });
    (head, rows.collect())
}

/// What is to be said of defaults that another setting beats.
pub fn warnings(curves: &[Curve]) -> Vec<String> {
    let beaten = curves.iter().filter_map(|c| Some((c, c.dominated_by.as_ref()?)));
    beaten.map(|(c, by)| format!("{} on {}: the default is dominated by \"{by}\"", c.title, c.scene)).collect()
}

/// Processor time over error, a circle for each setting with the range of its time; the front is joined by a line, the
/// default is filled.
fn scatter(curve: &Curve) -> String {
    let dot = |(p, &error): (&Measured, &f64)| {
        let [median, least, most] = p.cpu();
        Dot { at: (error, median), range: (least, most), filled: p.default, label: p.label.clone() }
    };
    let dots: Vec<Dot> = curve.points.iter().zip(&curve.errors).map(dot).collect();
    let mut line: Vec<(f64, f64)> = dots.iter().zip(&curve.front).filter(|(_, f)| **f).map(|(d, _)| d.at).collect();
    line.sort_by(|a, b| a.0.total_cmp(&b.0));
    let title = format!("{} ({})", curve.title, curve.scene);
    Chart { title, axes: format!("{}; upwards: CPU seconds", curve.measure), line, dots, ..Chart::default() }.svg()
}

/// What a plan gave.
#[derive(Debug, Default, Serialize)]
pub struct Results {
    /// Tables of scores.
    pub tables: Vec<Table>,
    /// Run time against error.
    pub curves: Vec<Curve>,
    /// Run time against size.
    pub growth: Vec<Growth>,
}

/// The page.
pub fn html(results: &Results, subtitle: &str) -> String {
    let mut page = Page::default();
    for table in &results.tables {
        page.section(&format!("table-{}", table.name), &table.title);
        for (title, head, rows) in tables::blocks(table) {
            page.heading(&title, "");
            let head: Vec<&str> = head.iter().map(String::as_str).collect();
            page.table(&head, &rows);
        }
        page.paragraph(&tables::remark(table));
    }
    if !results.curves.is_empty() {
        page.section("trade-offs", "Run time against error");
    }
    for warning in warnings(&results.curves) {
        page.note(&warning);
    }
    for c in &results.curves {
        page.heading(&c.title, &c.scene);
        page.charts(&[scatter(c)]);
        let (head, rows) = curve_table(c);
        page.table(&head, &rows);
    }
    if !results.growth.is_empty() {
        page.section("growth", "Growth");
        let (head, rows) = growth_table(&results.growth);
        page.table(&head, &rows);
    }
    page.finish("Experiments", subtitle)
}

/// The same as Markdown, without pictures.
pub fn text(results: &Results, subtitle: &str) -> String {
    let mut text = format!("# Experiments\n\n{subtitle}\n");
    for table in &results.tables {
        let _ = writeln!(text, "\n## {}\n\n{}", table.title, tables::text(table));
    }
    for warning in warnings(&results.curves) {
        let _ = writeln!(text, "* {warning}");
    }
    for c in &results.curves {
        let (head, rows) = curve_table(c);
        let _ = writeln!(text, "\n## {} ({})\n\nlost: {}\n\n{}", c.title, c.scene, c.measure, markdown(&head, &rows));
    }
    if !results.growth.is_empty() {
        let (head, rows) = growth_table(&results.growth);
        let _ = writeln!(text, "\n## Growth\n\n{}", markdown(&head, &rows));
    }
    text
}

/// The matrix of stress as Markdown and as a page.
pub fn stress(all: &[Row]) -> (String, String) {
    let head = ["scene", "stage", "error", "tolerance", "finite", "good", "what was asked, what was said"];
    let figure = |v: Option<f64>| v.map_or("–".into(), |v| if v == 0.0 { "0".into() } else { format!("{v:.1e}") });
    let yes = |is: bool| if is { "yes" } else { "NO" }.to_string();
    let rows: Vec<Vec<String>> = all
        .iter()
        .map(|r| {
            let (error, tolerance) = (figure(r.error), figure(r.tolerance));
            vec![r.scene.clone(), r.stage.clone(), error, tolerance, yes(!r.non_finite), yes(r.good), r.note.clone()]
        })
        .collect();
    let mut page = Page::default();
    page.section("stress", "Hostile scenes");
    page.table(&head, &rows);
    let good = all.iter().filter(|r| r.good).count();
    let subtitle = format!("{good} of {} cells are good", all.len());
    (
        format!("# Numerical stress\n\n{subtitle}\n\n{}", markdown(&head, &rows)),
        page.finish("Numerical stress", &subtitle),
    )
}
