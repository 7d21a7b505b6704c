//! Which meshes a glTF's scene shows, and where.

use super::FLIPS;
use glam::{DMat4, DQuat, DVec3, DVec4};
use gs_io::{Error, Result};
use serde_json::Value;

/// Nodes that are visited at most: a node may be reached in one way only, but a damaged file may go in circles.
const MOST_NODES: usize = 100_000;

/// A map of glTF's axes as one that ends in ours: the flips come last.
pub(super) fn ours(map: DMat4) -> DMat4 {
    DMat4::from_scale(DVec3::from(FLIPS)) * map
}

/// The meshes that the scene shows and the maps from their axes to the scene's, in the order of its nodes; all meshes where
/// there are no nodes.
pub(super) fn placed_meshes(description: &Value) -> Result<Vec<(DMat4, usize)>> {
    let nodes = description["nodes"].as_array();
    let Some(nodes) = nodes.filter(|n| !n.is_empty()) else {
        let meshes = description["meshes"].as_array().map_or(0, Vec::len);
        return Ok((0..meshes).map(|m| (DMat4::IDENTITY, m)).collect());
    };
    let scene = description["scene"].as_u64().unwrap_or(0) as usize;
    let mut to_visit: Vec<(DMat4, u64)> = match description["scenes"][scene]["nodes"].as_array() {
        Some(roots) => roots.iter().rev().filter_map(Value::as_u64).map(|n| (DMat4::IDENTITY, n)).collect(),
        None => (0..nodes.len() as u64).rev().map(|n| (DMat4::IDENTITY, n)).collect(),
    };
    let mut placed = Vec::new();
    let mut visits = 0;
    while let Some((above, index)) = to_visit.pop() {
        visits += 1;
        if visits > MOST_NODES.min(nodes.len()) {
            return Err(Error::new("a node is reached in two ways, or is its own child").field("nodes"));
        }
        let node = nodes.get(index as usize).ok_or_else(|| Error::new("no such node").field("nodes").found(index))?;
        let map = above * local(node).map_err(|e| e.field(format!("nodes[{index}]")))?;
        placed.extend(node["mesh"].as_u64().map(|m| (map, m as usize)));
        to_visit.extend(
            node["children"].as_array().into_iter().flatten().rev().filter_map(Value::as_u64).map(|c| (map, c)),
        );
    }
    Ok(placed)
}

/// A node's own transform.
fn local(node: &Value) -> Result<DMat4> {
    let numbers = |key: &str, count: usize| -> Result<Option<Vec<f64>>> {
        if node[key].is_null() {
            return Ok(None);
        }
        let list: Option<Vec<f64>> = node[key].as_array().and_then(|l| l.iter().map(Value::as_f64).collect());
        let list = list.filter(|l| l.len() == count);
        list.map(Some).ok_or_else(|| Error::new(format!("{key} is not {count} numbers")))
    };
    if let Some(matrix) = numbers("matrix", 16)? {
        return Ok(DMat4::from_cols_slice(&matrix));
    }
    let vector = |key: &str, default: DVec3| Ok(numbers(key, 3)?.map_or(default, |v| DVec3::from_slice(&v)));
    let rotation = numbers("rotation", 4)?.map_or(DQuat::IDENTITY, |q| DQuat::from_vec4(DVec4::from_slice(&q)));
    let (scale, translation) = (vector("scale", DVec3::ONE)?, vector("translation", DVec3::ZERO)?);
    Ok(DMat4::from_scale_rotation_translation(scale, rotation.normalize(), translation))
}
