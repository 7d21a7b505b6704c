//! Workshops: a bench along a wall, shelves and a pegboard above it, and many small, thin things that touch.
//!
//! No method is tuned on this family: it is for reports alone.

use crate::random::either_way;
use crate::scene::families::{CONTACT, Planner};
use crate::scene::room::Footprint;
use crate::scene::{Identity, Scene};
use crate::things::catalogue::{BENCH, HANGING, Hanging, IN_RUNS, STORES, VISE};
use crate::things::class::Class;
use crate::things::model::Model;
use crate::things::workshop::{self, BOARD_FRONT, SHELF_DEPTH, SHELF_LENGTH, SHELF_ROOM, SHELVES, STRETCH};
use glam::{DVec2, DVec3};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Things for each stretch of the wall, and the shares of them that hang and that stand on shelves. The rest are on the
/// bench, or on what stands there.
const PER_STRETCH: f64 = 45.0;
const HANG: f64 = 0.30;
const SHELVED: f64 = 0.40;
/// From the front of the bench to the wall behind the cameras.
const FREE: f64 = 3.0;
/// Heights of the tops of the pegboard's rows, and the longest tool of a row.
const ROWS: [f64; 2] = [1.765, 1.375];
const LONGEST: f64 = 0.36;
/// What fits on the bench below the shelves.
const BENCH_ROOM: f64 = 0.25;
/// Height above the bench from which things stand in its rear half.
const TALL: f64 = 0.09;
/// Least height of what is put on things of a shelf, where cameras look from the side.
const FLAT: f64 = 0.03;
/// Free depth behind the vise.
const VISE_SHADE: f64 = 0.12;
/// Probability that neighbours of a row which are not of a run touch.
const TOUCHING: f64 = 0.5;
/// What stands upright on shelves alone.
const BOOKS: [&str; 2] = ["manual", "magazine"];
/// Things made for a place before it stays empty.
const TRIES: usize = 12;

/// A thing of a row on a shelf or on the pegboard.
struct InRow {
    model: Model,
    who: Identity,
    /// Whether it touches what is left of it.
    touches: bool,
    /// How far its front is from the front of its shelf.
    back: f64,
    /// Where the peg is that it hangs on: along the wall from its middle, and above its lower end.
    peg: [f64; 2],
}

/// Gives the things of a list in a shuffled order, again and again.
struct Deck<T: 'static> {
    all: Vec<&'static T>,
    left: Vec<&'static T>,
}

impl<T> Deck<T> {
    fn new(all: Vec<&'static T>) -> Self {
        Self { all, left: Vec::new() }
    }

    fn draw(&mut self, rng: &mut ChaCha8Rng) -> &'static T {
        if self.left.is_empty() {
            self.left.clone_from(&self.all);
            self.left.shuffle(rng);
        }
        self.left.pop().expect("lists of classes are not empty")
    }
}

/// A workshop with `objects` things besides what is built in; none where they do not fit.
pub(super) fn workshop(objects: usize, growth: f64, rng: &mut ChaCha8Rng) -> Option<Scene> {
    let count = ((objects as f64 * growth / PER_STRETCH).ceil() as usize).max(2);
    let depth = 0.5 * (workshop::BENCH[0] + FREE);
    let mut p = Planner::new(DVec2::new(0.5 * STRETCH * count as f64 + 0.9, depth), rng);
    let wall = DVec3::new(0.0, p.half.y, 0.0);
    let built_in = |name: &str, class, color| Identity { name: name.into(), class, color, background: true };
    p.put(&workshop::bench(count), built_in("workbench", "workbench", "brown"), wall, 0.0);
    p.supports[0].headroom = BENCH_ROOM;
    // Shelves and pegboards take turns.
    let (shelved, pegged): (Vec<usize>, Vec<usize>) = (0..count).partition(|k| k % 2 == 0);
    p.put(&workshop::shelves(&shelved, count), built_in("shelves", "shelves", "white"), wall, 0.0);

    // Tools come before the board, whose pegs hold them.
    let hung = hang(&mut p, (objects as f64 * HANG) as usize, &pegged, count);
    let front = p.half.y - BOARD_FRONT - CONTACT;
    let peg = |(x, z, t): &(f64, f64, InRow)| [x + t.peg[0], z + t.peg[1], t.model.extent().1 + 0.012];
    let pegs: Vec<[f64; 3]> = hung.iter().map(peg).collect();
    p.put(&workshop::pegboard(&pegged, count, &pegs), built_in("pegboard", "pegboard", "brown"), wall, 0.0);
    let mut left = objects - hung.len();
    for (x, z, thing) in hung {
        p.put(&thing.model, thing.who, DVec3::new(x, front, z), 0.0);
    }

    if objects >= 3 {
        vise(&mut p);
        left -= 1;
    }
    left -= shelve(&mut p, ((objects as f64 * SHELVED) as usize).min(left), &shelved, count);
    lie(&mut p, left)?;
    let top = DVec3::new(0.0, p.half.y - 0.5 * workshop::BENCH[0], workshop::BENCH[1]);
    Some(p.scene.built(p.half, vec![top]))
}

