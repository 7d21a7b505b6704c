//! Binary masks over the pixels of a view.

/// A set of pixels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Whether each pixel belongs, `[height][width]`.
    pub bits: Vec<bool>,
}

impl Mask {
    /// The empty set on `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, bits: vec![false; width * height] }
    }

    /// The pixels whose value exceeds `threshold` (strictly).
    ///
    /// # Panics
    /// When `values` does not hold `width` x `height` numbers.
    pub fn above(width: usize, height: usize, values: &[f32], threshold: f32) -> Self {
        assert_eq!(values.len(), width * height);
        Self { width, height, bits: values.iter().map(|&v| v > threshold).collect() }
    }

    /// Number of pixels in the set.
    pub fn count(&self) -> usize {
        self.bits.iter().filter(|&&b| b).count()
    }

    /// Intersection over union; 0 when both sets are empty (docs/protocols.md).
    ///
    /// # Panics
    /// When the masks differ in size.
    pub fn iou(&self, other: &Self) -> f64 {
        assert_eq!((self.width, self.height), (other.width, other.height));
        let (mut both, mut either) = (0usize, 0usize);
        for (&a, &b) in self.bits.iter().zip(&other.bits) {
            both += usize::from(a & b);
            either += usize::from(a | b);
        }
        if either == 0 { 0.0 } else { both as f64 / either as f64 }
    }

    /// The pixels outside the set within `radius` (Chebyshev) of it: an outline that hides nothing of the inside.
    pub fn outline(&self, radius: usize) -> Self {
        // A square window is two passes of a line window.
        let (w, h) = (self.width, self.height);
        let mut rows = Self::new(w, h);
        for y in 0..h {
            for x in 0..w {
                rows.bits[y * w + x] =
                    (x.saturating_sub(radius)..(x + radius + 1).min(w)).any(|u| self.bits[y * w + u]);
            }
        }
        let mut out = Self::new(w, h);
        for y in 0..h {
            for x in 0..w {
                let near = (y.saturating_sub(radius)..(y + radius + 1).min(h)).any(|v| rows.bits[v * w + x]);
                out.bits[y * w + x] = near && !self.bits[y * w + x];
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(x0: usize, x1: usize) -> Mask {
        let mut m = Mask::new(10, 4);
        for y in 1..3 {
            for x in x0..x1 {
                m.bits[y * 10 + x] = true;
            }
        }
        m
    }

    #[test]
    fn iou_of_shifted_blocks() {
        assert_eq!(block(0, 4).iou(&block(2, 6)), 4.0 / 12.0);
        assert_eq!(block(0, 4).iou(&block(0, 4)), 1.0);
        assert_eq!(block(0, 4).iou(&block(5, 9)), 0.0);
        assert_eq!(Mask::new(3, 3).iou(&Mask::new(3, 3)), 0.0, "an empty union scores nothing");
    }

    #[test]
    fn the_threshold_is_strict() {
        assert_eq!(Mask::above(3, 1, &[0.69, 0.7, 0.71], 0.7).bits, [false, false, true]);
    }

    #[test]
    fn the_outline_surrounds_without_overlap() {
        let (m, o) = (block(3, 6), block(3, 6).outline(1));
        assert_eq!(o.count(), 5 * 4 - 6);
        assert!(m.bits.iter().zip(&o.bits).all(|(a, b)| !(a & b)));
    }
}
