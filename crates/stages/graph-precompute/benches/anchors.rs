//! Where the sampling puts the anchors of real splats: `cargo bench -p graph-precompute --bench anchors -- SPLAT.ply...`.
//! A folder after a PLY is the scene it is of, and the next folder its id maps: then Gaussians that no view sees can be
//! left out, as graph-precompute does. Prints a Markdown table.

use artifacts::ScratchEntries;
use graph_precompute::graph::{GraphOptions, Space, anchor_graph};
use graph_precompute::positions::shifted;
use graph_precompute::precompute::{Options, precompute};
use gs_scene::Geometry;
use gs_scene::dataset::{self, LoadOptions, Resolution, Split, View};
use std::path::{Path, PathBuf};

/// Sampling: its name, in which space, and whether unseen Gaussians take part.
const SAMPLINGS: [(&str, Space, bool); 4] = [
    ("plain, over everything", Space::World, true),
    ("plain, over what is seen", Space::World, false),
    ("contracted, over everything", Space::Contracted, true),
    ("contracted, over what is seen", Space::Contracted, false),
];

/// The Gaussians that some view of the scene sees.
fn seen(geometry: &Geometry, scene: &Path, masks: &Path) -> Vec<[f32; 3]> {
    let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };
    let dataset = dataset::load(scene, &load).expect("a scene");
    let views: Vec<&View> = dataset.views.iter().filter(|v| v.split == Split::Train).collect();
    let stage = stage::Stage::silent("bench");
    let mut entries = ScratchEntries::beside(&std::env::temp_dir().join("footprints")).expect("room for footprints");
    let (_, graph, _) =
        precompute(geometry, &views, masks, &Options::default(), &stage, &mut entries).expect("footprints");
    graph.kept.iter().map(|&i| geometry.gaussians.means[i as usize]).collect()
}

fn main() {
    let arguments: Vec<PathBuf> = std::env::args().skip(1).filter(|a| a != "--bench").map(PathBuf::from).collect();
    let mut lines = vec![
        "| splat | sampling | Gaussians | anchors | of these in the middle half | distance there: median, 99% | distance over all: median, 99% |".to_string(),
        "|---|---|---|---|---|---|---|".to_string(),
    ];
    let mut rest = &arguments[..];
    while let [file, after @ ..] = rest {
        let folders = if after.len() >= 2 && after[0].is_dir() { 2 } else { 0 };
        rest = &after[folders..];
        let geometry = Geometry::read(file).expect("a 3DGS PLY");
        let gaussians = &geometry.gaussians;
        let visible = (folders == 2).then(|| seen(&geometry, &after[0], &after[1]));
        for (name, space, everything) in SAMPLINGS {
            let Some(means) = (if everything { Some(&gaussians.means) } else { visible.as_ref() }) else { continue };
            let points = shifted(means).points;
            let g = anchor_graph(&points, &GraphOptions { space, ..GraphOptions::default() });
            let (all, middle) = (g.distances(&points), g.middle(&points));
            let stem = file.file_stem().unwrap_or_default().to_string_lossy();
            lines.push(format!(
                "| {stem} | {name} | {} | {} | {:.1} % | {:.4}, {:.4} | {:.4}, {:.4} |",
                points.len(),
                g.anchors.len(),
                100.0 * middle.share,
                middle.distance.median,
                middle.distance.p99,
                all.median,
                all.p99
            ));
        }
    }
    #[allow(clippy::print_stdout, reason = "the result of the program")]
    if !arguments.is_empty() {
        println!("{}", lines.join("\n"));
    }
}