/// How many of `total` things go into row `k` of `rows`.
fn share(total: usize, k: usize, rows: usize) -> usize {
    (k + 1) * total / rows - k * total / rows
}

/// Where the middles of the things of a row are, around 0: those that touch side by side, gaps between the others.
fn line_up(row: &[InRow], length: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let widths: Vec<f64> = row.iter().map(|t| 2.0 * t.model.extent().0).collect();
    let slack = length - widths.iter().map(|w| w + CONTACT).sum::<f64>();
    let mut gaps: Vec<f64> = row.iter().map(|t| if t.touches { 0.0 } else { 0.2 + rng.random::<f64>() }).collect();
    // One more, for what is right of the last one.
    let total = gaps.iter().sum::<f64>() + 0.2 + rng.random::<f64>();
    gaps.iter_mut().for_each(|g| *g *= slack.max(0.0) / total);
    let mut x = -0.5 * length;
    let place = |(gap, width): (f64, &f64)| {
        x += gap + CONTACT + width;
        x - 0.5 * width
    };
    gaps.into_iter().zip(&widths).map(place).collect()
}

/// Chooses up to `total` tools and where they hang: along the wall, and the height of their lower ends.
fn hang(p: &mut Planner, total: usize, at: &[usize], count: usize) -> Vec<(f64, f64, InRow)> {
    let mut deck: Deck<Hanging> = Deck::new(HANGING.iter().collect());
    let mut all = Vec::new();
    let rows = ROWS.len() * at.len();
    for k in 0..rows {
        let (length, top, middle) = (STRETCH - 0.03, ROWS[k % 2], workshop::middle(at[k / 2], count));
        let mut row: Vec<InRow> = Vec::new();
        let mut used = 0.0;
        for _ in 0..share(total, k, rows) {
            let fits = |t: &InRow| used + 2.0 * t.model.extent().0 + CONTACT < length && t.model.extent().2 < LONGEST;
            let mut next = |p: &mut Planner| {
                let hanging = deck.draw(p.rng);
                tool(p, hanging)
            };
            let Some(thing) = (0..TRIES).map(|_| next(p)).find(fits) else { break };
            used += 2.0 * thing.model.extent().0 + CONTACT;
            p.names.insert(thing.who.name.clone());
            row.push(thing);
        }
        let places = line_up(&row, length, p.rng);
        all.extend(places.into_iter().zip(row).map(|(x, t)| (middle + x, top - t.model.extent().2, t)));
    }
    all
}

/// A tool as it hangs.
fn tool(p: &mut Planner, hanging: &'static Hanging) -> InRow {
    let (mut model, who) = p.make(&hanging.class, true, 1.0);
    model.centre();
    let (x, y, _) = model.extent();
    model.hang(hanging.tip_up);
    let sign = if hanging.tip_up { -1.0 } else { 1.0 };
    let peg = [sign * y * hanging.peg[1], x - sign * x * hanging.peg[0]];
    InRow { model, who, touches: p.rng.random::<f64>() < TOUCHING, back: 0.0, peg }
}

