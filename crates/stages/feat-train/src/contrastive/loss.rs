//! Losses on the centroids of the masks of one view (paper, "Mask-Aware Contrastive Learning"), in f64: there are few
//! masks.

use crate::options::Loss;
/// Centroids shorter than this have no direction and are left out.
pub const SHORTEST: f64 = 1e-12;

/// Loss, its gradients, and how far apart the centroids are.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evaluated {
    /// Mean over masks.
    pub loss: f64,
    /// Gradient of the centroids `[K][d]`.
    pub centroids: Vec<f64>,
    /// 1 - mean cosine of different masks.
    pub separation: f64,
}

/// Unit vectors and lengths of `rows` `[K][d]`.
pub fn directions(rows: &[f64], d: usize) -> (Vec<f64>, Vec<f64>) {
    let mut unit = rows.to_vec();
    let lengths = unit
        .chunks_exact_mut(d)
        .map(|row| {
            let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
            row.iter_mut().for_each(|v| *v = if length > SHORTEST { *v / length } else { 0.0 });
            length
        })
        .collect();
    (unit, lengths)
}

pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Adds to `gradient` that of a vector of this `unit` direction and `length`, given the gradient `g` of its direction.
pub fn add_direction_gradient(gradient: &mut [f64], unit: &[f64], length: f64, g: &[f64]) {
    if length > SHORTEST {
        let along = dot(unit, g);
        for ((o, &g), &u) in gradient.iter_mut().zip(g).zip(unit) {
            *o += (g - along * u) / length;
        }
    }
}

/// log Σ exp without overflow: the maximum taken out. Turns `logits` into their softmax.
pub fn log_sum_exp(logits: &mut [f64]) -> f64 {
    let max = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut sum = 0.0;
    for v in logits.iter_mut() {
        *v = (*v - max).exp();
        sum += *v;
    }
    logits.iter_mut().for_each(|v| *v /= sum);
    max + sum.ln()
}

/// The centroids of a view's masks, to classify single features by.
#[derive(Debug, Clone, PartialEq)]
pub struct Prototypes {
    d: usize,
    tau: f64,
    unit: Vec<f64>,
    length: Vec<f64>,
    /// Those that have a direction.
    alive: Vec<usize>,
}

/// Room for the numbers of one point: an allocation for each of many points would cost more than the sums.
#[derive(Debug, Default)]
pub struct Room {
    unit: Vec<f64>,
    logits: Vec<f64>,
    sum: Vec<f64>,
}

impl Prototypes {
    /// From `centroids` `[K][d]`, at the temperature `tau`.
    pub fn new(centroids: &[f64], d: usize, tau: f64) -> Self {
        let (unit, length) = directions(centroids, d);
        let alive = (0..length.len()).filter(|&k| length[k] > SHORTEST).collect();
        Self { d, tau, unit, length, alive }
    }

    /// Cross-entropy of the softmax over all masks of the cosines with `f`, against its `share` in each mask `[K]`. Adds
    /// the gradients of the centroids' directions `[K][d]` and of `f`.
    pub fn cross_entropy(
        &self,
        f: &[f64],
        share: &[f64],
        room: &mut Room,
        to_directions: &mut [f64],
        to_feature: &mut [f64],
    ) -> f64 {
        let (d, tau, length) = (self.d, self.tau, dot(f, f).sqrt());
        if length <= SHORTEST || self.alive.len() < 2 {
            return 0.0;
        }
        let Room { unit: u, logits, sum } = room;
        u.clear();
        u.extend(f.iter().map(|v| v / length));
        logits.clear();
        logits.extend(self.alive.iter().map(|&k| dot(u, &self.unit[k * d..(k + 1) * d]) / tau));
        let mine: f64 = self.alive.iter().map(|&k| share[k]).sum();
        let positive: f64 = self.alive.iter().zip(&*logits).map(|(&k, l)| share[k] * l).sum();
        let value = mine * log_sum_exp(logits) - positive;
        sum.clear();
        sum.resize(d, 0.0);
        for (&k, p) in self.alive.iter().zip(&*logits) {
            // Gradient of the cosine.
            let g = (mine * p - share[k]) / tau;
            let range = k * d..(k + 1) * d;
            to_directions[range.clone()].iter_mut().zip(&*u).for_each(|(t, u)| *t += g * u);
            sum.iter_mut().zip(&self.unit[range]).for_each(|(s, u)| *s += g * u);
        }
        add_direction_gradient(to_feature, u, length, sum);
        value
    }

    /// Adds the gradient of the centroids `[K][d]`, given that of their directions.
    pub fn add_gradient(&self, of_directions: &[f64], to_centroids: &mut [f64]) {
        for &k in &self.alive {
            let range = k * self.d..(k + 1) * self.d;
            let (unit, g) = (&self.unit[range.clone()], &of_directions[range.clone()]);
            add_direction_gradient(&mut to_centroids[range], unit, self.length[k], g);
        }
    }
}

/// Distance of `f` from `centroid` times `scale`; adds the gradients of both.
pub fn cohesion(f: &[f64], centroid: &[f64], scale: f64, to_centroid: &mut [f64], to_feature: &mut [f64]) -> f64 {
    let difference: Vec<f64> = f.iter().zip(centroid).map(|(f, c)| f - c).collect();
    let distance = dot(&difference, &difference).sqrt();
    if distance > SHORTEST {
        for ((c, f), v) in to_centroid.iter_mut().zip(to_feature).zip(&difference) {
            let g = scale * v / distance;
            *c -= g;
            *f += g;
        }
    }
    scale * distance
}

