//! Families of scenes besides the studio of [`crate::scene::layout`]: a crowded table top, a kitchen counter, a furnished room;
//! the workshop is in [`crate::scene::workshop`].
//!
//! What they have that the studio lacks: up to hundreds of things; things that touch (half a millimetre apart), stand on
//! others and hide each other; few colours for many things; patterns, mirrors and sizes ([`crate::things::dress`]); thin wires
//! and stems; furniture, shelves with rows of books, walls with doors and windows.

use crate::random::either_way;
use crate::scene::layout;
use crate::scene::room::{Footprint, TABLE_HEIGHT, enclose, name_of, wall_span};
use crate::scene::workshop::workshop;
use crate::scene::{Family, Identity, Scene};
use crate::things::catalogue::{ALONG_WALLS, CLASSES, ON_WALLS, PROPS, SHELF, SINK, STOVE, WALL_CABINET};
use crate::things::class::{Class, Place};
use crate::things::dress::dress;
use crate::things::furniture;
use crate::things::material::PAINTS;
use crate::things::model::Model;
use glam::{DVec2, DVec3};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeSet;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Colours of one scene: few, so that many things share one.
const PALETTE: usize = 4;
/// Free space between things put down at random, and between things that touch, in metres.
const GAP: f64 = 0.004;
pub(super) const CONTACT: f64 = 0.0005;
/// Probability that a thing is put beside another one, touching it.
const TOUCHING: f64 = 0.5;
/// Places tried for a thing before the scene is planned anew with more room.
const TRIES: usize = 300;
/// Probability that a thing is put on another one rather than on the largest top, where it fits.
const STACKED: f64 = 0.35;
const COUNTER: [f64; 2] = [0.62, 0.90];
/// Growth of the room, table or counter from one attempt to the next.
const GROWTH: f64 = 1.15;

/// A flat top that things may be put on, in the world.
pub(super) struct Support {
    pub place: Footprint,
    pub height: f64,
    pub headroom: f64,
    pub taken: Vec<Footprint>,
}

/// A stretch of a wall that is taken: wall, along it, from and to above the floor.
pub(super) struct Hung {
    wall: usize,
    along: [f64; 2],
    up: [f64; 2],
}

/// A scene while it is being furnished.
pub(super) struct Planner<'a> {
    pub scene: Scene,
    pub supports: Vec<Support>,
    hung: Vec<Hung>,
    floor: Vec<Footprint>,
    /// Half extents of the room.
    pub half: DVec2,
    /// Names that are taken.
    pub names: BTreeSet<String>,
    palette: Vec<usize>,
    pub rng: &'a mut ChaCha8Rng,
}

/// A scene of the family with `objects` things besides floor, walls, the table or counter, and what is built into a workshop.
pub fn plan(family: Family, objects: usize, rng: &mut ChaCha8Rng) -> Scene {
    let mut growth = 1.0;
    loop {
        let scene = match family {
            Family::Studio => return layout::plan(objects, rng),
            Family::Table => table(objects, growth, rng),
            Family::Kitchen => kitchen(objects, growth, rng),
            Family::Room => room(objects, growth, rng),
            Family::Workshop => workshop(objects, growth, rng),
        };
        if let Some(mut scene) = scene {
            scene.family = family;
            return scene;
        }
        growth *= GROWTH;
    }
}

fn table(objects: usize, growth: f64, rng: &mut ChaCha8Rng) -> Option<Scene> {
    let area = (objects as f64 * 0.020).max(0.6) * growth;
    let top = DVec2::new((1.3 * area).sqrt(), (area / 1.3).sqrt());
    let mut p = Planner::new(0.5 * top + 1.6, rng);
    let mut model = furniture::table(top.to_array(), TABLE_HEIGHT, 0.85 + 0.3 * p.rng.random::<f64>());
    model.top([0.0, 0.0], (0.5 * top - 0.02).to_array(), TABLE_HEIGHT);
    let who = Identity { name: "table".into(), class: "table", color: "brown", background: true };
    p.put(&model, who, DVec3::ZERO, 0.0);
    let classes: Vec<&'static Class> =
        CLASSES.iter().filter(|c| c.place == Place::Table).chain(PROPS).filter(|c| c.name != "row of books").collect();
    p.scatter(&classes, objects)?;
    Some(p.scene.built(p.half, vec![DVec3::new(0.0, 0.0, TABLE_HEIGHT)]))
}