/// Puts up to `total` things on the shelves; says how many.
fn shelve(p: &mut Planner, total: usize, at: &[usize], count: usize) -> usize {
    let mut deck: Deck<Class> = Deck::new(STORES.iter().collect());
    let rows = SHELVES.len() * at.len();
    let mut done = 0;
    for k in 0..rows {
        let (height, middle) = (SHELVES[k % 3], workshop::middle(at[k / 3], count));
        // What lies on things of the upper shelf, no camera looks down on.
        let room = if k % 3 == 2 { 0.0 } else { SHELF_ROOM };
        let row = row_of_stores(p, share(total, k, rows), &mut deck);
        done += row.len();
        let places = line_up(&row, SHELF_LENGTH, p.rng);
        for (x, thing) in places.into_iter().zip(row) {
            let (_, half, _) = thing.model.extent();
            let y = p.half.y - SHELF_DEPTH + thing.back + half;
            settle(p, &thing.model, thing.who, DVec3::new(middle + x, y, height + CONTACT), 0.0, room);
        }
    }
    done
}

/// Up to `total` things for a shelf, as many as stand on it side by side; some in runs of their like.
fn row_of_stores(p: &mut Planner, total: usize, deck: &mut Deck<Class>) -> Vec<InRow> {
    let mut row: Vec<InRow> = Vec::new();
    let mut used = 0.0;
    while row.len() < total {
        let class = deck.draw(p.rng);
        let run = if IN_RUNS.contains(&class.name) { p.rng.random_range(2..=5) } else { 1 };
        let mut touches = p.rng.random::<f64>() < TOUCHING;
        let back = 0.004 + 0.02 * p.rng.random::<f64>();
        for _ in 0..run.min(total - row.len()) {
            let store = |p: &mut Planner| {
                let (mut model, who) = p.make(class, true, 1.0);
                model.centre();
                InRow { model, who, touches, back, peg: [0.0; 2] }
            };
            let fits = |t: &InRow| {
                let (_, y, height) = t.model.extent();
                2.0 * y + t.back < SHELF_DEPTH && height < SHELF_ROOM - 0.005
            };
            let Some(thing) = (0..TRIES).map(|_| store(p)).find(fits) else { break };
            used += 2.0 * thing.model.extent().0 + CONTACT;
            if used > SHELF_LENGTH {
                return row;
            }
            p.names.insert(thing.who.name.clone());
            row.push(thing);
            touches = true;
        }
    }
    row
}

/// Puts a thing below something: what stands on it has no more room than it.
fn settle(p: &mut Planner, model: &Model, who: Identity, position: DVec3, yaw: f64, room: f64) {
    let first = p.supports.len();
    p.put(model, who, position, yaw);
    for s in &mut p.supports[first..] {
        s.headroom = room - (s.height - position.z);
    }
}

/// Fixes a vise to the front edge of the bench.
fn vise(p: &mut Planner) {
    let (mut model, who) = p.make(&VISE, false, 1.0);
    model.centre();
    let (x, y, _) = model.extent();
    let place = p.supports[0].place;
    let along = either_way(p.rng) * (place.half.x - x - 0.05);
    let centre = place.centre + DVec2::new(along, y - place.half.y);
    // Nothing low is put behind it, where it would be hidden.
    let shade = 0.5 * VISE_SHADE;
    let taken = Footprint { centre: centre + DVec2::new(0.0, shade), half: DVec2::new(x, y + shade), yaw: 0.0 };
    p.supports[0].taken.push(taken);
    let height = p.supports[0].height;
    settle(p, &model, who, centre.extend(height), 0.0, BENCH_ROOM);
}

