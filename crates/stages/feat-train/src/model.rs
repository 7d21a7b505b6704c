//! The model of the paper's stage 2: per-Gaussian features, the graph network that adds context, the loss on one view's
//! masks, and their gradients. Written once for f32 and f64.

use crate::loss::{self, Loss, Prototypes, SHORTEST, directions, dot};
use crate::network::{self, Activations, Layer};
use crate::normalize::{Axis, Moments, channel_moments, row_moments};
use crate::pixels;
use crate::real::{Real, Weight};
use crate::scene::{Context, MaskSet, NONE, Neighbours};
use rand::Rng;
use rayon::prelude::*;

/// Channels between layers (paper: "an intermediate channel size of 16").
const HIDDEN: usize = 16;
/// Channels of a colour.
pub(crate) const COLOR: usize = 3;
/// Anchors worked on at a time.
const CHUNK: usize = 512;

/// How features start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Init {
    /// Uniform in [0, 1), as OpenGaussian's.
    Uniform,
    /// Normal with deviation 0.01.
    NormalSmall,
}

/// Of what cohesion is the distance to a mask's centroid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum CohesionOf {
    /// The mask's Gaussians, by their weight in it.
    Gaussians,
    /// The rendered features of its sampled pixels, as OpenGaussian has it.
    Pixels,
}

/// What an anchor's own feature is before the first layer, f_m^(0).
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum AnchorStart {
    /// Its input h: feature and colour.
    Inputs,
    /// Its feature alone; colours come in through the neighbours.
    Feature,
}

/// What shapes the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Numbers per feature, d.
    pub dim: usize,
    /// Layers of the graph network, 0 to 4; 0 trains features alone.
    pub layers: usize,
    /// What anchors start from.
    pub anchor_start: AnchorStart,
    /// Whether what is negative becomes zero after the last layer too.
    pub last_relu: bool,
    /// Whether f_final is brought to unit length, per Gaussian, before it is rendered.
    pub unit_length: bool,
    /// What is standardised together.
    pub norm_axis: Axis,
    /// The loss.
    pub loss: Loss,
    /// Temperature, more than 0.
    pub tau: f64,
    /// Weight of the cohesion term (pulls Gaussians to the centroids of their masks); the paper has none.
    pub cohesion: f64,
    /// Of what.
    pub cohesion_of: CohesionOf,
    /// How features start.
    pub init: Init,
}

impl Settings {
    /// The loss as the paper prints it, without cohesion, at temperature 0.1, channels standardised over anchors, features that
    /// start uniform.
    pub fn printed(dim: usize, layers: usize) -> Self {
        Self {
            dim,
            layers,
            anchor_start: AnchorStart::Inputs,
            last_relu: true,
            unit_length: false,
            norm_axis: Axis::Channel,
            loss: Loss::Printed,
            tau: 0.1,
            cohesion: 0.0,
            cohesion_of: CohesionOf::Gaussians,
            init: Init::Uniform,
        }
    }

    /// Whether the loss looks at sampled pixels.
    pub fn needs_pixels(&self) -> bool {
        self.loss == Loss::Pixel || self.cohesion > 0.0 && self.cohesion_of == CohesionOf::Pixels
    }
}

/// Parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Model<T> {
    /// What shapes it.
    pub settings: Settings,
    /// Features, `[n][d]`, in the training order.
    pub features: Vec<T>,
    /// The graph network.
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

/// Loss and gradients of one view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Step<T> {
    /// The loss.
    pub loss: f64,
    /// 1 - mean cosine of the centroids of different masks.
    pub separation: f64,
    /// Gradient of the features of the view's columns `[v][d]`.
    pub features: Vec<T>,
    /// Gradient of each layer's weights.
    pub layers: Vec<Vec<T>>,
}

impl<T: Real> Model<T> {
    /// A model before training. `rng` draws features in the order of kept Gaussians, whatever the training order.
    pub fn new(settings: Settings, context: &Context, rng: &mut impl Rng) -> Self {
        let (n, d) = (context.order.len(), settings.dim);
        let drawn: Vec<T> = (0..n * d)
            .map(|_| {
                T::of(match settings.init {
                    Init::Uniform => rng.random_range(0.0..1.0),
                    Init::NormalSmall => 0.01 * normal(rng),
                })
            })
            .collect();
        let features =
            context.order.iter().flat_map(|&i| drawn[i as usize * d..(i as usize + 1) * d].to_vec()).collect();
        let mut layers = network::random_layers(settings.layers, d + COLOR, HIDDEN, d, context.kind, rng);
        if let Some(first) = layers.first_mut().filter(|_| settings.anchor_start == AnchorStart::Feature) {
            first.read_only(d);
        }
        if let Some(last) = layers.last_mut() {
            last.relu = settings.last_relu;
        }
        Self { settings, features, layers }
    }

