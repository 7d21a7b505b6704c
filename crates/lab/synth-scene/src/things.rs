//! What stands in a scene: surfaces and what they are made of, models, and the classes of things by kind.

pub mod catalogue;
pub mod class;
mod dishes;
pub mod dress;
pub mod furniture;
pub mod material;
pub mod model;
mod props;
pub mod shape;
mod stores;
mod tools;
mod toys;
pub mod walls;
pub mod workshop;