/// Puts `total` things on the bench and on what has a flat top; none where they do not fit.
fn lie(p: &mut Planner, total: usize) -> Option<()> {
    let small: Vec<&Class> = BENCH.iter().chain(HANGING.iter().map(|h| &h.class)).collect();
    let mut deck = Deck::new(small.into_iter().chain(STORES).collect());
    for _ in 0..total {
        // Smaller ones are tried where the bench is full.
        let found = (0..2 * TRIES).find_map(|k| {
            let class = deck.draw(p.rng);
            let (mut model, who) = p.make(class, true, if k < TRIES { 1.0 } else { 0.8 });
            model.centre();
            if BOOKS.contains(&class.name) {
                model.lie_down();
                let (x, y, height) = model.extent();
                model.top([0.0, 0.0], [0.9 * x, 0.9 * y], height + CONTACT);
            }
            let (s, footprint) = p.find(&model, None)?;
            // What is tall stands behind what is low, or it would hide it from all cameras; so does what is on the shelves.
            let (above, height) = (p.supports[s].height - workshop::BENCH[1], model.extent().2);
            let behind = footprint.centre.y > p.supports[0].place.centre.y + 0.04;
            if (above + height > TALL) != behind || (above > BENCH_ROOM && height < FLAT) {
                return None;
            }
            Some((model, who, s, footprint))
        });
        let (model, who, s, footprint) = found?;
        let (height, room) = (p.supports[s].height, p.supports[s].headroom);
        p.supports[s].taken.push(footprint);
        settle(p, &model, who, footprint.centre.extend(height), footprint.yaw, room);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::families::plan;
    use crate::scene::{Family, Thing, cameras};
    use crate::testing::chart_points;
    use rand::SeedableRng;
    use std::collections::BTreeSet;

    fn scene(count: usize, seed: u64) -> Scene {
        plan(Family::Workshop, count, &mut ChaCha8Rng::seed_from_u64(seed))
    }

    fn objects(scene: &Scene) -> impl Iterator<Item = &Thing> {
        scene.things.iter().filter(|t| !t.background)
    }

    fn column(t: &Thing) -> Footprint {
        Footprint { centre: t.position.truncate(), half: t.footprint, yaw: t.yaw }
    }

    /// Whether the boxes of two things come nearer to each other than `gap`.
    fn near(a: &Thing, b: &Thing, gap: f64) -> bool {
        let low = a.position.z.max(b.position.z);
        let high = (a.position.z + a.height).min(b.position.z + b.height);
        low < high + gap && column(a).touches(&column(b), gap)
    }

    #[test]
    fn workshops_hold_as_many_things_as_asked_with_names_and_parts_of_their_own() {
        for (count, seed) in [(1, 0), (2, 1), (3, 2), (40, 3), (60, 4), (200, 5), (250, 6)] {
            let scene = scene(count, seed);
            assert_eq!(objects(&scene).count(), count);
            let names: BTreeSet<&str> = scene.things.iter().map(|t| t.name.as_str()).collect();
            assert_eq!(names.len(), scene.things.len());
            let background: Vec<&str> = scene.things.iter().filter(|t| t.background).map(|t| t.class).collect();
            let walls = ["floor", "wall", "wall", "wall", "wall"];
            assert_eq!(background, [&walls[..], &["workbench", "shelves", "pegboard"]].concat());
            assert!(scene.things[..8].iter().all(|t| t.background), "background comes first");
            for (id, t) in scene.things.iter().enumerate() {
                assert!(t.background || t.parts.len() >= 2, "{}", t.name);
                assert!(t.parts.clone().all(|p| scene.parts[p as usize].thing as usize == id));
            }
            assert!(scene.primitives.iter().all(|p| scene.parts[p.part as usize].thing == p.thing));
        }
    }

    #[test]
    fn most_things_are_small_many_are_thin_and_many_touch() {
        let scene = scene(120, 7);
        let all: Vec<&Thing> = objects(&scene).collect();
        let size = |t: &Thing| [2.0 * t.footprint.x, 2.0 * t.footprint.y, t.height];
        let longest = |t: &Thing| size(t).into_iter().fold(0.0, f64::max);
        assert!(all.iter().all(|t| longest(t) < 0.45));
        assert!(all.iter().filter(|t| longest(t) < 0.25).count() > 70);
        let thinnest = |t: &Thing| size(t).into_iter().fold(f64::INFINITY, f64::min);
        assert!(all.iter().filter(|t| thinnest(t) < 0.04).count() > 30);
        let pairs = all.iter().enumerate().flat_map(|(i, a)| all[..i].iter().map(move |b| (a, b)));
        let touching = pairs.filter(|(a, b)| near(a, b, 2.0 * CONTACT)).count();
        assert!(touching > 60, "{touching} pairs touch");
        let classes: BTreeSet<&str> = all.iter().map(|t| t.class).collect();
        assert!(classes.len() > 35, "{classes:?}");
        let parts = |t: &Thing, name| t.parts.clone().filter(|&p| scene.parts[p as usize].name == name).count();
        for t in &all {
            match t.class {
                "screwdriver" => assert_eq!([parts(t, "handle"), parts(t, "shaft")], [1, 1]),
                "paintbrush" => assert_eq!([parts(t, "handle"), parts(t, "ferrule"), parts(t, "bristles")], [1; 3]),
                "set of screwdrivers" => assert!(parts(t, "handle") >= 4 && parts(t, "shaft") == parts(t, "handle")),
                "rack of jars" => assert!(parts(t, "lid") >= 3 && parts(t, "lid") == parts(t, "glass")),
                _ => {}
            }
        }
    }

    #[test]
    fn things_keep_to_their_own_boxes_and_no_two_boxes_meet() {
        for (count, seed) in [(60, 0), (120, 1), (250, 2)] {
            let scene = scene(count, seed);
            for p in &scene.primitives {
                let t = &scene.things[p.thing as usize];
                if t.background {
                    continue;
                }
                for at in chart_points(&p.shape, 6) {
                    let q = p.to_world(p.shape.surface(at).0) - t.position;
                    let local = DVec2::from_angle(-t.yaw).rotate(q.truncate());
                    assert!((local.abs() - t.footprint).max_element() < 1e-6, "{} leaves its footprint", t.name);
                    assert!(q.z < t.height + 1e-6 && q.z > -2e-3, "{}: {}", t.name, q.z);
                }
            }
            let all: Vec<&Thing> = objects(&scene).collect();
            for (i, a) in all.iter().enumerate() {
                for b in &all[..i] {
                    assert!(!near(a, b, -1e-6), "{} in {}", a.name, b.name);
                }
            }
        }
    }

    /// What stands has something below it, what hangs is before the board.
    #[test]
    fn nothing_floats() {
        let scene = scene(120, 3);
        for t in objects(&scene) {
            let front = scene.room.y - BOARD_FRONT - 2.0 * CONTACT;
            let hangs = (front..scene.room.y).contains(&t.position.y);
            let (from, towards) = match hangs {
                true => (t.position + DVec3::new(0.0, -1e-6, 0.5 * t.height), DVec3::Y),
                false => (t.position - DVec3::new(0.0, 0.0, 1e-6), -DVec3::Z),
            };
            assert!(scene.blocked(from, towards, 0.0, 0.003), "{} at {}", t.name, t.position);
        }
    }

    #[test]
    fn every_thing_is_seen_in_several_views() {
        for (count, views, seed) in [(40, 40, 0), (200, 100, 1), (60, 60, 2), (250, 120, 3)] {
            let scene = scene(count, seed);
            let mut seen = vec![0; scene.things.len()];
            for camera in cameras::place(&scene, views, 240, 180, &mut ChaCha8Rng::seed_from_u64(2)) {
                let frame = crate::render::identify(&scene, &camera);
                assert!(frame.distance.iter().all(|&d| d > 0.2), "a camera is in something");
                let mut here = vec![0; scene.things.len()];
                frame.thing.iter().for_each(|&t| here[t as usize] += 1);
                seen.iter_mut().zip(here).for_each(|(s, n)| *s += usize::from(n >= 12));
            }
            let seen: Vec<(&str, usize)> = scene
                .things
                .iter()
                .zip(seen)
                .filter(|(t, _)| !t.background)
                .map(|(t, n)| (t.name.as_str(), n))
                .collect();
            let hidden: Vec<_> = seen.iter().filter(|s| s.1 == 0).collect();
            assert!(hidden.is_empty(), "{count} things: {hidden:?} are never seen");
            let seldom = seen.iter().filter(|s| s.1 < 4).count();
            assert!(20 * seldom <= count, "{count} things: {seldom} are seen in fewer than four views");
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_workshop() {
        let text = |seed| format!("{:?}", scene(60, seed).primitives);
        assert!(text(5) == text(5) && text(5) != text(6));
    }
}
