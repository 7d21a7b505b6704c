//! LaGa (Cen et al., "Tackling View-Dependent Semantics in 3D Language Gaussian Splatting", ICML 2025): prototypes of the masks of
//! all views are clustered into objects, and an object has several descriptors.
//!
//! Settings and formulas are those of the public code (`inference.ipynb`). Each mask has a prototype, the mean of the Gaussians'
//! unit features over it, at unit length. HDBSCAN clusters them (5 masks, epsilon 0.1 for the finest level, 0.2 and 0.3 for the
//! next); a Gaussian joins the object whose mean prototype is most like its own feature. The features of an object's masks are
//! clustered by k-means, of 2 to 20 clusters those of best silhouette. A centre c weighs c . m, m being the unit mean of the
//! object's features: its direction's agreement with the mean, times its length, which says how compact its cluster is. The
//! score of an object for a text is the best of weight times relevance.
//!
//! The affinity features are those of `feat-train`. The code trains 16 + 8 + 8 numbers for three levels, of which the coarsest
//! level uses the first 16; here all levels have the same features. A prototype is the
//! mean over the footprint; the code brings the features of pixels to unit length before. Footprints hold no masks of less than
//! 0.1 % of the image, where the code drops those of up to 400 pixels, 0.06 %.
//!
//! A table of unit descriptors can't hold weights, which lower scores. The nearest to it: a descriptor is dropped whose weight
//! is below a share of the object's largest, for a low weight would keep it from being the best one. The code averages scores
//! over the levels before it selects; here a Gaussian has the descriptors of its objects on all levels, and takes the best. As
//! instances go the objects of the coarsest level, each with the mean m.

use crate::cli::Peer;
use crate::product::{Grouping, Product, Table};
use crate::vectors::{add, group_means, most_alike, normalised, normed, smoothed};
use crate::world::{Inputs, LearnedInputs, World};
use artifacts::{Features, Level, Match, flat};
use gs_io::Result;
use hdbscan_exact::{Options as Hdbscan, cluster};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Tries of k-means for each number of clusters (the code).
const TRIES: usize = 10;
/// Most rounds of a try (the code's library).
const ROUNDS: usize = 300;
/// Most masks of an object that its descriptors are made from, evenly chosen: k-means takes all pairs.
const MOST_MASKS: usize = 2000;
/// Most descriptors of an object and level (the code).
const MOST: usize = 20;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    learned: LearnedInputs,
    /// Output file for the descriptors of Gaussians; without it there are instances alone
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    descriptors: Option<PathBuf>,
    /// Neighbours over which features are averaged first, 0 for none, as the code does but for ScanNet's training (16)
    #[arg(long, value_name = "COUNT", default_value_t = 0, value_parser = stage::within(0..=1000u32))]
    smooth: u32,
    /// Fewest masks of an object, 2 or more
    #[arg(long, value_name = "COUNT", default_value_t = 5, value_parser = stage::at_least(2u32))]
    min_cluster_size: u32,
    /// Objects that part below this distance of unit prototypes are one, times 1 for the finest level used, 2 for the next; 0 to 2
    #[arg(long, value_name = "DISTANCE", default_value_t = 0.1, value_parser = stage::within(0.0..=2.0))]
    epsilon: f64,
    /// Descriptors are dropped whose weight is below this share of the object's largest, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.95, value_parser = stage::within(0.0..=1.0))]
    min_weight: f64,
}

/// Objects of a level.
#[derive(Debug, Clone, Default, PartialEq)]
struct Objects {
    /// Object of every kept Gaussian, -1 for none.
    labels: Vec<i32>,
    /// Masks of each object, as rows of the footprints.
    masks: Vec<Vec<u32>>,
    /// Unit mean of each object's mask features, zero for none.
    means: Vec<Vec<f32>>,
    /// Descriptors of each object, of any length.
    descriptors: Vec<Vec<Vec<f32>>>,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.learned.inputs
    }

    fn features(&self) -> Option<&Path> {
        Some(&self.learned.features)
    }

    fn descriptors(&self) -> Option<&Path> {
        self.descriptors.as_deref()
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let mut levels = world.levels.clone();
        levels.sort();
        levels.dedup();
        let mut all = Vec::new();
        let (dim, mut features) = (world.learned.dim(), affinity(&world.learned));
        if self.smooth > 0 {
            features = smoothed(&features, dim, &world.graph.gaussian_knn, self.smooth as usize);
        }
        for (rank, &level) in levels.iter().enumerate() {
            let objects = self.objects(world, stage, level, self.epsilon * (rank + 1) as f64, dim, &features)?;
            stage.info(&format!("level {level}: {} objects", objects.masks.len()));
            all.push(objects);
        }
        let grouping = grouping(world, all.last().unwrap_or(&Objects::default()));
        Ok(match self.descriptors {
            Some(_) => Product::Both(grouping, table(&all, world.kept(), world.dim())),
            None => Product::Instances(grouping),
        })
    }
}