fn kitchen(objects: usize, growth: f64, rng: &mut ChaCha8Rng) -> Option<Scene> {
    let length = (objects as f64 * 0.045).max(2.2) * growth;
    let mut p = Planner::new(DVec2::new(0.5 * length + 0.9, 1.9), rng);
    let model = furniture::counter(length, COUNTER[0], COUNTER[1]);
    let at = DVec3::new(0.0, p.half.y - 0.5 * COUNTER[0] - 0.03, 0.0);
    let counter = Identity { name: "counter".into(), class: "counter", color: "grey", background: true };
    p.put(&model, counter, at, 0.0);
    // What is built in, as far as the number of things allows; half of them at least stand about.
    let places = (length / 1.25) as usize;
    let mut left = objects;
    for k in 0..3 + places {
        if left <= objects / 2 {
            break;
        }
        let placed = match k {
            0 => p.stand(&SINK, Some(0), 1.0),
            1 => p.stand(&STOVE, Some(0), 1.0),
            2 => p.along_wall(&ALONG_WALLS[5], Some(0)),
            _ => {
                let along = length * ((k as f64 - 2.5) / places as f64 - 0.5);
                let (class, height) = if k % 2 == 1 { &SHELF } else { &WALL_CABINET };
                p.hang(class, *height, Some((0, along)))
            }
        };
        left -= usize::from(placed.is_some());
    }
    let kitchen = ["toy", "puzzle", "clock", "gift", "headphones", "laptop", "row of", "pencil"];
    let classes: Vec<&'static Class> = CLASSES
        .iter()
        .filter(|c| c.place == Place::Table)
        .chain(PROPS)
        .filter(|c| !kitchen.iter().any(|k| c.name.starts_with(k)))
        .collect();
    p.scatter(&classes, left)?;
    Some(p.scene.built(p.half, vec![DVec3::new(0.0, at.y, COUNTER[1])]))
}

fn room(objects: usize, growth: f64, rng: &mut ChaCha8Rng) -> Option<Scene> {
    let size = (objects as f64 / 60.0).sqrt().max(0.85) * growth;
    let mut p = Planner::new(DVec2::new(2.6 + 0.5 * size, 2.4 + 0.4 * size), rng);
    let furniture = (objects * 2 / 5).clamp(1, 8 + objects / 8);
    let mut made = 0;
    let tables = if furniture >= 3 { 1 + objects / 80 } else { 1 };
    let mut centres = Vec::new();
    for k in 0..tables {
        let (w, d) = (1.2 * (0.9 + 0.2 * p.rng.random::<f64>()), 0.8);
        let mut model = furniture::table([w, d], TABLE_HEIGHT, 0.8 + 0.4 * p.rng.random::<f64>());
        model.top([0.0, 0.0], [0.5 * w - 0.02, 0.5 * d - 0.02], TABLE_HEIGHT);
        let x = (k as f64 - 0.5 * (tables - 1) as f64) * 1.5;
        let name = if k == 0 { "wooden table".to_string() } else { format!("wooden table {}", k + 1) };
        let at = DVec3::new(x, 0.0, 0.0);
        p.floor.push(Footprint { centre: at.truncate(), half: DVec2::new(0.5 * w, 0.5 * d), yaw: 0.0 });
        p.put(&model, Identity { name, class: "table", color: "brown", background: false }, at, 0.0);
        centres.push(DVec3::new(x, 0.0, TABLE_HEIGHT));
        made += 1;
    }
    let named = |name: &str| CLASSES.iter().find(|c| c.name == name);
    let mut order: Vec<&'static Class> = ALONG_WALLS.iter().collect();
    order.extend(["cabinet", "armchair"].into_iter().filter_map(named));
    // Every room has a shelf and a desk; what else there is, is drawn.
    order[4..].shuffle(p.rng);
    order.swap(0, 2);
    let seats: Vec<&'static Class> = ["chair", "stool", "waste bin"].into_iter().filter_map(named).collect();
    for k in 0.. {
        if made >= furniture {
            break;
        }
        // Walls fill up: then chairs, then nothing more.
        let placed = match k % 4 {
            1 => {
                let (class, height) = &ON_WALLS[(k / 4) % ON_WALLS.len()];
                p.hang(class, *height, None)
            }
            3 => p.free_standing(seats[(k / 4) % seats.len()]),
            2 if k % 8 == 6 => CLASSES.last().and_then(|painting| p.hang(painting, 1.5, None)),
            _ => p.along_wall(order[(k / 2) % order.len()], None),
        };
        made += usize::from(placed.is_some());
        if k > 8 * furniture {
            return None;
        }
    }
    let classes: Vec<&'static Class> = CLASSES.iter().filter(|c| c.place == Place::Table).chain(PROPS).collect();
    p.scatter(&classes, objects - made)?;
    Some(p.scene.built(p.half, centres))
}

