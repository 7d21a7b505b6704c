//! All classes of things, by where they stand. The order counts: a scene's seed draws from these lists.

use crate::things::class::{Class, Place};
use crate::things::material::{ANY, BLACK, BLUE, GREEN, ORANGE, PINK, PURPLE, RED, TURQUOISE, VIVID, WHITE, YELLOW};
use crate::things::{dishes, furniture, props, stores, tools, toys, walls};

const PALE: &[usize] = &[WHITE, TURQUOISE, YELLOW, PINK];
const NOT_BLACK: &[usize] = &[RED, BLUE, GREEN, YELLOW, ORANGE, PURPLE, PINK, TURQUOISE, WHITE];

/// The classes of the studio. Scenes take table things in a shuffled order of this list, so that small scenes repeat none.
pub const CLASSES: &[Class] = &[
    Class::new("mug", Place::Table, VIVID, dishes::mug),
    Class::new("coffee set", Place::Table, ANY, dishes::coffee_set),
    Class::new("plate of cookies", Place::Table, &[WHITE, BLUE, GREEN, PINK, TURQUOISE], dishes::plate_of_cookies)
        .plain(),
    Class::new("bowl of fruit", Place::Table, &[TURQUOISE, WHITE, BLUE, PURPLE], dishes::bowl_of_fruit).plain(),
    Class::new("lamp", Place::Table, VIVID, props::lamp),
    Class::new("laptop", Place::Table, &[BLACK, WHITE, RED, BLUE, PINK], props::laptop),
    Class::new("kettle", Place::Table, ANY, dishes::kettle),
    Class::new("stack of books", Place::Table, &[RED, BLUE, GREEN, ORANGE, PURPLE], props::books)
        .of("stack of", "books"),
    Class::new("bottle", Place::Table, &[GREEN, RED, BLUE, PURPLE, YELLOW], dishes::bottle),
    Class::new("gift box", Place::Table, VIVID, props::gift_box),
    Class::new("toy bear", Place::Table, &[PINK, BLUE, ORANGE, YELLOW, PURPLE, WHITE], toys::toy_bear),
    Class::new("toy duck", Place::Table, &[YELLOW, PINK, BLUE, GREEN], toys::toy_duck),
    Class::new("toy car", Place::Table, VIVID, toys::toy_car),
    Class::new("plant", Place::Table, &[ORANGE, WHITE, BLUE, RED, PURPLE], props::plant).of("plant in a", "pot"),
    Class::new("candle", Place::Table, &[WHITE, RED, PURPLE, BLUE, PINK], props::candle),
    Class::new("toy blocks", Place::Table, &[RED, YELLOW, BLUE, GREEN], toys::toy_blocks).plain(),
    Class::new("clock", Place::Table, VIVID, props::clock),
    Class::new("pencil holder", Place::Table, ANY, props::pencil_holder),
    Class::new("chair", Place::Floor, VIVID, furniture::chair),
    Class::new("stool", Place::Floor, VIVID, furniture::stool),
    Class::new("cabinet", Place::Floor, &[WHITE, TURQUOISE, YELLOW, BLUE, GREEN], furniture::cabinet),
    Class::new("waste bin", Place::Floor, VIVID, furniture::waste_bin),
    Class::new("armchair", Place::Floor, VIVID, furniture::armchair),
    Class::new("painting", Place::Wall, &[BLACK, WHITE, ORANGE, RED, BLUE], walls::painting)
        .of("painting in a", "frame"),
];
/// What stands on tables, counters and shelves besides.
pub const PROPS: &[Class] = &[
    Class::new("plate", Place::Table, ANY, dishes::plate),
    Class::new("bowl", Place::Table, ANY, dishes::bowl),
    Class::new("glass", Place::Table, VIVID, dishes::glass),
    Class::new("jar", Place::Table, VIVID, dishes::jar),
    Class::new("pot", Place::Table, ANY, dishes::pot),
    Class::new("pan", Place::Table, ANY, dishes::pan),
    Class::new("cutting board", Place::Table, VIVID, dishes::cutting_board),
    Class::new("knife", Place::Table, VIVID, dishes::knife),
    Class::new("fork", Place::Table, VIVID, dishes::fork),
    Class::new("dish rack", Place::Table, ANY, dishes::dish_rack),
    Class::new("vase", Place::Table, ANY, props::vase),
    Class::new("puzzle cube", Place::Table, VIVID, toys::puzzle_cube),
    Class::new("toy rocket", Place::Table, VIVID, toys::toy_rocket),
    Class::new("row of books", Place::Table, VIVID, props::row_of_books).of("row of", "books"),
    Class::new("book", Place::Table, VIVID, props::book),
    Class::new("tray", Place::Table, ANY, dishes::tray),
    Class::new("headphones", Place::Table, ANY, props::headphones),
    Class::new("ball", Place::Table, VIVID, toys::ball),
];
/// What stands with its back to a wall.
pub const ALONG_WALLS: &[Class] = &[
    Class::new("bed", Place::Floor, NOT_BLACK, furniture::bed),
    Class::new("sofa", Place::Floor, NOT_BLACK, furniture::sofa),
    Class::new("bookshelf", Place::Floor, PALE, furniture::bookshelf),
    Class::new("desk", Place::Floor, PALE, furniture::desk),
    Class::new("side table", Place::Floor, NOT_BLACK, furniture::side_table),
    Class::new("refrigerator", Place::Floor, PALE, furniture::refrigerator),
];
/// What hangs on a wall, with the height of its origin.
pub const ON_WALLS: &[(Class, f64)] = &[
    (Class::new("door", Place::Wall, NOT_BLACK, walls::door), 0.0),
    (Class::new("window", Place::Wall, PALE, walls::window), 1.0),
    (Class::new("curtain", Place::Wall, NOT_BLACK, walls::curtain), 0.85),
];
/// The wall cabinet of kitchens and the height of its lower side.
pub const WALL_CABINET: (Class, f64) =
    (Class::new("wall cabinet", Place::Wall, NOT_BLACK, furniture::wall_cabinet), 1.55);
