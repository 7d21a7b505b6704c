//! Footprints of all views, then the graph over the Gaussians that were seen.

use crate::footprint::{FootprintOptions, view_footprints};
use crate::graph::{AnchorDistances, anchor_graph};
use crate::options::Settings;
use crate::positions::shifted;
use artifacts::{FootprintsBuilder, Graph, MaskFolder, PixelSamples, ScratchEntries, maps_path};
use gs_io::{Error, Result};
use gs_raster::RasterOptions;
use gs_scene::Geometry;
use gs_scene::dataset::View;
use stage::Stage;
use std::path::Path;

/// Pixels of the images on which mask sizes are usually stated (LERF's 986 x 728).
const REFERENCE_PIXELS: f64 = 986.0 * 728.0;

/// Figures of the result.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct Summary {
    pub gaussians: usize,
    /// Of these, Gaussians that are damaged.
    pub damaged: usize,
    /// Gaussians that take part.
    pub kept: usize,
    pub anchors: usize,
    /// How far the Gaussians that take part are from their anchors.
    pub anchor_distance: AnchorDistances,
    pub views: usize,
    /// Masks that own enough pixels, over all views and levels.
    pub masks: usize,
    /// Masks left out for being too small.
    pub small_masks: usize,
    pub entries: usize,
    /// Single pixels kept.
    pub pixels: usize,
    /// Largest share of a mask's weight that the cut dropped: a centroid changes by at most this times the largest feature.
    pub largest_cut: f64,
}

/// Computes footprints and graph of a geometry from the `views` that have id maps in the folder `masks`. The entries of the
/// footprints go into `entries`, view by view; the builder that comes back has none.
pub(crate) fn precompute(
    geometry: &Geometry,
    views: &[&View],
    masks: &Path,
    settings: &Settings,
    seed: u64,
    stage: &Stage,
    entries: &mut ScratchEntries,
) -> Result<(FootprintsBuilder, Graph, Summary)> {
    let views = with_masks(views, masks, stage)?;
    let mut c = Collected::new(geometry, entries);
    c.summary.views = views.len();
    let usable = c.usable(stage);
    let folder = MaskFolder::open(masks);
    let bent = views.iter().filter(|v| folder.bends(v)).count();
    if bent > 0 {
        stage
            .info(&format!("the id maps of {bent} views are undistorted and turned upright, as their photographs are"));
    }
    let mut progress = stage.progress("views", views.len() as u64);
    for view in &views {
        stage.go_on()?;
        c.add(view, &folder, settings, seed)?;
        progress.step();
    }
    progress.finish(&[("masks", c.out.rows.len() as f64), ("entries", c.entries.count as f64)]);
    if c.out.rows.is_empty() {
        return Err(Error::new("no view has a mask of enough pixels")
            .file(masks)
            .found(format!("{} masks, all too small", c.summary.small_masks))
            .expected(format!("at least {} pixels in an image of 986 x 728", settings.min_mask_pixels))
            .hint("lower --min-mask-pixels, or check the id maps"));
    }
    c.keep(usable, settings.keep_unseen(), stage)?;
    let points: Vec<[f32; 3]> = c.out.kept.iter().map(|&i| geometry.gaussians.means[i as usize]).collect();
    let points = shifted(&points).points;
    let g = anchor_graph(&points, settings.anchor_ratio, settings.k, seed);
    let summary = Summary {
        anchor_distance: AnchorDistances::of(&g, &points),
        anchors: g.anchors.len(),
        kept: c.out.kept.len(),
        masks: c.out.rows.len(),
        entries: c.entries.count as usize,
        pixels: c.out.pixels.len(),
        ..c.summary
    };
    let seen_weight = c.seen_weight.iter().map(|&w| w as f32).collect();
    let graph = Graph { kept: c.out.kept.clone(), seen_views: c.seen_views, seen_weight, ..g };
    Ok((c.out, graph, summary))
}

/// The views that have id maps; the others are said to be skipped.
fn with_masks<'a>(views: &[&'a View], masks: &Path, stage: &Stage) -> Result<Vec<&'a View>> {
    let found: Vec<&View> = views.iter().copied().filter(|v| maps_path(masks, v.stem()).is_file()).collect();
    if found.is_empty() {
        let first = views.first().map_or("frame", |v| v.stem());
        return Err(Error::new("no view has an id map")
            .file(masks)
            .found("no matching file")
            .expected(format!("{first}_s.npy and so on, for {} views", views.len()))
            .hint("run mask-embed, or give the folder with the *_s.npy files of this scene"));
    }
    if found.len() < views.len() {
        stage.skipped(&format!("{} of {} views: no id map", views.len() - found.len(), views.len()));
    }
    Ok(found)
}

