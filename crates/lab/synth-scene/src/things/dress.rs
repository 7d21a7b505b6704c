//! What makes things hard to tell apart and parts hard to keep together: patterns within one thing, mirrors, sizes.

use crate::things::material::{Paint, Pattern};
use crate::things::model::Model;
use glam::DVec3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Probabilities of a small and of a large thing, of a patterned and of a shiny one.
const SMALL: f64 = 0.2;
const LARGE: f64 = 0.15;
const PATTERNED: f64 = 0.35;
const SHINY: f64 = 0.3;
/// Sizes of small and large things.
const SIZES: [f64; 2] = [0.75, 1.25];
/// Highlight and mirror of shiny things.
const GLEAM: [f64; 2] = [0.35, 0.25];
/// Cosine between the colours of a surface and the thing's paint above which it is painted.
const PAINTED: f64 = 0.97;

/// Changes size, pattern and shine of a model at random; gives the words that tell it from its like, such as
/// "small shiny striped". Furniture is not `sized`: it keeps its size and is no mirror.
pub fn dress(model: &mut Model, paint: &Paint, other: &Paint, sized: bool, rng: &mut ChaCha8Rng) -> Vec<&'static str> {
    let draws: [f64; 4] = rng.random();
    let mut words = Vec::new();
    if sized && draws[0] < SMALL + LARGE {
        let small = draws[0] < SMALL;
        words.push(if small { "small" } else { "large" });
        model.scale(if small { SIZES[0] } else { SIZES[1] });
    }
    let painted = |albedo: DVec3| albedo.normalize_or_zero().dot(paint.albedo().normalize_or_zero()) > PAINTED;
    let plain = |p: Pattern| matches!(p, Pattern::Clouds { .. });
    let surfaces = model.pieces.iter_mut().map(|piece| &mut piece.material);
    let mut surfaces: Vec<_> = surfaces.filter(|m| painted(m.albedo) && plain(m.pattern) && m.glow == 0.0).collect();
    if surfaces.is_empty() {
        return words;
    }
    if sized && draws[1] < SHINY {
        words.push("shiny");
        surfaces.iter_mut().for_each(|m| (m.specular, m.mirror) = (GLEAM[0], GLEAM[1]));
    }
    if draws[2] < PATTERNED {
        let (striped, other) = (draws[3] < 0.6, other.albedo() * 0.8 + 0.1);
        words.push(if striped { "striped" } else { "chequered" });
        let pattern = match striped {
            true => Pattern::Stripes { other, across: DVec3::new(6.0, 4.0, 16.0) },
            false => Pattern::Checks { other, size: 0.035 },
        };
        surfaces.iter_mut().for_each(|m| m.pattern = pattern);
    }
    words
}
