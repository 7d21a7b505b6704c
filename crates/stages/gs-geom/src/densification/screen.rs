//! What adaptive density control goes by.

/// The gradients of each Gaussian's projected centre since the last densification.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScreenGradients {
    /// Sum over views of the length of d loss / d projected centre, N.
    pub sum: Vec<f32>,
    /// In how many views it was drawn, N.
    pub views: Vec<u32>,
}

impl ScreenGradients {
    /// Nothing seen yet.
    pub fn new(count: usize) -> Self {
        Self { sum: vec![0.0; count], views: vec![0; count] }
    }

    /// Counts a view that drew the Gaussians `visible` at `width` x `height` pixels.
    /// `mean2d` is the gradient of the projected centres: [`gs_raster::Gradients::mean2d`].
    pub fn observe(&mut self, visible: &[u32], mean2d: &[[f32; 2]], width: u32, height: u32) {
        // Pixels to half widths and half heights: the loss's slope by x / (width / 2).
        let (x, y) = (0.5 * width as f32, 0.5 * height as f32);
        for &i in visible {
            let i = i as usize;
            let [gx, gy] = mean2d[i];
            self.sum[i] += (gx * x).hypot(gy * y);
            self.views[i] += 1;
        }
    }

    /// Mean over the views that drew it.
    pub fn mean(&self, i: usize) -> f32 {
        if self.views[i] == 0 { 0.0 } else { self.sum[i] / self.views[i] as f32 }
    }
}
