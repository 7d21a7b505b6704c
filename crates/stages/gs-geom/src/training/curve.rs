//! The training curve as a picture: loss, held-out PSNR and number of Gaussians over the iterations.

use report::curve::Panel;

const PANELS: [Panel; 3] = [
    ("loss", "training loss", "#1f77b4"),
    ("psnr_heldout", "PSNR on held-out views, dB", "#2ca02c"),
    ("gaussians", "Gaussians", "#d62728"),
];

/// An SVG of the lines of `<output>.curve.jsonl`; see [`report::curve::svg`].
pub fn svg(lines: &[String]) -> String {
    report::curve::svg(lines, &PANELS)
}

#[cfg(test)]
mod tests {
    #[test]
    fn every_figure_has_its_panel() {
        let line = r#"{"iteration":9,"loss":0.5,"gaussians":7,"psnr_heldout":30}"#;
        assert_eq!(super::svg(&[line.into()]).matches("<polyline").count(), 3);
    }
}