/// The shelf of kitchens and the height of its board.
pub const SHELF: (Class, f64) = (Class::new("shelf", Place::Wall, NOT_BLACK, furniture::shelf), 1.35);
/// The sink of kitchens, which stands on the counter.
pub const SINK: Class = Class::new("sink", Place::Table, PALE, furniture::sink);
/// The stove of kitchens, which stands on the counter.
pub const STOVE: Class = Class::new("stove", Place::Table, &[BLACK, WHITE], furniture::stove);

/// How a tool hangs on a pegboard.
#[derive(Debug)]
pub struct Hanging {
    pub class: Class,
    /// Whether the end of +x is above when it hangs, as it lies.
    pub tip_up: bool,
    /// Where the peg is, in x and y as it lies, -1 to 1 of its half extents.
    pub peg: [f64; 2],
}

const fn hung(class: Class, tip_up: bool, peg: [f64; 2]) -> Hanging {
    Hanging { class, tip_up, peg }
}

/// The tools of workshops that hang on a pegboard or lie on the bench.
pub const HANGING: &[Hanging] = &[
    hung(Class::new("screwdriver", Place::Table, VIVID, tools::screwdriver), false, [-0.94, 0.0]),
    hung(Class::new("hammer", Place::Table, VIVID, tools::hammer), false, [-0.94, 0.0]),
    hung(Class::new("saw", Place::Table, VIVID, tools::saw), false, [-0.80, 0.0]),
    hung(Class::new("pliers", Place::Table, VIVID, tools::pliers), true, [0.17, 0.0]),
    hung(Class::new("wrench", Place::Table, ANY, tools::wrench), false, [-0.87, 0.0]),
    hung(Class::new("chisel", Place::Table, VIVID, tools::chisel), false, [-0.94, 0.0]),
    hung(Class::new("paintbrush", Place::Table, ANY, tools::paintbrush), false, [-0.94, 0.0]),
    hung(Class::new("file", Place::Table, VIVID, tools::file), false, [-0.94, 0.0]),
    hung(Class::new("mallet", Place::Table, ANY, tools::mallet), false, [-0.94, 0.0]),
    hung(Class::new("putty knife", Place::Table, VIVID, tools::putty_knife), false, [-0.94, 0.0]),
    hung(Class::new("scissors", Place::Table, VIVID, tools::scissors), false, [-0.84, 0.5]),
    hung(Class::new("hex key", Place::Table, ANY, tools::hex_key), false, [-0.83, 0.2]),
    hung(Class::new("ruler", Place::Table, NOT_BLACK, tools::ruler), false, [-0.96, 0.0]),
    hung(Class::new("clamp", Place::Table, VIVID, tools::clamp), true, [0.80, 0.34]),
    hung(
        Class::new("coil of cable", Place::Table, ANY, stores::coil_of_cable).of("coil of", "cable"),
        false,
        [-0.62, 0.0],
    ),
    hung(
        Class::new("roll of tape", Place::Table, ANY, stores::roll_of_tape).of("roll of", "tape"),
        false,
        [-0.46, 0.0],
    ),
];
/// What stands on the shelves of workshops.
pub const STORES: &[Class] = &[
    Class::new("screw jar", Place::Table, ANY, stores::screw_jar),
    Class::new("manual", Place::Table, VIVID, stores::manual),
    Class::new("tin can", Place::Table, VIVID, stores::tin_can),
    Class::new("magazine", Place::Table, ANY, stores::magazine),
    Class::new("paint can", Place::Table, ANY, stores::paint_can),
    Class::new("spray can", Place::Table, ANY, stores::spray_can),
    Class::new("screw box", Place::Table, VIVID, stores::screw_box),
    Class::new("spool of wire", Place::Table, VIVID, stores::spool_of_wire).of("spool of", "wire"),
    Class::new("glue bottle", Place::Table, VIVID, stores::glue_bottle),
    Class::new("drawer box", Place::Table, VIVID, stores::drawer_box),
    Class::new("set of screwdrivers", Place::Table, VIVID, stores::set_of_screwdrivers).of("set of", "screwdrivers"),
    Class::new("pencil cup", Place::Table, ANY, stores::pencil_cup),
    Class::new("stack of boxes", Place::Table, VIVID, stores::stack_of_boxes).of("stack of", "boxes"),
    Class::new("rack of jars", Place::Table, VIVID, stores::rack_of_jars).of("rack of", "jars"),
    Class::new("oil can", Place::Table, VIVID, stores::oil_can),
    Class::new("jar of brushes", Place::Table, VIVID, stores::jar_of_brushes).of("jar of", "brushes"),
    Class::new("battery", Place::Table, ANY, stores::battery),
    Class::new("light bulb", Place::Table, &[WHITE, YELLOW, BLUE, PINK], tools::light_bulb),
];
/// The stores that stand side by side with their like.
pub const IN_RUNS: [&str; 7] = ["screw jar", "manual", "tin can", "magazine", "paint can", "spray can", "screw box"];
/// What lies on the benches of workshops besides.
pub const BENCH: &[Class] = &[
    Class::new("pencil", Place::Table, VIVID, tools::pencil),
    Class::new("tape measure", Place::Table, VIVID, tools::tape_measure),
    Class::new("utility knife", Place::Table, VIVID, tools::utility_knife),
    Class::new("bolt", Place::Table, ANY, tools::bolt),
    Class::new("power drill", Place::Table, VIVID, tools::power_drill),
    Class::new("spirit level", Place::Table, VIVID, tools::spirit_level),
    Class::new("tool box", Place::Table, VIVID, stores::tool_box),
];
/// The vise of workshops, fixed to the front edge of the bench.
pub const VISE: Class = Class::new("vise", Place::Table, &[BLUE, RED, GREEN, BLACK], tools::vise);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::chart_points;
    use crate::things::material::PAINTS;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn all() -> impl Iterator<Item = &'static Class> {
        let hung = ON_WALLS.iter().map(|c| &c.0).chain([&SHELF.0, &WALL_CABINET.0, &SINK, &STOVE]);
        let workshop = HANGING.iter().map(|h| &h.class).chain(STORES).chain(BENCH).chain([&VISE]);
        CLASSES.iter().chain(PROPS).chain(ALONG_WALLS).chain(hung).chain(workshop)
    }

    #[test]
    fn every_class_builds_in_every_colour_with_parts_that_own_pieces() {
        for class in all() {
            for &paint in class.paints {
                for seed in 0..5 {
                    let m = class.make(&PAINTS[paint], &mut ChaCha8Rng::seed_from_u64(seed));
                    assert!(m.parts.len() >= 2, "{} has parts", class.name);
                    for part in 0..m.parts.len() {
                        assert!(m.pieces.iter().any(|p| p.part == part), "{}: {}", class.name, m.parts[part]);
                    }
                    for piece in &m.pieces {
                        assert!(piece.part < m.parts.len());
                        assert!(piece.material.albedo.min_element() > 0.0 && piece.material.albedo.max_element() < 1.1);
                    }
                }
            }
        }
    }

    #[test]
    fn things_stand_on_their_ground() {
        for class in all().filter(|c| c.place != Place::Wall) {
            let m = class.make(&PAINTS[class.paints[0]], &mut ChaCha8Rng::seed_from_u64(1));
            let mut low = f64::INFINITY;
            for piece in &m.pieces {
                for at in chart_points(&piece.shape, 100) {
                    low = low.min((piece.rotation * piece.shape.surface(at).0 + piece.offset).z);
                }
            }
            assert!((-1e-3..0.003).contains(&low), "{}: lowest point {low}", class.name);
        }
    }
}
