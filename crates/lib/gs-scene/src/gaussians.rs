//! The Gaussians of a scene, as a structure of arrays.

use crate::middle::{less, shift_of};
use gs_io::{Error, Result};

/// Largest coordinate of a centre: squares of distances stay finite in f32.
const FARTHEST: f32 = 1e17;

/// Zeroth real spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + `SH_C0` * dc for degree 0.
pub const SH_C0: f32 = 0.282_094_8;

/// Number of spherical-harmonics coefficients per colour channel up to `degree`: (degree + 1)^2.
pub const fn sh_coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// N Gaussians in the parametrisation that 3DGS stores and optimises.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres in the world, N: less [`Self::shift`].
    pub means: Vec<[f32; 3]>,
    /// Natural logarithms of the standard deviations along the Gaussian's own axes, N.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations as quaternions w x y z, not necessarily normalised, N.
    pub rotations: Vec<[f32; 4]>,
    /// Opacities before the sigmoid, N.
    pub opacity_logits: Vec<f32>,
    /// Spherical-harmonics coefficients, `[N][coefficients][rgb]` flattened, the constant term first.
    pub sh: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// What was subtracted from the centres, so that single precision holds them; zeros for scenes that are not far from the origin.
    pub shift: [f64; 3],
}

/// Logit of an opacity, as [`Gaussians::opacity_logits`] has it: ln(o / (1 - o)), infinite for 0 and 1.
pub fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

