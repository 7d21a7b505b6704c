//! What the page asks a server: what is at a pixel, what a text means, the Gaussians of a selection.

use crate::world::{Edited, World};
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
    let mut shown = vec![true; world.cells.len()];
    for &cell in &click.hidden {
        *shown.get_mut(cell as usize).ok_or_else(|| Error::new("no such cell").field("hidden").found(cell))? = false;
    }
    let cell_of = |i: u32| world.cell_of[i as usize];
    let seen = |i: u32| shown[cell_of(i) as usize];
    let g = world.gaussians();
    let (raster, pixel) = (&world.scene.raster, [click.x, click.y]);
    let near = world.reach.candidates(g, &world.packed.order, &camera, f64::from(raster.near), pixel);
    let near: Vec<u32> = near.into_iter().filter(|&i| seen(i)).collect();
    let weights = query::pixel_weights(&g.select(&near), &camera, raster, pixel);
    let weights: Vec<(u32, f64)> = weights.into_iter().map(|(i, w)| (near[i as usize], w)).collect();
    let alpha: f64 = weights.iter().map(|w| w.1).sum();
    let mut of_instance = BTreeMap::<i32, f64>::new();
    let mut of_cell = BTreeMap::<u32, f64>::new();
    let mut position = [0.0; 3];
    for &(i, w) in &weights {
        *of_instance.entry(edited.instances.label[i as usize]).or_default() += w;
        *of_cell.entry(cell_of(i)).or_default() += w;
        (0..3).for_each(|k| position[k] += w / alpha * f64::from(g.means[i as usize][k]));
    }
    let most = |a: &(i32, f64), b: &(i32, f64)| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0));
    let best = of_instance.into_iter().max_by(most).map(|(label, _)| label);
    // What the edits made of a cell: all of it belongs to one instance.
    let label = |cell: u32| edited.instances.label[world.first_of[cell as usize] as usize];
    let own = |cell: &u32| world.cells[*cell as usize].0 == best.unwrap_or(-1) || Some(label(*cell)) == best;
    let cell = of_cell.iter().filter(|(c, _)| own(c)).max_by(|a, b| a.1.total_cmp(b.1)).map(|(&c, _)| c);
    Ok(Picked {
        instance: best.and_then(|l| u32::try_from(l).ok()),
        cell,
        position: (alpha > 0.0).then_some(position),
        alpha,
    })
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
pub fn selection(world: &World, export: &Export) -> Result<Vec<u32>> {
    let mut meant = vec![export.others; world.cells.len()];
    for &cell in &export.cells {
        *meant.get_mut(cell as usize).ok_or_else(|| Error::new("no such cell").field("cells").found(cell))? =
            !export.others;
    }
    let chosen: Vec<u32> =
        (0..world.cell_of.len() as u32).filter(|&i| meant[world.cell_of[i as usize] as usize]).collect();
    if chosen.is_empty() {
        return Err(Error::new("nothing is selected: there is nothing to save"));
    }
    Ok(chosen)
}