    /// Runs the graph network on the (detached) features.
    pub fn propagate(&self, context: &Context) -> Propagated<T> {
        if self.layers.is_empty() {
            return Propagated::default();
        }
        let d = self.settings.dim;
        let (h, sums) = self.inputs(context);
        let activations = network::forward(&self.layers, context, h, sums);
        let output = activations.features.last().expect("there are layers");
        let moments: Vec<Moments> = match self.settings.norm_axis {
            Axis::Channel => channel_moments(output, d, Some(&context.served)),
            Axis::Gaussian => output
                .chunks_exact(d)
                .map(|row| row_moments(&row.iter().map(|v| v.get()).collect::<Vec<_>>()))
                .collect(),
        };
        let hat = output.iter().enumerate().map(|(i, v)| T::of(self.moment(&moments, i).apply(v.get()))).collect();
        Propagated { hat, activations, moments }
    }

    /// The moments that standardise entry `i` of an `[M][d]` array.
    fn moment<'a>(&self, moments: &'a [Moments], i: usize) -> &'a Moments {
        match self.settings.norm_axis {
            Axis::Channel => &moments[i % self.settings.dim],
            Axis::Gaussian => &moments[i / self.settings.dim],
        }
    }

    /// Standardised inputs h of the anchors, and their sums over neighbours: `[M][d + 3]` each.
    fn inputs<'a>(&self, context: &'a Context) -> (Vec<T>, Vec<T>) {
        let d = self.settings.dim;
        let channels = d + COLOR;
        let moments: Vec<Moments> = match self.settings.norm_axis {
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
            match self.settings.norm_axis {
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
        let sums = match context.kind {
            Neighbours::Gaussians | Neighbours::AnchorInputs => gather(&|a| context.neighbours_of(a)),
            Neighbours::Anchors => network::neighbour_sums(context, &h, channels),
        };
        (h, sums)
    }

    /// f_final of the Gaussian at `place`: its own feature and what it receives. Gives its length before it was brought to
    /// unit length, where that is asked for; else 1.
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
        if !self.settings.unit_length {
            return 1.0;
        }
        let length = dot(out, out).sqrt();
        out.iter_mut().for_each(|o| *o = if length > SHORTEST { *o / length } else { 0.0 });
        length
    }

    /// f_final of all Gaussians `[n][d]`, in the order of `kept`.
    pub fn final_features(&self, context: &Context, propagated: &Propagated<T>) -> Vec<f32> {
        let d = self.settings.dim;
        let mut out = vec![0.0f32; self.features.len()];
        let mut row = vec![0.0; d];
        for (place, &i) in context.order.iter().enumerate() {
            self.final_feature(context, propagated, place, &mut row);
            let to = &mut out[i as usize * d..(i as usize + 1) * d];
            to.iter_mut().zip(&row).for_each(|(o, &v)| *o = v as f32);
        }
        out
    }

    /// Sums over pieces of columns, in order: `visit(column, feature, sums)` adds to `sums`.
    fn sum_columns<W: Weight>(
        &self,
        context: &Context,
        propagated: &Propagated<T>,
        set: &MaskSet<W>,
        length: usize,
        visit: impl Fn(usize, &[f64], &mut [f64]) + Sync,
    ) -> Vec<f64> {
        let parts: Vec<Vec<f64>> = set
            .pieces
            .par_windows(2)
            .map(|bounds| {
                let mut sums = vec![0.0; length];
                let mut f = vec![0.0; self.settings.dim];
                for c in bounds[0]..bounds[1] {
                    self.final_feature(context, propagated, set.columns[c as usize] as usize, &mut f);
                    visit(c as usize, &f, &mut sums);
                }
                sums
            })
            .collect();
        let mut total = vec![0.0; length];
        for part in parts {
            total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
        }
        total
    }

    /// Centroids A f of all masks `[K][d]`.
    pub fn centroids<W: Weight>(&self, context: &Context, propagated: &Propagated<T>, set: &MaskSet<W>) -> Vec<f64> {
        let d = self.settings.dim;
        self.sum_columns(context, propagated, set, set.len() * d, |c, f, sums| {
            let (masks, weights) = set.entries(c);
            for (&k, w) in masks.iter().zip(weights) {
                let to = &mut sums[k as usize * d..(k as usize + 1) * d];
                to.iter_mut().zip(f).for_each(|(s, f)| *s += f64::from(w.get()) * f);
            }
        })
    }

    /// Mean over masks of the weighted mean cosine between a mask's Gaussians and its centroid.
    pub fn alignment<W: Weight>(&self, context: &Context, propagated: &Propagated<T>, set: &MaskSet<W>) -> f64 {
        let (d, masks) = (self.settings.dim, set.len());
        let (unit, _) = directions(&self.centroids(context, propagated, set), d);
        let sums = self.sum_columns(context, propagated, set, 2 * masks, |c, f, sums| {
            let (u, _) = directions(f, d);
            for (&k, w) in set.entries(c).0.iter().zip(set.entries(c).1) {
                let w = f64::from(w.get());
                sums[k as usize] += w * dot(&u, &unit[k as usize * d..(k as usize + 1) * d]);
                sums[masks + k as usize] += w;
            }
        });
        (0..masks).map(|k| sums[k] / sums[masks + k]).sum::<f64>() / masks.max(1) as f64
    }

    /// Loss and gradients on the masks of one view. `noise` seeds the halves of [`Loss::HalfMask`].
    pub fn step<W: Weight>(
        &self,
        context: &Context,
        propagated: &Propagated<T>,
        set: &MaskSet<W>,
        noise: u64,
    ) -> Step<T> {
        self.step_beside(context, propagated, set, noise, None)
    }

    /// [`Model::step`], with positives from another view `[K][d]` for [`Loss::CrossView`].
    pub fn step_beside<W: Weight>(
        &self,
        context: &Context,
        propagated: &Propagated<T>,
        set: &MaskSet<W>,
        noise: u64,
        beside: Option<&[f64]>,
    ) -> Step<T> {
        let (d, s) = (self.settings.dim, &self.settings);
        let centroids = self.centroids(context, propagated, set);
        let half = |entry: usize| splitmix(noise ^ entry as u64) & 1 == 1;
        let positives = (s.loss == Loss::HalfMask).then(|| {
            self.sum_columns(context, propagated, set, set.len() * d, |c, f, sums| {
                for e in set.start[c] as usize..set.start[c + 1] as usize {
                    if half(e) {
                        let (k, w) = (set.mask[e] as usize, f64::from(set.weight[e].get()));
                        sums[k * d..(k + 1) * d].iter_mut().zip(f).for_each(|(s, f)| *s += w * f);
                    }
                }
            })
        });
        let mut evaluated = loss::evaluate(s.loss, &centroids, positives.as_deref().or(beside), d, s.tau);
        let columns = ColumnTerms::new(s, set, &centroids);
        if columns.any() {
            // The column terms move the centroids too: sum their gradients over columns first.
            let sums = self.sum_columns(context, propagated, set, centroids.len() + 1, |c, f, sums| {
                let (gradient, value) = sums.split_at_mut(centroids.len());
                value[0] += columns.add(c, f, Some(gradient), None);
            });
            evaluated.loss += sums[centroids.len()];
            evaluated.centroids.iter_mut().zip(&sums).for_each(|(g, s)| *g += s);
        }
        // So do sampled pixels; what they give the columns is added below.
        let of_pixels = s.needs_pixels().then(|| {
            let terms = pixels::Terms::new(s, set, &centroids);
            let feature = |c: usize, f: &mut [f64]| {
                self.final_feature(context, propagated, set.columns[c] as usize, f);
            };
            let (value, to_columns) =
                terms.gradients(&set.sampled, set.columns.len(), feature, &mut evaluated.centroids);
            evaluated.loss += value;
            to_columns
        });
        // Back to the columns, piece by piece; the Gaussians of an anchor lie in one piece.
        let parts: Vec<PieceGradients<T>> = set
            .pieces
            .par_windows(2)
            .map(|bounds| {
                let mut rows = Vec::with_capacity((bounds[1] - bounds[0]) as usize * d);
                let mut to_anchors: Vec<(u32, Vec<f64>)> = Vec::new();
                let (mut f, mut g) = (vec![0.0; d], vec![0.0; d]);
                for c in bounds[0] as usize..bounds[1] as usize {
                    g.fill(0.0);
                    for e in set.start[c] as usize..set.start[c + 1] as usize {
                        let (k, w) = (set.mask[e] as usize * d, f64::from(set.weight[e].get()));
                        g.iter_mut().zip(&evaluated.centroids[k..k + d]).for_each(|(g, v)| *g += w * v);
                        if positives.is_some() && half(e) {
                            g.iter_mut().zip(&evaluated.positives[k..k + d]).for_each(|(g, v)| *g += w * v);
                        }
                    }
                    let place = set.columns[c] as usize;
                    let length = if columns.any() || s.unit_length {
                        self.final_feature(context, propagated, place, &mut f)
                    } else {
                        1.0
                    };
                    if columns.any() {
                        columns.add(c, &f, None, Some(&mut g));
                    }
                    if let Some(rows) = &of_pixels {
                        g.iter_mut().zip(&rows[c * d..(c + 1) * d]).for_each(|(g, v)| *g += v);
                    }
                    if s.unit_length {
                        let of_direction = std::mem::replace(&mut g, vec![0.0; d]);
                        loss::add_direction_gradient(&mut g, &f, length, &of_direction);
                    }
                    rows.extend(g.iter().map(|&v| T::of(v)));
                    let source = context.source[place];
                    if source != NONE && !propagated.hat.is_empty() {
                        match to_anchors.last_mut() {
                            Some((a, sum)) if *a == source => sum.iter_mut().zip(&g).for_each(|(s, g)| *s += g),
                            _ => to_anchors.push((source, g.clone())),
                        }
                    }
                }
                (rows, to_anchors)
            })
            .collect();
        let mut step = Step {
            loss: evaluated.loss,
            separation: evaluated.separation,
            features: Vec::with_capacity(set.columns.len() * d),
            layers: Vec::new(),
        };
        let mut hat_gradient = vec![0.0f64; propagated.hat.len()];
        for (rows, to_anchors) in parts {
            step.features.extend(rows);
            for (a, sum) in to_anchors {
                hat_gradient[a as usize * d..(a as usize + 1) * d].copy_from_slice(&sum);
            }
        }
        if !self.layers.is_empty() {
            let gradient = self.unstandardised(context, propagated, &hat_gradient);
            step.layers = network::backward(&self.layers, context, &propagated.activations, gradient);
        }
        step
    }

    /// Gradient of the network's output `[M][d]` from that of its standardised output.
    fn unstandardised(&self, context: &Context, propagated: &Propagated<T>, g: &[f64]) -> Vec<T> {
        let d = self.settings.dim;
        let groups = propagated.moments.len();
        let group = |i: usize| match self.settings.norm_axis {
            Axis::Channel => i % d,
            Axis::Gaussian => i / d,
        };
        let (mut sum_g, mut sum_gy) = (vec![0.0; groups], vec![0.0; groups]);
        for (i, (&g, y)) in g.iter().zip(&propagated.hat).enumerate() {
            sum_g[group(i)] += g;
            sum_gy[group(i)] += g * y.get();
        }
        let weight = |i: usize| match self.settings.norm_axis {
            Axis::Channel => f64::from(context.served[i / d]),
            Axis::Gaussian => 1.0,
        };
        g.par_iter()
            .zip(&propagated.hat)
            .enumerate()
            .with_min_len(CHUNK)
            .map(|(i, (&g, y))| {
                let c = group(i);
                T::of(propagated.moments[c].backward(weight(i), g, y.get(), sum_g[c], sum_gy[c]))
            })
            .collect()
    }
}