impl Gaussians {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Floats in [`Self::sh`] per Gaussian: 3, 12, 27 or 48.
    pub fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.sh_degree)
    }

    /// The spherical-harmonics coefficients of Gaussian `i`, `[coefficients][rgb]`.
    pub fn sh_of(&self, i: usize) -> &[f32] {
        let s = self.sh_stride();
        &self.sh[i * s..(i + 1) * s]
    }

    /// Size of the scene by its Gaussians, world units: the median distance of the centres from the median centre. 1 for
    /// none, and where they coincide.
    pub fn spread(&self) -> f64 {
        fn median(mut values: Vec<f32>) -> f64 {
            let middle = values.len() / 2;
            f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
        }
        if self.is_empty() {
            return 1.0;
        }
        let centre = [0, 1, 2].map(|c| median(self.means.iter().map(|m| m[c]).collect()));
        let from_centre =
            |m: &[f32; 3]| (0..3).map(|c| (f64::from(m[c]) - centre[c]).powi(2)).sum::<f64>().sqrt() as f32;
        Some(median(self.means.iter().map(from_centre).collect())).filter(|s| *s > 0.0 && s.is_finite()).unwrap_or(1.0)
    }

    /// Brings centres that are far from the origin near it, and adds what they move by to [`Self::shift`]. Says whether they were far: then
    /// single precision had cost them digits before.
    pub(crate) fn settle(&mut self) -> bool {
        let by = shift_of(self.means.iter().map(|m| m.map(f64::from)));
        let far = by != [0.0; 3];
        if far {
            self.means.iter_mut().for_each(|m| *m = less(m.map(f64::from), by));
            self.shift = [0, 1, 2].map(|c| self.shift[c] + by[c]);
        }
        far
    }

    /// The same Gaussians with another [`Self::shift`].
    pub fn shift_to(&mut self, shift: [f64; 3]) {
        if self.shift != shift {
            let by = [0, 1, 2].map(|c| shift[c] - self.shift[c]);
            self.means.iter_mut().for_each(|m| *m = less(m.map(f64::from), by));
            self.shift = shift;
        }
    }

    /// The highest degree of the spherical harmonics of which some coefficient is not zero: what renders need.
    pub fn used_degree(&self) -> u8 {
        let used = |degree: &u8| {
            let band = 3 * sh_coefficients(degree - 1)..3 * sh_coefficients(*degree);
            (0..self.len()).any(|i| self.sh_of(i)[band.clone()].iter().any(|&v| v != 0.0))
        };
        (1..=self.sh_degree).rev().find(used).unwrap_or(0)
    }

    /// Opacity of Gaussian `i`, in (0, 1).
    pub fn opacity(&self, i: usize) -> f32 {
        1.0 / (1.0 + (-self.opacity_logits[i]).exp())
    }

    /// View-independent colour of Gaussian `i` from its constant term, not clamped.
    pub fn base_color(&self, i: usize) -> [f32; 3] {
        let sh = self.sh_of(i);
        [0, 1, 2].map(|c| 0.5 + SH_C0 * sh[c])
    }

    /// The properties among which Gaussian `i` has a number that is not finite, if it has one; an opacity logit may be infinite.
    pub fn not_finite(&self, i: usize) -> Option<&'static str> {
        let groups = [
            ("x, y, z", &self.means[i][..]),
            ("scale_*", &self.log_scales[i]),
            ("rot_*", &self.rotations[i]),
            ("f_dc_* or f_rest_*", self.sh_of(i)),
        ];
        let found = groups.iter().find(|(_, values)| !values.iter().all(|v| v.is_finite()));
        found.map(|(name, _)| *name).or(self.opacity_logits[i].is_nan().then_some("opacity"))
    }

    /// Whether the centre of Gaussian `i` can be calculated with.
    pub(crate) fn is_near(&self, i: usize) -> bool {
        self.means[i].iter().all(|v| v.abs() <= FARTHEST)
    }

    /// The properties of Gaussian `i` that cannot be used, and why, in words: a number is not finite, the centre is too far, or the
    /// rotation has length 0. Programs that take no rotation for that make balls of what nobody ever saw.
    fn damage(&self, i: usize) -> Option<(&'static str, &'static str)> {
        let turned = self.rotations[i].iter().any(|&v| v != 0.0);
        let not_finite = self.not_finite(i).map(|name| (name, "is not finite"));
        let far = (!self.is_near(i)).then_some(("x, y, z", "is beyond 1e17"));
        not_finite.or(far).or((!turned).then_some(("rot_*", "is a rotation of length 0")))
    }

    /// Whether Gaussian `i` can be used: its numbers are finite, but for the opacity logit, its centre is within 1e17, and its rotation
    /// has a length.
    pub fn is_whole(&self, i: usize) -> bool {
        self.damage(i).is_none()
    }

    /// Checks that every Gaussian is whole.
    pub fn check_whole(&self) -> Result<()> {
        let damage = (0..self.len()).find_map(|i| Some((i, self.damage(i)?)));
        let Some((first, (parameter, is))) = damage else { return Ok(()) };
        let all = (first..self.len()).filter(|&i| !self.is_whole(i)).count();
        Err(Error::new(format!("a parameter {is}"))
            .field(format!("vertex {first}, {parameter}"))
            .found(format!("{all} of {} vertices with such a one", self.len()))
            .hint("remove these vertices, or export the file again"))
    }

    /// Whether every number of Gaussian `i` is finite.
    pub fn is_finite(&self, i: usize) -> bool {
        self.not_finite(i).is_none() && self.opacity_logits[i].is_finite()
    }

    /// Makes infinite opacity logits +-50, which is as opaque and as transparent as single precision tells.
    pub fn bound_opacities(&mut self) {
        self.opacity_logits.iter_mut().filter(|o| o.is_infinite()).for_each(|o| *o = o.clamp(-50.0, 50.0));
    }

    /// The Gaussians at `indices`, in that order.
    ///
    /// # Panics
    /// When an index is out of range.
    #[must_use]
    pub fn select(&self, indices: &[u32]) -> Self {
        let at = || indices.iter().map(|&i| i as usize);
        // Harmonics are most of it: no more room than they need.
        let mut sh = Vec::with_capacity(indices.len() * self.sh_stride());
        at().for_each(|i| sh.extend_from_slice(self.sh_of(i)));
        Self {
            means: at().map(|i| self.means[i]).collect(),
            log_scales: at().map(|i| self.log_scales[i]).collect(),
            rotations: at().map(|i| self.rotations[i]).collect(),
            opacity_logits: at().map(|i| self.opacity_logits[i]).collect(),
            sh,
            sh_degree: self.sh_degree,
            shift: self.shift,
        }
    }

    /// The same with spherical harmonics of another degree: cut off, or filled with zeros.
    #[must_use]
    pub fn with_degree(self, sh_degree: u8) -> Self {
        if self.sh_degree == sh_degree {
            return self;
        }
        let (from, to) = (self.sh_stride(), 3 * sh_coefficients(sh_degree));
        let mut sh = vec![0.0; self.len() * to];
        for (new, old) in sh.chunks_exact_mut(to).zip(self.sh.chunks_exact(from)) {
            let both = from.min(to);
            new[..both].copy_from_slice(&old[..both]);
        }
        Self { sh, sh_degree, ..self }
    }

    /// Checks that the arrays fit together.
    pub fn check(&self) -> Result<()> {
        let n = self.len();
        let lengths = [
            ("log_scales", self.log_scales.len(), n),
            ("rotations", self.rotations.len(), n),
            ("opacity_logits", self.opacity_logits.len(), n),
            ("sh", self.sh.len(), n * self.sh_stride()),
        ];
        for (field, found, expected) in lengths {
            if found != expected {
                return Err(Error::new("arrays of different lengths").field(field).found(found).expected(expected));
            }
        }
        if self.sh_degree > 3 {
            return Err(Error::new("unsupported degree").field("sh_degree").found(self.sh_degree).expected("0 to 3"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_has_the_scenes_scale_and_ignores_what_is_far() {
        let at = |scale: f32| {
            let mut means: Vec<[f32; 3]> = (0..99).map(|i| [i as f32 * scale, 5.0, 0.0]).collect();
            means.push([1e9, 0.0, 0.0]);
            Gaussians { means, ..Gaussians::default() }.spread()
        };
        assert!((at(1.0) - 25.0).abs() < 1.0, "{}", at(1.0));
        assert!((at(1e-6) / at(1.0) - 1e-6).abs() < 1e-8);
        assert_eq!(Gaussians::default().spread(), 1.0);
        assert_eq!(Gaussians { means: vec![[3.0; 3]; 4], ..Gaussians::default() }.spread(), 1.0);
    }

    #[test]
    fn bands_of_zeros_are_not_used() {
        let mut g = Gaussians { means: vec![[0.0; 3]; 2], sh: vec![0.0; 96], sh_degree: 3, ..Gaussians::default() };
        assert_eq!(g.used_degree(), 0);
        g.sh[48 + 12] = 0.5;
        assert_eq!(g.used_degree(), 2);
        g.sh[47] = -0.5;
        assert_eq!(g.used_degree(), 3);
    }
}
