//! The model of the paper's stage 2: per-Gaussian features, the graph network that adds context, the loss on one view's
//! masks, and their gradients. Written once for f32 and f64.

use super::alignment::alignment;
use super::context::{Context, NONE};
use super::loss::{self, Evaluated, SHORTEST, dot};
use super::masks::MaskSet;
use super::network::{self, Activations, Layer};
use super::normalize::{Moments, channel_moments, row_moments};
use super::real::Real;
use super::terms;
use crate::options::{Axis, Contrastive, Init, Loss, UnitLength};
use crate::random::normal;
use rand::RngExt;
use rayon::prelude::*;
use std::ops::Range;

/// Channels of a colour.
pub const COLOR: usize = 3;
/// Anchors worked on at a time.
const CHUNK: usize = 512;

/// Parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Model<T> {
    /// Dimension of a feature, d.
    pub dim: usize,
    pub options: Contrastive,
    /// Features, `[n][d]`, in the training order.
    pub features: Vec<T>,
    pub layers: Vec<Layer<T>>,
}

/// What the graph network makes of the features.
#[derive(Debug, Clone, Default)]
pub struct Propagated<T> {
    /// Standardised output of each anchor `[M][d]`; empty without layers.
    pub hat: Vec<T>,
    activations: Activations<T>,
    /// Of each channel, or of each anchor.
    moments: Vec<Moments>,
}

impl<T> Propagated<T> {
    /// Bytes of all activations.
    pub fn bytes(&self) -> usize {
        let Activations { features, sums } = &self.activations;
        let values = features.iter().chain([sums, &self.hat]).map(Vec::len).sum::<usize>();
        values * size_of::<T>()
    }
}

/// Loss and gradients of one view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Step<T> {
    pub loss: f64,
    /// 1 - mean cosine of the centroids of different masks.
    pub separation: f64,
    /// Gradient of the features of the view's columns `[v][d]`.
    pub features: Vec<T>,
    pub layers: Vec<Vec<T>>,
}

impl<T: Real> Model<T> {
    /// A model before training. `rng` draws features in the order of kept Gaussians, whatever the training order.
    pub fn new(d: usize, options: Contrastive, context: &Context, rng: &mut impl RngExt) -> Self {
        let n = context.order.len();
        let drawn: Vec<T> = (0..n * d)
            .map(|_| {
                T::of(match options.init {
                    Init::Uniform => rng.random_range(0.0..1.0),
                    Init::NormalSmall => 0.01 * normal(rng),
                })
            })
            .collect();
        let features =
            context.order.iter().flat_map(|&i| drawn[i as usize * d..(i as usize + 1) * d].to_vec()).collect();
        let layers = network::random_layers(options.layers, d + COLOR, d, rng);
        Self { dim: d, options, features, layers }
    }

    /// Runs the graph network on the (detached) features.
    pub fn propagate(&self, context: &Context) -> Propagated<T> {
        if self.layers.is_empty() {
            return Propagated::default();
        }
        let d = self.dim;
        let (h, sums) = self.inputs(context);
        let activations = network::forward(&self.layers, context, h, sums);
        let output = activations.features.last().expect("there are layers");
        let moments: Vec<Moments> = match self.options.norm_axis {
            Axis::Channel => channel_moments(output, d, Some(&context.served)),
            Axis::Gaussian => output.chunks_exact(d).map(row_moments).collect(),
        };
        let hat = output.iter().enumerate().map(|(i, v)| T::of(moments[self.group(i)].apply(v.get()))).collect();
        Propagated { hat, activations, moments }
    }

    /// Which of the moments standardise entry `i` of an `[M][d]` array.
    fn group(&self, i: usize) -> usize {
        match self.options.norm_axis {
            Axis::Channel => i % self.dim,
            Axis::Gaussian => i / self.dim,
        }
    }