impl Options {
    fn objects(
        &self,
        world: &World,
        stage: &Stage,
        level: Level,
        epsilon: f64,
        dim: usize,
        features: &[f32],
    ) -> Result<Objects> {
        let rows = &world.footprints.rows;
        let of_level: Vec<u32> = (0..rows.len() as u32).filter(|&r| rows[r as usize].is_of(&[level])).collect();
        let (mut masks, mut prototypes) = (Vec::new(), Vec::<f32>::new());
        world.footprints.in_batches(&of_level, |rows, entries| {
            let found: Vec<Option<Vec<f32>>> = entries.par_iter().map(|e| prototype(e.iter(), features, dim)).collect();
            for (&row, prototype) in rows.iter().zip(found) {
                if let Some(prototype) = prototype {
                    masks.push(row);
                    prototypes.extend(prototype);
                }
            }
        })?;
        let size = self.min_cluster_size as usize;
        if masks.len() < size {
            return Ok(Objects { labels: vec![-1; world.kept()], ..Objects::default() });
        }
        // The library of the code does not count a point among its own neighbours.
        let options = Hdbscan { min_cluster_size: size, min_samples: size + 1, epsilon, ..Hdbscan::default() };
        let of_mask = cluster(&prototypes, dim, &options).labels;
        let count = of_mask.iter().max().map_or(0, |&l| (l + 1) as usize);
        let mut own = vec![Vec::new(); count];
        for (&row, &label) in masks.iter().zip(&of_mask) {
            if let Ok(label) = usize::try_from(label) {
                own[label].push(row);
            }
        }
        let centres = group_means(of_mask.iter().copied().zip(prototypes.chunks_exact(dim)), dim, count);
        let labels = most_alike(features, dim, &centres, -1.0);
        let describe = |(object, masks): (usize, &Vec<u32>)| {
            let features = masks.iter().filter_map(|&r| world.feature(&rows[r as usize]));
            let features: Vec<Vec<f32>> = features.map(|f| normed(&wide(f))).collect();
            let seed = stage.seed() ^ ((level.index() as u64) << 32) ^ object as u64;
            (mean(&features, world.dim()), describe(&features, MOST, self.min_weight, seed))
        };
        let (means, descriptors) = own.par_iter().enumerate().map(describe).unzip();
        Ok(Objects { labels, masks: own, means, descriptors })
    }
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|&x| f64::from(x)).collect()
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
}

/// Unit mean.
fn mean(features: &[Vec<f32>], dim: usize) -> Vec<f32> {
    let mut sum = vec![0.0f64; dim];
    features.iter().for_each(|f| add(&mut sum, f));
    normed(&sum)
}

/// Unit affinity features.
fn affinity(learned: &Features) -> Vec<f32> {
    let row = |i: usize| normed(&wide(flat(learned.row(i))));
    (0..learned.kept.len()).into_par_iter().flat_map_iter(row).collect()
}

/// Unit mean of the features over a mask's weights; none where it is zero.
fn prototype(entries: impl Iterator<Item = (u32, f32)>, features: &[f32], dim: usize) -> Option<Vec<f32>> {
    let mut sum = vec![0.0f64; dim];
    for (i, w) in entries {
        let feature = &features[i as usize * dim..(i as usize + 1) * dim];
        sum.iter_mut().zip(feature).for_each(|(s, &f)| *s += f64::from(w) * f64::from(f));
    }
    normalised(&sum)
}

