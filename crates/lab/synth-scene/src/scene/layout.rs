//! Where things stand: a room, tables, and things that do not touch each other on tables, floor and walls.

use crate::random::either_way;
use crate::scene::room::{Footprint, TABLE_HEIGHT, enclose, name_of, wall_span};
use crate::scene::{Identity, Scene};
use crate::things::catalogue::CLASSES;
use crate::things::class::{Class, Place};
use crate::things::furniture;
use crate::things::material::PAINTS;
use crate::things::model::Model;
use glam::{DVec2, DVec3};
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, TAU};

const TABLE: [f64; 2] = [1.36, 1.00];
/// Distance of the centres of neighbouring tables.
const TABLE_SPACING: [f64; 2] = [2.8, 2.5];
/// From the centres of the outer tables to the walls.
const MARGIN: f64 = 2.45;
const PAINTING_HEIGHT: f64 = 1.12;
/// Free space between two things, in metres.
const GAP: f64 = 0.012;
/// Places tried for a thing, and arrangements tried for a number of tables.
const TRIES: usize = 600;
const ATTEMPTS: usize = 20;
/// A table is planned for this many things.
const PER_TABLE: usize = 10;
/// One painting per twelve things, up to this many.
const MOST_PAINTINGS: usize = 4;

const ORDINALS: [&str; 9] = ["second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"];
/// A thing that has been chosen but not placed.
struct Chosen {
    class: &'static Class,
    paint: usize,
    model: Model,
    at: Option<(DVec3, f64)>,
}

/// A scene with `objects` things besides floor, walls and tables.
pub fn plan(objects: usize, rng: &mut ChaCha8Rng) -> Scene {
    let mut chosen = choose(objects, rng);
    let on_tables = chosen.iter().filter(|c| c.class.place == Place::Table).count();
    let mut tables = on_tables.div_ceil(PER_TABLE).max(1);
    // Things are put down at random, so another attempt may succeed; if a table is too small, another table helps.
    let (centres, room) = loop {
        let (centres, room) = floor_plan(tables);
        if (0..ATTEMPTS).any(|_| arrange(&mut chosen, &centres, room, rng)) {
            break (centres, room);
        }
        tables += 1;
    };
    let mut scene = Scene::default();
    enclose(&mut scene, room);
    for (k, &centre) in centres.iter().enumerate() {
        let table = furniture::table(TABLE, TABLE_HEIGHT, 0.85 + 0.3 * rng.random::<f64>());
        let name = match k {
            0 => "table".to_string(),
            1..=9 => format!("{} table", ORDINALS[k - 1]),
            _ => format!("table {}", k + 1),
        };
        let who = Identity { name, class: "table", color: "brown", background: true };
        scene.place(&table, who, centre.extend(0.0), 0.0);
    }
    for c in &chosen {
        let Some((position, yaw)) = c.at else { continue };
        let repeated = chosen.iter().filter(|d| d.class.name == c.class.name).count() > 1;
        let color = PAINTS[c.paint].name;
        let name = name_of(c.class, color, repeated);
        scene.place(&c.model, Identity { name, class: c.class.name, color, background: false }, position, yaw);
    }
    scene.built(room, centres.iter().map(|c| c.extend(TABLE_HEIGHT)).collect())
}

/// Classes and colours: no pair twice, classes and colours as evenly used as can be.
fn choose(objects: usize, rng: &mut ChaCha8Rng) -> Vec<Chosen> {
    let on_walls = (objects / 12).min(MOST_PAINTINGS);
    let on_floor = (objects / 8).max(1).min(objects - on_walls);
    let mut used = Vec::new();
    let mut paint_uses = [0usize; PAINTS.len()];
    let mut all = Vec::new();
    for (place, count) in
        [(Place::Table, objects - on_floor - on_walls), (Place::Floor, on_floor), (Place::Wall, on_walls)]
    {
        let mut order: Vec<&'static Class> = CLASSES.iter().filter(|c| c.place == place).collect();
        order.shuffle(rng);
        let wanted = all.len() + count;
        for class in order.into_iter().cycle() {
            if all.len() == wanted {
                break;
            }
            // A class whose colours are all taken is passed over; there are more pairs than things in any scene offered.
            let free = |p: &&usize| !used.contains(&(class.name, **p));
            let fewest = class.paints.iter().filter(free).map(|&p| paint_uses[p]).min();
            let pick: Vec<usize> =
                class.paints.iter().filter(free).copied().filter(|&p| Some(paint_uses[p]) == fewest).collect();
            let Some(&paint) = pick.get(rng.random_range(0..pick.len().max(1))) else { continue };
            used.push((class.name, paint));
            paint_uses[paint] += 1;
            all.push(Chosen { class, paint, model: class.make(&PAINTS[paint], rng), at: None });
        }
    }
    all
}

/// Centres of the tables and half extents of the room around them.
fn floor_plan(tables: usize) -> (Vec<DVec2>, DVec2) {
    let columns = (tables as f64).sqrt().ceil() as usize;
    let rows = tables.div_ceil(columns);
    let spread = DVec2::new((columns - 1) as f64, (rows - 1) as f64) * DVec2::from_array(TABLE_SPACING) * 0.5;
    let centres = (0..tables)
        .map(|k| {
            let (row, column) = (k / columns, k % columns);
            // Every other row runs backwards, so that a walk from table to table is short.
            let column = if row % 2 == 0 { column } else { columns - 1 - column };
            DVec2::new(column as f64, row as f64) * DVec2::from_array(TABLE_SPACING) - spread
        })
        .collect();
    (centres, spread + MARGIN)
}

