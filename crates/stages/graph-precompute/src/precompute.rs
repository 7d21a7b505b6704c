//! The whole stage: footprints of all views, then the graph over the Gaussians that were seen.

use crate::footprint::{FootprintOptions, view_footprints};
use crate::graph::{AnchorDistances, GraphOptions, MiddleAnchors, anchor_graph};
use crate::positions::shifted;
use artifacts::{FootprintsBuilder, Graph, MaskMaps, PixelSamples, ScratchEntries, maps_path};
use gs_io::{Error, Result};
use gs_raster::RasterOptions;
use gs_scene::dataset::View;
use gs_scene::{Camera, Gaussians, Geometry};
use stage::Stage;
use std::path::Path;
use std::time::Instant;

/// Pixels of the images on which mask sizes are usually stated (LERF's 986 x 728).
const REFERENCE_PIXELS: f64 = 986.0 * 728.0;

/// How the stage works.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Anchors and neighbours.
    pub graph: GraphOptions,
    /// Accumulated alpha above which a pixel counts.
    pub gate: f32,
    /// Smallest mask, in pixels of an image of 986 x 728; scaled by the area of the id map.
    pub min_mask_pixels: f64,
    /// Entries whose share of their mask's gated pixels is below this are dropped; 0 keeps all.
    pub cut: f64,
    /// Keep Gaussians that no view sees.
    pub keep_unseen: bool,
    /// Single pixels kept of each mask, at most.
    pub pixel_samples: usize,
}

impl Default for Options {
    fn default() -> Self {
        let graph = GraphOptions::default();
        Self { graph, gate: 0.7, min_mask_pixels: 50.0, cut: 0.0, keep_unseen: false, pixel_samples: 0 }
    }
}

/// Figures of the result.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct Summary {
    /// Gaussians of the geometry.
    pub gaussians: usize,
    /// Of these, Gaussians with a parameter that is not finite.
    pub damaged: usize,
    /// Others without a usable position (beyond 1e18).
    pub unusable: usize,
    /// Gaussians that take part.
    pub kept: usize,
    /// Anchors.
    pub anchors: usize,
    /// How far the Gaussians that take part are from their anchors.
    pub anchor_distance: AnchorDistances,
    /// What the middle of the scene has of the anchors.
    pub middle: MiddleAnchors,
    /// Views with masks.
    pub views: usize,
    /// Masks that own enough pixels, over all views and levels.
    pub masks: usize,
    /// Masks left out for being too small.
    pub small_masks: usize,
    /// Entries of the footprints.
    pub entries: usize,
    /// Single pixels kept.
    pub pixels: usize,
    /// Largest share of a mask's weight that the cut dropped: a centroid moves by at most this times the largest feature.
    pub largest_cut: f64,
}

/// The camera for an id map; the map may be smaller than the photograph but not of another shape.
fn camera_for(view: &View, maps: &MaskMaps, file: &Path) -> Result<Camera> {
    maps.expect_shape(view.camera.width, view.camera.height, file)?;
    Ok(view.camera.resized(maps.width as u32, maps.height as u32))
}

