//! OpenGaussian (arXiv 2406.02058; public code): features that masks of each view bring together and drive apart, a codebook of
//! two levels, and clusters matched with masks by overlap and features.
//!
//! The features are learned by `feat-train` (`--features`) with its losses: `--loss separation --cohesion 0.1 --layers 0` on sampled pixels.
//! From the authors' code are: 64 coarse clusters by features and by positions as they are, times 0.5 (LERF-OVS) or 1
//! (ScanNet, in metres); fine ones in each by features alone, as many as masks of one view lie in it and one more, at most 10
//! (LERF-OVS) or 5 (ScanNet); features at unit length, shown as (f + 1) / 2; silhouettes of a cluster alone above 0.8; a
//! score of IoU x (1 - L1) and a match above 0.2; masks of features that vary by more than 0.006 left out, unless they are
//! nearly the largest. Texts join look-alikes within 0.9 and want 5 views: `eval score --min-support 5 --join 0.9`.
//!
//! The paper has a fixed number of fine clusters; the code has only a largest one, and it is followed here (`--fixed` for the
//! paper). Of several levels of masks each is counted alone, and the most count: there it is one level.
//!
//! What differs: the codebooks are found by Lloyd's rounds until nothing changes, not by 5 rounds every 50 or 200 steps of
//! learning, and fine-tuning the features on them is left out. A cluster that loses all its points keeps its centre.
//! Features are at unit length in the codebooks too: `feat-train` writes them so, the code clusters them as learned. The
//! code leaves out clusters of few Gaussians (100 or 10) and large Gaussians; scenes with fewer Gaussians would lose too
//! much by that.

use crate::cli::Peer;
use crate::kmeans::k_means;
use crate::product::{Grouping, Product};
use crate::silhouettes::{FeatureTable, Overlaps, best_masks, overlaps};
use crate::vectors::unit;
use crate::world::{Inputs, LearnedInputs, World};
use artifacts::{Features, Level, MaskMaps, Match, flat};
use gs_io::Result;
use gs_raster::{TILE, TileWeights, render_features};
use gs_scene::Camera;
use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Rounds of k-means.
const ROUNDS: usize = 100;
/// Masks of features with more variance show several things ...
const MOST_VARIANCE: f64 = 0.006;
/// ... unless their area is more than this share of the largest mask's.
const LARGE: f64 = 0.8;
/// Alpha of a coarse cluster alone, above which a pixel is its own.
const COARSE_ALPHA: f32 = 0.9;
/// A mask lies in a coarse cluster where more than this share of it does ...
const INSIDE: f64 = 0.2;
/// ... and where mean features differ by less than this, summed over their numbers ...
const NEAR_SUM: f64 = 0.9;
/// ... and as a distance.
const NEAR: f64 = 0.5;
const PIXELS: usize = TILE * TILE;
/// Least score of a match (the code).
const LEAST_SCORE: f32 = 0.2;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    learned: LearnedInputs,
    /// Coarse clusters, by features and positions
    #[arg(long, value_name = "COUNT", default_value_t = 64, value_parser = stage::within(1..=10_000usize))]
    coarse: usize,
    /// Most fine clusters in each coarse one, by features (LERF-OVS 10, ScanNet 5)
    #[arg(long, value_name = "COUNT", default_value_t = 10, value_parser = stage::within(1..=1_000usize))]
    fine: usize,
    /// Part every coarse cluster in as many fine ones as --fine says, however many masks lie in it
    #[arg(long)]
    fixed: bool,
    /// Weight of positions, in units of the scene, for coarse clusters (LERF-OVS 0.5, ScanNet 1)
    #[arg(long, value_name = "FACTOR", default_value_t = 0.5, value_parser = stage::at_least(0.0f32))]
    position_weight: f32,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.learned.inputs
    }

    fn features(&self) -> Option<&Path> {
        Some(&self.learned.features)
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let dim = world.learned.dim();
        let mut features = flat(world.learned.values.view()).to_vec();
        features.chunks_exact_mut(dim).for_each(unit);
        // As they are shown: 0 to 1.
        let values = features.iter().map(|f| (f + 1.0) / 2.0).collect();
        let values = Array2::from_shape_vec(world.learned.values.dim(), values).expect("as many");
        let shown = Features { kept: world.learned.kept.clone(), values };
        let means = &world.geometry.gaussians.means;
        let places: Vec<[f32; 3]> = shown.kept.iter().map(|&i| means[i as usize]).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(stage.seed());
        let (coarse, count) = coarse(&features, dim, &places, self, &mut rng);
        let (seen, masks) = look(world, &world.spread(&signed(&coarse)), count, &shown, stage)?;
        let most: Vec<usize> =
            masks.iter().map(|m| if self.fixed { self.fine } else { (m + 1).min(self.fine) }).collect();
        let (labels, instances) = fine(&features, dim, &coarse, &most, &mut rng);
        let labels = world.spread(&labels);
        let matches = matched(world, &labels, &shown, &seen, LEAST_SCORE, stage)?;
        Ok(Product::Instances(Grouping { labels, instances, matches, ..Grouping::default() }))
    }
}

