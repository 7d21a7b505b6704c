//! Charts as SVG: lines, points, or both.

use crate::html::escape;
use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 240.0;
const LEFT: f64 = 60.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 40.0;
/// A chart shows no more points than it has pixels to tell apart.
const MAX_POINTS: usize = 400;
/// A line of at most this many points shows them as circles too.
const FEW_POINTS: usize = 20;
/// Colours of a chart outside of a page, which has a style sheet.
const STYLE: &str = ".title{font-weight:bold}.grid{stroke:#ddd}.curve{fill:none;stroke:currentColor;stroke-width:1.5}\
                     .point{fill:currentColor}";

/// A chart.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chart {
    /// What it shows.
    pub title: String,
    /// What the axes show; written below them.
    pub axes: String,
    /// Points (x, y) that a line joins, by rising x. A point that is not finite breaks the line.
    pub line: Vec<(f64, f64)>,
    /// Lines to compare with, dashed, with a name at the end of each.
    pub beside: Vec<(String, Vec<(f64, f64)>)>,
    /// Points that stand alone. Where there are any, both axes include 0.
    pub dots: Vec<Dot>,
}

/// A point of a scatter plot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Dot {
    /// Where it is.
    pub at: (f64, f64),
    /// Least and largest y, which a vertical line joins.
    pub range: (f64, f64),
    /// Whether the circle is filled.
    pub filled: bool,
    /// Text beside it.
    pub label: String,
}

/// From figures to pixels.
struct Frame {
    x: (f64, f64),
    y: (f64, f64),
}

impl Frame {
    fn px(&self, x: f64) -> f64 {
        LEFT + along(x, self.x) * (WIDTH - LEFT - RIGHT)
    }

    fn py(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - along(y, self.y) * (HEIGHT - TOP - BOTTOM)
    }
}

/// Where `v` lies in a range, 0 to 1.
fn along(v: f64, (low, high): (f64, f64)) -> f64 {
    if high > low { (v - low) / (high - low) } else { 0.5 }
}

