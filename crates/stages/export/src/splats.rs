//! Some Gaussians as a splat of their own. Every command that writes splats calls [`Splats::write`].

use crate::options::SplatFormat;
use clap::ValueEnum;
use gs_io::{Error, Result};
use gs_scene::splat::{self, Extra};
use gs_scene::{Geometry, ply};
use query::LabelledScene;
use std::path::Path;

/// The format of an output by its extension.
///
/// # Errors
/// When there is no such format.
pub fn format_of(path: &Path) -> Result<SplatFormat> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
    // A compressed PLY has another order.
    let format = if name.ends_with(".compressed.ply") { "" } else { extension };
    SplatFormat::from_str(format, false).map_err(|_| {
        let known: Vec<String> =
            SplatFormat::value_variants().iter().map(|f| format!(".{}", extension_of(*f))).collect();
        Error::new("no format of splats has this extension").file(path).expected(known.join(", "))
    })
}

/// The extension of a format, without its dot.
pub fn extension_of(format: SplatFormat) -> &'static str {
    match format {
        SplatFormat::Ply => "ply",
        SplatFormat::Spz => "spz",
        SplatFormat::Splat => "splat",
        SplatFormat::Glb => "glb",
    }
}

/// The Gaussians of a scene, to write some of them.
pub struct Splats<'a> {
    scene: &'a LabelledScene,
    /// The rows of the geometry's file, where they can be copied.
    rows: Option<ply::Vertices>,
    comments: Vec<String>,
}

impl<'a> Splats<'a> {
    /// Reads what [`LabelledScene`] does not hold of the geometry's file.
    ///
    /// # Errors
    /// When the file cannot be read any more.
    pub fn new(scene: &'a LabelledScene, geometry: &Path) -> Result<Self> {
        let Geometry { damaged, .. } = &scene.geometry;
        // Rows with numbers that are not finite would break those who read the file.
        let plain = damaged.is_empty() && ply::holds_gaussians(geometry).unwrap_or(false);
        let rows = plain.then(|| ply::Vertices::read(geometry)).transpose()?;
        let comments = scene.geometry.comments(vec![format!("made by export {}", env!("CARGO_PKG_VERSION"))]);
        Ok(Self { scene, rows, comments })
    }

    /// Writes the Gaussians `which`, ascending, with all their harmonics and the object of each; to a PLY also with all other
    /// properties that the geometry's PLY has.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, to: &Path, format: SplatFormat, which: &[u32]) -> Result<()> {
        let labels = &self.scene.instances.label;
        match (format, &self.rows) {
            (SplatFormat::Ply, Some(rows)) => rows.write(to, which, Some(labels), &self.comments),
            _ => {
                let own: Vec<i32> = which.iter().map(|&i| labels[i as usize]).collect();
                let antialias = self.scene.geometry.antialias;
                let extra = Extra { comments: &self.comments, antialias, instance: Some(&own) };
                splat::write(to, &self.scene.gaussians().select(which), &extra)
            }
        }
    }
}
