//! What the page asks a server: what is at a pixel, what a text means, the Gaussians of a selection.

use crate::cells::Cells;
use crate::world::{Edited, World};
use artifacts::runs_of;
use glam::{DMat3, DVec3};
use gs_io::{Error, Result};
use gs_scene::Camera;
use query::{Index, Verdict};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Most pixels along a side of a picture that the page asks about.
const LARGEST_SIDE: u32 = 1 << 15;

/// A pinhole camera as the page writes it.
#[derive(Debug, Clone, Deserialize)]
pub struct PageCamera {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    /// By rows, camera from world.
    rotation: [f64; 9],
    translation: [f64; 3],
}

impl PageCamera {
    fn camera(&self) -> Result<Camera> {
        let numbers = [self.fx, self.fy, self.cx, self.cy].into_iter().chain(self.rotation).chain(self.translation);
        let sides = [self.width, self.height];
        if !numbers.into_iter().all(f64::is_finite)
            || !sides.iter().all(|s| (1..=LARGEST_SIDE).contains(s))
            || self.fx <= 0.0
            || self.fy <= 0.0
        {
            return Err(Error::new("not a camera")
                .field("camera")
                .expected("finite numbers, positive focal lengths and sizes"));
        }
        Ok(Camera {
            width: self.width,
            height: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx,
            cy: self.cy,
            rotation: DMat3::from_cols_array(&self.rotation).transpose(),
            translation: DVec3::from(self.translation),
        })
    }
}

/// A click.
#[derive(Debug, Clone, Deserialize)]
pub struct Click {
    camera: PageCamera,
    x: u32,
    y: u32,
    /// Cells that are not shown.
    #[serde(default)]
    hidden: Vec<u32>,
}

/// What is at a pixel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Picked {
    /// The instance with the largest blending weight there; none where that is noise or nothing.
    pub instance: Option<u32>,
    /// The cell of largest weight within it.
    pub cell: Option<u32>,
    /// Where in the world: the mean of the Gaussians that are seen there, by weight.
    pub position: Option<[f64; 3]>,
    /// Accumulated alpha, 0 to 1.
    pub alpha: f64,
}

/// What is at a pixel, by the rasteriser's weights.
///
/// # Errors
/// When the camera or the pixel cannot be.
pub fn pick(world: &World, edited: &Edited, click: &Click) -> Result<Picked> {
    let camera = click.camera.camera()?;
    if click.x >= camera.width || click.y >= camera.height {
        return Err(Error::new("the pixel lies outside of the picture").field("x, y"));
    }
    let cells = &edited.cells;
    let shown = marked(cells, &click.hidden, "hidden", false)?;
    let cell_of = |i: u32| cells.of[i as usize];
    let seen = |i: u32| shown[cell_of(i) as usize];
    let g = world.gaussians();
    let (raster, pixel) = (&world.scene.raster, [click.x, click.y]);
    let near = world.reach.candidates(g, &world.packed.order, &camera, f64::from(raster.near), pixel);
    let near: Vec<u32> = near.into_iter().filter(|&i| seen(i)).collect();
    let weights = query::pixel_weights(&g.select(&near), &camera, raster, pixel);
    let weights: Vec<(u32, f64)> = weights.into_iter().map(|(i, w)| (near[i as usize], w)).collect();
    let alpha: f64 = weights.iter().map(|w| w.1).sum();
    let mut of_instance = BTreeMap::<i32, f64>::new();
    let mut of_cell = BTreeMap::<u32, (i32, f64)>::new();
    let mut position = [0.0; 3];
    for &(i, w) in &weights {
        let label = edited.instances.label[i as usize];
        *of_instance.entry(label).or_default() += w;
        // What the edits made of a cell: all of it belongs to one instance.
        of_cell.entry(cell_of(i)).or_insert((label, 0.0)).1 += w;
        (0..3).for_each(|k| position[k] += w / alpha * f64::from(g.means[i as usize][k]));
    }
    let most = |a: &(i32, f64), b: &(i32, f64)| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0));
    let best = of_instance.into_iter().max_by(most).map(|(label, _)| label);
    let own = of_cell.iter().filter(|(_, (label, _))| Some(*label) == best);
    let cell = own.max_by(|a, b| a.1.1.total_cmp(&b.1.1)).map(|(&c, _)| c);
    Ok(Picked {
        instance: best.and_then(|l| u32::try_from(l).ok()),
        cell,
        position: (alpha > 0.0).then_some(position),
        alpha,
    })
}