fn signed(labels: &[u32]) -> Vec<i32> {
    labels.iter().map(|&l| l as i32).collect()
}

/// The coarse cluster of every Gaussian, by features and positions, and their number.
fn coarse(features: &[f32], dim: usize, places: &[[f32; 3]], o: &Options, rng: &mut ChaCha8Rng) -> (Vec<u32>, usize) {
    let rows = features.chunks_exact(dim).zip(places);
    let joined: Vec<f32> = rows.flat_map(|(f, p)| f.iter().copied().chain(p.map(|v| v * o.position_weight))).collect();
    k_means(&joined, dim + 3, o.coarse, ROUNDS, rng)
}

/// The fine cluster of every Gaussian, by features alone, and their number: at most `most[c]` in coarse cluster c.
fn fine(features: &[f32], dim: usize, coarse: &[u32], most: &[usize], rng: &mut ChaCha8Rng) -> (Vec<i32>, usize) {
    let row = |i: usize| &features[i * dim..(i + 1) * dim];
    let mut own = vec![Vec::new(); most.len()];
    coarse.iter().enumerate().for_each(|(i, &c)| own[c as usize].push(i));
    let (mut labels, mut all) = (vec![-1; coarse.len()], 0);
    for (own, &most) in own.into_iter().zip(most) {
        let points: Vec<f32> = own.iter().flat_map(|&i| row(i)).copied().collect();
        let (fine, count) = k_means(&points, dim, most, ROUNDS, rng);
        own.into_iter().zip(fine).for_each(|(i, label)| labels[i] = (all + label as usize) as i32);
        all += count;
    }
    (labels, all)
}

/// A mask with the features that are rendered over it.
#[derive(Debug, Clone, Default, PartialEq)]
struct Seen {
    /// Place of its level among those that are used.
    level: usize,
    area: f64,
    mean: Vec<f64>,
    /// It shows several things: the features vary too much for its size.
    mixed: bool,
}

/// Masks of a view, by id.
type Masks = BTreeMap<u32, Seen>;

/// Pixels of coarse clusters, rendered alone, in masks, and their features summed over these, by both.
type Shares = BTreeMap<(u32, u32), (u32, Vec<f64>)>;

