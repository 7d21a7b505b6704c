//! Point clouds.

/// Coloured points, such as COLMAP's or a scan's vertices.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions in the world.
    pub positions: Vec<[f32; 3]>,
    /// 8-bit sRGB colours, as many as positions.
    pub colors: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}