/// Finds a place for everything; false when something does not fit.
fn arrange(chosen: &mut [Chosen], tables: &[DVec2], room: DVec2, rng: &mut ChaCha8Rng) -> bool {
    let table_half = 0.5 * DVec2::from_array(TABLE);
    let upright = |centre, half| Footprint { centre, half, yaw: 0.0 };
    let mut on_table: Vec<Vec<Footprint>> = vec![Vec::new(); tables.len()];
    let mut on_floor: Vec<Footprint> = tables.iter().map(|&centre| upright(centre, table_half)).collect();
    let mut on_wall: Vec<(usize, f64)> = Vec::new();
    // The largest first: they find the fewest places.
    let mut order: Vec<usize> = (0..chosen.len()).collect();
    let area = |c: &Chosen| {
        let (x, y, _) = c.model.extent();
        x * y
    };
    order.sort_by(|&a, &b| area(&chosen[b]).total_cmp(&area(&chosen[a])).then(a.cmp(&b)));
    for i in order {
        let (x, y, _) = chosen[i].model.extent();
        let half = DVec2::new(x, y);
        let random = |rng: &mut ChaCha8Rng, half: DVec2| DVec2::new(either_way(rng), either_way(rng)) * half;
        chosen[i].at = (0..TRIES).find_map(|_| match chosen[i].class.place {
            Place::Table => {
                // Fill the emptiest table, so that tables are alike.
                let t = (0..tables.len()).min_by_key(|&t| (on_table[t].len(), t))?;
                let yaw = rng.random::<f64>() * TAU;
                let f = Footprint { centre: tables[t] + random(rng, table_half), half, yaw };
                let fits =
                    f.inside(&upright(tables[t], table_half - 0.02)) && !on_table[t].iter().any(|o| o.touches(&f, GAP));
                fits.then(|| {
                    on_table[t].push(f);
                    (f.centre.extend(TABLE_HEIGHT), yaw)
                })
            }
            Place::Floor => {
                let yaw = FRAC_PI_2 * f64::from(rng.random_range(0..4)) + 0.5 * (rng.random::<f64>() - 0.5);
                let f = Footprint { centre: random(rng, room), half, yaw };
                let fits =
                    f.inside(&upright(DVec2::ZERO, room - 0.06)) && !on_floor.iter().any(|o| o.touches(&f, 0.06));
                fits.then(|| {
                    on_floor.push(f);
                    (f.centre.extend(0.0), yaw)
                })
            }
            Place::Wall => {
                let wall = rng.random_range(0..4usize);
                let (length, distance) = wall_span(room, wall);
                let along = either_way(rng) * (length - half.x - 0.3).min(tables.len() as f64 * 1.2);
                let fits = !on_wall.iter().any(|&(w, a)| w == wall && (a - along).abs() < 2.0 * half.x + 0.1);
                fits.then(|| {
                    on_wall.push((wall, along));
                    let yaw = FRAC_PI_2 * wall as f64;
                    let at = DVec2::from_angle(yaw).rotate(DVec2::new(along, distance));
                    (at.extend(PAINTING_HEIGHT), yaw)
                })
            }
        });
        if chosen[i].at.is_none() {
            return false;
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Thing;
    use crate::testing::chart_points;
    use rand::SeedableRng;

    #[test]
    fn ten_things_need_one_table() {
        for seed in 0..40 {
            assert_eq!(plan(10, &mut ChaCha8Rng::seed_from_u64(seed)).tables.len(), 1, "seed {seed}");
        }
    }

    /// Points of every thing's surfaces must stay in its own column above its footprint, and columns must not meet.
    #[test]
    fn things_do_not_interpenetrate() {
        for seed in 0..8 {
            let scene = plan(20, &mut ChaCha8Rng::seed_from_u64(seed));
            let column = |t: &Thing| Footprint { centre: t.position.truncate(), half: t.footprint, yaw: t.yaw };
            for p in &scene.primitives {
                let t = &scene.things[p.thing as usize];
                if t.background {
                    continue;
                }
                for at in chart_points(&p.shape, 10) {
                    let q = p.to_world(p.shape.surface(at).0) - t.position;
                    let local = DVec2::from_angle(-t.yaw).rotate(q.truncate());
                    assert!((local.abs() - t.footprint).max_element() < 1e-6, "{} leaves its footprint", t.name);
                    assert!(q.z < t.height + 1e-6 && (t.class == "painting" || q.z > -2e-3), "{}: {}", t.name, q.z);
                }
            }
            let things: Vec<&Thing> = scene.things.iter().filter(|t| !t.background && t.class != "painting").collect();
            for (i, a) in things.iter().enumerate() {
                for b in &things[..i] {
                    let apart = a.position.z != b.position.z || !column(a).touches(&column(b), 0.01);
                    assert!(apart, "{} and {}", a.name, b.name);
                }
            }
        }
    }
}