/// The masks of every view, and for each coarse cluster the most masks of a view that lie in it, 1 at least.
fn look(
    world: &World,
    coarse: &[i32],
    count: usize,
    shown: &Features,
    stage: &Stage,
) -> Result<(Vec<Masks>, Vec<usize>)> {
    let (gaussians, dim) = (&world.geometry.gaussians, shown.dim());
    let mut of_all = vec![0.0; world.gaussians() * dim];
    for (at, &i) in shown.kept.iter().enumerate() {
        of_all[i as usize * dim..(i as usize + 1) * dim].copy_from_slice(flat(shown.row(at)));
    }
    let (mut all, mut most) = (Vec::new(), vec![1; count]);
    for view in 0..world.views.len() {
        stage.go_on()?;
        let (maps, camera): (MaskMaps, Camera) = world.maps(view)?;
        let image = render_features(gaussians, &of_all, dim, &camera, &world.raster);
        let seen = seen(&image, dim, &maps, &world.levels);
        // Hidden Gaussians of a cluster count too.
        let early_stop = false;
        let tiles = world.tiles(&camera, early_stop, |t| shares(t, coarse, &of_all, dim, &maps, &world.levels));
        let mut sum = Shares::new();
        for (key, (pixels, features)) in tiles.into_iter().flatten() {
            let to = sum.entry(key).or_insert_with(|| (0, vec![0.0; dim]));
            to.0 += pixels;
            to.1.iter_mut().zip(features).for_each(|(s, f)| *s += f);
        }
        for (cluster, masks) in lying_in(&sum, &seen) {
            most[cluster as usize] = most[cluster as usize].max(masks);
        }
        all.push(seen);
    }
    Ok((all, most))
}

/// The part of a tile: `coarse` are clusters of all Gaussians, `shown` their features.
fn shares(t: &TileWeights<'_>, coarse: &[i32], shown: &[f32], dim: usize, maps: &MaskMaps, levels: &[Level]) -> Shares {
    let mut left = BTreeMap::<u32, [f32; PIXELS]>::new();
    for (&i, alphas) in t.gaussians.iter().zip(t.alphas.chunks_exact(PIXELS)) {
        let Ok(cluster) = u32::try_from(coarse[i as usize]) else { continue };
        left.entry(cluster).or_insert([1.0; PIXELS]).iter_mut().zip(alphas).for_each(|(l, a)| *l *= 1.0 - a);
    }
    let inside: BTreeMap<u32, [bool; PIXELS]> =
        left.iter().map(|(&cluster, left)| (cluster, left.map(|l| 1.0 - l > COARSE_ALPHA))).collect();
    // Pixels with the same masks, and which of these sets each pixel belongs to; the first has no masks.
    let (mut sets, mut set_of) = (vec![Vec::new()], [0; PIXELS]);
    for (x, y) in (0..t.height).flat_map(|y| (0..t.width).map(move |x| (x, y))) {
        let at = [t.y0 + y, t.x0 + x];
        let set: Vec<u32> = levels.iter().filter_map(|&l| u32::try_from(maps.level(l)[at]).ok()).collect();
        set_of[y * TILE + x] = sets.iter().position(|s| *s == set).unwrap_or_else(|| {
            sets.push(set);
            sets.len() - 1
        });
    }
    let mut out = Shares::new();
    for (&cluster, inside) in &inside {
        for mask in (0..PIXELS).filter(|&p| inside[p]).flat_map(|p| &sets[set_of[p]]) {
            out.entry((cluster, *mask)).or_insert_with(|| (0, vec![0.0; dim])).0 += 1;
        }
    }
    left.values_mut().for_each(|left| *left = [1.0; PIXELS]);
    let mut weights = vec![0.0f32; sets.len()];
    for (&i, alphas) in t.gaussians.iter().zip(t.alphas.chunks_exact(PIXELS)) {
        let Ok(cluster) = u32::try_from(coarse[i as usize]) else { continue };
        let (Some(left), Some(inside)) = (left.get_mut(&cluster), inside.get(&cluster)) else { continue };
        weights.fill(0.0);
        for p in 0..PIXELS {
            weights[set_of[p]] += if inside[p] { left[p] * alphas[p] } else { 0.0 };
            left[p] *= 1.0 - alphas[p];
        }
        let feature = &shown[i as usize * dim..(i as usize + 1) * dim];
        for (set, &weight) in sets.iter().zip(&weights).filter(|(_, w)| **w > 0.0) {
            for mask in set {
                let Some((_, sum)) = out.get_mut(&(cluster, *mask)) else { continue };
                sum.iter_mut().zip(feature).for_each(|(s, &f)| *s += f64::from(weight) * f64::from(f));
            }
        }
    }
    out
}

