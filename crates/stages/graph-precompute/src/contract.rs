//! Contracted space: the room as it is, everything beyond drawn together (the contraction of mip-NeRF 360, there for
//! unbounded scenes; arXiv 2111.12077, equation 10).

/// Share of the points that keep their place.
const INSIDE: f64 = 0.75;

/// Points around their origin (the scene's middle) with those outside the sphere that holds three quarters of them moved
/// inwards: a point at r radii goes to 2 - 1/r, so that the farthest background is two radii away.
pub fn contracted(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let length = |p: &[f32; 3]| p.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    let mut lengths: Vec<f64> = points.iter().map(length).collect();
    let rank = (lengths.len() as f64 * INSIDE) as usize;
    if rank >= lengths.len() {
        return points.to_vec();
    }
    let radius = *lengths.select_nth_unstable_by(rank, f64::total_cmp).1;
    let contract = |p: &[f32; 3]| {
        let r = length(p) / radius;
        // A radius of 0: three quarters of the points coincide, and the others are all infinitely far in its terms.
        if r.is_nan() || r <= 1.0 || r.is_infinite() {
            return *p;
        }
        let scale = (2.0 - 1.0 / r) / r;
        p.map(|v| (f64::from(v) * scale) as f32)
    };
    points.iter().map(contract).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_inside_stays_and_the_outside_comes_near() {
        let mut p: Vec<[f32; 3]> = (1..=8).map(|i| [i as f32 / 8.0, 0.0, 0.0]).collect();
        p.extend([[0.0, 4.0, 0.0], [0.0, 0.0, -4e6]]);
        // 10 points: the one of rank 7 is at radius 1.
        let c = contracted(&p);
        assert_eq!(c[..8], p[..8]);
        assert_eq!(c[8], [0.0, 1.75, 0.0]);
        assert!((c[9][2] + 2.0).abs() < 1e-5);
        assert_eq!(contracted(&[[3.0; 3]; 5]), [[3.0; 3]; 5]);
        assert_eq!(contracted(&[[0.0; 3], [0.0; 3], [0.0; 3], [0.0; 3], [1.0; 3]])[4], [1.0; 3]);
        assert!(contracted(&[]).is_empty());
    }
}
