//! Instances ranked by how well their descriptors fit a feature, and the choice among them.

use artifacts::{Features, Instances, flat};
use serde::{Deserialize, Serialize};

/// An instance in a ranking.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Ranked {
    /// Index of the instance.
    pub instance: u32,
    /// Cosine of descriptor and feature, -1 to 1; with negatives the relevancy, 0 to 1; of a place its share.
    pub score: f32,
    /// Views in which the instance was matched with a mask.
    pub support: u32,
    /// Gaussians of the instance.
    pub gaussians: u32,
}

/// Which instances of a ranking answer a query.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Selection {
    /// At most this many, best first.
    pub top_k: usize,
    /// Only those with at least this score.
    pub threshold: Option<f32>,
    /// Only those matched in at least this many views.
    pub min_support: u32,
}

impl Selection {
    /// The rule behind `--top-k` and `--threshold`: the best instance alone by default; with a threshold, all that
    /// reach it.
    pub fn new(top_k: Option<u32>, threshold: Option<f32>, min_support: u32) -> Self {
        let default = if threshold.is_some() { u32::MAX } else { 1 };
        Self { top_k: top_k.unwrap_or(default) as usize, threshold, min_support }
    }

    /// The chosen instances, best first.
    pub fn choose(&self, ranking: &[Ranked]) -> Vec<u32> {
        ranking
            .iter()
            .filter(|r| r.support >= self.min_support && self.threshold.is_none_or(|t| r.score >= t))
            .take(self.top_k)
            .map(|r| r.instance)
            .collect()
    }
}

/// A feature to compare descriptors with, and the lengths of what it takes.
pub(crate) struct Question<'a> {
    feature: &'a [f32],
    length: f64,
    negatives: Vec<(&'a [f32], f64)>,
}

impl<'a> Question<'a> {
    /// A feature, and features of texts that mean nothing in particular ("object", "things", "stuff", "texture").
    pub fn new(feature: &'a [f32], negatives: &'a [Vec<f32>]) -> Self {
        let negatives = negatives.iter().map(|n| (&n[..], norm(n))).collect();
        Self { feature, length: norm(feature), negatives }
    }

    /// Score of a descriptor of this length; none where one of both is zero.
    ///
    /// Without negatives it is the plain cosine (docs/protocols.md). With them it is LERF's relevancy: over the negatives n the
    /// smallest exp(10 p) / (exp(10 p) + exp(10 n)) of the cosines p and n with the feature and the negative.
    pub fn score(&self, descriptor: &[f32], length: f64) -> Option<f32> {
        let cosine = |v: &[f32], n: f64| if n > 0.0 { dot(descriptor, v) / (length * n) } else { 0.0 };
        (length * self.length > 0.0).then(|| {
            let p = cosine(self.feature, self.length);
            match self.negatives.iter().map(|&(v, n)| cosine(v, n)).reduce(f64::max) {
                None => p as f32,
                Some(n) => (1.0 / (1.0 + (10.0 * (n - p)).exp())) as f32,
            }
        })
    }
}

/// Instances laid out for many queries: descriptors with their lengths, and the Gaussians of each instance together.
pub struct Index<'a> {
    /// The instances themselves.
    pub instances: &'a Instances,
    norms: Vec<f64>,
    /// Gaussians by instance, ascending within each.
    members: Vec<u32>,
    /// Where each instance's Gaussians begin in `members`; K + 1.
    starts: Vec<usize>,
}

pub(crate) fn norm(v: &[f32]) -> f64 {
    dot(v, v).sqrt()
}

/// In f64 and in eight sums that the compiler can keep apart.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0f64; 8];
    let (a8, a_rest) = a.as_chunks::<8>();
    let (b8, b_rest) = b.as_chunks::<8>();
    for (x, y) in a8.iter().zip(b8) {
        for k in 0..8 {
            sums[k] += f64::from(x[k]) * f64::from(y[k]);
        }
    }
    sums.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum::<f64>()
}