/// OpenGaussian's loss between masks: the mean over ordered pairs of w / (|a - b|² + 1). Its weight goes by the rank of b among
/// the neighbours of a: 1 for the nearest, 0.1 for the farthest, evenly between; it is a constant. Returns the value, and adds
/// the gradient of the `centroids` `[K][d]`.
fn separation(centroids: &[f64], d: usize, alive: &[usize], gradient: &mut [f64]) -> f64 {
    let of = |k: usize| &centroids[k * d..(k + 1) * d];
    let pairs = (alive.len() * (alive.len() - 1)) as f64;
    let farthest = (alive.len() - 2).max(1) as f64;
    let mut value = 0.0;
    for &a in alive {
        let squares = |b: usize| of(a).iter().zip(of(b)).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
        let mut others: Vec<(f64, usize)> = alive.iter().filter(|&&b| b != a).map(|&b| (squares(b), b)).collect();
        others.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        for (rank, (squared, b)) in others.into_iter().enumerate() {
            let weight = (1.0 - 0.9 * rank as f64 / farthest) / pairs;
            value += weight / (squared + 1.0);
            let slope = -2.0 * weight / ((squared + 1.0) * (squared + 1.0));
            for j in 0..d {
                let pull = slope * (centroids[a * d + j] - centroids[b * d + j]);
                gradient[a * d + j] += pull;
                gradient[b * d + j] -= pull;
            }
        }
    }
    value
}

/// The loss per mask, averaged over the masks that take part. [`Loss::Gaussian`] and [`Loss::Pixel`] do not compare masks:
/// their loss is 0 here, and only the separation counts.
pub fn evaluate(loss: Loss, centroids: &[f64], d: usize, tau: f64) -> Evaluated {
    let (unit, length) = directions(centroids, d);
    let alive: Vec<usize> = (0..length.len()).filter(|&k| length[k] > SHORTEST).collect();
    let mut out = Evaluated { centroids: vec![0.0; centroids.len()], ..Evaluated::default() };
    if alive.len() < 2 {
        return out; // nothing to push from: an empty sum
    }
    let of = |k: usize| &unit[k * d..(k + 1) * d];
    let mut unit_gradient = vec![0.0; centroids.len()];
    let mut cosines = 0.0;
    let share = 1.0 / alive.len() as f64;
    for &k in &alive {
        let others: Vec<usize> = alive.iter().copied().filter(|&j| j != k).collect();
        let mut logits: Vec<f64> = others.iter().map(|&j| dot(of(k), of(j)) / tau).collect();
        cosines += logits.iter().sum::<f64>() * tau;
        if loss != Loss::Printed {
            continue;
        }
        out.loss += share * (log_sum_exp(&mut logits) - 1.0 / tau);
        let softmax = logits;
        let mut add = |k: usize, scale: f64, v: &[f64]| {
            unit_gradient[k * d..(k + 1) * d].iter_mut().zip(v).for_each(|(g, v)| *g += scale * v);
        };
        for (&j, &p) in others.iter().zip(&softmax) {
            add(k, share * p / tau, of(j));
            add(j, share * p / tau, of(k));
        }
    }
    out.separation = 1.0 - cosines * share / (alive.len() - 1) as f64;
    if loss == Loss::Separation {
        out.loss = separation(centroids, d, &alive, &mut out.centroids);
    }
    for k in alive {
        let range = k * d..(k + 1) * d;
        let (g, u) = (&unit_gradient[range.clone()], &unit[range.clone()]);
        add_direction_gradient(&mut out.centroids[range], u, length[k], g);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_printed_loss_is_the_formula() {
        let c = [1.0, 0.0, 0.0, 2.0, 1.0, 1.0];
        let e = evaluate(Loss::Printed, &c, 2, 0.1);
        let r = 0.5f64.sqrt();
        let l = |a: f64, b: f64| -10.0 + ((10.0 * a).exp() + (10.0 * b).exp()).ln();
        let want = (l(0.0, r) + l(0.0, r) + l(r, r)) / 3.0;
        assert!((e.loss - want).abs() < 1e-12, "{} {want}", e.loss);
        assert!((e.separation - (1.0 - 2.0 * r / 3.0)).abs() < 1e-12);
    }

    #[test]
    fn masks_push_their_nearest_away_the_most() {
        let c = [1.0, 2.0, 4.0];
        let e = evaluate(Loss::Separation, &c, 1, 0.1);
        // Per mask the nearest with weight 1, the other with 0.1.
        let want = (1.0 / 2.0 + 0.1 / 10.0) + (1.0 / 2.0 + 0.1 / 5.0) + (1.0 / 5.0 + 0.1 / 10.0);
        assert!((e.loss - want / 6.0).abs() < 1e-12, "{}", e.loss);
        assert!(e.centroids[0] > 0.0 && e.centroids[2] < 0.0, "less loss further out: {:?}", e.centroids);
        assert!(evaluate(Loss::Separation, &[0.5, 1.0], 1, 0.1).loss > 0.0, "two masks");
    }

    #[test]
    fn small_temperatures_do_not_overflow_and_empty_sums_and_zero_centroids_are_left_out() {
        let c = [1.0, 0.0, 0.99, 0.01, 0.0, 1.0];
        let e = evaluate(Loss::Printed, &c, 2, 1e-4);
        assert!(e.loss.is_finite() && e.centroids.iter().all(|g| g.is_finite()), "{e:?}");
        assert_eq!(evaluate(Loss::Printed, &[1.0, 0.0], 2, 0.1).loss, 0.0);
        let with_zero = evaluate(Loss::Printed, &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0], 2, 0.1);
        let without = evaluate(Loss::Printed, &[1.0, 0.0, 0.0, 1.0], 2, 0.1);
        assert_eq!(with_zero.loss, without.loss);
        assert_eq!(with_zero.centroids[2..4], [0.0, 0.0]);
    }
}
