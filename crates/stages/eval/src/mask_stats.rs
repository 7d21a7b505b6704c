//! `eval masks`: how id maps look (how many, how large) and how consistent they are from view to view, by one instrument
//! for real and synthetic masks.
//!
//! Sizes come from the maps alone. Consistency needs to know which pixels of two views show the same surface: the
//! Gaussians of the mask's footprint say so. Each view is compared with the view that shares most of its Gaussians. A
//! mask takes part when at least half of its weight lies on Gaussians that the other view's masks of that level own. It
//! is *split* when at least two of the other view's masks hold a quarter of that weight each, and *merged* when the mask
//! that holds most of it is itself split, with this mask among the pieces.

use crate::options::MasksOptions;
use crate::score::metrics::counts;
use artifacts::{Footprints, LEVELS, Level, MaskMaps, maps_path, role};
use gs_io::{Error, Result, write_json};
use report::sheet::markdown;
use serde::Serialize;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::path::Path;

/// Share of a mask's weight that another view must see for the two to be compared.
const SEEN: f64 = 0.5;
/// Share of a mask that makes a piece of it.
const PIECE: f64 = 0.25;
/// Quantiles of the masks' areas.
const QUANTILES: [f64; 5] = [0.1, 0.25, 0.5, 0.75, 0.9];

pub(crate) fn run(o: &MasksOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let maps = artifacts::folder_files(&o.masks, "_s.npy")?;
    let mut claim = stage.outputs(&o.out).file(&o.out).reads(maps).reads(&o.footprints).claim()?;
    let footprints = o.footprints.as_deref().map(Footprints::read).transpose()?;
    let mut inputs = BTreeMap::from([(role::MASKS.to_string(), artifacts::hash_folder(&o.masks, "_s.npy")?)]);
    if let Some(f) = &footprints {
        f.artifact().expect_input(role::MASKS, &inputs[role::MASKS])?;
        inputs.insert(role::FOOTPRINTS.into(), f.artifact().hash().into());
    }
    let stats = measure(&o.masks, footprints.as_ref())?;
    write_json(&o.out, &stats)?;
    stage.record(&mut claim, parameters, inputs, json!({"views": stats.views}))?;
    Ok(table(&stats))
}

/// Statistics of one level.
#[derive(Debug, Serialize)]
pub struct LevelStats {
    /// Name of the level.
    pub level: String,
    /// Masks per view: mean, and standard deviation over views.
    pub masks: [f64; 2],
    /// Areas as shares of the image, at 10, 25, 50, 75 and 90 percent of the masks.
    pub area: [f64; 5],
    /// Share of all pixels that a mask owns.
    pub covered: f64,
    /// Masks that could be compared with another view's.
    pub compared: usize,
    /// Share of them that are split in the other view; none without footprints.
    pub split: Option<f64>,
    /// Share of them that are merged with others in the other view.
    pub merged: Option<f64>,
    /// Share of them that are neither.
    pub stable: Option<f64>,
}

/// Statistics of a folder of masks.
#[derive(Debug, Serialize)]
pub struct MaskStats {
    /// Views.
    pub views: usize,
    /// Each level.
    pub levels: Vec<LevelStats>,
}

/// Measures the id maps of a folder, with footprints of these very masks also their consistency.
pub fn measure(folder: &Path, footprints: Option<&Footprints>) -> Result<MaskStats> {
    let stems = artifacts::stems(folder)?;
    if stems.is_empty() {
        return Err(Error::new("no id maps").file(folder).expected("*_s.npy").hint("run mask-embed or synth-scene"));
    }
    if let Some(f) = footprints
        && let Some(other) = f.views.iter().find(|v| !stems.contains(v))
    {
        return Err(Error::new("the footprints are of other masks")
            .file(f.artifact().path())
            .field("views")
            .found(other)
            .hint("run graph-precompute on these masks"));
    }
    let [mut masks, mut areas, mut covered]: [[Vec<f64>; LEVELS]; 3] = Default::default();
    for stem in &stems {
        let maps = MaskMaps::read(maps_path(folder, stem))?;
        let image = (maps.width() * maps.height()) as f64;
        for &level in maps.levels() {
            let pixels = counts(maps.level(level).into_iter().filter(|&&id| id >= 0));
            let l = level.index();
            masks[l].push(pixels.len() as f64);
            covered[l].push(pixels.values().sum::<usize>() as f64 / image);
            areas[l].extend(pixels.values().map(|&n| n as f64 / image));
        }
    }
    let pairs = footprints.map(closest_views).transpose()?;
    let fates = |level: Level| match footprints.zip(pairs.as_ref()) {
        Some((f, pairs)) => compare(f, level.index() as u32, pairs),
        None => Ok([0; 4]),
    };
    let mut levels = Vec::new();
    for level in Level::ALL.into_iter().filter(|&level| !masks[level.index()].is_empty()) {
        let l = level.index();
        let [compared, fates @ ..] = fates(level)?;
        let [split, merged, stable] = fates.map(|n| (compared > 0).then(|| n as f64 / compared as f64));
        let (masks, area) = (mean_and_spread(&masks[l]), quantiles(&mut areas[l]));
        let covered = mean_and_spread(&covered[l])[0];
        levels.push(LevelStats { level: level.to_string(), masks, area, covered, compared, split, merged, stable });
    }
    Ok(MaskStats { views: stems.len(), levels })
}

