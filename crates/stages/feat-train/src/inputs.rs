//! Graph and footprints, read and checked against each other and the geometry.

use crate::options::Args;
use artifacts::{Footprints, Graph, role};
use gs_io::{Error, Result, hash_file};
use std::collections::BTreeMap;

/// The inputs, but for the geometry, of which only training needs more than its hash.
pub struct Inputs {
    pub graph: Graph,
    pub footprints: Footprints,
    /// Hashes of all inputs, by role.
    pub hashes: BTreeMap<String, String>,
}

impl Inputs {
    /// Reads the files that `args` names, and refuses those that are not of one run.
    pub fn read(args: &Args) -> Result<Self> {
        let geometry = hash_file(&args.geometry)?;
        let (graph, graph_file) = Graph::read(&args.graph)?;
        graph_file.expect_input(role::GEOMETRY, &geometry)?;
        let footprints = Footprints::read(&args.footprints)?;
        // Made in one run: same parents, same parameters, same kept Gaussians.
        let mut hashes = graph_file.provenance().inputs.clone();
        for (role, hash) in &hashes {
            footprints.artifact().expect_input(role, hash)?;
        }
        if let Some((found, expected)) = difference(&footprints.kept, &graph.kept) {
            return Err(Error::new("does not belong to this graph: it keeps other Gaussians")
                .file(&args.footprints)
                .field("kept")
                .found(found)
                .expected(expected)
                .hint("give --graph and --footprints files of one run of graph-precompute"));
        }
        hashes.insert(role::GRAPH.into(), graph_file.hash().into());
        hashes.insert(role::FOOTPRINTS.into(), footprints.artifact().hash().into());
        Ok(Self { graph, footprints, hashes })
    }
}

/// Where two lists of kept Gaussians differ: what the footprints have, and what the graph has.
fn difference(footprints: &[u32], graph: &[u32]) -> Option<(String, String)> {
    if footprints.len() != graph.len() {
        return Some((format!("{} Gaussians", footprints.len()), format!("{}, as in the graph", graph.len())));
    }
    let at = footprints.iter().zip(graph).position(|(a, b)| a != b)?;
    Some((format!("Gaussian {} at position {at}", footprints[at]), format!("{}, as in the graph", graph[at])))
}
