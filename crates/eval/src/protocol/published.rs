//! Published numbers, and tables in the layout of the CAGS paper with ours below them.

use super::lerf::{Figures, dataset_figures};
use super::lerf_scenes;
use std::fmt::Write;

/// mIoU and mAcc@0.25 in percent of a method on LERF-OVS: waldo_kitchen, ramen, figurines, teatime, mean.
struct LerfRow {
    method: &'static str,
    source: &'static str,
    miou: [Option<f64>; 5],
    macc25: [Option<f64>; 5],
}

const fn all(v: [f64; 5]) -> [Option<f64>; 5] {
    [Some(v[0]), Some(v[1]), Some(v[2]), Some(v[3]), Some(v[4])]
}

const fn mean_only(v: f64) -> [Option<f64>; 5] {
    [None, None, None, None, Some(v)]
}

/// Rows under the same rule: selected-only rendering, (frame, category) pairs, mean over scenes.
const LERF: [LerfRow; 9] = [
    LerfRow {
        method: "LangSplat",
        source: "CAGS paper",
        miou: all([9.18, 7.92, 10.16, 11.38, 9.66]),
        macc25: all([9.09, 11.27, 8.93, 20.34, 12.41]),
    },
    LerfRow { method: "LEGaussians", source: "OpenGaussian paper", miou: mean_only(16.21), macc25: mean_only(23.82) },
    LerfRow {
        method: "OpenGaussian",
        source: "CAGS paper",
        miou: all([22.70, 31.01, 39.29, 60.44, 38.36]),
        macc25: all([31.82, 42.25, 55.36, 76.27, 51.43]),
    },
    LerfRow {
        method: "Dr. Splat",
        source: "CAGS paper",
        miou: all([37.05, 24.33, 54.42, 57.35, 43.29]),
        macc25: all([63.64, 35.21, 80.36, 77.97, 64.30]),
    },
    LerfRow { method: "InstanceGaussian", source: "COS3D paper", miou: mean_only(45.30), macc25: mean_only(58.44) },
    LerfRow { method: "COS3D", source: "its paper", miou: mean_only(50.76), macc25: mean_only(72.08) },
    LerfRow {
        method: "CAGS",
        source: "its paper",
        miou: all([37.62, 36.29, 60.85, 68.40, 50.79]),
        macc25: all([63.64, 46.48, 82.14, 86.44, 69.62]),
    },
    LerfRow { method: "OpenGaFF", source: "arXiv 2605.06088", miou: mean_only(54.36), macc25: mean_only(80.84) },
    LerfRow {
        method: "VALA",
        source: "arXiv 2509.05515v2",
        miou: all([55.71, 45.41, 60.38, 70.61, 58.02]),
        macc25: all([86.36, 67.61, 89.29, 88.14, 82.85]),
    },
];

fn percent(v: Option<f64>) -> String {
    v.map_or("–".into(), |v| format!("{v:.2}"))
}

/// The paper's LERF-OVS table as Markdown: published rows, then ours. `scenes` are the figures of the scenes scored, by
/// name; scenes of other names than the four get a column of their own. The mean is over the scenes scored, and stands
/// beside the published means only when all four are.
pub fn lerf_table(scenes: &[(String, Figures)], notes: &[String]) -> String {
    let standard: Vec<&str> = lerf_scenes::SCENES.iter().map(|s| s.name).collect();
    let of = |name: &str| scenes.iter().find(|s| s.0 == name).map(|s| s.1);
    let others: Vec<&(String, Figures)> = scenes.iter().filter(|s| !standard.contains(&s.0.as_str())).collect();
    let ours = dataset_figures(&scenes.iter().map(|s| s.1).collect::<Vec<_>>());
    let mut header = vec!["Methods".to_string()];
    for metric in ["mIoU", "mAcc@0.25"] {
        header.extend(standard.iter().map(|s| format!("{metric} {s}")));
        header.extend(others.iter().map(|s| format!("{metric} {}", s.0)));
        header.push(format!("{metric} Mean"));
    }
    header.push("source".into());
    let mut out = line(&header) + &line(&vec!["---".into(); header.len()]);
    for row in &LERF {
        let mut cells = vec![row.method.to_string()];
        for values in [row.miou, row.macc25] {
            cells.extend(values[..4].iter().map(|&v| percent(v)));
            cells.extend(others.iter().map(|_| percent(None)));
            cells.push(percent(values[4]));
        }
        cells.push(row.source.into());
        out += &line(&cells);
    }
    let mut cells = vec!["**ours**".to_string()];
    for metric in [|f: &Figures| f.miou, |f: &Figures| f.macc25] {
        cells.extend(standard.iter().map(|s| percent(of(s).map(|f| 100.0 * metric(&f)))));
        cells.extend(others.iter().map(|s| percent(Some(100.0 * metric(&s.1)))));
        cells.push(percent((!scenes.is_empty()).then(|| 100.0 * metric(&ours))));
    }
    cells.push("measured".into());
    out += &line(&cells);
    let _ = writeln!(out, "\nOurs also: mAcc@0.5 {:.2}, {} (frame, category) pairs.", 100.0 * ours.macc50, ours.pairs);
    if let Some(l) = ours.localisation {
        let _ = writeln!(out, "Localisation accuracy {:.2}.", 100.0 * l);
    }
    if !standard.iter().all(|s| of(s).is_some()) {
        out += "Our mean is over the scenes scored here, not over the four of the published means: do not compare it with them.\n";
    }
    out + &noted(notes)
}

