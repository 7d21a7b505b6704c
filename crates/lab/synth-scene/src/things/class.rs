//! A class of things: its name, its colours, where it stands, how it is built.

use crate::things::material::{Material, Paint, Pattern, albedo};
use crate::things::model::Model;
use glam::{DMat3, DVec3};
use rand_chacha::ChaCha8Rng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    Table,
    Floor,
    /// On a wall; its back is at y = 0 and it faces -y.
    Wall,
}

/// How a thing is called.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Naming {
    /// Always with its colour: "red mug".
    Colored,
    /// With its colour only where a scene has several: "plate of cookies".
    Plain,
    /// The colour belongs to the contents: "stack of red books".
    Of(&'static str, &'static str),
}

#[derive(Debug)]
pub struct Class {
    pub name: &'static str,
    pub naming: Naming,
    pub place: Place,
    /// Colours it comes in; they index [`PAINTS`](crate::things::material::PAINTS).
    pub paints: &'static [usize],
    build: Build,
}

type Build = fn(&mut Model, &Paint, &mut ChaCha8Rng);

impl Class {
    pub(super) const fn new(name: &'static str, place: Place, paints: &'static [usize], build: Build) -> Self {
        Self { name, naming: Naming::Colored, place, paints, build }
    }

    pub(super) const fn plain(self) -> Self {
        Self { naming: Naming::Plain, ..self }
    }

    pub(super) const fn of(self, before: &'static str, after: &'static str) -> Self {
        Self { naming: Naming::Of(before, after), ..self }
    }

    /// One of the class in a colour; the generator varies sizes and details.
    pub fn make(&self, paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
        let mut model = Model::default();
        (self.build)(&mut model, paint, rng);
        model
    }
}

pub(super) fn wood(tone: f64) -> Material {
    Material::matt(albedo([0.72, 0.52, 0.33]) * tone).with(Pattern::Wood { board: 0.11 })
}

pub(super) fn metal() -> Material {
    Material::matt(albedo([0.70, 0.70, 0.72])).gleaming(0.2)
}

pub(super) fn ivory() -> DVec3 {
    albedo([0.93, 0.90, 0.82])
}

/// About x by `degrees`: tips +y up.
pub(super) fn tip(degrees: f64) -> DMat3 {
    DMat3::from_rotation_x(degrees.to_radians())
}