/// `mark` for these cells, the contrary for all others.
fn marked(cells: &Cells, these: &[u32], field: &str, mark: bool) -> Result<Vec<bool>> {
    let mut marks = vec![!mark; cells.pairs.len()];
    for &cell in these {
        *marks.get_mut(cell as usize).ok_or_else(|| Error::new("no such cell").field(field).found(cell))? = mark;
    }
    Ok(marks)
}

/// An outline around Gaussians that belong, or don't belong, to an instance.
#[derive(Debug, Clone, Deserialize)]
pub struct Lasso {
    camera: PageCamera,
    /// Its corners in pixels.
    outline: Vec<[f64; 2]>,
    /// Cells that are not shown.
    hidden: Vec<u32>,
    instance: i32,
    /// Whether those of the instance are wanted, or those that it has not.
    own: bool,
}

/// What a lasso catches.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Caught {
    /// As [`artifacts::runs_of`] writes them; empty where there are none.
    pub gaussians: String,
    /// How many.
    pub count: usize,
}

/// Most corners of an outline, and pixels of its picture: four times a screen of 4K.
const MOST_CORNERS: usize = 10_000;
const MOST_PIXELS: u64 = 1 << 25;
/// A Gaussian is seen where at least this share of the light from its centre gets through what lies before it. From a view of the
/// demo a half leaves nine of ten Gaussians of a thing where they are; a tenth takes four, and with a hundred one of what lies behind.
const SEEN: f32 = 0.1;

/// The Gaussians whose centres are seen within an outline, by the rasteriser's weights: what lies behind a thing is not caught.
///
/// # Errors
/// When the camera or the outline cannot be.
pub fn lasso(world: &World, edited: &Edited, lasso: &Lasso) -> Result<Caught> {
    let camera = lasso.camera.camera()?;
    let pixels = u64::from(camera.width) * u64::from(camera.height);
    if pixels > MOST_PIXELS {
        let e = Error::new("the picture is too large").field("camera").found(format!("{pixels} pixels"));
        return Err(e.expected(format!("at most {MOST_PIXELS}")));
    }
    let corners = lasso.outline.len();
    if !(3..=MOST_CORNERS).contains(&corners) || !lasso.outline.as_flattened().iter().all(|v| v.is_finite()) {
        let e = Error::new("not an outline").field("outline").found(format!("{corners} corners"));
        return Err(e.expected(format!("3 to {MOST_CORNERS} points, finite numbers")));
    }
    let cells = &edited.cells;
    let shown = marked(cells, &lasso.hidden, "hidden", false)?;
    let drawn: Vec<u32> = (0..cells.of.len() as u32).filter(|&i| shown[cells.of[i as usize] as usize]).collect();
    let some = if lasso.hidden.is_empty() { None } else { Some(world.gaussians().select(&drawn)) };
    let g = some.as_ref().unwrap_or(world.gaussians());
    let (w, h) = (camera.width as usize, camera.height as usize);
    let inside = outlined(&lasso.outline, w, h);
    let label = |i: u32| edited.instances.label[drawn[i as usize] as usize];
    let caught = query::tile_weights(g, &camera, &world.scene.raster, true, |t| {
        let seen = |(at, &i): (usize, &u32)| {
            let (x, y, _) = camera.project(DVec3::from(g.means[i as usize].map(f64::from)));
            let (x, y) = (x.floor(), y.floor());
            let within = |v: f64, from: usize, size: usize| v >= from as f64 && v < (from + size) as f64;
            if !within(x, t.x0, t.width) || !within(y, t.y0, t.height) || (label(i) == lasso.instance) != lasso.own {
                return None;
            }
            let (x, y) = (x as usize, y as usize);
            let (alpha, weight) = t.of(at, x, y);
            (inside[y * w + x] && alpha > 0.0 && weight >= SEEN * alpha).then_some(drawn[i as usize])
        };
        t.gaussians.iter().enumerate().filter_map(seen).collect::<Vec<u32>>()
    });
    let mut caught = caught.concat();
    caught.sort_unstable();
    Ok(Caught { gaussians: runs_of(&caught), count: caught.len() })
}