/// mIoU and mAcc of the sets of 19, 15 and 10 classes; none where a set was not scored.
pub type SetRow = [Option<(f64, f64)>; 3];

/// mIoU and mAcc in percent of a method on ScanNet (frozen points, 10 scenes): 19, 15 and 10 classes.
const SCANNET: [(&str, SetRow, &str); 8] = [
    ("LangSplat", [Some((2.0, 9.2)), Some((4.9, 14.6)), Some((8.0, 23.9))], "CAGS paper"),
    ("LEGaussians", [Some((1.6, 7.9)), Some((4.6, 16.1)), Some((7.7, 24.9))], "CAGS paper"),
    ("OpenGaussian", [Some((24.73, 41.54)), Some((30.13, 48.25)), Some((38.29, 55.19))], "its paper"),
    ("OpenGaussian", [Some((30.1, 46.5)), Some((38.1, 56.8)), Some((49.7, 71.4))], "CAGS paper"),
    ("Dr. Splat", [Some((28.0, 44.6)), Some((38.2, 60.4)), Some((47.2, 68.9))], "CAGS paper"),
    ("THGS", [Some((34.39, 50.74)), Some((39.61, 57.07)), Some((46.38, 64.74))], "source not recorded"),
    ("NormLift", [Some((35.77, 54.02)), Some((39.62, 59.26)), Some((48.93, 68.83))], "arXiv 2609.18898"),
    ("CAGS", [Some((32.6, 48.9)), Some((41.1, 62.0)), Some((54.8, 75.9))], "its paper"),
];

/// The paper's ScanNet table as Markdown: published rows, then ours (mIoU and mAcc as fractions, for 19, 15 and 10
/// classes; none where a set was not scored), each under its name.
pub fn scannet_table(ours: &[(String, SetRow)], scenes: usize, notes: &[String]) -> String {
    let header =
        ["Methods", "19 mIoU", "19 mAcc", "15 mIoU", "15 mAcc", "10 mIoU", "10 mAcc", "source"].map(String::from);
    let mut out = line(&header) + &line(&["---"; 8].map(String::from));
    let mut row = |name: &str, values: SetRow, source: &str| {
        let mut cells = vec![name.to_string()];
        cells.extend(values.iter().flat_map(|v| [percent(v.map(|v| v.0)), percent(v.map(|v| v.1))]));
        cells.push(source.into());
        out += &line(&cells);
    };
    for (name, values, source) in SCANNET {
        row(name, values, source);
    }
    for (name, values) in ours {
        row(&format!("**{name}**"), values.map(|v| v.map(|v| (100.0 * v.0, 100.0 * v.1))), "measured");
    }
    if scenes != super::scannet::SCENES.len() {
        let _ = writeln!(
            out,
            "\nOurs: {scenes} scene(s), not the 10 of the published rows: do not compare the means with them."
        );
    }
    out + &noted(notes)
}

/// A row of a Markdown table.
pub fn line(cells: &[String]) -> String {
    format!("| {} |\n", cells.iter().map(|c| c.replace('|', "\\|")).collect::<Vec<_>>().join(" | "))
}

fn noted(notes: &[String]) -> String {
    let mut out = String::from("\n");
    notes.iter().for_each(|n| out += &format!("- {n}\n"));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_their_scenes() {
        for row in LERF.iter().filter(|r| r.miou[0].is_some()) {
            for values in [row.miou, row.macc25] {
                // The paper prints 69.62 as its own mean accuracy; its four scenes make 69.675.
                let slack = if row.method == "CAGS" { 0.06 } else { 0.011 };
                let mean = values[..4].iter().flatten().sum::<f64>() / 4.0;
                assert!((mean - values[4].unwrap()).abs() < slack, "{} {mean}", row.method);
            }
        }
    }

    #[test]
    fn tables_have_as_many_cells_in_every_row() {
        let f = Figures { miou: 0.5079, macc25: 0.6962, macc50: 0.4, localisation: Some(0.5), pairs: 59 };
        for scenes in [vec![("teatime".to_string(), f)], vec![("my|room".into(), f), ("ramen".into(), f)]] {
            let t = lerf_table(&scenes, &["a note".into()]);
            let rows: Vec<usize> =
                t.lines().filter(|l| l.starts_with('|')).map(|l| l.replace("\\|", "").matches('|').count()).collect();
            assert!(rows.len() == LERF.len() + 3 && rows.iter().all(|&n| n == rows[0]), "{t}");
            assert!(t.contains("50.79") && t.contains("do not compare") && t.contains("- a note"));
        }
        let t = scannet_table(&[("ours".into(), [Some((0.326, 0.489)), None, None])], 10, &[]);
        assert!(t.contains("| **ours** | 32.60 | 48.90 | – | – | – | – | measured |"), "{t}");
        assert!(!t.contains("do not compare"));
    }
}
