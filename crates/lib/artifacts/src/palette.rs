//! The colours by which people tell instances and masks apart: the same in PLYs, pictures and the report.

/// Colour of noise and of pixels without a mask, sRGB in 0 to 1.
pub const NOISE_COLOR: [f32; 3] = [0.25, 0.25, 0.25];

/// Colour of instance or mask `id`, sRGB in 0 to 1. Neighbouring ids differ strongly: the hue advances by the golden
/// angle, lightness and saturation cycle with other periods.
pub fn instance_color(id: u32) -> [f32; 3] {
    let hue = (id as f32 * 0.618_034 + 0.08).fract();
    let value = [0.95, 0.75, 0.85][id as usize % 3];
    let saturation = [0.75, 0.55, 0.9, 0.65][id as usize % 4];
    // HSV to RGB: each channel is a trapezoid over the hue.
    [0.0f32, 2.0 / 3.0, 1.0 / 3.0].map(|shift| {
        let h = ((hue + shift).fract() * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation + saturation * h.clamp(0.0, 1.0))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_ids_look_different() {
        for id in 0..200 {
            let (a, b) = (instance_color(id), instance_color(id + 1));
            let d: f32 = a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f32>().sqrt();
            assert!(d > 0.3, "{id}: {a:?} {b:?}");
            assert!(a.iter().all(|c| (0.0..=1.0).contains(c)));
        }
    }
}