/// How many masks of a level, at most, lie in each coarse cluster.
fn lying_in(shares: &Shares, seen: &Masks) -> BTreeMap<u32, usize> {
    let mut of_level = BTreeMap::<(u32, usize), usize>::new();
    for (&(cluster, mask), (pixels, sum)) in shares {
        let Some(mask) = seen.get(&mask).filter(|m| !m.mixed) else { continue };
        let pixels = f64::from(*pixels);
        let apart: Vec<f64> = sum.iter().zip(&mask.mean).map(|(s, m)| (s / pixels - m).abs()).collect();
        let near = apart.iter().sum::<f64>() < NEAR_SUM && apart.iter().map(|a| a * a).sum::<f64>().sqrt() < NEAR;
        if pixels > INSIDE * mask.area && near {
            *of_level.entry((cluster, mask.level)).or_default() += 1;
        }
    }
    let mut most = BTreeMap::new();
    for ((cluster, _), masks) in of_level {
        let so_far = most.entry(cluster).or_insert(masks);
        *so_far = masks.max(*so_far);
    }
    most
}

/// The masks of a view, with the rendered features, `[pixels][dim]`.
fn seen(image: &[f32], dim: usize, maps: &MaskMaps, levels: &[Level]) -> Masks {
    let mut all = BTreeMap::new();
    for (at, &level) in levels.iter().enumerate() {
        // Pixels, sums and sums of squares.
        let mut of = BTreeMap::<u32, (f64, Vec<f64>, f64)>::new();
        for (&id, pixel) in maps.level(level).iter().zip(image.chunks_exact(dim)) {
            let Ok(id) = u32::try_from(id) else { continue };
            let (area, sum, squares) = of.entry(id).or_insert_with(|| (0.0, vec![0.0; dim], 0.0));
            *area += 1.0;
            sum.iter_mut().zip(pixel).for_each(|(s, &v)| *s += f64::from(v));
            *squares += pixel.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
        }
        let largest = of.values().map(|m| m.0).fold(0.0, f64::max);
        for (id, (area, sum, squares)) in of {
            let mean: Vec<f64> = sum.iter().map(|s| s / area).collect();
            let variance = (squares / area - mean.iter().map(|m| m * m).sum::<f64>()) / dim as f64;
            let mixed = variance > MOST_VARIANCE && area <= LARGE * largest;
            all.insert(id, Seen { level: at, area, mean, mixed });
        }
    }
    all
}

/// The masks that the clusters of all Gaussians are matched with.
fn matched(
    world: &World,
    labels: &[i32],
    shown: &Features,
    seen: &[Masks],
    threshold: f32,
    stage: &Stage,
) -> Result<Vec<Match>> {
    let table = FeatureTable::new(shown, world.gaussians());
    let mut all = Vec::new();
    for (view, seen) in seen.iter().enumerate() {
        stage.go_on()?;
        let (maps, camera): (MaskMaps, Camera) = world.maps(view)?;
        let gaussians = &world.geometry.gaussians;
        let found = overlaps(gaussians, &world.raster, labels, &table, &camera, &maps, &world.levels);
        let mixed = seen.iter().filter(|(_, m)| m.mixed).map(|(&id, _)| id).collect();
        all.extend(best(&found, view as u32, &mixed, threshold));
    }
    all.sort_by_key(|m| (m.instance, m.view));
    Ok(all)
}

