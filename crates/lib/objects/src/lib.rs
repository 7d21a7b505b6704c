//! The things of a scene, for people and programs that use them: `scene.json` (`scene`), what is up (`up`), upright boxes
//! that a few floaters don't stretch (`upright`), what stands on, in, under and next to what (`relations`, `near`), all of this from
//! instances and Gaussians (`describe`), and ids beside splats that cannot hold them (`ids`). docs/objects.md has the fields and the rules.

mod describe;
mod ids;
mod near;
mod relations;
mod scene;
#[cfg(test)]
mod testing;
mod up;
mod upright;

pub use describe::{Names, describe, members, solid_centers};
pub use ids::{Ids, ObjectClass, classes};
pub use scene::{BestView, Family, Name, NameSource, Object, Part, Relation, RelationKind, SCHEMA, Scene};
pub use up::{Up, UpSource};
pub use upright::{ObjectBox, upright_box};
