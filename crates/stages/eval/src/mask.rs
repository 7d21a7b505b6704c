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

    /// Number of pixels in the set.
    pub fn count(&self) -> usize {
        self.bits.iter().filter(|&&b| b).count()
    }

    /// Intersection over union; 0 when both sets are empty (docs/protocols.md).
    pub fn iou(&self, other: &Self) -> f64 {
        assert_eq!((self.width, self.height), (other.width, other.height));
        let (mut both, mut either) = (0usize, 0usize);
        for (&a, &b) in self.bits.iter().zip(&other.bits) {
            both += usize::from(a & b);
            either += usize::from(a | b);
        }
        if either == 0 { 0.0 } else { both as f64 / either as f64 }
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
}
