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

/// Selects clusters and labels points; `of_point` gives the distinct point of each original one.
pub(crate) fn label(tree: CondensedTree, of_point: &[u32], options: &Options) -> Clustering {
    let (m, k) = (tree.points as usize, tree.clusters as usize);
    let cluster = |node: u32| node as usize - m;
    let mut birth = vec![0.0f64; k];
    let mut parent: Vec<Option<usize>> = vec![None; k];
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); k];
    for e in tree.edges.iter().filter(|e| e.child as usize >= m) {
        let (p, c) = (cluster(e.parent), cluster(e.child));
        birth[c] = e.lambda;
        parent[c] = Some(p);
        children[p].push(c);
    }
    // Stability: sum over what leaves of (lambda - birth) * size. Equal infinities count as nothing.
    let mut stability = vec![0.0f64; k];
    for e in &tree.edges {
        let p = cluster(e.parent);
        let excess = if e.lambda == birth[p] { 0.0 } else { (e.lambda - birth[p]).min(1e30) };
        stability[p] += excess * f64::from(e.size);
    }

    let mut chosen = vec![false; k];
    match options.selection {
        Selection::Leaf => {
            for c in 0..k {
                chosen[c] = children[c].is_empty() && (c > 0 || options.allow_single_cluster);
            }
        }
        Selection::ExcessOfMass => {
            let mut best = stability.clone();
            // Children have larger numbers than their parents.
            for c in (0..k).rev() {
                if c == 0 && !options.allow_single_cluster {
                    continue;
                }
                let below: f64 = children[c].iter().map(|&x| best[x]).sum();
                if children[c].is_empty() || stability[c] >= below {
                    chosen[c] = true;
                } else {
                    best[c] = below;
                }
            }
            // Only the topmost of those chosen count.
            for c in 0..k {
                let mut up = parent[c];
                while let Some(p) = up {
                    if chosen[p] {
                        chosen[c] = false;
                        break;
                    }
                    up = parent[p];
                }
            }
        }
    }
    if options.epsilon > 0.0 {
        join_below_epsilon(&mut chosen, &birth, &parent, options);
    }

    let selected: Vec<u32> = (0..k).filter(|&c| chosen[c]).map(|c| (c + m) as u32).collect();
    let mut label_of = vec![-1i32; k];
    // Each cluster belongs to the nearest chosen one at or above it.
    let mut next = 0;
    for c in 0..k {
        if chosen[c] {
            label_of[c] = next;
            next += 1;
        } else if let Some(p) = parent[c] {
            label_of[c] = label_of[p];
        }
    }
    // Lambda at which each distinct point leaves the tree, and the largest in each cluster.
    let mut point_label = vec![-1i32; m];
    let mut point_lambda = vec![0.0f64; m];
    let mut largest = vec![0.0f64; selected.len()];
    let root_chosen = k > 0 && chosen[0];
    // With the root as the one cluster, points that leave it before its last split are noise, as in the reference.
    let root_limit = if options.epsilon > 0.0 {
        1.0 / options.epsilon
    } else {
        tree.edges.iter().filter(|e| cluster_is_root(e.parent, m)).map(|e| e.lambda).fold(0.0, f64::max)
    };
    for e in tree.edges.iter().filter(|e| (e.child as usize) < m) {
        let c = cluster(e.parent);
        let l = label_of[c];
        let stays = !(root_chosen && c == 0) || e.lambda >= root_limit;
        if l >= 0 && stays {
            point_label[e.child as usize] = l;
            point_lambda[e.child as usize] = e.lambda;
            if e.lambda.is_finite() {
                largest[l as usize] = largest[l as usize].max(e.lambda);
            }
        }
    }
    let probability = |u: usize| {
        let l = point_label[u];
        if l < 0 {
            return 0.0;
        }
        let most = largest[l as usize];
        if most == 0.0 || !point_lambda[u].is_finite() { 1.0 } else { (point_lambda[u] / most).min(1.0) as f32 }
    };
    Clustering {
        labels: of_point.iter().map(|&u| point_label[u as usize]).collect(),
        probabilities: of_point.iter().map(|&u| probability(u as usize)).collect(),
        tree,
        selected,
    }
}

fn cluster_is_root(node: u32, m: usize) -> bool {
    node as usize == m
}

/// Chosen clusters that were born below the distance epsilon give way to their first ancestor that was not.
fn join_below_epsilon(chosen: &mut [bool], birth: &[f64], parent: &[Option<usize>], options: &Options) {
    let distance = |c: usize| if birth[c] > 0.0 { 1.0 / birth[c] } else { f64::INFINITY };
    let k = chosen.len();
    let before = chosen.to_vec();
    chosen.fill(false);
    for c in 0..k {
        if !before[c] {
            continue;
        }
        let mut at = c;
        while distance(at) < options.epsilon {
            match parent[at] {
                // The root was born at infinite distance; it is a cluster only where that is allowed.
                Some(0) if !options.allow_single_cluster => break,
                Some(p) => at = p,
                None => break,
            }
        }
        chosen[at] = true;
    }
    // Of clusters above one another only the topmost stays.
    for c in 0..k {
        let mut up = parent[c];
        while let Some(p) = up {
            if chosen[p] {
                chosen[c] = false;
                break;
            }
            up = parent[p];
        }
    }
}
