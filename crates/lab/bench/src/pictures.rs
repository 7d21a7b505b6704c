//! Pictures of one scene for all rows of a table, side by side: what each system takes for one thing.

use crate::cells::{descriptors_beside, files};
use crate::plan::{Plan, Product, TablePlan};
use artifacts::{Descriptors, Instances, NOISE_COLOR, TrueObject, TruePoints, TrueScene, flat, instance_color};
use base64::Engine as _;
use eval::true_labels;
use gs_io::{Result, write_bytes};
use gs_raster::{RasterOptions, render};
use gs_scene::dataset::{self, LoadOptions, View};
use gs_scene::{Camera, Gaussians, Geometry, SH_C0};
use query::TextTable;
use report::html;
use report::picture::Picture;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Pictures in a line, the width of each in pixels, and the height of a line of text.
const COLUMNS: usize = 4;
const WIDTH: u32 = 240;
const TEXT: u32 = 22;
/// How bright the colour of a fragment is, beside that of the best instance of its thing.
const FRAGMENT: f32 = 0.45;

/// The colour of a Gaussian: that of a thing, whole or dimmed, or that of none.
type Paint = Option<(u32, bool)>;

/// Writes the pictures of the plan's middle scene with its first seed and the table's first masks, in the view that shows most
/// things: the photograph, the truth, then every row. A thing has one colour in all of them. The instance that is most like a thing (IoU in Gaussians) has its
/// colour; others that lie mostly in it are dark. Of systems without instances each Gaussian has the colour of the thing whose
/// name is most similar to its descriptor.
///
/// # Errors
/// When a file of the cells cannot be read.
pub fn write(plan: &Plan, table: &TablePlan, work: &Path, to: &Path) -> Result<()> {
    let (scene, seed, p) = (&plan.scenes[plan.scenes.len() / 2], plan.seeds[0], &table.p[0]);
    let name = format!("{}-{seed}", scene.name);
    let of = |row| files(plan, work, &name, p, row);
    let first = of(&table.rows[0]);
    let dataset = dataset::load(&first.scene, &LoadOptions::default())?;
    let geometry = Geometry::read(&first.geometry)?;
    let things = TrueScene::read(first.scene.join("truth/scene.json"))?.objects;
    let truth = true_labels(&geometry, &TruePoints::read(first.scene.join("truth/points.safetensors"))?);
    let shown = |view: &&View| things_in(&view.camera, &geometry.gaussians, &truth);
    let view = dataset.views.iter().max_by_key(shown).expect("a dataset has views");
    let photograph = view.load_image()?;
    let drawn = |paint: &[Paint]| painted(&geometry.gaussians, paint, &view.camera);
    let own: Vec<Paint> = truth.iter().map(|&t| u32::try_from(t).ok().map(|t| (t, true))).collect();
    let mut panels = vec![
        ("photograph", Picture::new(photograph.width, photograph.height, &photograph.rgb)),
        ("true labels", drawn(&own)),
    ];
    for row in &table.rows {
        let files = of(row);
        let descriptors = match plan.product(&row.clustering) {
            Product::Descriptors => Some(files.instances.clone()),
            Product::Both if !files.instances.exists() => Some(descriptors_beside(&files)),
            _ => None,
        };
        let paint = match descriptors {
            Some(path) => by_name(&Descriptors::read(path)?.0, &TextTable::read(&files.texts)?, &things, truth.len()),
            None => by_thing(&Instances::read(&files.instances)?.0.label, &truth),
        };
        panels.push((&row.label, drawn(&paint)));
    }
    write_bytes(to, sheet(&panels)?.as_bytes())
}

/// Things of which half of the Gaussians are in the picture.
fn things_in(camera: &Camera, g: &Gaussians, truth: &[i32]) -> usize {
    let mut of: BTreeMap<i32, (usize, usize)> = BTreeMap::new();
    for (mean, &thing) in g.means.iter().zip(truth).filter(|(_, t)| **t >= 0) {
        let inside = camera.sees(mean.map(f64::from).into()).is_some();
        let (all, within) = of.entry(thing).or_default();
        (*all, *within) = (*all + 1, *within + usize::from(inside));
    }
    of.values().filter(|(all, within)| 2 * within >= *all).count()
}

/// Of each Gaussian, the thing that its instance is most like, and whether no other instance is more like that thing.
fn by_thing(labels: &[i32], truth: &[i32]) -> Vec<Paint> {
    let (mut both, mut found, mut true_size) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    for (&l, &t) in labels.iter().zip(truth).filter(|(l, _)| **l >= 0) {
        *found.entry(l).or_insert(0usize) += 1;
        if let Ok(t) = u32::try_from(t) {
            *both.entry((l, t)).or_insert(0usize) += 1;
        }
    }
    truth.iter().filter_map(|&t| u32::try_from(t).ok()).for_each(|t| *true_size.entry(t).or_insert(0usize) += 1);
    let mut like: BTreeMap<i32, (f64, u32)> = BTreeMap::new();
    for (&(l, t), &n) in &both {
        let iou = n as f64 / (found[&l] + true_size[&t] - n) as f64;
        if like.get(&l).is_none_or(|best| iou > best.0) {
            like.insert(l, (iou, t));
        }
    }
    let mut best: BTreeMap<u32, (f64, i32)> = BTreeMap::new();
    for (&l, &(iou, t)) in &like {
        if best.get(&t).is_none_or(|b| iou > b.0) {
            best.insert(t, (iou, l));
        }
    }
    labels.iter().map(|l| like.get(l).map(|&(_, t)| (t, best[&t].1 == *l))).collect()
}