/// Computes footprints and graph of a geometry from the `views` that have id maps in the folder `masks`. The entries of the
/// footprints go into `entries`, view by view; the builder that comes back has none.
///
/// # Errors
/// When the disk is full, an id map is damaged or of another shape, no view has masks, or no Gaussian is left.
pub fn precompute(
    geometry: &Geometry,
    views: &[&View],
    masks: &Path,
    options: &Options,
    stage: &Stage,
    entries: &mut ScratchEntries,
) -> Result<(FootprintsBuilder, Graph, Summary)> {
    let (gaussians, raster) = (&geometry.gaussians, RasterOptions::of(geometry));
    let n = gaussians.len();
    let with_masks: Vec<&View> = views.iter().copied().filter(|v| maps_path(masks, v.stem()).is_file()).collect();
    if with_masks.is_empty() {
        return Err(Error::new("no view has an id map")
            .file(masks)
            .found("no matching file")
            .expected(format!(
                "{}_s.npy and so on, for {} views",
                views.first().map_or("frame", |v| v.stem()),
                views.len()
            ))
            .hint("run mask-embed, or give the folder with the *_s.npy files of this scene"));
    }
    if with_masks.len() < views.len() {
        stage.skipped(&format!("{} of {} views: no id map", views.len() - with_masks.len(), views.len()));
    }
    if let Some(damage) = geometry.damage() {
        stage.skipped(&damage);
    }
    let (mut usable, whole) = (shifted(&gaussians.means).usable, geometry.whole());
    usable.retain(|&i| whole[i as usize]);
    let damaged = geometry.damaged.len();
    let unusable = n - damaged - usable.len();
    if unusable > 0 {
        stage.warn(&format!("{unusable} of {n} Gaussians have no usable position and are left out"));
    }
    let pixels = PixelSamples { ptr: vec![0], ..PixelSamples::default() };
    let mut out = FootprintsBuilder { row_ptr: vec![0], pixels, ..FootprintsBuilder::default() };
    let mut summary = Summary { gaussians: n, damaged, unusable, views: with_masks.len(), ..Summary::default() };
    let mut seen_views = vec![0u32; n];
    let mut seen_weight = vec![0f64; n];
    let mut progress = stage.progress("views", with_masks.len() as u64);
    for (index, view) in with_masks.iter().enumerate() {
        if stage.interrupted() {
            return Err(Error::new("interrupted"));
        }
        let file = maps_path(masks, view.stem());
        let maps = MaskMaps::read(&file)?;
        let camera = camera_for(view, &maps, &file)?;
        let scale = (maps.width * maps.height) as f64 / REFERENCE_PIXELS;
        let min_pixels = (options.min_mask_pixels * scale.min(1.0)).ceil() as usize;
        let look = FootprintOptions {
            gate: options.gate,
            min_pixels,
            samples: options.pixel_samples,
            seed: options.graph.seed ^ ((index as u64) << 32),
        };
        let footprints = view_footprints(gaussians, &raster, &camera, &maps, &look);
        for pixel in footprints.pixels {
            out.pixels.row.push(out.rows.len() as u32 + pixel.row);
            out.pixels.col.extend(pixel.entries.iter().map(|e| e.0));
            out.pixels.weight.extend(pixel.entries.iter().map(|e| e.1));
            out.pixels.ptr.push(out.pixels.col.len() as u64);
        }
        summary.small_masks += footprints.small_masks;
        for (gaussian, weight) in footprints.seen {
            seen_views[gaussian as usize] += 1;
            seen_weight[gaussian as usize] += weight;
        }
        for (mut row, of_row) in footprints.rows.into_iter().zip(footprints.entries) {
            let least = (options.cut * f64::from(row.gated)) as f32;
            let mut dropped = 0.0;
            for (gaussian, weight) in of_row {
                if weight < least {
                    dropped += f64::from(weight);
                } else {
                    entries.push(gaussian, weight)?;
                }
            }
            summary.largest_cut = summary.largest_cut.max(dropped / f64::from(row.gated.max(1)));
            row.view = index as u32;
            out.rows.push(row);
            out.row_ptr.push(entries.count);
        }
        out.views.push(view.stem().to_string());
        progress.step();
    }
    if out.rows.is_empty() {
        return Err(Error::new("no view has a mask of enough pixels")
            .file(masks)
            .found(format!("{} masks, all too small", summary.small_masks))
            .expected(format!("at least {} pixels in an image of 986 x 728", options.min_mask_pixels))
            .hint("lower --min-mask-pixels, or check the id maps"));
    }
    let kept: Vec<u32> = usable.into_iter().filter(|&i| options.keep_unseen || seen_weight[i as usize] > 0.0).collect();
    progress.finish(&[("masks", out.rows.len() as f64), ("entries", entries.count as f64)]);
    if kept.is_empty() {
        return Err(Error::new("no Gaussian is seen by any view with masks")
            .field("geometry")
            .found(format!("{n} Gaussians, {} views", with_masks.len()))
            .hint("geometry and dataset must be of the same scene, in the same coordinates"));
    }
    // Original indices to positions in `kept`. Every Gaussian with a footprint was seen, so it is kept.
    let mut position = vec![u32::MAX; n];
    for (p, &i) in kept.iter().enumerate() {
        position[i as usize] = p as u32;
    }
    entries.renumber(&position)?;
    out.pixels.col.iter_mut().for_each(|c| *c = position[*c as usize]);
    let start = Instant::now();
    let (graph, anchor_distance, middle) = graph_of(gaussians, &kept, seen_views, &seen_weight, options);
    let unseen = n - damaged - kept.len();
    if unseen > 0 && !options.keep_unseen {
        let what = format!("{unseen} of {n} Gaussians: never seen");
        stage.skipped_some(&what, unseen, kept.len(), start.elapsed().as_secs_f64());
    }
    summary.anchor_distance = anchor_distance;
    summary.middle = middle;
    summary.kept = kept.len();
    summary.anchors = graph.anchors.len();
    summary.masks = out.rows.len();
    summary.entries = entries.count as usize;
    summary.pixels = out.pixels.len();
    out.kept = kept;
    Ok((out, graph, summary))
}

fn graph_of(
    gaussians: &Gaussians,
    kept: &[u32],
    seen_views: Vec<u32>,
    seen_weight: &[f64],
    options: &Options,
) -> (Graph, AnchorDistances, MiddleAnchors) {
    let means: Vec<[f32; 3]> = kept.iter().map(|&i| gaussians.means[i as usize]).collect();
    let points = shifted(&means).points;
    let g = anchor_graph(&points, &options.graph);
    let (distances, middle) = (g.distances(&points), g.middle(&points));
    let graph = Graph {
        kept: kept.to_vec(),
        anchors: g.anchors,
        k: options.graph.k,
        knn: g.knn,
        anchor_knn: g.anchor_knn,
        nearest_anchor: g.nearest_anchor,
        gaussian_k: options.graph.gaussian_k,
        gaussian_knn: g.gaussian_knn,
        seen_views,
        seen_weight: seen_weight.iter().map(|&w| w as f32).collect(),
    };
    (graph, distances, middle)
}