/// The descriptors of an object from the unit features of its masks: centres of k-means for the number of clusters with the
/// best silhouette, without those of low weight.
fn describe(features: &[Vec<f32>], most: usize, min_weight: f64, seed: u64) -> Vec<Vec<f32>> {
    let step = features.len().div_ceil(MOST_MASKS).max(1);
    let chosen: Vec<&Vec<f32>> = features.iter().step_by(step).collect();
    let Some(dim) = chosen.first().map(|f| f.len()) else { return Vec::new() };
    let n = chosen.len();
    // All that k-means and silhouettes need are products of pairs.
    let gram: Vec<f64> = (0..n * n).map(|at| dot(chosen[at / n], chosen[at % n])).collect();
    let groups = best_groups(&gram, n, most, seed);
    let count = groups.iter().max().map_or(0, |&g| g + 1);
    let mean = mean(features, dim);
    let mut centres = vec![vec![0.0f64; dim]; count];
    for (&group, feature) in groups.iter().zip(&chosen) {
        let size = groups.iter().filter(|&&g| g == group).count() as f64;
        centres[group].iter_mut().zip(feature.iter()).for_each(|(c, &f)| *c += f64::from(f) / size);
    }
    let weigh = |c: &Vec<f64>| c.iter().zip(&mean).map(|(c, &m)| c * f64::from(m)).sum::<f64>();
    let best = centres.iter().map(weigh).fold(f64::NEG_INFINITY, f64::max);
    let heavy = centres.iter().filter(|c| weigh(c) >= min_weight * best);
    heavy.map(|c| c.iter().map(|&v| v as f32).collect()).collect()
}

/// Groups of `n` unit vectors with products `gram`: of k-means for 2 to `most` groups that of the best silhouette, or all in one.
fn best_groups(gram: &[f64], n: usize, most: usize, seed: u64) -> Vec<usize> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (mut best, mut groups) = (-1.0, vec![0; n]);
    // A silhouette is of fewer groups than points.
    for k in 2..=most.min(n.saturating_sub(1)) {
        let mut tries = (0..TRIES).map(|_| k_means(gram, n, k, &mut rng));
        let Some(first) = tries.next() else { continue };
        let (labels, _) = tries.fold(first, |a, b| if b.1 < a.1 { b } else { a });
        let score = silhouette(gram, n, k, &labels);
        if score > best {
            (best, groups) = (score, labels);
        }
    }
    groups
}

/// k-means with k-means++ seeds from products of pairs: groups, and the sum of squared distances to the centres.
fn k_means(gram: &[f64], n: usize, k: usize, rng: &mut ChaCha8Rng) -> (Vec<usize>, f64) {
    let apart = |i: usize, j: usize| (gram[i * n + i] + gram[j * n + j] - 2.0 * gram[i * n + j]).max(0.0);
    let mut seeds = vec![rng.random_range(0..n)];
    let mut nearest: Vec<f64> = (0..n).map(|i| apart(i, seeds[0])).collect();
    while seeds.len() < k {
        let total: f64 = nearest.iter().sum();
        let mut left = rng.random::<f64>() * total;
        let past = |&i: &usize| {
            left -= nearest[i];
            left < 0.0
        };
        let next = (0..n).find(past).unwrap_or(n - 1);
        seeds.push(next);
        (0..n).for_each(|i| nearest[i] = nearest[i].min(apart(i, next)));
    }
    let closest = |i: usize, distance: &dyn Fn(usize) -> f64| {
        let mut best = (0, f64::INFINITY);
        for c in 0..k {
            let d = distance(c);
            best = if d < best.1 { (c, d) } else { best };
        }
        (best.0, best.1 + gram[i * n + i])
    };
    let mut groups: Vec<usize> = (0..n).map(|i| closest(i, &|c| apart(i, seeds[c])).0).collect();
    let mut cost = f64::INFINITY;
    for _ in 0..ROUNDS {
        // Products of every point with every centre, and of the centres with themselves.
        let mut size = vec![0.0f64; k];
        groups.iter().for_each(|&g| size[g] += 1.0);
        let mut products = vec![0.0f64; n * k];
        for i in 0..n {
            (0..n).for_each(|j| products[i * k + groups[j]] += gram[i * n + j]);
            (0..k).for_each(|c| products[i * k + c] /= size[c].max(1.0));
        }
        let mut square = vec![0.0f64; k];
        (0..n).for_each(|i| square[groups[i]] += products[i * k + groups[i]] / size[groups[i]]);
        let distance =
            |i: usize, c: usize| if size[c] > 0.0 { square[c] - 2.0 * products[i * k + c] } else { f64::INFINITY };
        let found: Vec<(usize, f64)> = (0..n).map(|i| closest(i, &|c| distance(i, c))).collect();
        cost = found.iter().map(|f| f.1).sum();
        let moved: Vec<usize> = found.iter().map(|f| f.0).collect();
        if moved == groups {
            break;
        }
        groups = moved;
    }
    (groups, cost)
}