/// Gradients from one piece of columns: of the columns' features, and, per anchor, of what its Gaussians receive.
type PieceGradients<T> = (Vec<T>, Vec<(u32, Vec<f64>)>);

/// Terms of the loss that look at single Gaussians.
struct ColumnTerms<'a, W> {
    settings: &'a Settings,
    set: &'a MaskSet<W>,
    centroids: &'a [f64],
    prototypes: Prototypes,
    /// Blending weight of all entries, in pixels.
    total: f64,
}

impl<'a, W: Weight> ColumnTerms<'a, W> {
    fn new(settings: &'a Settings, set: &'a MaskSet<W>, centroids: &'a [f64]) -> Self {
        let prototypes = Prototypes::new(centroids, settings.dim, settings.tau);
        let pixels = |(&k, w): (&u16, &W)| f64::from(w.get()) * set.pixels[k as usize];
        let total = set.mask.iter().zip(&set.weight).map(pixels).sum();
        Self { settings, set, centroids, prototypes, total }
    }

    fn coheres(&self) -> bool {
        self.settings.cohesion > 0.0 && self.settings.cohesion_of == CohesionOf::Gaussians
    }

    fn any(&self) -> bool {
        self.settings.loss == Loss::Gaussian || self.coheres()
    }

    /// The terms of column `c` with feature `f`; adds their gradients of the centroids and of the feature where asked for.
    fn add(&self, c: usize, f: &[f64], mut centroids: Option<&mut [f64]>, mut feature: Option<&mut [f64]>) -> f64 {
        let d = f.len();
        let (masks, weights) = self.set.entries(c);
        let mut value = 0.0;
        if self.coheres() {
            for (&k, w) in masks.iter().zip(weights) {
                let range = k as usize * d..(k as usize + 1) * d;
                let scale = self.settings.cohesion * f64::from(w.get()) / self.set.len() as f64;
                let to_centroid = centroids.as_deref_mut().map(|to| &mut to[range.clone()]);
                value += loss::cohesion(f, &self.centroids[range], scale, to_centroid, feature.as_deref_mut());
            }
        }
        if self.settings.loss == Loss::Gaussian {
            let mut share = vec![0.0; self.set.len()];
            for (&k, w) in masks.iter().zip(weights) {
                share[k as usize] += f64::from(w.get()) * self.set.pixels[k as usize] / self.total;
            }
            value += self.prototypes.cross_entropy(f, &share, centroids, feature);
        }
        value
    }
}

