//! What stands in a scene: surfaces, what they are made of, models of them, and the classes of things.

pub mod catalogue;
pub mod dress;
pub mod furniture;
pub mod material;
pub mod model;
pub mod props;
pub mod shape;