/// Mean silhouette of `k` groups by distance, -1 where one is empty.
fn silhouette(gram: &[f64], n: usize, k: usize, groups: &[usize]) -> f64 {
    let mut size = vec![0usize; k];
    groups.iter().for_each(|&g| size[g] += 1);
    if size.contains(&0) {
        return -1.0;
    }
    let of = |i: usize| {
        let mut sums = vec![0.0f64; k];
        for j in 0..n {
            sums[groups[j]] += (gram[i * n + i] + gram[j * n + j] - 2.0 * gram[i * n + j]).max(0.0).sqrt();
        }
        let own = groups[i];
        if size[own] == 1 {
            return 0.0;
        }
        let inside = sums[own] / (size[own] - 1) as f64;
        let others = (0..k).filter(|&c| c != own).map(|c| sums[c] / size[c] as f64);
        let outside = others.fold(f64::INFINITY, f64::min);
        let larger = inside.max(outside);
        if larger > 0.0 { (outside - inside) / larger } else { 0.0 }
    };
    (0..n).map(of).sum::<f64>() / n as f64
}

/// Instances of a level's objects.
fn grouping(world: &World, objects: &Objects) -> Grouping {
    let mut matches = Vec::new();
    for (k, masks) in objects.masks.iter().enumerate() {
        // The largest mask of each view.
        let mut views = BTreeMap::<u32, Match>::new();
        for &r in masks {
            let row = &world.footprints.rows[r as usize];
            let visible = row.pixels as f32 * row.alpha;
            let found = Match { instance: k as u32, view: row.view, mask: row.mask, score: row.alpha, visible };
            let best = views.entry(row.view).or_insert(found);
            if found.visible > best.visible {
                *best = found;
            }
        }
        matches.extend(views.into_values());
    }
    Grouping {
        labels: world.spread(&objects.labels),
        instances: objects.masks.len(),
        matches,
        descriptors: objects.means.concat(),
        scores: Vec::new(),
    }
}

