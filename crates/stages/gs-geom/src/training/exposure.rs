//! Exposure compensation: an affine map of colours for each training photograph, learned with the scene.
//!
//! Cameras that choose exposure and white balance by themselves show one surface in different colours. Each training view
//! has a 3x4 map (as the later versions of 3DGS have); what is rendered goes through its view's map before it is compared
//! with the photograph. Scene and maps could drift apart together, so the maps' mean over the training views is kept at
//! the identity: the scene has the photographs' mean exposure, and held-out views are rendered as the scene is.

use rayon::prelude::*;

/// Numbers of a map: row-major 3x3 matrix and, in each row's fourth place, what is added.
pub const NUMBERS: usize = 12;
/// The map that changes nothing.
const IDENTITY: [f32; NUMBERS] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
/// Learning rate at the start and at the end, exponential between, as 3DGS has them.
const RATES: [f64; 2] = [0.01, 0.001];
/// Pixels per piece of parallel work.
const CHUNK: usize = 8192;

/// The maps of all training views, with Adam's state.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Exposures {
    /// A map a view.
    pub maps: Vec<[f32; NUMBERS]>,
    pub first: Vec<[f32; NUMBERS]>,
    pub second: Vec<[f32; NUMBERS]>,
    /// Steps taken, of each view.
    pub steps: Vec<u32>,
}

impl Exposures {
    /// Maps that change nothing, for `views` views; 0 for a run without compensation.
    pub fn new(views: usize) -> Self {
        Self {
            maps: vec![IDENTITY; views],
            first: vec![[0.0; NUMBERS]; views],
            second: vec![[0.0; NUMBERS]; views],
            steps: vec![0; views],
        }
    }

    /// Moves the map of `view` against its gradient, at `t` of the run (0 to 1), and all maps so that their mean is the
    /// identity. A gradient that is not finite is not used.
    pub fn step(&mut self, view: usize, gradient: &[f64; NUMBERS], t: f64) {
        if gradient.iter().any(|g| !g.is_finite()) {
            return;
        }
        self.steps[view] = self.steps[view].saturating_add(1);
        let steps = i32::try_from(self.steps[view]).unwrap_or(i32::MAX);
        let rate = RATES[0] * (RATES[1] / RATES[0]).powf(t.clamp(0.0, 1.0));
        for (k, &g) in gradient.iter().enumerate() {
            let m = 0.9 * f64::from(self.first[view][k]) + 0.1 * g;
            let v = 0.999 * f64::from(self.second[view][k]) + 0.001 * g * g;
            let step = m / (1.0 - 0.9f64.powi(steps)) / ((v / (1.0 - 0.999f64.powi(steps))).sqrt() + 1e-15);
            self.first[view][k] = m as f32;
            self.second[view][k] = v as f32;
            self.maps[view][k] -= (rate * step) as f32;
        }
        for k in 0..NUMBERS {
            let mean = self.maps.iter().map(|m| f64::from(m[k])).sum::<f64>() / self.maps.len() as f64;
            let off = mean - f64::from(IDENTITY[k]);
            self.maps.iter_mut().for_each(|m| m[k] = (f64::from(m[k]) - off) as f32);
        }
    }
}

/// Takes `[pixels][rgb]` through a map, into `out`.
pub fn apply(map: &[f32; NUMBERS], rgb: &[f32], out: &mut Vec<f32>) {
    out.resize(rgb.len(), 0.0);
    out.par_chunks_mut(3 * CHUNK).zip(rgb.par_chunks(3 * CHUNK)).for_each(|(out, rgb)| {
        for (o, p) in out.as_chunks_mut::<3>().0.iter_mut().zip(rgb.as_chunks::<3>().0) {
            *o = [0, 4, 8].map(|r| map[r] * p[0] + map[r + 1] * p[1] + map[r + 2] * p[2] + map[r + 3]);
        }
    });
}

/// Takes d loss / d mapped colours, in `gradient`, to d loss / d `rgb` in its place, and gives d loss / d map.
pub fn backward(map: &[f32; NUMBERS], rgb: &[f32], gradient: &mut [f32]) -> [f64; NUMBERS] {
    let chunks = gradient.par_chunks_mut(3 * CHUNK).zip(rgb.par_chunks(3 * CHUNK));
    let sums: Vec<[f64; NUMBERS]> = chunks
        .map(|(gradient, rgb)| {
            let mut sum = [0.0; NUMBERS];
            for (g, p) in gradient.as_chunks_mut::<3>().0.iter_mut().zip(rgb.as_chunks::<3>().0) {
                for (row, &d) in g.iter().enumerate() {
                    for (s, v) in sum[4 * row..].iter_mut().zip([p[0], p[1], p[2], 1.0]) {
                        *s += f64::from(d * v);
                    }
                }
                *g = [0, 1, 2].map(|c| map[c] * g[0] + map[4 + c] * g[1] + map[8 + c] * g[2]);
            }
            sum
        })
        .collect();
    sums.iter().fold([0.0; NUMBERS], |mut total, sum| {
        total.iter_mut().zip(sum).for_each(|(t, s)| *t += s);
        total
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixels(n: usize, seed: f32) -> Vec<f32> {
        (0..3 * n).map(|i| 0.5 + 0.4 * (i as f32 * seed).sin()).collect()
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let n = CHUNK + 7;
        let (rgb, weights) = (pixels(n, 0.7), pixels(n, 1.3));
        let map: [f32; NUMBERS] = std::array::from_fn(|k| IDENTITY[k] + 0.1 * (k as f32).cos());
        // The loss is a weighted sum of the mapped values.
        let loss = |map: &[f32; NUMBERS], rgb: &[f32]| {
            let mut out = Vec::new();
            apply(map, rgb, &mut out);
            out.iter().zip(&weights).map(|(o, w)| f64::from(*o) * f64::from(*w)).sum::<f64>()
        };
        let mut gradient = weights.clone();
        let of_map = backward(&map, &rgb, &mut gradient);
        for k in 0..NUMBERS {
            let mut moved = map;
            moved[k] += 0.5;
            let wanted = (loss(&moved, &rgb) - loss(&map, &rgb)) / 0.5;
            assert!((of_map[k] - wanted).abs() < 1e-4 * wanted.abs().max(1.0), "{k}: {} {wanted}", of_map[k]);
        }
        for i in [0, 1, 5, 3 * n - 1] {
            let mut moved = rgb.clone();
            moved[i] += 8.0;
            let wanted = (loss(&map, &moved) - loss(&map, &rgb)) / 8.0;
            assert!((f64::from(gradient[i]) - wanted).abs() < 1e-3, "{i}");
        }
    }

    #[test]
    fn the_mean_of_all_maps_is_neutral_and_wrong_gradients_are_not_used() {
        let mut exposures = Exposures::new(3);
        exposures.step(0, &[1.0; NUMBERS], 0.0);
        exposures.step(1, &[-0.5; NUMBERS], 0.5);
        let before = exposures.clone();
        exposures.step(0, &[f64::NAN; NUMBERS], 0.5);
        assert_eq!(exposures, before);
        for k in 0..NUMBERS {
            assert!(exposures.maps[0][k] < IDENTITY[k] && exposures.maps[1][k] > IDENTITY[k]);
            let mean = exposures.maps.iter().map(|m| m[k]).sum::<f32>() / 3.0;
            assert!((mean - IDENTITY[k]).abs() < 1e-5);
        }
    }
}