impl<'a> Planner<'a> {
    pub(super) fn new(half: DVec2, rng: &'a mut ChaCha8Rng) -> Self {
        let mut palette: Vec<usize> = (0..PAINTS.len()).collect();
        palette.shuffle(rng);
        palette.truncate(PALETTE);
        let mut scene = Scene::default();
        enclose(&mut scene, half);
        Self {
            scene,
            supports: Vec::new(),
            hung: Vec::new(),
            floor: Vec::new(),
            half,
            names: BTreeSet::new(),
            palette,
            rng,
        }
    }

    /// Puts a model into the scene and its flat tops among the supports.
    pub(super) fn put(&mut self, model: &Model, who: Identity, position: DVec3, yaw: f64) {
        let turn = DVec2::from_angle(yaw);
        for top in &model.tops {
            let centre = position.truncate() + turn.rotate(DVec2::from_array(top.centre));
            self.supports.push(Support {
                place: Footprint { centre, half: DVec2::from_array(top.half), yaw },
                height: position.z + top.height,
                headroom: top.room,
                taken: Vec::new(),
            });
        }
        self.names.insert(who.name.clone());
        self.scene.place(model, who, position, yaw);
    }

    /// A thing of a class in a colour of the scene, dressed, with a name that no other thing has.
    pub(super) fn make(&mut self, class: &'static Class, sized: bool, scale: f64) -> (Model, Identity) {
        let mut paints: Vec<usize> = class.paints.iter().copied().filter(|p| self.palette.contains(p)).collect();
        for attempt in 0.. {
            // When all names of the scene's colours are taken, others come in.
            if paints.is_empty() || attempt == 20 {
                paints = class.paints.to_vec();
            }
            let paint = &PAINTS[paints[self.rng.random_range(0..paints.len())]];
            let other = &PAINTS[self.palette[self.rng.random_range(0..PALETTE)]];
            let mut model = class.make(paint, self.rng);
            model.scale(scale);
            let words = dress(&mut model, paint, other, sized, self.rng);
            let plain = name_of(class, paint.name, true);
            let mut name = [&words[..], &[plain.as_str()]].concat().join(" ");
            if attempt > 60 {
                name = format!("{name} {}", attempt - 59);
            }
            if !self.names.contains(&name) {
                return (model, Identity { name, class: class.name, color: paint.name, background: false });
            }
        }
        unreachable!("numbers do not run out")
    }

    /// Puts a thing on a support, a given one or any; touching another where chance and space allow it.
    fn stand(&mut self, class: &'static Class, on: Option<usize>, scale: f64) -> Option<()> {
        let (model, who) = self.make(class, on.is_none(), scale);
        let (s, footprint) = self.find(&model, on)?;
        let position = footprint.centre.extend(self.supports[s].height);
        self.supports[s].taken.push(footprint);
        self.put(&model, who, position, footprint.yaw);
        Some(())
    }

    /// A free place for a model on a support, a given one or any, which comes with it.
    pub(super) fn find(&mut self, model: &Model, on: Option<usize>) -> Option<(usize, Footprint)> {
        let (x, y, height) = model.extent();
        let half = DVec2::new(x, y);
        let areas: Vec<f64> = self.supports.iter().map(|s| s.place.half.x * s.place.half.y).collect();
        let largest = areas.iter().copied().fold(0.0, f64::max);
        let small: Vec<f64> = areas.iter().map(|&a| if a < largest { a } else { 0.0 }).collect();
        let stacked = self.rng.random::<f64>() < STACKED;
        for attempt in 0..TRIES {
            let areas = if stacked && attempt < TRIES / 2 { &small } else { &areas };
            let total: f64 = areas.iter().sum();
            let mut pick = self.rng.random::<f64>() * total;
            let any = areas.iter().position(|a| {
                pick -= a;
                pick < 0.0
            });
            let Some(s) = on.or(any) else { continue };
            let support = &self.supports[s];
            if height > support.headroom {
                continue;
            }
            let random = DVec2::new(either_way(self.rng), either_way(self.rng));
            let (turn, touching): (f64, f64) = (self.rng.random(), self.rng.random());
            let beside = match support.taken.len() {
                0 => None,
                n => (touching < TOUCHING).then(|| support.taken[self.rng.random_range(0..n)]),
            };
            // What is built in stands straight.
            let (footprint, gap) = match beside {
                _ if on.is_some() => {
                    let along = random * (support.place.half - half).max(DVec2::ZERO) * DVec2::new(1.0, 0.3);
                    (Footprint { centre: support.place.centre + along, half, yaw: support.place.yaw }, GAP)
                }
                Some(other) => (other.beside(half, CONTACT, turn, random.x), CONTACT * 0.5),
                None => {
                    let [ax, ay] = support.place.axes();
                    let at = random * support.place.half;
                    let centre = support.place.centre + ax * at.x + ay * at.y;
                    (Footprint { centre, half, yaw: turn * TAU }, GAP)
                }
            };
            if footprint.inside(&support.place) && !support.taken.iter().any(|t| t.touches(&footprint, gap)) {
                return Some((s, footprint));
            }
        }
        None
    }

