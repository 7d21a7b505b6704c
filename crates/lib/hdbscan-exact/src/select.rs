//! Which clusters of the condensed tree are the result, and who belongs to them.

use crate::condense::CondensedTree;
use crate::{Clustering, Options};

/// How clusters are chosen from the hierarchy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Selection {
    /// Those of largest total stability that do not overlap.
    ExcessOfMass,
    /// The leaves: the finest clusters.
    Leaf,
}

/// What an infinite lambda (coincident points) counts in a stability: more than any finite one, but still a number that
/// can be added and compared.
const LAMBDA_CAP: f64 = 1e30;

/// The clusters of a condensed tree, numbered from 0 (the root). Parents have smaller numbers than their children.
pub(crate) struct Clusters {
    /// Lambda at which each was born; 0 for the root.
    pub birth: Vec<f64>,
    pub parent: Vec<Option<usize>>,
    children: Vec<Vec<usize>>,
    /// Sum over what leaves the cluster of (lambda - birth) * size.
    stability: Vec<f64>,
    /// Largest finite lambda at which something leaves the cluster.
    death: Vec<f64>,
}

impl Clusters {
    pub fn new(tree: &CondensedTree) -> Self {
        let (m, k) = (tree.points as usize, tree.clusters as usize);
        let mut out = Self {
            birth: vec![0.0; k],
            parent: vec![None; k],
            children: vec![Vec::new(); k],
            stability: vec![0.0; k],
            death: vec![0.0; k],
        };
        for e in tree.edges.iter().filter(|e| e.child as usize >= m) {
            let (p, c) = (e.parent as usize - m, e.child as usize - m);
            out.birth[c] = e.lambda;
            out.parent[c] = Some(p);
            out.children[p].push(c);
        }
        for e in &tree.edges {
            let p = e.parent as usize - m;
            // Equal infinities differ by nothing.
            let excess = if e.lambda == out.birth[p] { 0.0 } else { (e.lambda - out.birth[p]).min(LAMBDA_CAP) };
            out.stability[p] += excess * f64::from(e.size);
            if e.lambda.is_finite() {
                out.death[p] = out.death[p].max(e.lambda);
            }
        }
        out
    }

    fn len(&self) -> usize {
        self.birth.len()
    }

    /// Distance at which a cluster was born; infinite for the root.
    fn distance(&self, c: usize) -> f64 {
        if self.birth[c] > 0.0 { 1.0 / self.birth[c] } else { f64::INFINITY }
    }

    /// The chosen cluster, as an index into `selected` (ascending), at or above each cluster.
    pub fn labels(&self, selected: &[usize]) -> Vec<Option<usize>> {
        let mut out: Vec<Option<usize>> = vec![None; self.len()];
        for c in 0..self.len() {
            out[c] = selected.binary_search(&c).ok().or(self.parent[c].and_then(|p| out[p]));
        }
        out
    }

    /// Where the root is a cluster, points that leave it before this lambda are noise, as in scikit-learn: all cut off above
    /// epsilon, or, without epsilon, before the last.
    pub fn least_in_root(&self, tree: &CondensedTree, epsilon: f64) -> f64 {
        if epsilon > 0.0 {
            return 1.0 / epsilon;
        }
        tree.edges.iter().filter(|e| e.parent == tree.points).map(|e| e.lambda).fold(0.0, f64::max)
    }

    /// How firmly what leaves at `lambda` belongs to a cluster, 0 to 1.
    pub fn probability(&self, cluster: usize, lambda: f64) -> f32 {
        let death = self.death[cluster];
        if death == 0.0 || lambda >= death { 1.0 } else { (lambda / death) as f32 }
    }

    /// Largest finite lambda at which something leaves each cluster or one below it.
    fn last_deaths(&self) -> Vec<f64> {
        let mut out = self.death.clone();
        for c in (1..self.len()).rev() {
            if let Some(p) = self.parent[c] {
                out[p] = out[p].max(out[c]);
            }
        }
        out
    }