impl<'a> Index<'a> {
    /// Lays out the instances.
    pub fn new(instances: &'a Instances) -> Self {
        let k = instances.len();
        let mut starts = vec![0usize; k + 1];
        let labels = || instances.label.iter().enumerate().filter_map(|(i, &l)| Some((i, usize::try_from(l).ok()?)));
        labels().for_each(|(_, l)| starts[l + 1] += 1);
        (0..k).for_each(|l| starts[l + 1] += starts[l]);
        let mut next = starts.clone();
        let mut members = vec![0u32; starts[k]];
        for (i, l) in labels() {
            members[next[l]] = i as u32;
            next[l] += 1;
        }
        let norms = (0..k).map(|i| norm(flat(instances.descriptor_of(i)))).collect();
        Self { instances, norms, members, starts }
    }

    /// Score of every instance: the plain cosine, or with `negatives` LERF's relevancy (docs/protocols.md); none for one without a
    /// descriptor (no view matched it) or when the feature is zero.
    pub fn scores(&self, feature: &[f32], negatives: &[Vec<f32>]) -> Vec<Option<f32>> {
        let dim = self.instances.dim();
        assert!(feature.len() == dim && negatives.iter().all(|n| n.len() == dim));
        let question = Question::new(feature, negatives);
        let descriptor = |k| flat(self.instances.descriptor_of(k));
        (0..self.instances.len()).map(|k| question.score(descriptor(k), self.norms[k])).collect()
    }

    /// Whether an instance has a descriptor: masks of some view were matched with it.
    pub fn has_descriptor(&self, instance: usize) -> bool {
        self.norms[instance] > 0.0
    }

    /// All instances that have a score, best first, ties by index.
    pub fn rank(&self, feature: &[f32], negatives: &[Vec<f32>]) -> Vec<Ranked> {
        let scores = self.scores(feature, negatives).into_iter().enumerate();
        self.ranking(scores.filter_map(|(k, score)| Some((k, score?))))
    }

    /// Instances with their scores, best first, ties by index.
    pub fn ranking(&self, scores: impl Iterator<Item = (usize, f32)>) -> Vec<Ranked> {
        let ranked = |(k, score)| {
            let (support, gaussians) = (self.instances.support[k], self.gaussians_of(k).len() as u32);
            Ranked { instance: k as u32, score, support, gaussians }
        };
        let mut ranking: Vec<Ranked> = scores.map(ranked).collect();
        ranking.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.instance.cmp(&b.instance)));
        ranking
    }

    /// The Gaussians of an instance, ascending.
    fn gaussians_of(&self, instance: usize) -> &[u32] {
        &self.members[self.starts[instance]..self.starts[instance + 1]]
    }

    /// The Gaussians of the chosen instances, ascending.
    pub fn members(&self, chosen: &[u32]) -> Vec<u32> {
        let mut chosen = chosen.to_vec();
        chosen.sort_unstable();
        chosen.dedup();
        let mut all: Vec<u32> = chosen.iter().flat_map(|&c| self.gaussians_of(c as usize)).copied().collect();
        all.sort_unstable();
        all
    }
}

/// Candidates for joining, as in OpenGaussian.
const JOIN_AMONG: usize = 10;

/// Joins instances that look alike in instance-feature space, as OpenGaussian's query does: of the 10 best of the ranking,
/// those whose mean feature lies within a distance of the best one's. Its further test, that both are leaves of one of its
/// 32 to 64 coarse clusters, is left out: there are no such clusters here.
pub struct Join {
    distance: f64,
    /// Mean of the unit features of each instance's Gaussians; none without any.
    means: Vec<Option<Vec<f64>>>,
}

impl Join {
    /// Prepares joining within `distance` (OpenGaussian: 0.9), by the features that the instances were clustered from.
    pub fn new(instances: &Instances, features: &Features, distance: f32) -> Self {
        let mut sums: Vec<(Vec<f64>, usize)> = vec![(vec![0.0; features.dim()], 0); instances.len()];
        for (at, &gaussian) in features.kept.iter().enumerate() {
            let Ok(label) = usize::try_from(instances.label[gaussian as usize]) else { continue };
            let row = flat(features.row(at));
            let length = norm(row);
            if length > 0.0 {
                let (sum, count) = &mut sums[label];
                sum.iter_mut().zip(row).for_each(|(s, &v)| *s += f64::from(v) / length);
                *count += 1;
            }
        }
        let mean =
            |(sum, count): (Vec<f64>, usize)| (count > 0).then(|| sum.into_iter().map(|v| v / count as f64).collect());
        Self { distance: f64::from(distance), means: sums.into_iter().map(mean).collect() }
    }