    /// Puts `count` things of the classes on what tops there are.
    fn scatter(&mut self, classes: &[&'static Class], count: usize) -> Option<()> {
        let mut order = Vec::new();
        for _ in 0..count {
            if order.is_empty() {
                order = classes.to_vec();
                order.shuffle(self.rng);
            }
            let class = order.pop()?;
            // A class too large for what is free makes way for others.
            if self.stand(class, None, 0.8).is_some() {
                continue;
            }
            let smaller: Vec<usize> = (0..4).map(|_| self.rng.random_range(0..classes.len())).collect();
            smaller.into_iter().find_map(|k| self.stand(classes[k], None, 0.65))?;
        }
        Some(())
    }

    /// Puts a thing with its back to a wall, a given one or any.
    fn along_wall(&mut self, class: &'static Class, on: Option<usize>) -> Option<()> {
        let (model, who) = self.make(class, false, 1.0);
        let (x, y, height) = model.extent();
        for _ in 0..TRIES {
            let wall = on.unwrap_or(self.rng.random_range(0..4));
            let (length, distance) = wall_span(self.half, wall);
            let along = either_way(self.rng) * (length - x - 0.05);
            let turn = DVec2::from_angle(FRAC_PI_2 * wall as f64);
            let centre = turn.rotate(DVec2::new(along, distance - y - 0.03));
            let footprint = Footprint { centre, half: DVec2::new(x, y), yaw: FRAC_PI_2 * wall as f64 };
            let counter = self.supports.first().filter(|s| on.is_some() && s.height > 0.5);
            let free = !self.floor.iter().any(|f| f.touches(&footprint, 0.05))
                && !counter.is_some_and(|c| c.place.touches(&footprint, 0.03))
                && self.is_free(wall, along, x, [0.0, height]);
            if free {
                self.floor.push(footprint);
                self.hung.push(Hung { wall, along: [along - x, along + x], up: [0.0, height] });
                self.put(&model, who, centre.extend(0.0), footprint.yaw);
                return Some(());
            }
        }
        None
    }

    /// Hangs a thing on a wall at a height, anywhere or at a given place (wall, along it).
    fn hang(&mut self, class: &'static Class, height: f64, at: Option<(usize, f64)>) -> Option<()> {
        let (model, who) = self.make(class, false, 1.0);
        let (x, _, up) = model.extent();
        // Pictures hang from their middle.
        let up = if class.name == "painting" { [height - up, height + up] } else { [height, height + up] };
        for _ in 0..TRIES {
            let wall = at.map_or_else(|| self.rng.random_range(0..4), |a| a.0);
            let (length, distance) = wall_span(self.half, wall);
            let along = at.map_or_else(|| either_way(self.rng) * (length - x - 0.05), |a| a.1);
            if self.is_free(wall, along, x, up) {
                let yaw = FRAC_PI_2 * wall as f64;
                let position = DVec2::from_angle(yaw).rotate(DVec2::new(along, distance)).extend(height);
                self.hung.push(Hung { wall, along: [along - x, along + x], up });
                self.put(&model, who, position, yaw);
                return Some(());
            }
        }
        None
    }

    /// Puts a thing near the middle of the room, where a walk around it does not pass.
    fn free_standing(&mut self, class: &'static Class) -> Option<()> {
        let (model, who) = self.make(class, false, 1.0);
        let (x, y, _) = model.extent();
        let within = (self.half - 1.55).max(DVec2::splat(0.5));
        for _ in 0..TRIES {
            let random = DVec2::new(either_way(self.rng), either_way(self.rng));
            let yaw = FRAC_PI_2 * f64::from(self.rng.random_range(0..4)) + 0.5 * (self.rng.random::<f64>() - 0.5);
            let footprint = Footprint { centre: random * within, half: DVec2::new(x, y), yaw };
            if !self.floor.iter().any(|f| f.touches(&footprint, 0.02)) {
                self.floor.push(footprint);
                self.put(&model, who, footprint.centre.extend(0.0), yaw);
                return Some(());
            }
        }
        None
    }

    fn is_free(&self, wall: usize, along: f64, half: f64, up: [f64; 2]) -> bool {
        let apart = |a: [f64; 2], b: [f64; 2]| a[1] + 0.03 < b[0] || b[1] + 0.03 < a[0];
        let span = [along - half, along + half];
        self.hung.iter().all(|h| h.wall != wall || apart(h.along, span) || apart(h.up, up))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Thing;
    use rand::SeedableRng;

    const FAMILIES: [Family; 3] = [Family::Table, Family::Kitchen, Family::Room];

    fn objects(scene: &Scene) -> Vec<&Thing> {
        scene.things.iter().filter(|t| !t.background).collect()
    }

    #[test]
    fn families_hold_as_many_things_as_asked_with_names_of_their_own() {
        for family in FAMILIES.into_iter().chain([Family::Studio]) {
            for (count, seed) in [(1, 0), (7, 1), (30, 2), (60, 3), (200, 4)] {
                if count > 60 && family == Family::Studio {
                    continue;
                }
                let scene = plan(family, count, &mut ChaCha8Rng::seed_from_u64(seed));
                assert_eq!(objects(&scene).len(), count, "{family:?}");
                let names: BTreeSet<&str> = scene.things.iter().map(|t| t.name.as_str()).collect();
                assert_eq!(names.len(), scene.things.len());
                assert_eq!(scene.parts.len(), scene.things.iter().map(|t| t.parts.len()).sum::<usize>());
                let first = scene.things.iter().position(|t| !t.background).unwrap();
                assert!(scene.things[first..].iter().all(|t| !t.background), "background comes first");
            }
        }
    }

    #[test]
    fn things_touch_stand_on_each_other_and_share_colours() {
        for family in FAMILIES {
            let scene = plan(family, 60, &mut ChaCha8Rng::seed_from_u64(7));
            let all = objects(&scene);
            let column = |t: &Thing| Footprint { centre: t.position.truncate(), half: t.footprint, yaw: t.yaw };
            let mut touching = 0;
            for (i, a) in all.iter().enumerate() {
                for b in &all[..i] {
                    let level = a.position.z == b.position.z && a.position.z > 0.1;
                    touching += usize::from(level && column(a).touches(&column(b), 2.0 * CONTACT));
                    let overlap = a.position.z < b.position.z + b.height && b.position.z < a.position.z + a.height;
                    let hung = |t: &Thing| ["painting", "curtain", "shelf"].contains(&t.class);
                    if level && overlap && !hung(a) && !hung(b) {
                        assert!(!column(a).touches(&column(b), -1e-6), "{} in {}", a.name, b.name);
                    }
                }
            }
            assert!(touching >= 8, "{family:?}: {touching} pairs touch");
            let heights: BTreeSet<u64> = all.iter().map(|t| (t.position.z * 1e4) as u64).collect();
            assert!(heights.len() >= 3, "{family:?}: things stand on {heights:?}");
            let mut colors = std::collections::BTreeMap::<&str, usize>::new();
            all.iter().for_each(|t| *colors.entry(t.color).or_default() += 1);
            assert!(*colors.values().max().unwrap() >= 10, "{colors:?}");
            let any = |word: &str| all.iter().any(|t| t.name.contains(word));
            assert!(any("striped") && any("shiny") && any("small") && any("chequered"));
            let part = |name: &str| scene.parts.iter().any(|p| p.name == name);
            assert!(part("wires") || part("stem") || part("stems") || part("tines"), "thin structures");
        }
    }

    #[test]
    fn rooms_have_furniture_of_the_benchmark() {
        let scene = plan(Family::Room, 60, &mut ChaCha8Rng::seed_from_u64(3));
        let labels: BTreeSet<u32> = scene.things.iter().map(|t| crate::truth::scannet::label(t.class)).collect();
        assert!(labels.iter().filter(|&&l| l != 40).count() >= 8, "{labels:?}");
        let books = scene.things.iter().filter(|t| t.name.contains("book") && t.position.z > 0.9).count();
        assert!(books > 0, "shelves are used");
    }
}
