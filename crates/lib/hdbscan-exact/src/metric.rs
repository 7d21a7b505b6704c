//! What distance is between points.

use std::borrow::Cow;

/// A distance. Trees and searches are Euclidean; others are functions of that which grow with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Metric {
    /// The root of the sum of squares.
    #[default]
    Euclidean,
    /// 1 - the cosine of the angle between points, 0 to 2. No point may be 0.
    Cosine,
}

impl Metric {
    /// Points `[n][dim]` whose Euclidean distances [`Self::of_euclidean`] takes.
    ///
    /// # Panics
    /// With cosine when a point is 0.
    pub(crate) fn prepare(self, points: &[f32], dim: usize) -> Cow<'_, [f32]> {
        if self == Self::Euclidean {
            return Cow::Borrowed(points);
        }
        let mut out = points.to_vec();
        for p in out.chunks_exact_mut(dim) {
            let length = p.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
            assert!(length > 0.0, "a point is 0 and has no direction");
            p.iter_mut().for_each(|v| *v = (f64::from(*v) / length) as f32);
        }
        Cow::Owned(out)
    }

    /// This distance of points that are so far from each other after [`Self::prepare`].
    pub(crate) fn of_euclidean(self, distance: f64) -> f64 {
        match self {
            Self::Euclidean => distance,
            // The chord between two points on the unit sphere: its square is 2 - 2 cos.
            Self::Cosine => 0.5 * distance * distance,
        }
    }
}
