//! Line charts as inline SVG.

use std::fmt::Write;

/// A curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// What it shows; also the chart's title.
    pub name: String,
    /// Points (x, y), by rising x. Points that are not finite break the line.
    pub points: Vec<(f64, f64)>,
}

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 220.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 26.0;
/// A chart shows no more points than it has pixels to tell apart.
const MAX_POINTS: usize = 400;

/// A chart of one series with axes, grid and title; colours come from the page's style sheet (classes `grid`, `axis`,
/// `curve`). The empty string when the series has no finite point.
pub fn chart(series: &Series) -> String {
    let finite = || series.points.iter().filter(|(x, y)| x.is_finite() && y.is_finite());
    let range = |f: fn(&(f64, f64)) -> f64| {
        finite().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
    };
    let ((x0, x1), (low, high)) = (range(|p| p.0), range(|p| p.1));
    if !x0.is_finite() {
        return String::new();
    }
    let ticks = nice_ticks(low, high, 4);
    let y0 = ticks.first().map_or(low, |t| t.min(low));
    let y1 = ticks.last().map_or(high, |t| t.max(high));
    let along = |v: f64, lo: f64, hi: f64| if hi > lo { (v - lo) / (hi - lo) } else { 0.5 };
    let px = |x: f64| LEFT + along(x, x0, x1) * (WIDTH - LEFT - RIGHT);
    let py = |y: f64| HEIGHT - BOTTOM - along(y, y0, y1) * (HEIGHT - TOP - BOTTOM);
    let title = crate::html::escape(&series.name);
    let mut s = format!(r#"<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">"#);
    let _ = write!(s, r#"<text class="title" x="{LEFT}" y="16">{title}</text>"#);
    for &t in &ticks {
        let y = py(t);
        let _ = write!(s, r#"<line class="grid" x1="{LEFT}" x2="{:.1}" y1="{y:.1}" y2="{y:.1}"/>"#, WIDTH - RIGHT);
        let _ = write!(
            s,
            r#"<text class="axis" text-anchor="end" x="{}" y="{:.1}">{}</text>"#,
            LEFT - 6.0,
            y + 4.0,
            number(t)
        );
    }
    for t in nice_ticks(x0, x1, 4).into_iter().filter(|t| (x0..=x1).contains(t)) {
        let anchor = if px(t) > WIDTH - 40.0 { "end" } else { "middle" };
        let _ = write!(
            s,
            r#"<text class="axis" text-anchor="{anchor}" x="{:.1}" y="{}">{}</text>"#,
            px(t),
            HEIGHT - 8.0,
            number(t)
        );
    }
    for piece in thin(&series.points).split(|(x, y)| !(x.is_finite() && y.is_finite())) {
        if piece.is_empty() {
            continue;
        }
        let points: Vec<String> = piece.iter().map(|&(x, y)| format!("{:.1},{:.1}", px(x), py(y))).collect();
        let _ = write!(s, r#"<polyline class="curve" points="{}"/>"#, points.join(" "));
    }
    s + "</svg>"
}

/// At most [`MAX_POINTS`] points: means over runs of equal length.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let run = points.len().div_ceil(MAX_POINTS).max(1);
    let mean = |c: &[(f64, f64)], f: fn(&(f64, f64)) -> f64| c.iter().map(f).sum::<f64>() / c.len() as f64;
    points.chunks(run).map(|c| (mean(c, |p| p.0), mean(c, |p| p.1))).collect()
}

/// About `count` round numbers that cover `low` to `high`: steps of 1, 2 or 5 times a power of ten.
pub fn nice_ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    if high.is_nan() || low.is_nan() || high <= low {
        return vec![low];
    }
    let raw = (high - low) / count.max(1) as f64;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|&s| s >= raw * 0.999).unwrap_or(power * 10.0);
    let (first, last) = ((low / step + 1e-9).floor() as i64, (high / step - 1e-9).ceil() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

/// A number for people: no more digits than tell.
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
    fn a_chart_spans_its_frame_and_survives_nan() {
        let points = vec![(0.0, 1.0), (50.0, f64::NAN), (60.0, 2.0), (100.0, 3.0)];
        let s = chart(&Series { name: "loss <L1>".into(), points });
        assert!(s.contains("loss &lt;L1&gt;") && !s.contains("NaN"));
        assert_eq!(s.matches("<polyline").count(), 2);
        assert!(s.contains(&format!("{LEFT:.1},")) && s.contains(&format!("{:.1},{TOP:.1}", WIDTH - RIGHT)), "{s}");
        assert_eq!(chart(&Series { name: "none".into(), points: vec![(f64::NAN, 1.0)] }), "");
        let flat = chart(&Series { name: "flat".into(), points: vec![(0.0, 2.0), (1.0, 2.0)] });
        assert!(flat.contains("<polyline") && !flat.contains("NaN"));
    }

    #[test]
    fn long_curves_are_thinned_without_moving_their_mean() {
        let points: Vec<(f64, f64)> = (0..4000).map(|i| (f64::from(i), f64::from(i % 2))).collect();
        let t = thin(&points);
        assert_eq!(t.len(), 400);
        assert!(t.iter().all(|p| (p.1 - 0.5).abs() < 1e-12));
    }
}
