//! Points from depth images: back-projected on a grid, thinned to one a voxel.

use glam::DVec3;
use gs_io::Result;
use gs_scene::dataset::{DepthMap, View};
use gs_scene::{Camera, PointCloud};
use stage::Stage;
use std::collections::BTreeMap;

/// Pixels of a depth image that are looked at, about.
const SAMPLES: usize = 20_000;
/// Neighbouring pixels whose depths differ by more than this share lie on an edge, where sensors see neither side.
const EDGE: f32 = 0.05;
/// Edge of the voxels to begin with, in depths. They grow until there are few enough points.
const VOXEL: f64 = 1.0 / 400.0;

/// Sums of the points of a voxel: places, colours, their number.
#[derive(Default, Clone)]
struct Sum {
    place: DVec3,
    color: [u64; 3],
    count: u64,
}

/// Points of a voxel grid that grows with them.
struct Voxels {
    edge: f64,
    sums: BTreeMap<[i64; 3], Sum>,
}

impl Voxels {
    /// None yet, of a size for things at this distance.
    fn new(depth: f64) -> Self {
        Self { edge: (VOXEL * depth).max(f64::MIN_POSITIVE), sums: BTreeMap::new() }
    }

    fn see(&mut self, place: DVec3, color: [u8; 3]) {
        self.add(&Sum { place, color: color.map(u64::from), count: 1 });
    }

    /// A point for each, in the middle of its points and of their mean colour.
    fn cloud(&self) -> PointCloud {
        PointCloud {
            positions: self.sums.values().map(|s| (s.place / s.count as f64).as_vec3().to_array()).collect(),
            colors: self.sums.values().map(|s| s.color.map(|c| (c / s.count) as u8)).collect(),
            ..PointCloud::default()
        }
    }

    fn add(&mut self, sum: &Sum) {
        let place = sum.place / sum.count as f64 / self.edge;
        let own = self.sums.entry(place.to_array().map(|v| v.floor() as i64)).or_default();
        own.place += sum.place;
        own.count += sum.count;
        (0..3).for_each(|c| own.color[c] += sum.color[c]);
    }

    /// Grows the voxels until there are at most so many.
    fn limit(&mut self, most: usize) {
        while self.sums.len() > most {
            self.edge *= 1.2;
            let sums = std::mem::take(&mut self.sums);
            sums.values().for_each(|sum| self.add(sum));
        }
    }
}

/// At most `most` points that the depth images of `views` show, with the cameras given; none where no view has one.
pub(crate) fn points(views: &[(&View, &Camera)], most: usize, stage: &Stage) -> Result<PointCloud> {
    let mut voxels: Option<Voxels> = None;
    for (view, camera) in views {
        stage.go_on()?;
        let Some(map) = view.load_depth()? else { continue };
        let image = view.load_image()?;
        let seen = seen(&map);
        let Some(&(_, _, depth)) = seen.get(seen.len() / 2) else { continue };
        let voxels = voxels.get_or_insert_with(|| Voxels::new(depth));
        let zoom = camera.fx / view.camera.fx;
        for (x, y, depth) in seen {
            let c = &map.camera;
            let sight = DVec3::new((x - c.cx) / (c.fx * zoom), (y - c.cy) / (c.fy * zoom), 1.0);
            let place = camera.rotation.transpose() * (sight * depth - camera.translation);
            let (u, v, _) = camera.project(place);
            // The photograph may show less than the sensor saw.
            if !(0.0..f64::from(image.width)).contains(&u) || !(0.0..f64::from(image.height)).contains(&v) {
                continue;
            }
            let at = 3 * (v as usize * image.width as usize + u as usize);
            let color = [0, 1, 2].map(|k| (image.rgb[at + k].clamp(0.0, 1.0) * 255.0).round() as u8);
            voxels.see(place, color);
        }
        voxels.limit(most);
    }
    Ok(voxels.map(|v| v.cloud()).unwrap_or_default())
}

/// Pixels of a grid, centres at +0.5, whose depth is known, with it; none beside an edge.
fn seen(map: &DepthMap) -> Vec<(f64, f64, f64)> {
    let (w, h) = (map.camera.width as usize, map.camera.height as usize);
    let step = ((w * h) as f64 / SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
    let mut out = Vec::new();
    for y in (step / 2..h).step_by(step) {
        for x in (step / 2..w).step_by(step) {
            let depth = map.depth[y * w + x];
            let same = |x: usize, y: usize| (map.depth[y * w + x] - depth).abs() <= EDGE * depth;
            let beside =
                [(x.saturating_sub(1), y), ((x + 1).min(w - 1), y), (x, y.saturating_sub(1)), (x, (y + 1).min(h - 1))];
            if depth > 0.0 && beside.iter().all(|&(x, y)| same(x, y)) {
                out.push((x as f64 + 0.5, y as f64 + 0.5, f64::from(depth)));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_beside_an_edge_and_without_depth_are_left_out() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 6, 1, 1.0);
        let map = DepthMap { camera, depth: vec![2.0, 2.01, 2.02, 3.0, 3.0, 0.0] };
        assert_eq!(seen(&map).iter().map(|s| s.0).collect::<Vec<_>>(), [0.5, 1.5]);
    }

    #[test]
    fn voxels_grow_to_the_limit_and_keep_the_means() {
        let mut voxels = Voxels { edge: 0.1, sums: BTreeMap::new() };
        for i in 0..1000 {
            voxels.add(&Sum {
                place: DVec3::new(0.01 * f64::from(i), -1.0, 0.0),
                color: [i as u64 % 2, 0, 4],
                count: 1,
            });
        }
        assert_eq!(voxels.sums.len(), 100);
        voxels.limit(30);
        assert!((15..=30).contains(&voxels.sums.len()), "{}", voxels.sums.len());
        let all = voxels.sums.values().fold((DVec3::ZERO, 0), |a, s| (a.0 + s.place, a.1 + s.count));
        assert!(all.1 == 1000 && (all.0 / 1000.0).distance(DVec3::new(4.995, -1.0, 0.0)) < 1e-9);
        assert!(voxels.sums.values().all(|s| s.color[2] == 4 * s.count));
    }
}