/// Which pixels of a picture have their middle within an outline, by rows; where it crosses itself, those an odd number of times within.
fn outlined(outline: &[[f64; 2]], w: usize, h: usize) -> Vec<bool> {
    let mut inside = vec![false; w * h];
    for (y, row) in inside.chunks_exact_mut(w).enumerate() {
        let middle = y as f64 + 0.5;
        let sides = outline.iter().zip(outline.iter().cycle().skip(1));
        for (&[ax, ay], &[bx, by]) in sides.filter(|(a, b)| (a[1] <= middle) != (b[1] <= middle)) {
            let x = ax + (middle - ay) / (by - ay) * (bx - ax);
            // All to the right of the side change.
            row.iter_mut().skip((x - 0.5).ceil().max(0.0) as usize).for_each(|v| *v = !*v);
        }
    }
    inside
}

/// What a text finds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    /// The text, as it was asked.
    pub text: String,
    /// Score of every instance, none for one without a descriptor; empty where only names answer.
    pub scores: Vec<Option<f32>>,
    /// Instances that a person gave a name which holds the text.
    pub named: Vec<u32>,
    /// Whether the text matches anything; none where that is not judged.
    pub verdict: Option<Verdict>,
}

/// Characters that a text may have at most. CLIP reads 77 tokens; more only keeps a processor busy.
const LONGEST_TEXT: usize = 1000;

/// What a text finds.
///
/// # Errors
/// When the text is too long, or a table of text features does not have it.
pub fn find(world: &World, edited: &Edited, text: &str) -> Result<Found> {
    let length = text.chars().count();
    if length > LONGEST_TEXT {
        let e = Error::new("the text is too long").field("text").found(format!("{length} characters"));
        return Err(e.expected(format!("at most {LONGEST_TEXT}")));
    }
    let wanted = text.trim().to_lowercase();
    let named: Vec<u32> = edited
        .remarks
        .names
        .iter()
        .filter(|(_, name)| name.to_lowercase().contains(&wanted))
        .map(|(&k, _)| k)
        .collect();
    let feature = match &world.words {
        Ok(source) => source.known(&[], &[text.trim().to_string()], "text").map(|features| features[0].clone()),
        Err(why) => Err(Error::new(why.clone())),
    };
    match feature {
        Ok(feature) => Ok(Found { named, ..answer(world, edited, text, &feature) }),
        Err(_) if !named.is_empty() => Ok(Found { text: text.into(), scores: Vec::new(), named, verdict: None }),
        Err(e) => Err(e),
    }
}

/// What a text of this feature finds, whatever instances are named.
pub fn answer(world: &World, edited: &Edited, text: &str, feature: &[f32]) -> Found {
    let scores = Index::new(&edited.instances).scores(feature, &[]);
    Found { text: text.into(), scores, named: Vec::new(), verdict: edited.verdict(world, feature) }
}

/// What to save as a PLY.
#[derive(Debug, Clone, Deserialize)]
pub struct Export {
    /// Cells whose Gaussians are meant.
    cells: Vec<u32>,
    /// All others instead.
    #[serde(default)]
    others: bool,
}

/// The Gaussians of some cells, or all others, with all their harmonics, ascending.
///
/// # Errors
/// When there is no such cell or nothing is left.
pub fn selection(cells: &Cells, export: &Export) -> Result<Vec<u32>> {
    let meant = marked(cells, &export.cells, "cells", !export.others)?;
    let chosen: Vec<u32> = (0..cells.of.len() as u32).filter(|&i| meant[cells.of[i as usize] as usize]).collect();
    if chosen.is_empty() {
        return Err(Error::new("nothing is selected: there is nothing to save"));
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_within_where_their_middle_is() {
        let rows = |outline: &[[f64; 2]]| -> Vec<String> {
            let inside = outlined(outline, 6, 4);
            inside.chunks(6).map(|r| r.iter().map(|&v| if v { '#' } else { '.' }).collect()).collect()
        };
        assert_eq!(rows(&[[1.0, 1.0], [4.0, 1.0], [4.0, 3.0], [1.0, 3.0]]), ["......", ".###..", ".###..", "......"]);
        // Partly outside of the picture, and the other way around.
        assert_eq!(rows(&[[-9.0, -9.0], [-9.0, 9.0], [2.6, 9.0], [2.6, -9.0]]), ["###..."; 4]);
        assert_eq!(rows(&[[0.0, 0.0], [4.0, 4.0], [0.0, 4.0]]), ["......", "#.....", "##....", "###..."]);
    }
}