    fn excess_of_mass(&self, allow_root: bool) -> Vec<bool> {
        let mut chosen = vec![false; self.len()];
        let mut best = self.stability.clone();
        for c in (0..self.len()).rev() {
            if c == 0 && !allow_root {
                continue;
            }
            let below: f64 = self.children[c].iter().map(|&x| best[x]).sum();
            // A part of a graph that nothing joins to the rest is a root of its own. Born at lambda 0 it would outweigh all that
            // it divides into, as the root would.
            let root_of_part = self.birth[c] == 0.0 && !self.children[c].is_empty() && !allow_root;
            if below > best[c] || root_of_part {
                best[c] = below;
            } else {
                chosen[c] = true;
            }
        }
        self.keep_topmost(&mut chosen);
        chosen
    }

    fn leaves(&self, allow_root: bool) -> Vec<bool> {
        (0..self.len()).map(|c| self.children[c].is_empty() && (c > 0 || allow_root)).collect()
    }

    /// Of chosen clusters that lie within one another only the outermost stay.
    fn keep_topmost(&self, chosen: &mut [bool]) {
        let mut covered = vec![false; self.len()];
        for c in 0..self.len() {
            covered[c] = self.parent[c].is_some_and(|p| covered[p] || chosen[p]);
            chosen[c] &= !covered[c];
        }
    }

    /// Chosen clusters that were born below the distance `epsilon` give way to their first ancestor that was born above it
    /// (Malzer and Baum 2020).
    fn join_below(&self, epsilon: f64, allow_root: bool, chosen: &mut [bool]) {
        // Where a cluster ends that climbs.
        let mut end: Vec<usize> = (0..self.len()).collect();
        for c in 0..self.len() {
            end[c] = match self.parent[c] {
                Some(0) if !allow_root => c,
                Some(p) if self.distance(p) > epsilon => p,
                Some(p) => end[p],
                None => c,
            };
        }
        let before = chosen.to_vec();
        chosen.fill(false);
        for c in (0..self.len()).filter(|&c| before[c]) {
            chosen[if self.distance(c) < epsilon { end[c] } else { c }] = true;
        }
        self.keep_topmost(chosen);
    }
}

/// Selects clusters and labels points; `of_point` gives the distinct point of each original one.
pub(crate) fn label(tree: CondensedTree, of_point: &[u32], options: &Options) -> Clustering {
    let m = tree.points as usize;
    let clusters = Clusters::new(&tree);
    let mut chosen = match options.selection {
        Selection::Leaf => clusters.leaves(options.allow_single_cluster),
        Selection::ExcessOfMass => clusters.excess_of_mass(options.allow_single_cluster),
    };
    if options.epsilon > 0.0 {
        clusters.join_below(options.epsilon, options.allow_single_cluster, &mut chosen);
    }
    let selected: Vec<usize> = (0..clusters.len()).filter(|&c| chosen[c]).collect();
    let label_of = clusters.labels(&selected);
    let least_in_root = clusters.least_in_root(&tree, options.epsilon);
    let last = clusters.last_deaths();
    let mut outlier_scores = vec![0.0f32; m];
    let mut labels = vec![-1i32; m];
    let mut nodes = vec![tree.points; m];
    let mut probabilities = vec![0.0f32; m];
    for e in tree.edges.iter().filter(|e| (e.child as usize) < m) {
        let c = e.parent as usize - m;
        nodes[e.child as usize] = e.parent;
        if last[c] > 0.0 && e.lambda < last[c] {
            outlier_scores[e.child as usize] = ((last[c] - e.lambda) / last[c]) as f32;
        }
        let Some(label) = label_of[c] else { continue };
        if selected[label] == 0 && e.lambda < least_in_root {
            continue;
        }
        labels[e.child as usize] = label as i32;
        probabilities[e.child as usize] = clusters.probability(selected[label], e.lambda);
    }
    Clustering {
        labels: of_point.iter().map(|&u| labels[u as usize]).collect(),
        probabilities: of_point.iter().map(|&u| probabilities[u as usize]).collect(),
        outlier_scores: of_point.iter().map(|&u| outlier_scores[u as usize]).collect(),
        nodes: of_point.iter().map(|&u| nodes[u as usize]).collect(),
        distinct: of_point.to_vec(),
        tree,
        selected: selected.iter().map(|&c| (c + m) as u32).collect(),
    }
}
