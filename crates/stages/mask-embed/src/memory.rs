//! How much memory a run will take, said before its first photograph. The models run once on an empty picture first, because
//! their need is known only then. docs/performance.md compares the forecast with measured peaks.

use gs_scene::dataset::View;
use stage::peak_rss_bytes;

/// Peak of the program so far, in bytes; 0 where the system does not tell.
pub fn so_far() -> u64 {
    peak_rss_bytes().unwrap_or(0)
}

/// Pixels of the largest photograph.
pub fn largest<'a>(views: impl IntoIterator<Item = &'a View>) -> u64 {
    views.into_iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0)
}

/// Peak in bytes of `masks`, where the models took `models` on an empty picture: `points` of the grid are asked about a
/// photograph of `pixels`, whose map has `map` pixels.
pub fn of_masks(models: u64, points: u64, pixels: u64, map: u64) -> u64 {
    models + 10_000 * points + 6 * pixels + 30 * map
}

/// Peak in bytes of `embed`, where the model took `model` on a batch of empty pictures; `pictures` of `size` by `size`
/// wait for it at a time, and the map of a photograph of `pixels` has as many itself at the most.
pub fn of_features(model: u64, pictures: u64, size: u64, pixels: u64) -> u64 {
    model + 6 * size * size * pictures + 20 * pixels
}

/// Peak in bytes of `import`, where the program took `program` before: the largest picture has `pixels`, and a view `levels`
/// pictures.
pub fn of_import(program: u64, pixels: u64, levels: u64) -> u64 {
    program + (30 + 3 * levels) * pixels
}