/// Of each Gaussian, the thing whose name is most similar to one of its descriptors.
fn by_name(d: &Descriptors, texts: &TextTable, things: &[TrueObject], n: usize) -> Vec<Paint> {
    let names: Vec<(u32, &[f32])> = things.iter().filter_map(|t| Some((t.id, texts.get(&t.name)?))).collect();
    let cosine = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| f64::from(x * y)).sum::<f64>();
    let of_row = |row: usize| {
        let slots = || flat(d.of_row(row)).chunks_exact(d.dim()).filter(|s| s.iter().any(|v| *v != 0.0));
        let score = |text: &[f32]| slots().map(|s| cosine(s, text)).fold(f64::NEG_INFINITY, f64::max);
        let best = names.iter().map(|(t, text)| (score(text), *t)).reduce(|a, b| if b.0 > a.0 { b } else { a });
        best.filter(|b| b.0.is_finite()).map(|b| (b.1, true))
    };
    let mut paint = vec![None; n];
    d.kept.iter().zip(&d.row).for_each(|(&i, &row)| paint[i as usize] = of_row(row as usize));
    paint
}

/// The Gaussians in other colours, from a camera.
fn painted(g: &Gaussians, paint: &[Paint], camera: &Camera) -> Picture {
    let color = |p: &Paint| match *p {
        None => NOISE_COLOR,
        Some((thing, true)) => instance_color(thing),
        Some((thing, false)) => instance_color(thing).map(|v| FRAGMENT * v),
    };
    let sh = paint.iter().flat_map(|p| color(p).map(|v| (v - 0.5) / SH_C0)).collect();
    let g = Gaussians { sh, sh_degree: 0, ..g.clone() };
    let r = render(&g, camera, &RasterOptions::default());
    Picture::new(r.width, r.height, &r.rgb)
}

/// All pictures with their names below, in lines, as an SVG.
fn sheet(panels: &[(&str, Picture)]) -> Result<String> {
    let height = WIDTH * panels[0].1.height as u32 / panels[0].1.width as u32;
    let (step, lines) = (height + TEXT, panels.len().div_ceil(COLUMNS) as u32);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}\" height=\"{h}\" viewBox=\"0 0 {w} {h}\" font-family=\"sans-serif\" \
         font-size=\"14\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        w = WIDTH * COLUMNS as u32,
        h = step * lines
    );
    for (i, (name, picture)) in panels.iter().enumerate() {
        let (x, y) = (WIDTH * (i % COLUMNS) as u32, step * (i / COLUMNS) as u32);
        let data = base64::engine::general_purpose::STANDARD.encode(picture.jpeg(2 * WIDTH as usize, 85)?);
        let _ = writeln!(
            svg,
            "<image x=\"{x}\" y=\"{y}\" width=\"{}\" height=\"{height}\" href=\"data:image/jpeg;base64,{data}\"/>\n\
             <text x=\"{}\" y=\"{}\">{}</text>",
            WIDTH - 4,
            x + 4,
            y + height + 15,
            html::escape(name)
        );
    }
    svg.push_str("</svg>\n");
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fragments_are_dark_and_nothing_is_grey() {
        let truth = [0, 0, 0, 0, 1, 1, -1];
        let labels = [5, 5, 5, 2, 3, -1, 3];
        let whole = |t| Some((t, true));
        let dark = Some((0, false));
        assert_eq!(by_thing(&labels, &truth), [whole(0), whole(0), whole(0), dark, whole(1), None, whole(1)]);
    }

    #[test]
    fn descriptors_take_the_name_that_fits_best() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.json");
        std::fs::write(&path, r#"{"mug": [1, 0], "tray": [0, 1], "handle of the mug": [0.9, 0.1]}"#).unwrap();
        let thing = |id, name: &str| TrueObject { id, name: name.into(), ..Default::default() };
        let values = ndarray::arr3(&[[[0.9, 0.1], [0.0, 0.0]], [[0.0, 0.0], [0.2, 0.8]], [[0.0, 0.0]; 2]]);
        let d = Descriptors { kept: vec![0, 2, 3], row: vec![0, 1, 2], values };
        let found = by_name(&d, &TextTable::read(&path).unwrap(), &[thing(4, "mug"), thing(7, "tray")], 4);
        assert_eq!(found, [Some((4, true)), None, Some((7, true)), None]);
    }
}