/// A well-mixed number from a counter (splitmix64).
pub fn splitmix(counter: u64) -> u64 {
    let mut z = counter.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A standard normal number (Box-Muller).
pub fn normal(rng: &mut impl Rng) -> f64 {
    let (a, b): (f64, f64) = (1.0 - rng.random_range(0.0..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{context, mask_set};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn settings() -> Settings {
        Settings::printed(4, 2)
    }

    /// Compares every gradient with central differences.
    fn check(settings: Settings, kind: Neighbours, propagate: bool) {
        let name = format!("{settings:?} {kind:?} {propagate}");
        let context = context(50, kind, propagate);
        let set = mask_set(&context, 5, 3);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut model = Model::<f64>::new(settings, &context, &mut rng);
        let propagated = model.propagate(&context);
        // Positives for three masks of five.
        let beside: Vec<f64> = (0..20).map(|i| if i < 12 { f64::from(i * i % 7) - 2.0 } else { 0.0 }).collect();
        let beside = (model.settings.loss == Loss::CrossView).then_some(&beside[..]);
        let step = model.step_beside(&context, &propagated, &set, 77, beside);
        let close = |analytic: f64, plus: f64, minus: f64, h: f64, what: &str| {
            let numeric = (plus - minus) / (2.0 * h);
            assert!(
                (analytic - numeric).abs() <= 1e-6 * (1.0 + analytic.abs().max(numeric.abs())),
                "{name}: {what}: {analytic} {numeric}"
            );
        };
        let (d, h) = (model.settings.dim, 1e-6);
        // Inputs of the network are detached: what anchors give stays as it is.
        for (c, &place) in set.columns.iter().enumerate() {
            for j in 0..d {
                let at = place as usize * d + j;
                let was = model.features[at];
                let mut loss = |v: f64| {
                    model.features[at] = v;
                    model.step_beside(&context, &propagated, &set, 77, beside).loss
                };
                let (plus, minus) = (loss(was + h), loss(was - h));
                model.features[at] = was;
                close(step.features[c * d + j], plus, minus, h, "feature");
            }
        }
        assert!(step.features.iter().any(|g| g.abs() > 1e-4), "{name}: all gradients vanish");
        for l in 0..model.layers.len() {
            let frozen = model.layers[l].frozen.clone();
            for i in (0..model.layers[l].weights.len()).filter(|i| !frozen.contains(i)) {
                let was = model.layers[l].weights[i];
                let mut loss = |v: f64| {
                    model.layers[l].weights[i] = v;
                    let p = model.propagate(&context);
                    model.step_beside(&context, &p, &set, 77, beside).loss
                };
                let (plus, minus) = (loss(was + h), loss(was - h));
                model.layers[l].weights[i] = was;
                close(step.layers[l][i], plus, minus, h, "weight");
            }
        }
        let moved = step.layers.iter().flatten().any(|g| g.abs() > 1e-5);
        assert_eq!(moved, model.settings.layers > 0, "{name}: gradients of weights");
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        use Neighbours::{Anchors, Gaussians};
        for layers in 0..=4 {
            check(Settings { layers, ..settings() }, Gaussians, true);
        }
        for layers in [1, 3] {
            check(Settings { layers, ..settings() }, Anchors, true);
        }
        check(settings(), Gaussians, false);
        check(settings(), Neighbours::AnchorInputs, true);
        check(Settings { last_relu: false, ..settings() }, Gaussians, true);
        for kind in [Gaussians, Anchors] {
            check(Settings { anchor_start: AnchorStart::Feature, ..settings() }, kind, true);
            check(Settings { unit_length: true, last_relu: false, ..settings() }, kind, true);
        }
        for loss in [Loss::Gaussian, Loss::Pixel] {
            check(Settings { loss, unit_length: true, ..settings() }, Gaussians, true);
        }
        for loss in [Loss::WithSelf, Loss::HalfMask, Loss::CrossView, Loss::Gaussian, Loss::Pixel] {
            for norm_axis in [Axis::Channel, Axis::Gaussian] {
                check(Settings { loss, norm_axis, ..settings() }, Anchors, true);
            }
        }
        for cohesion_of in [CohesionOf::Gaussians, CohesionOf::Pixels] {
            let cohesive = Settings { cohesion: 0.3, cohesion_of, tau: 0.5, init: Init::NormalSmall, ..settings() };
            check(cohesive.clone(), Gaussians, true);
            check(Settings { loss: Loss::Pixel, layers: 0, ..cohesive.clone() }, Gaussians, true);
            check(Settings { loss: Loss::Pixel, ..cohesive }, Anchors, true);
        }
    }

    #[test]
    fn anchors_that_start_from_their_feature_do_not_read_their_colour() {
        let mut context = context(50, Neighbours::Gaussians, true);
        let start = Settings { anchor_start: AnchorStart::Feature, ..settings() };
        let model = Model::<f64>::new(start, &context, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!(model.layers[0].frozen, 4 * HIDDEN..7 * HIDDEN);
        assert!(model.layers[0].weights[model.layers[0].frozen.clone()].iter().all(|w| *w == 0.0));
        // Everybody's neighbours are the first anchor; the last is nobody's.
        let (first, last) = (context.anchors[0], *context.anchors.last().unwrap());
        context.neighbours.fill(first);
        let mut moved_by_colors_of = |a: u32, b: u32| {
            let before = model.propagate(&context).hat;
            context.colors.swap(a as usize, b as usize);
            let after = model.propagate(&context).hat;
            before.iter().zip(&after).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        assert!(moved_by_colors_of(last, last - 1) < 1e-9);
        assert!(moved_by_colors_of(first, last) > 1e-3);
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let context = context(20_000, Neighbours::Anchors, true);
        let set = mask_set(&context, 30, 3);
        assert!(set.pieces.len() > 4);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let model = Model::<f32>::new(settings(), &context, &mut ChaCha8Rng::seed_from_u64(1));
                let propagated = model.propagate(&context);
                (
                    model.step(&context, &propagated, &set, 7),
                    propagated.hat,
                    model.alignment(&context, &Propagated::default(), &set),
                )
            })
        };
        assert!(with(1) == with(3));
    }

    #[test]
    fn a_scene_of_one_color_has_no_noise() {
        let mut context = context(64, Neighbours::Gaussians, true);
        context.colors.fill([0.1, 0.7, 0.3]);
        let mut model = Model::<f32>::new(settings(), &context, &mut ChaCha8Rng::seed_from_u64(1));
        model.features.fill(0.1);
        let (h, sums) = model.inputs(&context);
        assert!(h.iter().chain(&sums).all(|v| *v == 0.0));
        assert!(model.propagate(&context).hat.iter().all(|v| *v == 0.0));
    }
}
