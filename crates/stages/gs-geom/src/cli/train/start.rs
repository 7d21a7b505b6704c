//! The Gaussians that a run starts from.

use super::{Init, TrainArgs};
use crate::cli::check_some;
use crate::init;
use gs_io::{Error, Result};
use gs_scene::dataset::Dataset;
use gs_scene::{Camera, Gaussians, PointCloud, ply};
use stage::Stage;
use std::path::Path;

impl TrainArgs {
    /// The Gaussians before the first iteration.
    pub(in crate::cli) fn start(
        &self,
        dataset: &Dataset,
        cameras: &[&Camera],
        extent: f64,
        stage: &Stage,
    ) -> Result<Gaussians> {
        let read: PointCloud;
        if let Init::File(path) = &self.init {
            if ply::holds_gaussians(path)? {
                return self.start_gaussians(path, stage);
            }
            read = ply::read_points(path)?;
            if read.is_empty() {
                return Err(Error::new("no points to start from").file(path).field("--init"));
            }
            stage.info(&format!("starting from the {} points of {}", read.len(), path.display()));
            return self.start_points(&read, extent, stage).map_err(|e| e.file(path));
        }
        if self.init == Init::Points && !dataset.points.is_empty() {
            return self.start_points(&dataset.points, extent, stage).map_err(|e| e.file(&self.scene.scene));
        }
        if self.fixed_points {
            return Err(Error::new("no points to keep").file(&self.scene.scene).field("points").hint(
                "--fixed-points needs a dataset with points, such as ScanNet's vertices, or --init with a file",
            ));
        }
        let why = if self.init == Init::Points { "the dataset has no points: " } else { "" };
        stage.info(&format!("{why}starting from {} random points", self.init_points));
        let random = init::random_points(cameras, self.init_points, stage.seed());
        self.start_points(&random, extent, stage).map_err(|e| e.file(&self.scene.scene))
    }

    /// One Gaussian for each point, or for as many as may be.
    fn start_points(&self, points: &PointCloud, extent: f64, stage: &Stage) -> Result<Gaussians> {
        let Some(most) = self.max_gaussians.filter(|&most| points.len() > most && !self.fixed_points) else {
            return init::from_points(points, self.sh_degree, extent);
        };
        stage.info(&format!("starting from {most} of {} points, for --max-gaussians", points.len()));
        init::from_points(&init::some_points(points, most, stage.seed()), self.sh_degree, extent)
    }

    /// The Gaussians of a file, all of which must be whole: none can be learnt from, and --fixed-points keeps all.
    fn start_gaussians(&self, path: &Path, stage: &Stage) -> Result<Gaussians> {
        let g = ply::read_gaussians(path)?;
        check_some(&g, path)?;
        let g = init::with_degree(g, self.sh_degree);
        if let Some(most) = self.max_gaussians.filter(|&most| g.len() > most && !self.fixed_points) {
            return Err(Error::new("more Gaussians than --max-gaussians")
                .file(path)
                .found(g.len())
                .expected(format!("at most {most}")));
        }
        let zero = g.rotations.iter().filter(|q| q.iter().all(|v| v.abs() < 1e-12)).count();
        if zero > 0 {
            stage.warn(&format!("{zero} Gaussians of --init have a quaternion of length 0 and are never drawn"));
        }
        Ok(g)
    }
}
