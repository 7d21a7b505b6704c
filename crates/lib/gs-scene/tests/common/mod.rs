//! What several tests need.
#![allow(dead_code, reason = "each test uses a part")]

use gs_scene::{Gaussians, sh_coefficients};

/// `n` Gaussians of a room, of unit quaternions; the same on every call.
pub fn cloud(n: usize, sh_degree: u8) -> Gaussians {
    let mut state = 11;
    let mut draw = move |low: f32, high: f32| {
        state += 1;
        low + (high - low) * (gs_io::mixed(state) >> 40) as f32 / (1 << 24) as f32
    };
    let mut g = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..n {
        g.means.push([(); 3].map(|()| draw(-4.0, 4.0)));
        g.log_scales.push([(); 3].map(|()| draw(-7.0, -1.0)));
        let q = [(); 4].map(|()| draw(-1.0, 1.0));
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        g.rotations.push(q.map(|v| v / length));
        g.opacity_logits.push(draw(-4.0, 5.0));
        g.sh.extend((0..3).map(|_| draw(-1.5, 1.5)));
        g.sh.extend((3..3 * sh_coefficients(sh_degree)).map(|_| draw(-0.7, 0.7)));
    }
    g
}

/// The largest differences between two versions of the same Gaussians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Differences {
    /// Of centres, world units.
    pub center: f32,
    /// Of logarithms of scales.
    pub log_scale: f32,
    /// Angle between rotations, radians.
    pub angle: f32,
    /// Of opacities, 0 to 1.
    pub opacity: f32,
    /// Of the colour of the constant coefficient, 0 to 1.
    pub color: f32,
    /// Of the coefficients of degree 1, and of 2 and 3.
    pub harmonics: [f32; 2],
}

impl Differences {
    pub fn between(a: &Gaussians, b: &Gaussians) -> Self {
        assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
        let most = |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0.0f32, |m, (x, y)| m.max((x - y).abs()));
        let angle = |i: usize| {
            let unit = |q: [f32; 4]| {
                let length = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
                q.map(|v| f64::from(v) / length)
            };
            let (p, q) = (unit(a.rotations[i]), unit(b.rotations[i]));
            let distance = |sign: f64| p.iter().zip(q).map(|(x, y)| (x - sign * y).powi(2)).sum::<f64>().sqrt();
            (4.0 * (distance(1.0).min(distance(-1.0)) / 2.0).asin()) as f32
        };
        let each = 0..a.len();
        let of = |i: usize, range: std::ops::Range<usize>| {
            let end = range.end.min(a.sh_stride());
            most(&a.sh_of(i)[range.start.min(end)..end], &b.sh_of(i)[range.start.min(end)..end])
        };
        let largest = |f: &dyn Fn(usize) -> f32| each.clone().map(f).fold(0.0, f32::max);
        Self {
            center: most(a.means.as_flattened(), b.means.as_flattened()),
            log_scale: most(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
            angle: largest(&angle),
            opacity: largest(&|i| (a.opacity(i) - b.opacity(i)).abs()),
            color: gs_scene::SH_C0 * largest(&|i| of(i, 0..3)),
            harmonics: [largest(&|i| of(i, 3..12)), largest(&|i| of(i, 12..48))],
        }
    }

    /// Fails where one is more than `most`.
    #[track_caller]
    pub fn within(self, most: Self) {
        let ok = self.center <= most.center
            && self.log_scale <= most.log_scale
            && self.angle <= most.angle
            && self.opacity <= most.opacity
            && self.color <= most.color
            && self.harmonics[0] <= most.harmonics[0]
            && self.harmonics[1] <= most.harmonics[1];
        assert!(ok, "{self:?}\nis more than\n{most:?}");
    }
}

/// What two readers of the same numbers may differ by: rounding of single precision.
pub const ROUNDING: Differences =
    Differences { center: 1e-4, log_scale: 1e-5, angle: 2e-3, opacity: 1e-5, color: 1e-5, harmonics: [1e-5; 2] };