/// What the views so far have given.
struct Collected<'a> {
    geometry: &'a Geometry,
    raster: RasterOptions,
    entries: &'a mut ScratchEntries,
    out: FootprintsBuilder,
    summary: Summary,
    /// In how many views each Gaussian contributes, and the sum of its blending weights there.
    seen_views: Vec<u32>,
    seen_weight: Vec<f64>,
}

impl<'a> Collected<'a> {
    fn new(geometry: &'a Geometry, entries: &'a mut ScratchEntries) -> Self {
        let n = geometry.gaussians.len();
        let pixels = PixelSamples { ptr: vec![0], ..PixelSamples::default() };
        Self {
            geometry,
            raster: RasterOptions::of(geometry),
            entries,
            out: FootprintsBuilder { row_ptr: vec![0], pixels, ..FootprintsBuilder::default() },
            summary: Summary { gaussians: n, damaged: geometry.damaged.len(), ..Summary::default() },
            seen_views: vec![0; n],
            seen_weight: vec![0.0; n],
        }
    }

    /// The whole Gaussians; the others are said to be left out.
    fn usable(&self, stage: &Stage) -> Vec<u32> {
        if let Some(damage) = self.geometry.damage() {
            stage.skipped(&damage);
        }
        let whole = self.geometry.whole();
        (0..whole.len() as u32).filter(|&i| whole[i as usize]).collect()
    }

    /// Adds the masks of a view.
    fn add(&mut self, view: &View, masks: &MaskFolder, settings: &Settings, seed: u64) -> Result<()> {
        // The map may be smaller than the photograph, but not of another shape.
        let mut maps = masks.read(view)?;
        if !settings.levels.is_empty() {
            maps.keep(&settings.levels);
        }
        if settings.mask_divisor > 1 {
            maps = maps.shrunk(settings.mask_divisor);
        }
        let (width, height) = (maps.width(), maps.height());
        let camera = view.camera.resized(width as u32, height as u32);
        let index = self.out.views.len() as u32;
        let scale = (width * height) as f64 / REFERENCE_PIXELS;
        let look = FootprintOptions {
            gate: settings.gate as f32,
            min_pixels: (settings.min_mask_pixels * scale.min(1.0)).ceil() as usize,
            samples: settings.pixel_samples,
            seed: seed ^ (u64::from(index) << 32),
        };
        let found = view_footprints(&self.geometry.gaussians, &self.raster, &camera, &maps, &look);
        let first_row = self.out.rows.len() as u32;
        let pixels = &mut self.out.pixels;
        for pixel in found.pixels {
            pixels.row.push(first_row + pixel.row);
            pixels.col.extend(pixel.entries.iter().map(|e| e.0));
            pixels.weight.extend(pixel.entries.iter().map(|e| e.1));
            pixels.ptr.push(pixels.col.len() as u64);
        }
        self.summary.small_masks += found.small_masks;
        for (gaussian, weight) in found.seen {
            self.seen_views[gaussian as usize] += 1;
            self.seen_weight[gaussian as usize] += weight;
        }
        for (mut row, of_row) in found.rows.into_iter().zip(found.entries) {
            let least = (settings.cut * f64::from(row.gated)) as f32;
            let mut dropped = 0.0;
            for (gaussian, weight) in of_row {
                if weight < least {
                    dropped += f64::from(weight);
                } else {
                    self.entries.push(gaussian, weight)?;
                }
            }
            self.summary.largest_cut = self.summary.largest_cut.max(dropped / f64::from(row.gated.max(1)));
            row.view = index;
            self.out.rows.push(row);
            self.out.row_ptr.push(self.entries.count);
        }
        self.out.views.push(view.stem().to_string());
        Ok(())
    }

    /// Keeps the Gaussians that some view saw, or all that are usable, and numbers the entries by their position among them.
    fn keep(&mut self, usable: Vec<u32>, unseen_too: bool, stage: &Stage) -> Result<()> {
        let n = self.summary.gaussians;
        let seen = |i: &u32| unseen_too || self.seen_weight[*i as usize] > 0.0;
        let kept: Vec<u32> = usable.into_iter().filter(seen).collect();
        if kept.is_empty() {
            return Err(Error::new("no Gaussian is seen by any view with masks")
                .field("geometry")
                .found(format!("{n} Gaussians, {} views", self.summary.views))
                .hint("geometry and dataset must be of the same scene, in the same coordinates"));
        }
        let unseen = n - self.summary.damaged - kept.len();
        if unseen > 0 && !unseen_too {
            stage.skipped(&format!("{unseen} of {n} Gaussians: never seen"));
        }
        // Every Gaussian with a footprint was seen, so it is kept.
        let mut position = vec![u32::MAX; n];
        for (p, &i) in kept.iter().enumerate() {
            position[i as usize] = p as u32;
        }
        self.entries.renumber(&position)?;
        self.out.pixels.col.iter_mut().for_each(|c| *c = position[*c as usize]);
        self.out.kept = kept;
        Ok(())
    }
}
