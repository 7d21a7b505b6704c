//! Everything that changes while training.

use super::adam::Adam;
use super::model::Model;

/// Parameters, the optimiser's moments, and how training has gone so far.
pub struct State {
    pub model: Model<f32>,
    /// Moments of the features.
    pub features: Adam<f32>,
    /// Moments of each layer's weights.
    pub layers: Vec<Adam<f32>>,
    pub iteration: u64,
    /// Means for the next point of the curve.
    pub window: Window,
    pub curve: Vec<CurvePoint>,
}

impl State {
    pub fn new(model: Model<f32>) -> Self {
        Self {
            features: Adam::new(model.features.len()),
            layers: model.layers.iter().map(|l| Adam::new(l.weights.len())).collect(),
            model,
            iteration: 0,
            window: Window::default(),
            curve: Vec::new(),
        }
    }

    /// All parameters and moments, by name.
    pub fn arrays(&mut self) -> Vec<(String, &mut Vec<f32>)> {
        let Self { model, features, layers, .. } = self;
        let mut all = vec![
            ("features".to_string(), &mut model.features),
            ("mean".to_string(), &mut features.mean),
            ("square".to_string(), &mut features.square),
        ];
        for (l, (layer, adam)) in model.layers.iter_mut().zip(layers).enumerate() {
            all.push((format!("layer{l}.weights"), &mut layer.weights));
            all.push((format!("layer{l}.mean"), &mut adam.mean));
            all.push((format!("layer{l}.square"), &mut adam.square));
        }
        all
    }
}

/// A point of the training curve.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct CurvePoint {
    pub iteration: u64,
    /// Mean loss since the point before.
    pub loss: f64,
    /// Mean cosine of a mask's Gaussians with its centroid, in the last view.
    pub alignment: f64,
    /// 1 - mean cosine of the centroids of different masks, mean since the point before.
    pub separation: f64,
    /// Learning rate of the features.
    pub rate: f64,
}

/// Sums since the last point of the curve.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Window {
    pub loss: f64,
    pub separation: f64,
    pub count: f64,
}

impl Window {
    pub fn add(&mut self, loss: f64, separation: f64) {
        self.loss += loss;
        self.separation += separation;
        self.count += 1.0;
    }

    /// The next point of the curve; begins again from zero.
    pub fn take(&mut self, iteration: u64, alignment: f64, rate: f64) -> CurvePoint {
        let w = std::mem::take(self);
        CurvePoint { iteration, loss: w.loss / w.count, alignment, separation: w.separation / w.count, rate }
    }
}