/// A row for each combination of objects that some of `n` Gaussians has on the levels, with the descriptors of all of them.
fn table(levels: &[Objects], n: usize, dim: usize) -> Table {
    let key = |i: usize| levels.iter().map(|l| l.labels[i]).collect::<Vec<i32>>();
    let mut rows: BTreeMap<Vec<i32>, u32> = (0..n).map(|i| (key(i), 0)).collect();
    rows.values_mut().enumerate().for_each(|(at, row)| *row = at as u32);
    let of = |key: &[i32]| -> Vec<&Vec<f32>> {
        let objects = levels.iter().zip(key).filter_map(|(l, &k)| l.descriptors.get(usize::try_from(k).ok()?));
        objects.flatten().collect()
    };
    let slots = rows.keys().map(|k| of(k).len()).max().unwrap_or(0).max(1);
    let mut values = vec![0.0; rows.len() * slots * dim];
    for (key, &row) in &rows {
        for (slot, descriptor) in of(key).into_iter().enumerate() {
            let at = (row as usize * slots + slot) * dim;
            values[at..at + dim].copy_from_slice(descriptor);
        }
    }
    Table { rows: (0..n).map(|i| rows[&key(i)]).collect(), slots, dim, values }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr2;

    fn gram(points: &[[f64; 2]]) -> Vec<f64> {
        points.iter().flat_map(|a| points.iter().map(move |b| a[0] * b[0] + a[1] * b[1])).collect()
    }

    #[test]
    fn a_prototype_is_the_unit_mean_of_features() {
        // 3 (1, 0) + 4 (0, 1) has length 5.
        let features = [1.0, 0.0, 0.0, 1.0];
        assert_eq!(prototype([(0, 3.0), (1, 4.0)].into_iter(), &features, 2), Some(vec![0.6, 0.8]));
        assert_eq!(prototype([(0, 0.0)].into_iter(), &features, 2), None);
    }

    #[test]
    fn features_are_of_unit_length_and_smoothed_over_neighbours() {
        assert_eq!(affinity(&Features { kept: vec![0], values: arr2(&[[3.0, 4.0]]) }), [0.6, 0.8]);
        let half = 0.5f32.sqrt();
        // Three in a row, each with the first of its neighbours: (1, 0) + (0, 1) twice, (0, 1) alone.
        let smoothed = smoothed(&[1.0, 0.0, 0.0, 1.0, 0.0, 1.0], 2, &arr2(&[[1], [0], [1]]), 2);
        smoothed.iter().zip([half, half, half, half, 0.0, 1.0]).for_each(|(a, b)| assert!((a - b).abs() < 1e-6));
    }

    #[test]
    fn gaussians_join_the_most_similar_object() {
        let centres = [1.0, 0.0, 0.0, 1.0];
        let features = [0.6, 0.8, 0.8, 0.6, 0.0, 0.0, -1.0, 0.0];
        assert_eq!(most_alike(&features, 2, &centres, -1.0), [1, 0, -1, 1]);
        assert_eq!(most_alike(&features, 2, &centres, 0.1), [1, 0, -1, -1]);
        assert_eq!(most_alike(&features, 2, &[], -1.0), [-1; 4]);
    }

    #[test]
    fn a_silhouette_compares_distances_inside_and_outside() {
        // On a line 0, 1 | 5: of 0 (5 - 1) / 5, of 1 (4 - 1) / 4, alone 0: 1.55 / 3.
        let g = gram(&[[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]]);
        assert!((silhouette(&g, 3, 2, &[0, 0, 1]) - 1.55 / 3.0).abs() < 1e-9);
        assert_eq!(silhouette(&g, 3, 3, &[0, 0, 1]), -1.0);
    }

    #[test]
    fn k_means_finds_groups_and_their_cost() {
        // Centres 0.5 and 5.5: four times a quarter.
        let g = gram(&[[0.0, 0.0], [1.0, 0.0], [5.0, 0.0], [6.0, 0.0]]);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (groups, cost) = k_means(&g, 4, 2, &mut rng);
        assert!(groups[0] == groups[1] && groups[2] == groups[3] && groups[0] != groups[2]);
        assert!((cost - 1.0).abs() < 1e-9);
        assert_eq!(best_groups(&g, 4, 20, 7), best_groups(&g, 4, 20, 7));
        // Two points or fewer, and equal points, are one group.
        assert_eq!(best_groups(&gram(&[[1.0, 0.0], [0.0, 1.0]]), 2, 20, 0), [0, 0]);
        assert_eq!(best_groups(&[1.0; 9], 3, 20, 0), [0; 3]);
    }

    #[test]
    fn a_descriptor_weighs_its_agreement_with_the_mean() {
        // Two directions, four masks and two: the mean is (4, 2) / sqrt(20); the weights 0.894 and 0.447, half of it.
        let features: Vec<Vec<f32>> = (0..6).map(|i| if i < 4 { vec![1.0, 0.0] } else { vec![0.0, 1.0] }).collect();
        assert_eq!(describe(&features, 20, 0.6, 0), [vec![1.0, 0.0]]);
        let mut both = describe(&features, 20, 0.4, 0);
        both.sort_by(|a, b| a[0].total_cmp(&b[0]));
        assert_eq!(both, [vec![0.0, 1.0], vec![1.0, 0.0]]);
        assert!(describe(&[], 20, 0.0, 0).is_empty());
    }

    #[test]
    fn a_row_holds_the_descriptors_of_all_levels() {
        let level = |labels: Vec<i32>, values: &[&[f32]]| Objects {
            labels,
            descriptors: values.iter().map(|o| o.iter().map(|&v| vec![v]).collect()).collect(),
            ..Objects::default()
        };
        let levels = [level(vec![0, 0, -1], &[&[1.0, 2.0]]), level(vec![0, 1, -1], &[&[3.0], &[]])];
        let table = table(&levels, 3, 1);
        // Rows in order of (-1, -1), (0, 0), (0, 1).
        assert_eq!((table.rows, table.slots), (vec![1, 2, 0], 3));
        assert_eq!(table.values, [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 1.0, 2.0, 0.0]);
    }
}