    /// Standardised inputs h of the anchors, and their sums over neighbours: `[M][d + 3]` each.
    fn inputs<'a>(&self, context: &'a Context) -> (Vec<T>, Vec<T>) {
        let d = self.dim;
        let channels = d + COLOR;
        let moments: Vec<Moments> = match self.options.norm_axis {
            Axis::Channel => {
                let colors: Vec<f32> = context.colors.iter().flatten().copied().collect();
                let mut moments = channel_moments(&self.features, d, None);
                moments.extend(channel_moments(&colors, COLOR, None));
                moments
            }
            Axis::Gaussian => Vec::new(),
        };
        let add = |place: usize, row: &mut [f64]| {
            let mut h = [0.0; 64 + COLOR];
            let h = &mut h[..channels];
            let f = &self.features[place * d..(place + 1) * d];
            h.iter_mut().zip(f).for_each(|(h, f)| *h = f.get());
            h[d..].iter_mut().zip(context.colors[place]).for_each(|(h, c)| *h = f64::from(c));
            match self.options.norm_axis {
                Axis::Channel => row.iter_mut().zip(h).zip(&moments).for_each(|((r, h), m)| *r += m.apply(*h)),
                Axis::Gaussian => {
                    let m = row_moments(h);
                    row.iter_mut().zip(h).for_each(|(r, h)| *r += m.apply(*h));
                }
            }
        };
        let anchors = context.anchors.len();
        // Sums h over the places that `places_of(anchor)` names.
        let gather = |places_of: &(dyn Fn(usize) -> &'a [u32] + Sync)| -> Vec<T> {
            let mut out = vec![T::default(); anchors * channels];
            out.par_chunks_mut(CHUNK * channels).enumerate().for_each(|(chunk, rows)| {
                let mut sum = vec![0.0; channels];
                for (i, row) in rows.chunks_exact_mut(channels).enumerate() {
                    sum.fill(0.0);
                    places_of(chunk * CHUNK + i).iter().for_each(|&place| add(place as usize, &mut sum));
                    row.iter_mut().zip(&sum).for_each(|(r, &s)| *r = T::of(s));
                }
            });
            out
        };
        let h = gather(&|a| &context.anchors[a..=a]);
        (h, gather(&|a| context.neighbours_of(a)))
    }

    /// f_final of the Gaussian at `place`: its own feature and what it receives. Returns the length that was divided by, or 1
    /// where nothing is brought to unit length.
    #[inline]
    fn final_feature(&self, context: &Context, propagated: &Propagated<T>, place: usize, out: &mut [f64]) -> f64 {
        let d = out.len();
        let own = &self.features[place * d..(place + 1) * d];
        out.iter_mut().zip(own).for_each(|(o, f)| *o = f.get());
        let source = context.source[place];
        if source != NONE && !propagated.hat.is_empty() {
            let hat = &propagated.hat[source as usize * d..(source as usize + 1) * d];
            out.iter_mut().zip(hat).for_each(|(o, h)| *o += h.get());
        }
        if self.options.unit_length == UnitLength::After { make_unit(out) } else { 1.0 }
    }

    /// f_final of all Gaussians `[n][d]`, in the order of `kept`.
    pub fn final_features(&self, context: &Context, propagated: &Propagated<T>) -> Vec<f32> {
        let d = self.dim;
        let mut out = vec![0.0f32; self.features.len()];
        let mut row = vec![0.0; d];
        for (place, &i) in context.order.iter().enumerate() {
            self.final_feature(context, propagated, place, &mut row);
            let to = &mut out[i as usize * d..(i as usize + 1) * d];
            to.iter_mut().zip(&row).for_each(|(o, &v)| *o = v as f32);
        }
        out
    }

    /// Centroids A f of all masks `[K][d]`: sums over pieces of columns, in order.
    pub fn centroids(&self, context: &Context, propagated: &Propagated<T>, set: &MaskSet) -> Vec<f64> {
        let d = self.dim;
        let piece = |bounds: &[u32]| {
            let (mut sums, mut f) = (vec![0.0; set.len() * d], vec![0.0; d]);
            for c in bounds[0] as usize..bounds[1] as usize {
                self.final_feature(context, propagated, set.columns[c] as usize, &mut f);
                for e in set.start[c] as usize..set.start[c + 1] as usize {
                    let (k, w) = (set.mask[e] as usize, f64::from(set.weight[e]));
                    sums[k * d..(k + 1) * d].iter_mut().zip(&f).for_each(|(s, f)| *s += w * f);
                }
            }
            sums
        };
        let parts: Vec<Vec<f64>> = set.pieces.par_windows(2).map(piece).collect();
        let mut total = vec![0.0; set.len() * d];
        for part in parts {
            total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
        }
        total
    }

    /// [Alignment](alignment()) of a view's masks.
    pub fn alignment(&self, context: &Context, propagated: &Propagated<T>, set: &MaskSet) -> f64 {
        alignment(set, &self.centroids(context, propagated, set), self.dim, |place, f| {
            self.final_feature(context, propagated, place, f);
        })
    }

    /// Loss and gradients on the masks of one view. `noise` seeds the choice of pixels.
    pub fn step(&self, context: &Context, propagated: &Propagated<T>, set: &MaskSet, noise: u64) -> Step<T> {
        let view = self.look(context, propagated, set, noise);
        let d = self.dim;
        // Back to the columns, piece by piece; the Gaussians of an anchor lie in one piece.
        let parts: Vec<PieceGradients<T>> = set
            .pieces
            .par_windows(2)
            .map(|bounds| self.piece_gradients(context, propagated, &view, bounds[0] as usize..bounds[1] as usize))
            .collect();
        let mut step = Step {
            loss: view.evaluated.loss,
            separation: view.evaluated.separation,
            features: Vec::with_capacity(set.columns.len() * d),
            layers: Vec::new(),
        };
        let mut hat_gradient = vec![0.0f64; propagated.hat.len()];
        for part in parts {
            step.features.extend(part.features);
            for (&a, sum) in part.anchors.iter().zip(part.to_anchors.chunks_exact(d)) {
                hat_gradient[a as usize * d..(a as usize + 1) * d].copy_from_slice(sum);
            }
        }
        if !self.layers.is_empty() {
            let gradient = self.unstandardised(context, propagated, &hat_gradient);
            step.layers = network::backward(&self.layers, context, &propagated.activations, gradient);
        }
        step
    }

    /// The loss on the masks of one view, and its gradients of centroids and pixels.
    fn look<'a>(&self, context: &Context, propagated: &Propagated<T>, set: &'a MaskSet, noise: u64) -> View<'a> {
        let (d, s) = (self.dim, &self.options);
        let centroids = self.centroids(context, propagated, set);
        let mut evaluated = loss::evaluate(s.loss, &centroids, d, s.tau);
        let to_centroids = &mut evaluated.centroids;
        let feature = |c: usize, f: &mut [f64]| {
            self.final_feature(context, propagated, set.columns[c] as usize, f);
        };
        let of_gaussians = (s.loss == Loss::Gaussian)
            .then(|| terms::of_gaussians(d, s.tau, set, feature, &centroids, &mut *to_centroids));
        let of_pixels = s.needs_pixels().then(|| terms::of_pixels(d, s, set, noise, feature, &centroids, to_centroids));
        let mut to_columns = Vec::new();
        for (value, rows) in [of_gaussians, of_pixels].into_iter().flatten() {
            evaluated.loss += value;
            to_columns.push(rows);
        }
        View { set, evaluated, to_columns }
    }

    /// Gradients of the features of some columns, and of what their anchors give them.
    fn piece_gradients(
        &self,
        context: &Context,
        propagated: &Propagated<T>,
        view: &View<'_>,
        columns: Range<usize>,
    ) -> PieceGradients<T> {
        let (d, set, evaluated) = (self.dim, view.set, &view.evaluated);
        let mut made = PieceGradients {
            features: Vec::with_capacity(columns.len() * d),
            anchors: Vec::new(),
            to_anchors: Vec::new(),
        };
        // No allocation per Gaussian from here: there are many of them, and little work in one.
        let (mut f, mut g, mut spare) = (vec![0.0; d], vec![0.0; d], vec![0.0; d]);
        for c in columns {
            g.fill(0.0);
            for e in set.start[c] as usize..set.start[c + 1] as usize {
                let (k, w) = (set.mask[e] as usize * d, f64::from(set.weight[e]));
                g.iter_mut().zip(&evaluated.centroids[k..k + d]).for_each(|(g, v)| *g += w * v);
            }
            let place = set.columns[c] as usize;
            for rows in &view.to_columns {
                g.iter_mut().zip(&rows[c * d..(c + 1) * d]).for_each(|(g, v)| *g += v);
            }
            if self.options.unit_length == UnitLength::After {
                let length = self.final_feature(context, propagated, place, &mut f);
                spare.copy_from_slice(&g);
                g.fill(0.0);
                loss::add_direction_gradient(&mut g, &f, length, &spare);
            }
            let source = context.source[place];
            if source != NONE && !propagated.hat.is_empty() {
                if made.anchors.last() != Some(&source) {
                    made.anchors.push(source);
                    made.to_anchors.resize(made.anchors.len() * d, 0.0);
                }
                let sum = made.to_anchors.len() - d;
                made.to_anchors[sum..].iter_mut().zip(&g).for_each(|(s, g)| *s += g);
            }
            made.features.extend(g.iter().map(|&v| T::of(v)));
        }
        made
    }

    /// Gradient of the network's output `[M][d]` from that of its standardised output.
    fn unstandardised(&self, context: &Context, propagated: &Propagated<T>, g: &[f64]) -> Vec<T> {
        let d = self.dim;
        let groups = propagated.moments.len();
        let (mut sum_g, mut sum_gy) = (vec![0.0; groups], vec![0.0; groups]);
        for (i, (&g, y)) in g.iter().zip(&propagated.hat).enumerate() {
            sum_g[self.group(i)] += g;
            sum_gy[self.group(i)] += g * y.get();
        }
        let weight = |i: usize| match self.options.norm_axis {
            Axis::Channel => f64::from(context.served[i / d]),
            Axis::Gaussian => 1.0,
        };
        g.par_iter()
            .zip(&propagated.hat)
            .enumerate()
            .with_min_len(CHUNK)
            .map(|(i, (&g, y))| {
                let c = self.group(i);
                T::of(propagated.moments[c].backward(weight(i), g, y.get(), sum_g[c], sum_gy[c]))
            })
            .collect()
    }
}

