//! Time against error as inline SVG.

use crate::tradeoff::Curve;
use eval::html::escape;
use eval::svg::{nice_ticks, number};
use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 60.0;
const RIGHT: f64 = 90.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 34.0;

/// Processor time over error, a circle for each setting with the spread of its time; the front is joined by a line, the
/// default is filled.
pub fn scatter(curve: &Curve) -> String {
    let times: Vec<[f64; 3]> = curve.points.iter().map(crate::tradeoff::Measured::cpu).collect();
    let most = times.iter().map(|t| t[2]).fold(0.0, f64::max);
    let (low, high) = curve.errors.iter().fold((0.0f64, 0.0f64), |(l, h), &e| (l.min(e), h.max(e)));
    let ticks = nice_ticks(low, high.max(low + 0.1), 4);
    let (x0, x1) = (ticks[0].min(low), ticks[ticks.len() - 1].max(high));
    let times_at = nice_ticks(0.0, most.max(1e-3), 4);
    let y1 = times_at[times_at.len() - 1];
    let px = |e: f64| LEFT + (e - x0) / (x1 - x0).max(1e-12) * (WIDTH - LEFT - RIGHT);
    let py = |t: f64| HEIGHT - BOTTOM - t / y1 * (HEIGHT - TOP - BOTTOM);
    let title = escape(&format!("{} ({})", curve.title, curve.scene));
    let mut s = format!(r#"<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">"#);
    let _ = write!(s, r#"<text class="title" x="{LEFT}" y="16">{title}</text>"#);
    for &t in &times_at {
        let y = py(t);
        let _ = write!(
            s,
            r#"<line class="grid" x1="{LEFT}" x2="{:.1}" y1="{y:.1}" y2="{y:.1}"/><text class="axis" text-anchor="end" x="{}" y="{:.1}">{}</text>"#,
            WIDTH - RIGHT,
            LEFT - 6.0,
            y + 4.0,
            number(t)
        );
    }
    for &e in &ticks {
        let _ = write!(
            s,
            r#"<text class="axis" text-anchor="middle" x="{:.1}" y="{}">{}</text>"#,
            px(e),
            HEIGHT - 18.0,
            number(e)
        );
    }
    let _ = write!(
        s,
        r#"<text class="axis" text-anchor="middle" x="{:.1}" y="{}">{}; upwards: CPU seconds</text>"#,
        0.5 * (LEFT + WIDTH - RIGHT),
        HEIGHT - 4.0,
        escape(&curve.measure)
    );
    let mut front: Vec<usize> = (0..curve.points.len()).filter(|&i| curve.front[i]).collect();
    front.sort_by(|&a, &b| curve.errors[a].total_cmp(&curve.errors[b]));
    let line: Vec<String> =
        front.iter().map(|&i| format!("{:.1},{:.1}", px(curve.errors[i]), py(times[i][0]))).collect();
    let _ = write!(s, r#"<polyline class="curve" points="{}"/>"#, line.join(" "));
    for (i, p) in curve.points.iter().enumerate() {
        let (x, [median, least, most]) = (px(curve.errors[i]), times[i]);
        let fill = if p.default { "currentColor" } else { "none" };
        let _ = write!(
            s,
            r#"<line class="axis" stroke="currentColor" x1="{x:.1}" x2="{x:.1}" y1="{:.1}" y2="{:.1}"/><circle cx="{x:.1}" cy="{:.1}" r="4" fill="{fill}" stroke="currentColor"/><text class="axis" x="{:.1}" y="{:.1}">{}</text>"#,
            py(least),
            py(most),
            py(median),
            x + 7.0,
            py(median) - 4.0,
            escape(&p.label)
        );
    }
    s + "</svg>"
}
