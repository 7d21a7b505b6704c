//! What several tests need.

use crate::render::light::LightMap;
use crate::render::{self, Frame};
use crate::scene::Scene;
use crate::scene::cameras;
use crate::scene::layout;
use crate::things::shape::{ChartPoint, Shape};
use crate::truth::polygon::Polygon;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::sync::OnceLock;

/// A small scene and a view of it.
pub fn example() -> &'static (Scene, Frame) {
    static ONCE: OnceLock<(Scene, Frame)> = OnceLock::new();
    ONCE.get_or_init(|| {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let scene = layout::plan(10, &mut rng);
        let light = LightMap::bake(&scene, 3.0);
        let cameras = cameras::place(&scene, 4, 240, 180, &mut rng);
        let frame = render::render(&scene, &light, &cameras[1]);
        (scene, frame)
    })
}

/// Places all over the chart of a shape: the middles of `n` x `n` squares a face.
pub fn chart_points(shape: &Shape, n: u32) -> impl Iterator<Item = ChartPoint> + use<> {
    let at = move |k: u32| (f64::from(k) + 0.5) / f64::from(n);
    (0..shape.faces()).flat_map(move |face| (0..n * n).map(move |k| ChartPoint { face, u: at(k % n), v: at(k / n) }))
}

/// What OpenCV's fillPoly does with whole coordinates: even-odd inside, and the line itself.
pub fn fill(polygon: &Polygon, width: usize, height: usize) -> Vec<bool> {
    let mut out = vec![false; width * height];
    let n = polygon.len();
    for y in 0..height as i32 {
        let mut crossings: Vec<f64> = (0..n)
            .filter_map(|i| {
                let (a, b) = (polygon[i], polygon[(i + 1) % n]);
                let (low, high) = (a[1].min(b[1]), a[1].max(b[1]));
                (y >= low && y < high)
                    .then(|| f64::from(a[0]) + f64::from(b[0] - a[0]) * f64::from(y - a[1]) / f64::from(b[1] - a[1]))
            })
            .collect();
        crossings.sort_by(f64::total_cmp);
        for pair in crossings.chunks_exact(2) {
            for x in pair[0].ceil() as i32..=pair[1].floor() as i32 {
                out[y as usize * width + x as usize] = true;
            }
        }
    }
    for i in 0..n {
        let (mut a, b) = (polygon[i], polygon[(i + 1) % n]);
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        assert!(dx == 0 || dy == 0 || dx.abs() == dy.abs(), "lines run in eight directions");
        out[a[1] as usize * width + a[0] as usize] = true;
        while a != b {
            a = [a[0] + dx.signum(), a[1] + dy.signum()];
            out[a[1] as usize * width + a[0] as usize] = true;
        }
    }
    out
}
