//! All classes of things, by where they stand. The order counts: a scene's seed draws from these lists.

use crate::things::class::{Class, Place};
use crate::things::material::{ANY, BLACK, BLUE, GREEN, ORANGE, PINK, PURPLE, RED, TURQUOISE, VIVID, WHITE, YELLOW};
use crate::things::{dishes, furniture, props, toys, walls};

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::chart_points;
    use crate::things::material::PAINTS;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn all() -> impl Iterator<Item = &'static Class> {
        let hung = ON_WALLS.iter().map(|c| &c.0).chain([&SHELF.0, &WALL_CABINET.0, &SINK, &STOVE]);
        CLASSES.iter().chain(PROPS).chain(ALONG_WALLS).chain(hung)
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
