//! Photographs of views and of instances as JPEG files.

use crate::world::World;
use artifacts::Instances;
use glam::DVec3;
use gs_io::Result;
use gs_scene::dataset::View;
use gs_scene::{Gaussians, Image};
use report::picture::Picture;

/// Photographs that a server has in its memory at a time: a large one takes a gigabyte.
pub const AT_A_TIME: usize = 2;
/// Quality of the JPEG files, of 100.
const QUALITY: u8 = 82;
/// Most pixels along the longer side of an instance's picture.
const THUMBNAIL: usize = 144;
/// Width of a photograph in a list, in pixels.
const PREVIEW: usize = 240;
/// Around an instance's picture, as a share of its size.
const MARGIN: f64 = 0.15;

/// The photograph of a view, without its lens's distortion, at the view's size.
///
/// # Errors
/// When it cannot be read.
pub fn photograph(view: &View) -> Result<Vec<u8>> {
    shrunk(view, usize::MAX)
}

/// The same, small.
///
/// # Errors
/// When it cannot be read.
pub fn preview(view: &View) -> Result<Vec<u8>> {
    shrunk(view, PREVIEW)
}

fn shrunk(view: &View, most: usize) -> Result<Vec<u8>> {
    let image = view.load_image()?;
    Picture::new(image.width, image.height, &image.rgb).jpeg(most, QUALITY)
}

/// The view that shows each instance best, by the matches with masks; none for one that no mask matched.
pub fn best_views(world: &World, instances: &Instances) -> Vec<Option<usize>> {
    let mut best = vec![None::<(f32, usize)>; instances.len()];
    for m in &instances.matches {
        let Some((view, _)) = world.view(&instances.views[m.view as usize]) else { continue };
        let fit = m.score * m.visible;
        let own = &mut best[m.instance as usize];
        if own.is_none_or(|(most, _)| fit > most) {
            *own = Some((fit, view));
        }
    }
    best.into_iter().map(|b| b.map(|(_, view)| view)).collect()
}

/// What a photograph shows of an instance.
///
/// # Errors
/// When it cannot be encoded.
pub fn thumbnail(photograph: &Image, view: &View, gaussians: &Gaussians, members: &[u32]) -> Result<Vec<u8>> {
    let [x0, y0, x1, y1] = rectangle(view, gaussians, members);
    let width = photograph.width as usize;
    let pixels = (y0..y1).flat_map(|y| photograph.rgb[3 * (y * width + x0)..3 * (y * width + x1)].to_vec());
    let part = Picture::new((x1 - x0) as u32, (y1 - y0) as u32, &pixels.collect::<Vec<f32>>());
    let (w, h) = (x1 - x0, y1 - y0);
    part.jpeg(if w >= h { THUMBNAIL } else { (THUMBNAIL * w / h).max(1) }, QUALITY)
}

/// Where most of the Gaussians lie in a view, with a margin: left, top, right, bottom; the whole view where none is before
/// the camera. Never empty.
fn rectangle(view: &View, gaussians: &Gaussians, members: &[u32]) -> [usize; 4] {
    let camera = &view.camera;
    let size = [f64::from(camera.width), f64::from(camera.height)];
    let project = |&i: &u32| camera.project(DVec3::from(gaussians.means[i as usize].map(f64::from)));
    let (mut x, mut y): (Vec<f64>, Vec<f64>) =
        members.iter().map(project).filter(|p| p.2 > 0.0).map(|p| (p.0, p.1)).unzip();
    let side = |along: &mut Vec<f64>, size: f64| {
        along.sort_unstable_by(f64::total_cmp);
        let Some(last) = along.len().checked_sub(1) else { return (0, size as usize) };
        let (low, high) = (along[last / 50], along[last - last / 50]);
        let margin = MARGIN * (high - low) + 4.0;
        let low = (low - margin).clamp(0.0, size - 1.0) as usize;
        (low, ((high + margin).clamp(0.0, size).ceil() as usize).clamp(low + 1, size as usize))
    };
    let ((x0, x1), (y0, y1)) = (side(&mut x, size[0]), side(&mut y, size[1]));
    [x0, y0, x1, y1]
}