/// Divides a vector by its length, which is returned; one without direction becomes zeros.
fn make_unit(v: &mut [f64]) -> f64 {
    let length = dot(v, v).sqrt();
    v.iter_mut().for_each(|v| *v = if length > SHORTEST { *v / length } else { 0.0 });
    length
}

/// Loss of a view, and what the gradients of its columns are computed from.
struct View<'a> {
    set: &'a MaskSet,
    evaluated: Evaluated,
    /// Gradients of the columns' features `[columns][d]` from terms of single Gaussians and pixels.
    to_columns: Vec<Vec<f64>>,
}

/// Gradients from one piece of columns: of the columns' features `[c][d]`, and, for the anchors `[a]` that they receive from,
/// of what each gives, `[a][d]`.
struct PieceGradients<T> {
    features: Vec<T>,
    anchors: Vec<u32>,
    to_anchors: Vec<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contrastive::testing::{context, mask_set};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const D: usize = 4;

    /// Compares every gradient with central differences.
    fn check(options: Contrastive, propagate: bool) {
        let name = format!("{options:?} {propagate}");
        let context = context(50, propagate);
        let set = mask_set(&context, 5, 3);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut model = Model::<f64>::new(D, options, &context, &mut rng);
        let propagated = model.propagate(&context);
        let step = model.step(&context, &propagated, &set, 77);
        let close = |analytic: f64, plus: f64, minus: f64, h: f64, what: &str| {
            let numeric = (plus - minus) / (2.0 * h);
            assert!(
                (analytic - numeric).abs() <= 1e-6 * (1.0 + analytic.abs().max(numeric.abs())),
                "{name}: {what}: {analytic} {numeric}"
            );
        };
        let (d, h) = (model.dim, 1e-6);
        // Inputs of the network are detached: what anchors give stays as it is.
        for (c, &place) in set.columns.iter().enumerate() {
            for j in 0..d {
                let at = place as usize * d + j;
                let was = model.features[at];
                let mut loss = |v: f64| {
                    model.features[at] = v;
                    model.step(&context, &propagated, &set, 77).loss
                };
                let (plus, minus) = (loss(was + h), loss(was - h));
                model.features[at] = was;
                close(step.features[c * d + j], plus, minus, h, "feature");
            }
        }
        assert!(step.features.iter().any(|g| g.abs() > 1e-4), "{name}: all gradients vanish");
        for l in 0..model.layers.len() {
            for i in 0..model.layers[l].weights.len() {
                let was = model.layers[l].weights[i];
                let mut loss = |v: f64| {
                    model.layers[l].weights[i] = v;
                    let p = model.propagate(&context);
                    model.step(&context, &p, &set, 77).loss
                };
                let (plus, minus) = (loss(was + h), loss(was - h));
                model.layers[l].weights[i] = was;
                close(step.layers[l][i], plus, minus, h, "weight");
            }
        }
        let moved = step.layers.iter().flatten().any(|g| g.abs() > 1e-5);
        assert_eq!(moved, model.options.layers > 0, "{name}: gradients of weights");
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        let printed = Contrastive::default();
        for layers in 0..=4 {
            check(Contrastive { layers, ..printed.clone() }, true);
        }
        check(printed.clone(), false);
        for loss in [Loss::Printed, Loss::Gaussian, Loss::Pixel, Loss::Separation] {
            check(Contrastive { loss, unit_length: UnitLength::After, ..printed.clone() }, true);
            for norm_axis in [Axis::Channel, Axis::Gaussian] {
                check(Contrastive { loss, norm_axis, ..printed.clone() }, true);
            }
        }
        let cohesive = Contrastive { cohesion: 0.3, tau: 0.5, init: Init::NormalSmall, ..printed };
        check(cohesive.clone(), true);
        check(Contrastive { loss: Loss::Pixel, layers: 0, pixels: 2, ..cohesive.clone() }, true);
        check(Contrastive { loss: Loss::Pixel, ..cohesive }, true);
    }
}
