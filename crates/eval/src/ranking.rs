//! Text queries: instances ranked by the cosine of their descriptors with a text feature, and the choice among them.

use artifacts::Instances;
use serde::Serialize;

/// An instance in a ranking.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Ranked {
    /// Index of the instance.
    pub instance: u32,
    /// Cosine of descriptor and text, -1 to 1; plain, without negatives (methods.md section 6, row 32).
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
    /// Only those with at least this cosine.
    pub threshold: Option<f32>,
    /// Only those matched in at least this many views.
    pub min_support: u32,
}

impl Selection {
    /// The rule behind `--top-k` and `--threshold`: the best instance alone by default; with a threshold, all that
    /// reach it.
    pub fn new(top_k: Option<usize>, threshold: Option<f32>, min_support: u32) -> Self {
        let default = if threshold.is_some() { usize::MAX } else { 1 };
        Self { top_k: top_k.unwrap_or(default), threshold, min_support }
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

/// All instances that have a descriptor, by falling cosine with `text`, ties by index. An instance that no view matched
/// has a zero descriptor: it has no cosine and is left out.
///
/// # Panics
/// When `text` has another length than the descriptors.
pub fn rank(instances: &Instances, text: &[f32]) -> Vec<Ranked> {
    assert_eq!(text.len(), instances.dim);
    let norm = |v: &[f32]| v.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
    let text_norm = norm(text);
    let mut ranking: Vec<Ranked> = (0..instances.len())
        .filter_map(|k| {
            let d = instances.descriptor_of(k);
            let norms = norm(d) * text_norm;
            let dot: f64 = d.iter().zip(text).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
            (norms > 0.0).then(|| Ranked {
                instance: k as u32,
                score: (dot / norms) as f32,
                support: instances.support[k],
                gaussians: instances.count[k],
            })
        })
        .collect();
    ranking.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.instance.cmp(&b.instance)));
    ranking
}

/// The Gaussians of the chosen instances, ascending.
pub fn members(instances: &Instances, chosen: &[u32]) -> Vec<u32> {
    let mut is_chosen = vec![false; instances.len()];
    for &c in chosen {
        is_chosen[c as usize] = true;
    }
    let of = |&i: &u32| usize::try_from(instances.label[i as usize]).is_ok_and(|l| is_chosen[l]);
    (0..instances.label.len() as u32).filter(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instances() -> Instances {
        let k = 4;
        Instances {
            label: vec![1, -1, 0, 1, 3, 2],
            dim: 2,
            descriptor: vec![1.0, 0.0, 0.6, 0.8, 0.0, 0.0, -1.0, 0.0],
            support: vec![5, 1, 0, 7],
            score: vec![0.5; k],
            count: vec![1, 2, 1, 1],
            centroid: vec![[0.0; 3]; k],
            bbox_min: vec![[0.0; 3]; k],
            bbox_max: vec![[0.0; 3]; k],
            ..Instances::default()
        }
    }

    #[test]
    fn ranks_by_cosine_whatever_the_length_of_the_text() {
        let r = rank(&instances(), &[0.0, 5.0]);
        assert_eq!(r.iter().map(|r| r.instance).collect::<Vec<_>>(), [1, 0, 3], "ties by index, zero left out");
        assert!((r[0].score - 0.8).abs() < 1e-6);
        assert!(rank(&instances(), &[0.0, 0.0]).is_empty());
    }

    #[test]
    fn selection_rules() {
        let r = rank(&instances(), &[1.0, 0.0]);
        assert_eq!(Selection::new(None, None, 0).choose(&r), [0]);
        assert_eq!(Selection::new(Some(2), None, 0).choose(&r), [0, 1]);
        assert_eq!(Selection::new(None, Some(0.5), 0).choose(&r), [0, 1]);
        assert_eq!(Selection::new(Some(1), Some(0.5), 0).choose(&r), [0]);
        assert_eq!(Selection::new(None, None, 6).choose(&r), [3]);
        assert!(Selection::new(None, Some(2.0), 0).choose(&r).is_empty());
        assert_eq!(members(&instances(), &[1, 2]), [0, 3, 5]);
    }
}