impl Chart {
    /// The chart as an `<svg>` element of a page, whose style sheet has the colours.
    pub fn svg(&self) -> String {
        let title = escape(&self.title);
        let body = self.body();
        format!(r#"<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">{body}</svg>"#)
    }

    fn body(&self) -> String {
        let mut s = format!(r#"<text class="title" x="{LEFT}" y="16">{}</text>"#, escape(&self.title));
        let dots = self.dots.iter().flat_map(|d| [d.at, (d.at.0, d.range.0), (d.at.0, d.range.1), (0.0, 0.0)]);
        let lines = || self.line.iter().chain(self.beside.iter().flat_map(|b| &b.1)).copied();
        let all = || lines().chain(dots.clone()).filter(|(x, y)| x.is_finite() && y.is_finite());
        let range = |f: fn((f64, f64)) -> f64| {
            all().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
        };
        let (mut x, y) = (range(|p| p.0), range(|p| p.1));
        if all().next().is_none() {
            return s + &format!(r#"<text class="axis" x="{LEFT}" y="{}">none</text>"#, HEIGHT / 2.0);
        }
        let (x_ticks, y_ticks) = (nice_ticks(x.0, x.1, 4), nice_ticks(y.0, y.1, 4));
        if !self.dots.is_empty() {
            x = covering(x, &x_ticks);
        }
        let frame = Frame { x, y: covering(y, &y_ticks) };
        for &t in &y_ticks {
            let (y, x, right) = (frame.py(t), LEFT - 6.0, WIDTH - RIGHT);
            let _ = write!(s, r#"<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1}" y2="{y:.1}"/>"#);
            let _ =
                write!(s, r#"<text class="axis" text-anchor="end" x="{x}" y="{:.1}">{}</text>"#, y + 4.0, number(t));
        }
        for t in x_ticks.into_iter().filter(|t| (x.0..=x.1).contains(t)) {
            let (px, y) = (frame.px(t), HEIGHT - BOTTOM + 16.0);
            let _ = write!(s, r#"<text class="axis" text-anchor="middle" x="{px:.1}" y="{y}">{}</text>"#, number(t));
        }
        let (middle, y) = (0.5 * (LEFT + WIDTH - RIGHT), HEIGHT - 6.0);
        let axes = escape(&self.axes);
        let _ = write!(s, r#"<text class="axis" text-anchor="middle" x="{middle}" y="{y}">{axes}</text>"#);
        self.draw_line(&self.line, "", &frame, &mut s);
        for (name, line) in &self.beside {
            self.draw_line(line, r#" stroke-dasharray="5 3""#, &frame, &mut s);
            if let Some(&(x, y)) = line.iter().rfind(|(x, y)| x.is_finite() && y.is_finite()) {
                let (x, y) = (frame.px(x), frame.py(y) + 14.0);
                let name = escape(name);
                let _ = write!(s, r#"<text class="axis" text-anchor="end" x="{x:.1}" y="{y:.1}">{name}</text>"#);
            }
        }
        self.dots.iter().for_each(|d| d.draw(&frame, &mut s));
        s
    }

    fn draw_line(&self, line: &[(f64, f64)], style: &str, frame: &Frame, s: &mut String) {
        let points = thin(line);
        for piece in points.split(|(x, y)| !(x.is_finite() && y.is_finite())).filter(|p| !p.is_empty()) {
            let points: Vec<String> =
                piece.iter().map(|&(x, y)| format!("{:.1},{:.1}", frame.px(x), frame.py(y))).collect();
            let _ = write!(s, r#"<polyline class="curve"{style} points="{}"/>"#, points.join(" "));
            for &(x, y) in piece.iter().filter(|_| self.dots.is_empty() && line.len() <= FEW_POINTS) {
                let (x, y) = (frame.px(x), frame.py(y));
                let _ = write!(s, r#"<circle class="point" cx="{x:.1}" cy="{y:.1}" r="2.5"/>"#);
            }
        }
    }
}

impl Dot {
    fn draw(&self, frame: &Frame, s: &mut String) {
        let (x, y) = (frame.px(self.at.0), frame.py(self.at.1));
        let (low, high) = (frame.py(self.range.0), frame.py(self.range.1));
        let fill = if self.filled { "currentColor" } else { "none" };
        // A label that would cross the right border ends at its circle.
        let (anchor, at) = if x > WIDTH - RIGHT - 90.0 { ("end", x - 7.0) } else { ("start", x + 7.0) };
        let _ = write!(
            s,
            r#"<line stroke="currentColor" x1="{x:.1}" x2="{x:.1}" y1="{low:.1}" y2="{high:.1}"/><circle cx="{x:.1}" cy="{y:.1}" r="4" fill="{fill}" stroke="currentColor"/><text class="axis" text-anchor="{anchor}" x="{at:.1}" y="{:.1}">{}</text>"#,
            y - 4.0,
            escape(&self.label)
        );
    }
}

/// Charts below each other as an SVG file, each with the colour of its line.
pub fn file(charts: &[(Chart, &str)]) -> String {
    let height = HEIGHT * charts.len() as f64;
    let mut s = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <style>{STYLE}</style><rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (i, (chart, color)) in charts.iter().enumerate() {
        let _ = writeln!(s, r#"<g color="{color}" transform="translate(0 {})">"#, HEIGHT * i as f64);
        let _ = writeln!(s, "{}</g>", chart.body());
    }
    s + "</svg>\n"
}

fn covering((low, high): (f64, f64), ticks: &[f64]) -> (f64, f64) {
    (ticks.first().map_or(low, |t| t.min(low)), ticks.last().map_or(high, |t| t.max(high)))
}

/// At most [`MAX_POINTS`] points: means over runs of equal length.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let run = points.len().div_ceil(MAX_POINTS).max(1);
    let mean = |c: &[(f64, f64)], f: fn(&(f64, f64)) -> f64| c.iter().map(f).sum::<f64>() / c.len() as f64;
    points.chunks(run).map(|c| (mean(c, |p| p.0), mean(c, |p| p.1))).collect()
}

/// About `count` round numbers that cover `low` to `high`: steps of 1, 2 or 5 times a power of ten.
fn nice_ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    if high.is_nan() || low.is_nan() || high <= low {
        return vec![low];
    }
    let raw = (high - low) / count.max(1) as f64;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|&s| s >= raw * 0.999).unwrap_or(power * 10.0);
    let (first, last) = ((low / step + 1e-9).floor() as i64, (high / step - 1e-9).ceil() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

/// A number for people, of about four digits.
pub fn number(v: f64) -> String {
    if v == 0.0 {
        return "0".into();
    }
    let digits = v.abs().log10().floor();
    if digits >= 6.0 {
        format!("{}M", trim(format!("{:.2}", v / 1e6)))
    } else if digits >= 4.0 {
        format!("{}k", trim(format!("{:.1}", v / 1e3)))
    } else if digits < -4.0 {
        format!("{v:.1e}")
    } else {
        trim(format!("{v:.*}", (3.0 - digits).clamp(0.0, 6.0) as usize))
    }
}

fn trim(s: String) -> String {
    if s.contains('.') { s.trim_end_matches('0').trim_end_matches('.').to_string() } else { s }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(title: &str, line: Vec<(f64, f64)>) -> Chart {
        Chart { title: title.into(), line, ..Chart::default() }
    }

    #[test]
    fn ticks_are_round_and_cover() {
        assert_eq!(nice_ticks(0.0, 100.0, 4), [0.0, 50.0, 100.0]);
        assert_eq!(nice_ticks(0.0, 8.0, 4), [0.0, 2.0, 4.0, 6.0, 8.0]);
        assert_eq!(nice_ticks(3.0, 3.0, 4), [3.0]);
        let t = nice_ticks(21.3, 29.9, 4);
        assert!(t[0] <= 21.3 && *t.last().unwrap() >= 29.9 && t.len() <= 6, "{t:?}");
    }

    #[test]
    fn numbers_for_people() {
        for (v, s) in
            [(0.0, "0"), (0.25, "0.25"), (1234.0, "1234"), (12_000.0, "12k"), (2.5e6, "2.5M"), (1e-6, "1.0e-6")]
        {
            assert_eq!(number(v), s);
        }
    }

    #[test]
    fn a_line_spans_its_frame_and_survives_nan() {
        let s = line("loss <L1>", vec![(0.0, 1.0), (50.0, f64::NAN), (60.0, 2.0), (100.0, 3.0)]).svg();
        assert!(s.contains("loss &lt;L1&gt;") && !s.contains("NaN"));
        assert_eq!((s.matches("<polyline").count(), s.matches("<circle").count()), (2, 3));
        assert!(s.contains(&format!("{LEFT:.1},")) && s.contains(&format!("{:.1},{TOP:.1}", WIDTH - RIGHT)), "{s}");
        assert!(line("none", vec![(f64::NAN, 1.0)]).svg().contains(">none<"));
        let flat = line("flat", vec![(0.0, 2.0), (1.0, 2.0)]).svg();
        assert!(flat.contains("<polyline") && !flat.contains("NaN"));
    }

    #[test]
    fn lines_beside_it_share_the_frame_and_have_names() {
        let chart = Chart {
            beside: vec![("a<b".into(), vec![(0.0, 1.0), (4.0, 9.0), (5.0, f64::NAN)])],
            ..line("", vec![(0.0, 3.0), (2.0, 5.0)])
        };
        let s = chart.svg();
        assert_eq!((s.matches("<polyline").count(), s.matches("dasharray").count()), (2, 1));
        // The first line ends in the middle, the other at the right border.
        let middle = 0.5 * (LEFT + WIDTH - RIGHT);
        assert!(s.contains(&format!("{middle:.1},")) && s.contains("a&lt;b") && !s.contains("NaN"), "{s}");
    }

    #[test]
    fn long_lines_are_thinned_without_moving_their_mean() {
        let points: Vec<(f64, f64)> = (0..4000).map(|i| (f64::from(i), f64::from(i % 2))).collect();
        let t = thin(&points);
        assert_eq!(t.len(), 400);
        assert!(t.iter().all(|p| (p.1 - 0.5).abs() < 1e-12));
    }

    #[test]
    fn dots_stand_above_zero_with_their_range_and_label() {
        let dot = Dot { at: (2.0, 3.0), range: (2.0, 4.0), filled: true, label: "a<b".into() };
        let chart = Chart { axes: "error".into(), dots: vec![dot], ..Chart::default() };
        let s = chart.svg();
        assert!(s.contains("a&lt;b") && s.contains(">error<") && s.contains(">0<"));
        // The range ends at the top; the point lies a quarter below.
        let y = |v: f64| HEIGHT - BOTTOM - v / 4.0 * (HEIGHT - TOP - BOTTOM);
        assert!(s.contains(&format!(r#"y2="{TOP:.1}""#)) && s.contains(&format!(r#"cy="{:.1}""#, y(3.0))), "{s}");
        let file = file(&[(chart, "red"), (line("loss", vec![]), "blue")]);
        assert!(file.contains(r#"color="red""#) && file.contains(">none<") && file.ends_with("</svg>\n"));
    }
}