    /// `selected` and what joins its first, in the order of the ranking.
    pub fn extend(&self, ranking: &[Ranked], min_support: u32, selected: &[u32]) -> Vec<u32> {
        let mut all = selected.to_vec();
        let Some(&first) = selected.first() else { return all };
        let Some(best) = &self.means[first as usize] else { return all };
        for r in ranking.iter().filter(|r| r.support >= min_support).take(JOIN_AMONG) {
            let Some(mean) = &self.means[r.instance as usize] else { continue };
            let squared: f64 = mean.iter().zip(best).map(|(a, b)| (a - b).powi(2)).sum();
            if squared.sqrt() < self.distance && !all.contains(&r.instance) {
                all.push(r.instance);
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr2;

    fn instances() -> Instances {
        let k = 4;
        Instances {
            label: vec![1, -1, 0, 1, 3, 2],
            descriptor: arr2(&[[1.0, 0.0], [0.6, 0.8], [0.0, 0.0], [-1.0, 0.0]]),
            support: vec![5, 1, 0, 7],
            score: vec![0.5; k],
            count: vec![1, 2, 1, 1],
            centroid: vec![[0.0; 3]; k],
            bbox_min: vec![[0.0; 3]; k],
            bbox_max: vec![[0.0; 3]; k],
            ..Instances::default()
        }
    }

    fn rank(feature: &[f32]) -> Vec<Ranked> {
        Index::new(&instances()).rank(feature, &[])
    }

    #[test]
    fn ranks_by_cosine_whatever_the_length_of_the_text() {
        let r = rank(&[0.0, 5.0]);
        assert_eq!(r.iter().map(|r| r.instance).collect::<Vec<_>>(), [1, 0, 3], "ties by index, zero left out");
        assert!((r[0].score - 0.8).abs() < 1e-6);
        assert_eq!(r[0].gaussians, 2);
        assert!(rank(&[0.0, 0.0]).is_empty());
        assert_eq!(Index::new(&instances()).members(&[2, 1, 1]), [0, 3, 5], "ascending, each once");
    }

    #[test]
    fn relevancy_is_the_worst_softmax_against_the_negatives() {
        let i = instances();
        let s = Index::new(&i).scores(&[2.0, 0.0], &[vec![0.0, 3.0], vec![-1.0, 0.0]]);
        let softmax = |p: f64, n: f64| (10.0 * p).exp() / ((10.0 * p).exp() + (10.0 * n).exp());
        assert!((f64::from(s[0].unwrap()) - softmax(1.0, 0.0)).abs() < 1e-6);
        assert!((f64::from(s[1].unwrap()) - softmax(0.6, 0.8)).abs() < 1e-6);
        assert_eq!(s[2], None);
        assert!((f64::from(s[3].unwrap()) - softmax(-1.0, 1.0)).abs() < 1e-6);
    }

    #[test]
    fn long_descriptors_have_the_same_cosine() {
        let a: Vec<f32> = (0..83).map(|k| (k as f32 * 0.37).sin()).collect();
        let b: Vec<f32> = (0..83).map(|k| (k as f32 * 0.11).cos()).collect();
        let plain: f64 = a.iter().zip(&b).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum();
        assert!((dot(&a, &b) - plain).abs() < 1e-12);
    }

    #[test]
    fn joining_takes_near_instances_of_the_best_ten() {
        let mut i = instances();
        i.label = vec![0, 1, 3, 3, -1];
        let values = arr2(&[[1.0, 0.0], [0.9, 0.3], [-2.0, 0.1], [-1.0, 0.0], [0.0, 0.0]]);
        let f = Features { kept: vec![0, 1, 2, 3, 4], values };
        let ranking = rank(&[1.0, 0.0]);
        assert_eq!(Join::new(&i, &f, 0.9).extend(&ranking, 0, &[0]), [0, 1]);
        assert_eq!(Join::new(&i, &f, 0.1).extend(&ranking, 0, &[0]), [0]);
        assert_eq!(Join::new(&i, &f, 3.0).extend(&ranking, 0, &[0]), [0, 1, 3]);
        assert_eq!(Join::new(&i, &f, 3.0).extend(&ranking, 5, &[0]), [0, 3], "support counts here too");
        assert!(Join::new(&i, &f, 3.0).extend(&ranking, 0, &[]).is_empty());
    }
}