fn mean_and_spread(values: &[f64]) -> [f64; 2] {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    [mean, (square / (n - 1.0).max(1.0)).sqrt()]
}

fn quantiles(values: &mut [f64]) -> [f64; 5] {
    values.sort_by(f64::total_cmp);
    QUANTILES.map(|q| match values.len() {
        0 => 0.0,
        n => values[(q * (n - 1) as f64).round() as usize],
    })
}

/// For each view the other one that shares the largest part of its Gaussians; none for a view without any.
fn closest_views(f: &Footprints) -> Result<Vec<Option<usize>>> {
    let words = f.kept.len().div_ceil(64);
    let mut seen = vec![vec![0u64; words]; f.views.len()];
    for (r, row) in f.rows.iter().enumerate().filter(|(_, row)| row.level == 0) {
        for c in f.entries(r)?.gaussians {
            seen[row.view as usize][c as usize / 64] |= 1 << (c % 64);
        }
    }
    let shared = |a: usize, b: usize| -> u32 { seen[a].iter().zip(&seen[b]).map(|(x, y)| (x & y).count_ones()).sum() };
    let closest = |a: usize| {
        let others = (0..f.views.len()).filter(|&b| b != a).map(|b| (shared(a, b), b)).filter(|s| s.0 > 0);
        others.max_by_key(|&(n, b)| (n, std::cmp::Reverse(b))).map(|s| s.1)
    };
    Ok((0..f.views.len()).map(closest).collect())
}

/// The weight of a mask, and of it what lies in each mask of another view.
type Shares = (f64, BTreeMap<usize, f64>);

/// Weight of each mask of view `from` by the masks of view `to` that own its Gaussians: row -> (row, weight), with the
/// weight of the whole mask.
fn shares(f: &Footprints, rows: &[usize], owner: &[u32]) -> Result<BTreeMap<usize, Shares>> {
    let one = |&r: &usize| {
        let mut by = BTreeMap::<usize, f64>::new();
        let mut all = 0.0;
        for (c, w) in f.entries(r)?.iter() {
            all += f64::from(w);
            if owner[c as usize] != u32::MAX {
                *by.entry(owner[c as usize] as usize).or_default() += f64::from(w);
            }
        }
        Ok((r, (all, by)))
    };
    rows.iter().map(one).collect()
}

/// The mask of each Gaussian with the largest weight; `u32::MAX` for none.
fn owners(f: &Footprints, rows: &[usize]) -> Result<Vec<u32>> {
    let mut best = vec![(0.0f32, u32::MAX); f.kept.len()];
    for &r in rows {
        for (c, w) in f.entries(r)?.iter() {
            if w > best[c as usize].0 {
                best[c as usize] = (w, r as u32);
            }
        }
    }
    Ok(best.into_iter().map(|b| b.1).collect())
}

/// The masks that hold a piece each of what is seen of a mask.
fn pieces(by: &BTreeMap<usize, f64>) -> Vec<usize> {
    let seen: f64 = by.values().sum();
    by.iter().filter(|(_, w)| **w >= PIECE * seen).map(|(r, _)| *r).collect()
}

/// How many masks of a level could be compared, and how many of them are split, merged, neither.
fn compare(f: &Footprints, level: u32, pairs: &[Option<usize>]) -> Result<[usize; 4]> {
    let mut rows: Vec<Vec<usize>> = vec![Vec::new(); f.views.len()];
    for (r, row) in f.rows.iter().enumerate().filter(|(_, row)| row.level == level) {
        rows[row.view as usize].push(r);
    }
    let mut fates = [0; 4];
    for (a, b) in pairs.iter().enumerate().filter_map(|(a, b)| Some((a, (*b)?))) {
        let there = shares(f, &rows[a], &owners(f, &rows[b])?)?;
        let back = shares(f, &rows[b], &owners(f, &rows[a])?)?;
        for (r, (all, by)) in &there {
            let seen: f64 = by.values().sum();
            if seen < SEEN * all || *all <= 0.0 {
                continue;
            }
            let split = pieces(by).len() > 1;
            let most = by.iter().max_by(|x, y| x.1.total_cmp(y.1)).map(|m| m.0);
            let merged = most.and_then(|m| back.get(m)).is_some_and(|(_, by)| {
                let pieces = pieces(by);
                pieces.len() > 1 && pieces.contains(r)
            });
            let is = [true, split, merged, !split && !merged];
            fates.iter_mut().zip(is).for_each(|(n, is)| *n += usize::from(is));
        }
    }
    Ok(fates)
}