/// The best mask of each cluster in a view, of those that are not `mixed`: IoU x (1 - L1 distance of mean features),
/// above `threshold`; of equals the lower id.
fn best(found: &Overlaps, view: u32, mixed: &BTreeSet<u32>, threshold: f32) -> Vec<Match> {
    best_masks(found, view, threshold, |iou, i, (mask, m)| {
        let mean = |sum: &f64, area: u32| sum / f64::from(area.max(1));
        let apart = i.features.iter().zip(&m.features).map(|(a, b)| (mean(a, i.area) - mean(b, m.area)).abs());
        if mixed.contains(&mask) { 0.0 } else { iou * (1.0 - apart.sum::<f64>()) }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::silhouettes::Region;
    use crate::testing::options;
    use ndarray::arr3;

    #[test]
    fn positions_count_by_their_weight() {
        // Features 0 and 1, at places 0 and 9.
        let (features, places) = ([0.0, 0.0, 1.0, 1.0], [[0.0; 3], [9.0, 0.0, 0.0], [0.0; 3], [9.0, 0.0, 0.0]]);
        let found = |o: &str| coarse(&features, 1, &places, &options(o), &mut ChaCha8Rng::seed_from_u64(3));
        let (by_place, count) = found("--coarse 2 --position-weight 1");
        assert_eq!((count, by_place[0] == by_place[2], by_place[1] == by_place[3]), (2, true, true));
        // Places are 0.45 apart now.
        let (by_feature, count) = found("--coarse 2 --position-weight 0.05");
        assert_eq!((count, by_feature[0] == by_feature[1], by_feature[2] == by_feature[3]), (2, true, true));
        assert_eq!(found("--coarse 9").1, 4);
    }

    #[test]
    fn fine_clusters_part_features_of_one_coarse_cluster() {
        let features = [0.0, 1.0, 0.0, 0.01, 1.0, 1.01];
        let (labels, count) = fine(&features, 1, &[0, 0, 1, 1, 1, 1], &[1, 2], &mut ChaCha8Rng::seed_from_u64(3));
        assert_eq!((count, labels[0], labels[1]), (3, 0, 0));
        assert!(
            labels[2] == labels[3] && labels[4] == labels[5] && labels[2] != labels[4] && labels[2] > 0,
            "{labels:?}"
        );
    }

    #[test]
    fn clusters_alone_share_pixels_and_features_with_masks() {
        let maps = MaskMaps { ids: arr3(&[[[5, 5, 6]]; 4]) };
        let mut alphas = vec![0.0; 3 * PIXELS];
        for (g, row) in [[0.8, 0.8, 0.0], [0.75, 0.0, 1.0], [0.0, 0.95, 0.5]].iter().enumerate() {
            alphas[g * PIXELS..g * PIXELS + 3].copy_from_slice(row);
        }
        let t = TileWeights {
            x0: 0,
            y0: 0,
            width: 3,
            height: 1,
            gaussians: &[0, 1, 2],
            alphas: &alphas,
            weights: &alphas,
            alpha: &[],
        };
        let found = shares(&t, &[0, 0, 1], &[1.0, 0.5, 0.25], 1, &maps, &[Level::LARGE]);
        // Cluster 0 alone has alpha 0.95, 0.8 and 1, so pixels 0 and 2: 0.8 x 1 + 0.2 x 0.75 x 0.5, and 0.5. Cluster 1 has
        // pixel 1: 0.95 x 0.25.
        let expected = [((0, 5), 0.875), ((0, 6), 0.5), ((1, 5), 0.2375)];
        assert_eq!(found.len(), 3);
        for ((key, (pixels, sum)), (expected_key, expected)) in found.into_iter().zip(expected) {
            assert_eq!((key, pixels), (expected_key, 1));
            assert!((sum[0] - expected).abs() < 1e-6, "{key:?} {sum:?}");
        }
    }

    #[test]
    fn masks_lie_in_clusters_that_hold_a_part_of_them_and_are_alike() {
        let mask = |level, mixed| Seen { level, area: 10.0, mean: vec![0.5, 0.5], mixed };
        let seen = BTreeMap::from([
            (1, mask(0, false)),
            (2, mask(0, false)),
            (3, mask(0, true)),
            (4, mask(0, false)),
            (5, mask(0, false)),
            (6, mask(1, false)),
        ]);
        let alike = |pixels: u32| (pixels, vec![0.5 * f64::from(pixels); 2]);
        // Mask 2 is held by a fifth, 3 is mixed, 4 is 0.55 away, 5 only 0.45 but 0.9 in sum; 6 is of another level.
        let far = |pixels: u32, a: f64| (pixels, vec![a * f64::from(pixels), a * f64::from(pixels)]);
        let shares = Shares::from([
            ((7, 1), alike(3)),
            ((7, 2), alike(2)),
            ((7, 3), alike(9)),
            ((7, 4), (4, vec![4.0 * 1.05, 4.0 * 0.5])),
            ((7, 5), far(4, 0.96)),
            ((7, 6), alike(4)),
            ((8, 4), alike(4)),
            ((8, 5), alike(5)),
        ]);
        assert_eq!(lying_in(&shares, &seen), BTreeMap::from([(7, 1), (8, 2)]));
    }

    #[test]
    fn masks_of_two_features_are_left_out_unless_they_are_large() {
        let row = [0, 0, 0, 0, 1, 1, 2, 2, 2, -1];
        let maps = MaskMaps { ids: arr3(&[[row]; 4]) };
        // Mask 0 is half 0.3 and half 0.7: variance 0.04, but the largest. Mask 1 is 0.4 and 0.6: 0.01. Mask 2 is even.
        let image = [0.3, 0.3, 0.7, 0.7, 0.4, 0.6, 0.2, 0.2, 0.2, 0.9];
        let found = seen(&image, 1, &maps, &[Level::LARGE]);
        let mixed: Vec<u32> = found.iter().filter(|(_, m)| m.mixed).map(|(&id, _)| id).collect();
        assert_eq!((mixed, found.len(), found[&1].area), (vec![1], 3, 2.0));
        assert!((found[&0].mean[0] - 0.5).abs() < 1e-6 && (found[&2].mean[0] - 0.2).abs() < 1e-6);
    }

    #[test]
    fn matches_weigh_overlap_and_features() {
        let region = |area, feature| Region { area, features: vec![feature * f64::from(area)], visible: 0.0 };
        let found = Overlaps {
            instances: BTreeMap::from([(0, region(10, 0.5))]),
            masks: BTreeMap::from([(1, region(10, 0.9)), (2, region(10, 0.5)), (3, region(10, 0.5))]),
            common: BTreeMap::from([((0, 1), 8), ((0, 2), 6), ((0, 3), 2)]),
        };
        // 8 of 12 at a distance of 0.4: 0.4; 6 of 14: 0.4286; 2 of 18: 0.11.
        let m = best(&found, 7, &BTreeSet::new(), 0.2);
        assert_eq!((m.len(), m[0].mask, m[0].view), (1, 2, 7));
        assert!((m[0].score - 6.0 / 14.0).abs() < 1e-6);
        let other = best(&found, 7, &BTreeSet::from([2]), 0.2);
        assert!(other[0].mask == 1 && (other[0].score - 0.4).abs() < 1e-6);
        assert!(best(&found, 7, &BTreeSet::from([1, 2]), 0.2).is_empty());
    }

    #[test]
    fn distances_add_up_over_the_numbers_of_a_feature() {
        let region =
            |features: [f64; 2]| Region { area: 10, features: features.map(|f| 10.0 * f).to_vec(), visible: 0.0 };
        let found = Overlaps {
            instances: BTreeMap::from([(0, region([0.2, 0.2]))]),
            masks: BTreeMap::from([(1, region([0.5, 0.4]))]),
            common: BTreeMap::from([((0, 1), 10)]),
        };
        // All in common, 0.3 and 0.2 apart.
        let m = best(&found, 0, &BTreeSet::new(), 0.2);
        assert!((m[0].score - 0.5).abs() < 1e-6, "{m:?}");
    }
}
