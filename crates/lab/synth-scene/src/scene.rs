//! A placed scene: things, their parts and the primitives they are made of, with ray queries.

use crate::render::bvh::{Aabb, Bvh};
use crate::things::material::Material;
use crate::things::model::Model;
use crate::things::shape::Shape;
use glam::{DMat3, DVec2, DVec3};

pub mod cameras;
pub mod families;
pub mod layout;
pub mod room;
pub mod workshop;

/// A family of scenes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    /// Tables with a few things each that do not touch, chairs, paintings
    #[default]
    Studio,
    /// One crowded table top, as LERF's figurines and teatime
    Table,
    /// A kitchen counter with sink, stove, shelves and wall cabinets
    Kitchen,
    /// A furnished room, as ScanNet's, with what stands on its furniture
    Room,
    /// A workbench with a pegboard and shelves: many small, thin things that touch
    Workshop,
}

/// A thing of the scene: an object or background.
#[derive(Debug, Clone)]
pub struct Thing {
    /// What it is called; unique in the scene.
    pub name: String,
    pub class: &'static str,
    pub color: &'static str,
    /// Whether it is floor, wall or table.
    pub background: bool,
    /// Its parts, as positions in [`Scene::parts`].
    pub parts: std::ops::Range<u32>,
    /// Where it stands.
    pub position: DVec3,
    /// Turn about z in radians.
    pub yaw: f64,
    /// Half extents of its footprint before the turn.
    pub footprint: DVec2,
    /// Height above its position.
    pub height: f64,
}

/// A part of a thing.
#[derive(Debug, Clone)]
pub struct Part {
    pub name: &'static str,
    pub thing: u32,
}

/// A surface placed in the world.
#[derive(Debug, Clone)]
pub struct Primitive {
    pub shape: Shape,
    /// `world_from_primitive`.
    pub rotation: DMat3,
    pub origin: DVec3,
    pub material: Material,
    pub part: u32,
    pub thing: u32,
}

impl Primitive {
    /// A point of the world in the primitive's frame.
    pub fn to_local(&self, world: DVec3) -> DVec3 {
        self.rotation.transpose() * (world - self.origin)
    }

    /// A point of the primitive's frame in the world.
    pub fn to_world(&self, local: DVec3) -> DVec3 {
        self.rotation * local + self.origin
    }

    fn bounds(&self) -> Aabb {
        let (half, centre) = self.shape.bounds();
        let c = self.to_world(centre);
        let r =
            DMat3::from_cols(self.rotation.x_axis.abs(), self.rotation.y_axis.abs(), self.rotation.z_axis.abs()) * half;
        // A little more than the shape, so that rounding loses no grazing ray.
        Aabb { min: c - r - 1e-9, max: c + r + 1e-9 }
    }
}

/// Where a ray meets the scene.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    pub t: f64,
    pub primitive: usize,
    /// The point in the primitive's frame.
    pub local: DVec3,
}

/// All that stands in a room. Things are background first; parts and primitives are in the order of their things.
#[derive(Default)]
pub struct Scene {
    pub things: Vec<Thing>,
    pub parts: Vec<Part>,
    pub primitives: Vec<Primitive>,
    /// Half extents of the room in x and y.
    pub room: DVec2,
    /// Centres of the table tops.
    pub tables: Vec<DVec3>,
    /// The family it is of, which says where cameras go.
    pub family: Family,
    /// How strong the fine marks on all surfaces are, 0 to 1.
    pub detail: f64,
    bvh: Bvh,
}

/// Who a thing is: the first fields of [`Thing`].
pub struct Identity {
    pub name: String,
    pub class: &'static str,
    pub color: &'static str,
    pub background: bool,
}

impl Scene {
    /// Adds `model` turned by `yaw` at `position`.
    pub fn place(&mut self, model: &Model, who: Identity, position: DVec3, yaw: f64) {
        let (index, first) = (self.things.len() as u32, self.parts.len() as u32);
        self.parts.extend(model.parts.iter().map(|&name| Part { name, thing: index }));
        let turn = DMat3::from_rotation_z(yaw);
        self.primitives.extend(model.pieces.iter().map(|piece| Primitive {
            shape: piece.shape.clone(),
            rotation: turn * piece.rotation,
            origin: turn * piece.offset + position,
            material: piece.material,
            part: first + piece.part as u32,
            thing: index,
        }));
        let Identity { name, class, color, background } = who;
        let (x, y, height) = model.extent();
        let (parts, footprint) = (first..self.parts.len() as u32, DVec2::new(x, y));
        self.things.push(Thing { name, class, color, background, parts, position, yaw, footprint, height });
    }

    /// The scene, ready for rays.
    pub fn built(self, room: DVec2, tables: Vec<DVec3>) -> Self {
        let boxes: Vec<Aabb> = self.primitives.iter().map(Primitive::bounds).collect();
        Self { room, tables, bvh: Bvh::new(&boxes), ..self }
    }

    /// The first surface that the ray meets after `near`, if any. `direction` has unit length.
    pub fn trace(&self, origin: DVec3, direction: DVec3, near: f64) -> Option<Hit> {
        let mut best = None;
        self.bvh.visit(origin, direction, f64::INFINITY, |i, far| {
            let p = &self.primitives[i];
            let o = p.to_local(origin);
            let d = p.rotation.transpose() * direction;
            match p.shape.intersect(o, d, near, far) {
                Some(t) => {
                    best = Some(Hit { t, primitive: i, local: o + d * t });
                    t
                }
                None => far,
            }
        });
        best
    }

    /// Whether something lies between `near` and `far` along the ray.
    pub fn blocked(&self, origin: DVec3, direction: DVec3, near: f64, far: f64) -> bool {
        let mut found = false;
        self.bvh.visit(origin, direction, far, |i, far| {
            let p = &self.primitives[i];
            let hit = p.shape.intersect(p.to_local(origin), p.rotation.transpose() * direction, near, far);
            found = hit.is_some();
            if found { -1.0 } else { far }
        });
        found
    }

    /// Names of the classes present, sorted; class ids are positions in this list.
    pub fn classes(&self) -> Vec<&'static str> {
        let mut all: Vec<&str> = self.things.iter().map(|t| t.class).collect();
        all.sort_unstable();
        all.dedup();
        all
    }
}