/// The statistics as a Markdown table.
pub fn table(stats: &MaskStats) -> String {
    let percent = |v: Option<f64>| v.map_or("–".to_string(), |v| format!("{:.0} %", 100.0 * v));
    let row = |l: &LevelStats| {
        let [low, _, middle, _, high] = l.area.map(|v| 100.0 * v);
        let masks = format!("{:.1} ± {:.1}", l.masks[0], l.masks[1]);
        let shares = [Some(l.covered), l.split, l.merged, l.stable].map(percent);
        [vec![l.level.clone(), masks, format!("{low:.2} / {middle:.2} / {high:.2}")], shares.to_vec()].concat()
    };
    let area = "Area at 10 / 50 / 90 % of masks, % of the image";
    let head = ["Level", "Masks per view", area, "Covered", "Split", "Merged", "Neither"];
    markdown(&head, &stats.levels.iter().map(row).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{FootprintsBuilder, Row};
    use gs_io::Provenance;

    /// Two views of eight Gaussians at one level; each mask is a list of Gaussians.
    fn footprints(views: [&[&[u32]]; 2]) -> (tempfile::TempDir, Footprints) {
        let mut b = FootprintsBuilder {
            views: vec!["a".into(), "b".into()],
            kept: (0..8).collect(),
            row_ptr: vec![0],
            ..FootprintsBuilder::default()
        };
        for (v, masks) in views.into_iter().enumerate() {
            for (m, mask) in masks.iter().enumerate() {
                b.rows.push(Row { view: v as u32, level: 0, mask: m as u32, pixels: 9, gated: 9, alpha: 1.0 });
                b.col.extend(*mask);
                b.weight.extend(mask.iter().map(|_| 1.0));
                b.row_ptr.push(b.col.len() as u64);
            }
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("footprints.safetensors");
        b.write(&path, Provenance::default()).unwrap();
        let f = Footprints::read(&path).unwrap();
        (dir, f)
    }

    fn fate(views: [&[&[u32]]; 2]) -> [usize; 4] {
        let (_dir, f) = footprints(views);
        compare(&f, 0, &closest_views(&f).unwrap()).unwrap()
    }

    #[test]
    fn a_thing_that_another_view_cuts_is_split_and_its_pieces_are_merged() {
        assert_eq!(fate([&[&[0, 1, 2, 3], &[4, 5, 6, 7]], &[&[0, 1, 2, 3], &[4, 5, 6, 7]]]), [4, 0, 0, 4]);
        assert_eq!(fate([&[&[0, 1, 2, 3], &[4, 5, 6, 7]], &[&[0, 1], &[2, 3], &[4, 5, 6, 7]]]), [5, 1, 2, 2]);
        // An eighth is no piece.
        assert_eq!(fate([&[&[0, 1, 2, 3, 4, 5, 6, 7]], &[&[0, 1, 2, 3, 4, 5, 6], &[7]]])[..2], [3, 0]);
        // What the other view hardly sees is not compared.
        assert_eq!(fate([&[&[0, 1, 2, 3], &[4, 5, 6, 7]], &[&[0, 1, 2, 3], &[4]]]), [3, 0, 0, 3]);
    }

    #[test]
    fn counts_areas_and_cover_are_those_of_the_maps() {
        let dir = tempfile::tempdir().unwrap();
        let id = |(_, y, _)| [0, 0, 0, 0, 0, 1, 1, 1, -1, -1][y];
        let maps = MaskMaps { ids: ndarray::Array3::from_shape_fn((4, 10, 10), id) };
        maps.write(maps_path(dir.path(), "v")).unwrap();
        let stats = measure(dir.path(), None).unwrap();
        let l = &stats.levels[0];
        assert_eq!((stats.views, l.masks, l.covered), (1, [2.0, 0.0], 0.8));
        assert_eq!((l.area[0], l.area[4], l.split), (0.3, 0.5, None));
        let table = table(&stats);
        assert!(table.contains("| large | 2.0 ± 0.0 | 30.00 / 50.00 / 50.00 | 80 % | – | – | – |"), "{table}");
    }
}
