//! The curve of a run as a picture: figures over the iterations, a panel each.

use serde_json::Value;
use std::fmt::Write;

const WIDTH: f64 = 640.0;
/// Height of one of the panels.
const PANEL: f64 = 200.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 24.0;
/// One figure of a curve: its key in the lines, its title, its colour.
pub type Panel = (&'static str, &'static str, &'static str);

/// An SVG of the lines of `<output>.curve.jsonl`. A line that is not JSON, or lacks a figure, has no point.
pub fn svg(lines: &[String], panels: &[Panel]) -> String {
    let values: Vec<Value> = lines.iter().filter_map(|l| serde_json::from_str(l).ok()).collect();
    let height = PANEL * panels.len() as f64;
    let mut s = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (i, &(key, title, color)) in panels.iter().enumerate() {
        let point = |v: &Value| Some((v["iteration"].as_f64()?, v[key].as_f64()?));
        let points: Vec<(f64, f64)> = values.iter().filter_map(point).collect();
        let _ = writeln!(s, "<g transform=\"translate(0 {})\">", PANEL * i as f64);
        panel(&mut s, title, color, &points);
        s += "</g>\n";
    }
    s + "</svg>\n"
}

fn panel(s: &mut String, title: &str, color: &str, points: &[(f64, f64)]) {
    let _ = writeln!(s, "<text x=\"{LEFT}\" y=\"18\" font-weight=\"bold\">{title}</text>");
    let range = |f: fn(&(f64, f64)) -> f64| {
        points.iter().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
    };
    let (last, (low, high)) = (range(|p| p.0).1, range(|p| p.1));
    if points.is_empty() {
        let _ = writeln!(s, "<text x=\"{LEFT}\" y=\"{}\" fill=\"gray\">none</text>", PANEL / 2.0);
        return;
    }
    let room = (0.05 * (high - low)).max(1e-6 * high.abs()).max(1e-12);
    let (y0, y1) = (low - room, high + room);
    let px = |x: f64| LEFT + x / last.max(1.0) * (WIDTH - LEFT - RIGHT);
    let py = |y: f64| PANEL - BOTTOM - (y - y0) / (y1 - y0) * (PANEL - TOP - BOTTOM);
    for step in 0..=4 {
        let share = f64::from(step) / 4.0;
        let (x, y) = (share * last, low + share * (high - low));
        let (at, right, floor) = (py(y), WIDTH - RIGHT, PANEL - 8.0);
        let _ = writeln!(
            s,
            "<line x1=\"{LEFT}\" x2=\"{right}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>\
             <text x=\"{:.1}\" y=\"{floor}\" text-anchor=\"middle\">{x:.0}</text>",
            LEFT - 6.0,
            at + 4.0,
            number(y),
            px(x)
        );
    }
    let line: Vec<String> = points.iter().map(|&(x, y)| format!("{:.1},{:.1}", px(x), py(y))).collect();
    let _ =
        writeln!(s, "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\" points=\"{}\"/>", line.join(" "));
    for &(x, y) in points.iter().filter(|_| points.len() <= 20) {
        let _ = writeln!(s, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.5\" fill=\"{color}\"/>", px(x), py(y));
    }
}

fn number(v: f64) -> String {
    match v.abs() {
        a if a >= 1000.0 => format!("{v:.0}"),
        a if a >= 10.0 => format!("{v:.2}"),
        _ => format!("{v:.4}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PANELS: [Panel; 3] = [("loss", "loss", "red"), ("psnr", "dB", "blue"), ("count", "count", "black")];

    #[test]
    fn every_figure_has_its_line() {
        let lines: Vec<String> = (1..=30)
            .map(|i| match i % 10 {
                0 => format!(r#"{{"iteration":{i},"loss":{},"count":7,"psnr":{}}}"#, 1.0 / f64::from(i), i),
                _ => format!(r#"{{"iteration":{i},"loss":{},"count":7}}"#, 1.0 / f64::from(i)),
            })
            .collect();
        let s = svg(&lines, &PANELS);
        assert_eq!((s.matches("<polyline").count(), s.matches("<circle").count()), (3, 3), "{s}");
        assert!(s.contains("dB") && !s.contains("NaN") && !s.contains("inf"));
        // The last point of the loss lies at the right edge, near the floor.
        let loss = s.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
        let (x, y) = loss.rsplit(' ').next().unwrap().split_once(',').unwrap();
        assert_eq!(x, "624.0");
        assert!(y.parse::<f64>().unwrap() > 160.0, "{y}");
    }

    #[test]
    fn nothing_to_draw_is_drawn_as_nothing() {
        let s = svg(&[r#"{"iteration":5,"loss":null,"count":3}"#.into(), "not json".into()], &PANELS);
        assert_eq!((s.matches(">none<").count(), s.matches("<polyline").count()), (2, 1));
        assert!(!s.contains("NaN") && s.ends_with("</svg>\n"));
        assert_eq!(svg(&[], &PANELS).matches(">none<").count(), 3);
    }
}
