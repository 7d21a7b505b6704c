//! The things that scenes are made of: for each class, its colours, where it stands and how it is built.

use crate::things::material::{Material, PAINTS, Paint, Pattern, albedo};
use crate::things::model::{Model, z_towards};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Where a thing stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// On a table.
    Table,
    /// On the floor.
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

/// A class of things.
#[derive(Debug)]
pub struct Class {
    /// The class's name.
    pub name: &'static str,
    /// How one of them is called.
    pub naming: Naming,
    /// Where it stands.
    pub place: Place,
    /// Colours it comes in; they index [`PAINTS`].
    pub paints: &'static [usize],
    /// Builds one in a colour; the generator varies sizes and details.
    pub build: fn(&Paint, &mut ChaCha8Rng) -> Model,
}

const RED: usize = 0;
const BLUE: usize = 1;
const GREEN: usize = 2;
const YELLOW: usize = 3;
const ORANGE: usize = 4;
const PURPLE: usize = 5;
const PINK: usize = 6;
const TURQUOISE: usize = 7;
const WHITE: usize = 8;
const BLACK: usize = 9;
const VIVID: &[usize] = &[RED, BLUE, GREEN, YELLOW, ORANGE, PURPLE, PINK, TURQUOISE];
const ANY: &[usize] = &[RED, BLUE, GREEN, YELLOW, ORANGE, PURPLE, PINK, TURQUOISE, WHITE, BLACK];

/// All classes. Scenes take table things in a shuffled order of this list, so that small scenes repeat none.
pub const CLASSES: &[Class] = &[
    Class { name: "mug", naming: Naming::Colored, place: Place::Table, paints: VIVID, build: mug },
    Class { name: "coffee set", naming: Naming::Colored, place: Place::Table, paints: ANY, build: coffee_set },
    Class {
        name: "plate of cookies",
        naming: Naming::Plain,
        place: Place::Table,
        paints: &[WHITE, BLUE, GREEN, PINK, TURQUOISE],
        build: plate_of_cookies,
    },
    Class {
        name: "bowl of fruit",
        naming: Naming::Plain,
        place: Place::Table,
        paints: &[TURQUOISE, WHITE, BLUE, PURPLE],
        build: bowl_of_fruit,
    },
    Class { name: "lamp", naming: Naming::Colored, place: Place::Table, paints: VIVID, build: lamp },
    Class {
        name: "laptop",
        naming: Naming::Colored,
        place: Place::Table,
        paints: &[BLACK, WHITE, RED, BLUE, PINK],
        build: laptop,
    },
    Class { name: "kettle", naming: Naming::Colored, place: Place::Table, paints: ANY, build: kettle },
    Class {
        name: "stack of books",
        naming: Naming::Of("stack of", "books"),
        place: Place::Table,
        paints: &[RED, BLUE, GREEN, ORANGE, PURPLE],
        build: books,
    },
    Class {
        name: "bottle",
        naming: Naming::Colored,
        place: Place::Table,
        paints: &[GREEN, RED, BLUE, PURPLE, YELLOW],
        build: bottle,
    },
    Class { name: "gift box", naming: Naming::Colored, place: Place::Table, paints: VIVID, build: gift_box },
    Class {
        name: "toy bear",
        naming: Naming::Colored,
        place: Place::Table,
        paints: &[PINK, BLUE, ORANGE, YELLOW, PURPLE, WHITE],
        build: toy_bear,
    },
    Class {
        name: "toy duck",
        naming: Naming::Colored,
        place: Place::Table,
        paints: &[YELLOW, PINK, BLUE, GREEN],
        build: toy_duck,
    },
    Class { name: "toy car", naming: Naming::Colored, place: Place::Table, paints: VIVID, build: toy_car },
    Class {
        name: "plant",
        naming: Naming::Of("plant in a", "pot"),
        place: Place::Table,
        paints: &[ORANGE, WHITE, BLUE, RED, PURPLE],
        build: plant,
    },
    Class {
        name: "candle",
        naming: Naming::Colored,
        place: Place::Table,
        paints: &[WHITE, RED, PURPLE, BLUE, PINK],
        build: candle,
    },
    Class {
        name: "toy blocks",
        naming: Naming::Plain,
        place: Place::Table,
        paints: &[RED, YELLOW, BLUE, GREEN],
        build: toy_blocks,
    },
    Class { name: "clock", naming: Naming::Colored, place: Place::Table, paints: VIVID, build: clock },
    Class { name: "pencil holder", naming: Naming::Colored, place: Place::Table, paints: ANY, build: pencil_holder },
    Class { name: "chair", naming: Naming::Colored, place: Place::Floor, paints: VIVID, build: chair },
    Class { name: "stool", naming: Naming::Colored, place: Place::Floor, paints: VIVID, build: stool },
    Class {
        name: "cabinet",
        naming: Naming::Colored,
        place: Place::Floor,
        paints: &[WHITE, TURQUOISE, YELLOW, BLUE, GREEN],
        build: cabinet,
    },
    Class { name: "waste bin", naming: Naming::Colored, place: Place::Floor, paints: VIVID, build: waste_bin },
    Class { name: "armchair", naming: Naming::Colored, place: Place::Floor, paints: VIVID, build: armchair },
    Class {
        name: "painting",
        naming: Naming::Of("painting in a", "frame"),
        place: Place::Wall,
        paints: &[BLACK, WHITE, ORANGE, RED, BLUE],
        build: painting,
    },
];

fn brown() -> DVec3 {
    albedo([0.46, 0.30, 0.18])
}

pub(crate) fn wood(tone: f64) -> Material {
    Material::matt(albedo([0.72, 0.52, 0.33]) * tone).with(Pattern::Wood { board: 0.11 })
}

pub(crate) fn metal() -> Material {
    Material { specular: 0.2, ..Material::matt(albedo([0.70, 0.70, 0.72])) }
}

pub(crate) fn ivory() -> DVec3 {
    albedo([0.93, 0.90, 0.82])
}

/// About x by `degrees`: tips +y up.
pub(crate) fn tip(degrees: f64) -> DMat3 {
    DMat3::from_rotation_x(degrees.to_radians())
}

pub(crate) fn vary(rng: &mut ChaCha8Rng, amount: f64) -> f64 {
    1.0 + amount * (2.0 * rng.random::<f64>() - 1.0)
}

/// A cup with a handle and a disc of coffee; returns nothing, adds parts `names`.
fn cup(m: &mut Model, r: f64, h: f64, foot: f64, names: [&'static str; 3], material: Material) {
    let wall = 0.11 * r;
    let body = m.part(names[0]);
    let profile = [
        (0.0, 0.0),
        (0.72 * r, 0.0),
        (0.86 * r, 0.06 * h),
        (0.96 * r, 0.25 * h),
        (r, 0.6 * h),
        (r, 0.985 * h),
        (r - 0.5 * wall, h),
        (r - wall, 0.985 * h),
        (r - wall, 0.5 * h),
        (0.7 * r, 0.1 * h),
        (0.0, 0.1 * h),
    ];
    m.turn(body, &profile, [0.0, 0.0, foot], material);
    let handle = m.part(names[1]);
    let ring = Shape::Ring { major: 0.3 * h, minor: 0.085 * h, arc: 1.42 };
    m.add_turned(handle, ring, [0.97 * r, 0.0, foot + 0.55 * h], tip(90.0), material);
    let coffee = m.part(names[2]);
    m.turn(
        coffee,
        &[(r - 1.05 * wall, 0.86 * h), (0.0, 0.86 * h)],
        [0.0, 0.0, foot],
        Material::matt(albedo([0.33, 0.19, 0.10])),
    );
}

fn mug(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (r, h) = (0.052 * vary(rng, 0.08), 0.125 * vary(rng, 0.1));
    let mut material = Material::glazed(paint.albedo());
    if rng.random::<f64>() < 0.4 {
        material = material.with(Pattern::Stripes { other: ivory(), across: DVec3::Z * 16.0 });
    }
    cup(&mut m, r, h, 0.0, ["cup", "handle", "coffee"], material);
    m
}

fn coffee_set(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let material = Material::glazed(paint.albedo());
    let saucer = m.part("saucer");
    let s = 0.115 * vary(rng, 0.06);
    let profile =
        [(0.0, 0.0), (0.5 * s, 0.0), (0.98 * s, 0.022), (s, 0.026), (0.96 * s, 0.027), (0.5 * s, 0.007), (0.0, 0.007)];
    m.turn(saucer, &profile, [0.0; 3], Material::glazed(paint.albedo() * 0.75 + ivory() * 0.25));
    cup(&mut m, 0.5 * s, 0.09, 0.0072, ["cup", "handle", "coffee"], material);
    let spoon = m.part("spoon");
    let lean = DMat3::from_rotation_y((-11f64).to_radians());
    let (y, z) = (-0.70 * s, 0.0305);
    m.add_turned(
        spoon,
        Shape::Ellipsoid { radii: DVec3::new(0.024, 0.015, 0.005) },
        [-0.5 * s, y, z - 0.006],
        lean,
        metal(),
    );
    m.rod(spoon, [-0.35 * s, y, z - 0.002], [0.85 * s, y, z + 0.010], 0.0045, metal());
    m
}

fn plate_of_cookies(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let plate = m.part("plate");
    let r = 0.15 * vary(rng, 0.06);
    let profile =
        [(0.0, 0.0), (0.6 * r, 0.0), (0.98 * r, 0.022), (r, 0.026), (0.96 * r, 0.027), (0.62 * r, 0.010), (0.0, 0.010)];
    m.turn(plate, &profile, [0.0; 3], Material::glazed(paint.albedo()));
    let dough = Material::matt(albedo([0.80, 0.55, 0.27])).with(Pattern::Clouds { size: 0.012, amount: 0.35 });
    let count = rng.random_range(4..=5);
    let (c, h) = (0.040, 0.016);
    let profile = [
        (0.0, 0.0),
        (0.85 * c, 0.0),
        (0.98 * c, 0.2 * h),
        (c, 0.5 * h),
        (0.9 * c, 0.85 * h),
        (0.6 * c, h),
        (0.0, 1.05 * h),
    ];
    let start = rng.random::<f64>() * TAU;
    for k in 0..count {
        let cookie = m.part("cookie");
        let a = start + TAU * f64::from(k) / f64::from(count);
        let ring = 0.5 * r * if count == 4 { 0.88 } else { 0.95 };
        m.turn(cookie, &profile, [ring * a.cos(), ring * a.sin(), 0.0102], dough);
    }
    let top = m.part("cookie");
    m.turn(top, &profile, [0.0, 0.0, 0.0102 + 1.06 * h], dough);
    m
}

fn bowl_of_fruit(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let bowl = m.part("bowl");
    let r = 0.15 * vary(rng, 0.06);
    let h = 0.095;
    let profile = [
        (0.0, 0.0),
        (0.45 * r, 0.0),
        (0.47 * r, 0.008),
        (0.72 * r, 0.25 * h),
        (0.92 * r, 0.6 * h),
        (r, h),
        (0.97 * r, 1.02 * h),
        (0.88 * r, 0.65 * h),
        (0.66 * r, 0.3 * h),
        (0.4 * r, 0.16 * h),
        (0.0, 0.15 * h),
    ];
    m.turn(bowl, &profile, [0.0; 3], Material::glazed(paint.albedo()));
    let fruit: [(&str, [f64; 3], DVec3); 4] = [
        ("apple", [0.78, 0.13, 0.12], DVec3::new(0.047, 0.047, 0.043)),
        ("orange", [0.94, 0.52, 0.10], DVec3::splat(0.046)),
        ("lemon", [0.94, 0.83, 0.20], DVec3::new(0.052, 0.038, 0.038)),
        ("green apple", [0.52, 0.70, 0.20], DVec3::new(0.046, 0.046, 0.042)),
    ];
    let start = rng.random::<f64>() * TAU;
    for (k, (name, srgb, radii)) in fruit.into_iter().enumerate() {
        let part = m.part(name);
        let skin = Material { specular: 0.08, ..Material::matt(albedo(srgb)) };
        let a = start + TAU * k as f64 / 3.0;
        let at = if k < 3 { [0.058 * a.cos(), 0.058 * a.sin(), 0.092] } else { [0.0, 0.0, 0.155] };
        m.add_turned(part, Shape::Ellipsoid { radii }, at, DMat3::from_rotation_z(a), skin);
        if name.contains("apple") {
            m.rod(
                part,
                [at[0], at[1], at[2] + 0.038],
                [at[0] + 0.008, at[1], at[2] + 0.058],
                0.003,
                Material::matt(brown()),
            );
        }
    }
    m
}

fn lamp(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.08);
    let base = m.part("base");
    m.turn(
        base,
        &[(0.0, 0.0), (0.085, 0.0), (0.085, 0.014), (0.075, 0.022), (0.02, 0.034), (0.0, 0.034)],
        [0.0; 3],
        Material::glazed(albedo([0.35, 0.27, 0.22])),
    );
    let stem = m.part("stem");
    m.rod(stem, [0.0, 0.0, 0.02], [0.0, 0.0, 0.30], 0.012, metal());
    let shade = m.part("shade");
    let cloth = Material::matt(paint.albedo() * 0.9 + 0.05).glowing(0.25);
    m.turn(shade, &[(0.128, 0.25), (0.085, 0.42), (0.081, 0.42), (0.124, 0.25), (0.128, 0.25)], [0.0; 3], cloth);
    let bulb = m.part("bulb");
    m.add(bulb, Shape::sphere(0.032), [0.0, 0.0, 0.325], Material::matt(albedo([1.0, 0.95, 0.8])).glowing(0.8));
    m.scaled(k)
}

fn laptop(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d) = (0.35, 0.24);
    let shell = Material { specular: 0.08, ..Material::matt(paint.albedo()) };
    let base = m.part("keyboard");
    let dark = if paint.name == "black" { albedo([0.42, 0.42, 0.45]) } else { albedo([0.25, 0.25, 0.28]) };
    let keys = Pattern::Keys { other: dark, half: [0.44 * w, 0.30 * d], above: 0.007 };
    m.block(base, [w, d, 0.02], 0.004, [0.0, 0.0, 0.0], shell.with(keys));
    let screen = m.part("screen");
    let open = (105.0 + 15.0 * rng.random::<f64>()).to_radians();
    let up = DVec3::new(0.0, -open.cos(), open.sin());
    let lid = DMat3::from_cols(DVec3::X, up, DVec3::X.cross(up));
    let centre = DVec3::new(0.0, 0.5 * d - 0.006, 0.022) + up * (0.5 * d);
    m.add_turned(
        screen,
        Shape::Block { half: DVec3::new(0.5 * w, 0.5 * d, 0.006), round: 0.004 },
        centre.to_array(),
        lid,
        shell,
    );
    // z of the lid points to the user.
    let glass = Material::glazed(albedo([0.36, 0.52, 0.72]))
        .with(Pattern::Stripes { other: albedo([0.62, 0.76, 0.86]), across: DVec3::new(4.0, 5.0, 0.0) })
        .glowing(0.15);
    let front = centre + lid.z_axis * 0.0062;
    m.add_turned(
        screen,
        Shape::Block { half: DVec3::new(0.46 * w, 0.44 * d, 0.0008), round: 0.0 },
        front.to_array(),
        lid,
        glass,
    );
    m
}

fn kettle(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.08);
    let body = m.part("body");
    let enamel = Material { specular: 0.15, ..Material::glazed(paint.albedo()) };
    let profile = [
        (0.0, 0.0),
        (0.080, 0.0),
        (0.092, 0.012),
        (0.098, 0.04),
        (0.094, 0.08),
        (0.080, 0.12),
        (0.060, 0.145),
        (0.0, 0.147),
    ];
    m.turn(body, &profile, [0.0; 3], enamel);
    let spout = m.part("spout");
    let out = DVec3::new(0.62, 0.0, 0.78);
    m.turn_rotated(
        spout,
        &[(0.026, 0.0), (0.013, 0.09), (0.009, 0.09), (0.012, 0.06), (0.0, 0.06)],
        [0.075, 0.0, 0.055],
        z_towards(out),
        enamel,
    );
    let dark = Material { specular: 0.08, ..Material::matt(albedo([0.20, 0.18, 0.17])) };
    let handle = m.part("handle");
    m.add_turned(
        handle,
        Shape::Ring { major: 0.072, minor: 0.010, arc: 1.75 },
        [0.0, 0.0, 0.150],
        tip(90.0) * DMat3::from_rotation_z(FRAC_PI_2),
        dark,
    );
    let lid = m.part("lid");
    m.turn(
        lid,
        &[(0.050, 0.146), (0.050, 0.152), (0.035, 0.160), (0.0, 0.163)],
        [0.0; 3],
        Material { albedo: enamel.albedo * 0.8, ..enamel },
    );
    m.add(lid, Shape::sphere(0.013), [0.0, 0.0, 0.172], dark);
    m.scaled(k)
}

fn books(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let mut z = 0.0;
    let names = ["bottom book", "middle book", "top book"];
    for (k, name) in names.into_iter().enumerate() {
        let part = m.part(name);
        let size = [0.25 - 0.02 * k as f64, 0.18 - 0.015 * k as f64, 0.036 * vary(rng, 0.2)];
        let half = 0.5 * DVec3::from_array(size);
        let shade = [0.7, 1.15, 0.9][k];
        let cover = Material::matt((paint.albedo() * shade + [0.0, 0.03, 0.0][k]).min(DVec3::splat(0.9)))
            .with(Pattern::Pages { other: ivory(), inner: half - DVec3::new(0.004, 0.004, 0.005) });
        let angle = 0.35 * (rng.random::<f64>() - 0.5);
        m.add_turned(
            part,
            Shape::Block { half, round: 0.002 },
            [0.0, 0.0, z + half.z],
            DMat3::from_rotation_z(angle),
            cover,
        );
        z += size[2] + 0.0005;
    }
    m.top([0.0, 0.0], [0.08, 0.05], z);
    m
}

fn bottle(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.08);
    let glass = Material { specular: 0.25, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    let profile = [
        (0.0, 0.0),
        (0.040, 0.0),
        (0.045, 0.008),
        (0.045, 0.17),
        (0.040, 0.20),
        (0.026, 0.225),
        (0.018, 0.25),
        (0.017, 0.29),
        (0.0, 0.29),
    ];
    m.turn(body, &profile, [0.0; 3], glass);
    let label = m.part("label");
    m.turn(
        label,
        &[(0.0455, 0.06), (0.0455, 0.14)],
        [0.0; 3],
        Material::matt(ivory()).with(Pattern::Stripes { other: paint.albedo() * 0.6 + 0.3, across: DVec3::Z * 25.0 }),
    );
    let cap = m.part("cap");
    m.turn(
        cap,
        &[(0.020, 0.275), (0.020, 0.305), (0.016, 0.309), (0.0, 0.309)],
        [0.0; 3],
        Material::matt(albedo([0.85, 0.70, 0.30])),
    );
    m.scaled(k)
}

fn gift_box(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, h) = (0.17 * vary(rng, 0.1), 0.12 * vary(rng, 0.15));
    let paper =
        Material::matt(paint.albedo()).with(Pattern::Checks { other: paint.albedo() * 0.72 + 0.10, size: 0.045 });
    let body = m.part("box");
    m.block(body, [w, w, h], 0.003, [0.0; 3], paper);
    let lid = m.part("lid");
    m.block(lid, [w + 0.012, w + 0.012, 0.032], 0.003, [0.0, 0.0, h], Material::matt(paint.albedo() * 0.8));
    let ribbon = m.part("ribbon");
    let silk = Material::glazed(if paint.name == "yellow" || paint.name == "orange" {
        albedo([0.75, 0.15, 0.15])
    } else {
        albedo([0.95, 0.83, 0.35])
    });
    let top = h + 0.032;
    m.block(ribbon, [w + 0.016, 0.026, top + 0.002], 0.0, [0.0; 3], silk);
    m.block(ribbon, [0.026, w + 0.016, top + 0.002], 0.0, [0.0; 3], silk);
    for side in [-1.0, 1.0] {
        let lean = DMat3::from_rotation_y(side * 0.9);
        m.add_turned(
            ribbon,
            Shape::Ellipsoid { radii: DVec3::new(0.012, 0.016, 0.034) },
            [side * 0.026, 0.0, top + 0.022],
            lean,
            silk,
        );
    }
    m
}

fn toy_bear(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let fur = Material::matt(paint.albedo() * 0.92 + 0.02).with(Pattern::Clouds { size: 0.015, amount: 0.15 });
    let pale = Material { albedo: fur.albedo * 0.45 + ivory() * 0.5, ..fur };
    let ball = |x: f64, y: f64, z: f64| Shape::Ellipsoid { radii: DVec3::new(x, y, z) };
    let body = m.part("body");
    m.add(body, ball(0.062, 0.055, 0.075), [0.0, 0.0, 0.075], fur);
    m.add(body, ball(0.042, 0.020, 0.050), [0.0, -0.043, 0.072], pale);
    let head = m.part("head");
    m.add(head, ball(0.052, 0.048, 0.047), [0.0, -0.005, 0.180], fur);
    m.add(head, ball(0.024, 0.020, 0.018), [0.0, -0.048, 0.170], pale);
    let dark = Material::glazed(albedo([0.12, 0.10, 0.10]));
    m.add(head, Shape::sphere(0.008), [0.0, -0.068, 0.176], dark);
    let ears = m.part("ears");
    for side in [-1.0, 1.0] {
        m.add(head, Shape::sphere(0.0065), [side * 0.020, -0.046, 0.194], dark);
        m.add(ears, ball(0.020, 0.012, 0.020), [side * 0.042, 0.0, 0.220], fur);
        m.add(ears, ball(0.012, 0.006, 0.012), [side * 0.042, -0.009, 0.220], pale);
    }
    let arms = m.part("arms");
    let legs = m.part("legs");
    for side in [-1.0, 1.0] {
        m.rod(arms, [side * 0.052, -0.01, 0.118], [side * 0.082, -0.045, 0.070], 0.020, fur);
        m.rod(legs, [side * 0.035, -0.02, 0.024], [side * 0.060, -0.085, 0.024], 0.024, fur);
        m.add(legs, ball(0.018, 0.006, 0.018), [side * 0.0655, -0.106, 0.026], pale);
    }
    m.scaled(1.1 * vary(rng, 0.08))
}

fn toy_duck(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let skin = Material { specular: 0.12, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    m.add(body, Shape::Ellipsoid { radii: DVec3::new(0.085, 0.062, 0.050) }, [0.0, 0.0, 0.050], skin);
    m.add_turned(
        body,
        Shape::Ellipsoid { radii: DVec3::new(0.040, 0.030, 0.016) },
        [-0.075, 0.0, 0.075],
        DMat3::from_rotation_y(0.6),
        skin,
    );
    let head = m.part("head");
    m.add(head, Shape::sphere(0.043), [0.050, 0.0, 0.122], skin);
    let beak = m.part("beak");
    let bill = if paint.name == "yellow" { albedo([0.90, 0.36, 0.10]) } else { albedo([0.96, 0.74, 0.15]) };
    m.add(
        beak,
        Shape::Ellipsoid { radii: DVec3::new(0.028, 0.022, 0.009) },
        [0.098, 0.0, 0.116],
        Material::glazed(bill),
    );
    let wings = m.part("wings");
    for side in [-1.0, 1.0] {
        m.add(head, Shape::sphere(0.007), [0.082, side * 0.022, 0.136], Material::glazed(albedo([0.08, 0.08, 0.08])));
        m.add_turned(
            wings,
            Shape::Ellipsoid { radii: DVec3::new(0.045, 0.014, 0.026) },
            [-0.012, side * 0.056, 0.066],
            DMat3::from_rotation_y(0.25),
            Material { albedo: skin.albedo * 0.82, ..skin },
        );
    }
    m.scaled(vary(rng, 0.1))
}

fn toy_car(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let lacquer = Material { specular: 0.2, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    m.block(body, [0.22, 0.10, 0.045], 0.016, [0.0, 0.0, 0.022], lacquer);
    let cabin = m.part("cabin");
    m.block(cabin, [0.115, 0.085, 0.046], 0.014, [-0.012, 0.0, 0.064], Material::glazed(albedo([0.62, 0.74, 0.82])));
    m.block(cabin, [0.10, 0.080, 0.012], 0.005, [-0.012, 0.0, 0.104], lacquer);
    let wheels = m.part("wheels");
    let rubber = Material::matt(albedo([0.17, 0.17, 0.18]));
    for x in [-0.065, 0.065] {
        for side in [-1.0, 1.0] {
            let across = tip(-90.0 * side);
            m.turn_rotated(
                wheels,
                &[(0.0, 0.0), (0.028, 0.0), (0.028, 0.022), (0.024, 0.025), (0.0, 0.025)],
                [x, side * 0.034, 0.0285],
                across,
                rubber,
            );
            m.turn_rotated(wheels, &[(0.013, 0.0255), (0.0, 0.0275)], [x, side * 0.034, 0.0285], across, metal());
        }
    }
    m.scaled(vary(rng, 0.1))
}

fn plant(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let pot = m.part("pot");
    m.turn(
        pot,
        &[(0.0, 0.0), (0.050, 0.0), (0.066, 0.085), (0.074, 0.085), (0.074, 0.105), (0.066, 0.105), (0.062, 0.09)],
        [0.0; 3],
        Material::matt(paint.albedo()),
    );
    let soil = m.part("soil");
    m.turn(soil, &[(0.063, 0.092), (0.0, 0.097)], [0.0; 3], Material::matt(albedo([0.28, 0.19, 0.13])));
    let leaves = m.part("leaves");
    let start = rng.random::<f64>() * TAU;
    for k in 0..11 {
        let t = f64::from(k);
        let azimuth = start + t * 2.4;
        let lean = 0.18 + 0.075 * t;
        let out = DVec3::new(azimuth.cos() * lean.sin(), azimuth.sin() * lean.sin(), lean.cos());
        let length = 0.10 - 0.003 * t;
        let centre = DVec3::new(0.0, 0.0, 0.10) + out * length;
        let green = albedo([0.22 + 0.015 * t, 0.50 + 0.012 * t, 0.20]);
        m.add_turned(
            leaves,
            Shape::Ellipsoid { radii: DVec3::new(0.026, 0.007, length) },
            centre.to_array(),
            z_towards(out),
            Material::matt(green),
        );
    }
    m.scaled(vary(rng, 0.08))
}

fn candle(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let holder = m.part("holder");
    m.turn(
        holder,
        &[(0.0, 0.0), (0.075, 0.0), (0.078, 0.010), (0.070, 0.014), (0.045, 0.008), (0.0, 0.008)],
        [0.0; 3],
        Material { specular: 0.2, ..Material::matt(albedo([0.80, 0.66, 0.34])) },
    );
    let wax = m.part("wax");
    let h = 0.14 * vary(rng, 0.2);
    m.turn(
        wax,
        &[(0.034, 0.008), (0.034, h), (0.031, h + 0.004), (0.024, h), (0.0, h - 0.004)],
        [0.0; 3],
        Material { specular: 0.06, ..Material::matt(paint.albedo()) },
    );
    let flame = m.part("flame");
    m.rod(flame, [0.0, 0.0, h - 0.004], [0.0, 0.0, h + 0.010], 0.0025, Material::matt(albedo([0.1; 3])));
    m.add(
        flame,
        Shape::Ellipsoid { radii: DVec3::new(0.011, 0.011, 0.025) },
        [0.0, 0.0, h + 0.030],
        Material::matt(albedo([1.0, 0.80, 0.30])).glowing(1.0),
    );
    m
}

fn toy_blocks(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let first = PAINTS.iter().position(|p| p.name == paint.name).unwrap_or(0);
    let names = ["red block", "blue block", "green block", "yellow block"];
    let s = 0.072;
    for (k, foot) in [[-0.52 * s, 0.0, 0.0], [0.52 * s, 0.0, 0.0], [0.05 * s, 0.0, s + 0.0005]].into_iter().enumerate()
    {
        let color = (first + k) % 4;
        let part = m.part(names[color]);
        let half = DVec3::splat(0.5 * s);
        let angle = if k == 2 { 0.8 * (rng.random::<f64>() - 0.5) } else { 0.0 };
        m.add_turned(
            part,
            Shape::Block { half, round: 0.005 },
            [foot[0], foot[1], foot[2] + half.z],
            DMat3::from_rotation_z(angle),
            Material::matt(PAINTS[color].albedo()),
        );
    }
    m
}

fn clock(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let case = m.part("case");
    let (r, y) = (0.075, 0.028);
    let forward = tip(90.0);
    let lacquer = Material { specular: 0.12, ..Material::matt(paint.albedo()) };
    m.turn_rotated(
        case,
        &[(0.0, -y), (0.9 * r, -y), (r, -0.6 * y), (r, y), (0.88 * r, y + 0.004), (0.88 * r, y - 0.004)],
        [0.0, 0.0, 0.093],
        forward,
        lacquer,
    );
    let face = m.part("face");
    m.turn_rotated(
        face,
        &[(0.88 * r, y - 0.003), (0.0, y - 0.003)],
        [0.0, 0.0, 0.093],
        forward,
        Material::matt(ivory()),
    );
    let hands = m.part("hands");
    let ink = Material::matt(albedo([0.15, 0.15, 0.18]));
    let time = rng.random::<f64>() * TAU;
    for (length, angle) in [(0.56, time), (0.40, time * 7.0 + 1.0)] {
        let tip_at = [length * r * angle.sin(), -y - 0.001, 0.093 + length * r * angle.cos()];
        m.rod(hands, [0.0, -y - 0.001, 0.093], tip_at, 0.004, ink);
    }
    let feet = m.part("feet");
    for side in [-1.0, 1.0] {
        m.rod(feet, [side * 0.045, 0.0, 0.040], [side * 0.058, 0.0, 0.010], 0.010, metal());
    }
    m.scaled(1.1 * vary(rng, 0.08))
}

fn pencil_holder(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let holder = m.part("holder");
    let (r, h) = (0.050, 0.115);
    let material = Material::matt(paint.albedo())
        .with(Pattern::Stripes { other: paint.albedo() * 0.6 + 0.15, across: DVec3::Z * 20.0 });
    m.turn(
        holder,
        &[(0.0, 0.0), (r, 0.0), (r, h), (r - 0.005, h), (r - 0.005, 0.006), (0.0, 0.006)],
        [0.0; 3],
        material,
    );
    let start = rng.random::<f64>() * TAU;
    for k in 0..4 {
        let pencil = m.part("pencil");
        let a = start + TAU * f64::from(k) / 4.0;
        let color = PAINTS[[RED, YELLOW, BLUE, GREEN][k as usize]].albedo();
        let low = [-0.020 * a.cos(), -0.020 * a.sin(), 0.018];
        let high = [0.046 * a.cos(), 0.046 * a.sin(), 0.195 + 0.008 * f64::from(k)];
        m.rod(pencil, low, high, 0.0085, Material::glazed(color));
    }
    m.scaled(vary(rng, 0.08))
}

fn chair(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let timber = wood(vary(rng, 0.15));
    let cloth = Material::matt(paint.albedo());
    let (w, seat_at) = (0.42, 0.42);
    let legs = m.part("legs");
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        m.block(legs, [0.04, 0.04, seat_at], 0.006, [x * (0.5 * w - 0.03), y * (0.5 * w - 0.03), 0.0], timber);
    }
    let seat = m.part("seat");
    m.block(seat, [w, w, 0.055], 0.02, [0.0, 0.0, seat_at], cloth);
    let back = m.part("back");
    for x in [-1.0, 1.0] {
        m.rod(
            back,
            [x * 0.16, 0.5 * w - 0.03, seat_at + 0.05],
            [x * 0.16, 0.5 * w + 0.01, seat_at + 0.42],
            0.016,
            timber,
        );
    }
    let lean = tip(-6.0);
    m.add_turned(
        back,
        Shape::Block { half: DVec3::new(0.5 * w, 0.018, 0.12), round: 0.016 },
        [0.0, 0.5 * w - 0.002, seat_at + 0.33],
        lean,
        cloth,
    );
    m
}

fn stool(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let timber = wood(vary(rng, 0.15));
    let legs = m.part("legs");
    let h = 0.46 * vary(rng, 0.06);
    for k in 0..4 {
        let a = TAU * (f64::from(k) + 0.5) / 4.0;
        m.rod(legs, [0.18 * a.cos(), 0.18 * a.sin(), 0.016], [0.12 * a.cos(), 0.12 * a.sin(), h], 0.016, timber);
    }
    let seat = m.part("seat");
    m.turn(
        seat,
        &[(0.0, h), (0.17, h), (0.185, h + 0.015), (0.185, h + 0.04), (0.165, h + 0.058), (0.0, h + 0.064)],
        [0.0; 3],
        Material::matt(paint.albedo()),
    );
    m
}

fn cabinet(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let body = m.part("body");
    let (w, d, h) = (0.62 * vary(rng, 0.08), 0.36, 0.66);
    let lacquer = Material::matt(paint.albedo());
    m.block(body, [w, d, h], 0.008, [0.0; 3], lacquer);
    m.block(body, [w + 0.03, d + 0.03, 0.025], 0.006, [0.0, 0.0, h], wood(1.0));
    m.top([0.0, 0.0], [0.5 * w, 0.5 * d], h + 0.0255);
    for k in 0..2 {
        let drawer = m.part("drawer");
        let z = 0.05 + 0.31 * f64::from(k);
        let front = Material { albedo: lacquer.albedo * 0.86 + 0.05, ..lacquer };
        m.block(drawer, [w - 0.06, 0.02, 0.28], 0.005, [0.0, -0.5 * d - 0.004, z], front);
        m.rod(drawer, [-0.05, -0.5 * d - 0.028, z + 0.16], [0.05, -0.5 * d - 0.028, z + 0.16], 0.011, metal());
    }
    m
}

fn waste_bin(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let bin = m.part("bin");
    let (r, h) = (0.13 * vary(rng, 0.08), 0.30);
    m.turn(
        bin,
        &[(0.0, 0.0), (0.82 * r, 0.0), (r, h), (r - 0.008, h), (0.8 * r, 0.012), (0.0, 0.012)],
        [0.0; 3],
        Material::matt(paint.albedo()),
    );
    let paper = m.part("paper");
    let white = Material::matt(ivory()).with(Pattern::Clouds { size: 0.02, amount: 0.2 });
    m.add(paper, Shape::sphere(0.060), [0.030, 0.015, 0.235], white);
    m.add(paper, Shape::sphere(0.052), [-0.045, -0.03, 0.225], white);
    m
}

fn armchair(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let cloth = Material::matt(paint.albedo()).with(Pattern::Clouds { size: 0.1, amount: 0.12 });
    let k = vary(rng, 0.05);
    let seat = m.part("seat");
    m.block(seat, [0.52, 0.56, 0.30], 0.04, [0.0, -0.02, 0.06], Material { albedo: cloth.albedo * 1.1, ..cloth });
    let back = m.part("back");
    m.block(back, [0.72, 0.15, 0.72], 0.06, [0.0, 0.30, 0.06], cloth);
    for side in [-1.0, 1.0] {
        let arm = m.part("arm");
        m.block(arm, [0.12, 0.56, 0.48], 0.05, [side * 0.32, -0.02, 0.06], cloth);
    }
    let legs = m.part("legs");
    for (x, y) in [(-1.0, -0.24), (1.0, -0.24), (-1.0, 0.30), (1.0, 0.30)] {
        m.block(legs, [0.05, 0.05, 0.10], 0.008, [x * 0.31, y, 0.0], wood(0.7));
    }
    m.scaled(k)
}

fn painting(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, h, bar) = (0.62, 0.46, 0.045);
    let frame = m.part("frame");
    let lacquer = Material::glazed(paint.albedo());
    for side in [-1.0, 1.0] {
        m.add(
            frame,
            Shape::Block { half: DVec3::new(0.5 * w, 0.018, 0.5 * bar), round: 0.006 },
            [0.0, -0.018, side * (0.5 * h - 0.5 * bar)],
            lacquer,
        );
        m.add(
            frame,
            Shape::Block { half: DVec3::new(0.5 * bar, 0.018, 0.5 * h), round: 0.006 },
            [side * (0.5 * w - 0.5 * bar), -0.018, 0.0],
            lacquer,
        );
    }
    let canvas = m.part("canvas");
    let ground = Material::matt(ivory()).with(Pattern::Painting { picture: rng.random_range(0..1000) });
    m.add(
        canvas,
        Shape::Block { half: DVec3::new(0.5 * w - 0.02, 0.006, 0.5 * h - 0.02), round: 0.0 },
        [0.0, -0.008, 0.0],
        ground,
    );
    m
}

/// A table of the given top: background, but with parts.
pub fn table(size: [f64; 2], height: f64, tone: f64) -> Model {
    let mut m = Model::default();
    let top = m.part("top");
    m.block(top, [size[0], size[1], 0.035], 0.006, [0.0, 0.0, height - 0.035], wood(tone));
    let legs = m.part("legs");
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let at = [x * (0.5 * size[0] - 0.06), y * (0.5 * size[1] - 0.06), 0.0];
        m.block(legs, [0.06, 0.06, height - 0.035], 0.006, at, wood(0.8 * tone));
    }
    m
}

/// The floor of a room with the given half extents.
pub fn floor(half: [f64; 2]) -> Model {
    let mut m = Model::default();
    let part = m.part("floor");
    let boards = Material::matt(albedo([0.60, 0.52, 0.45])).with(Pattern::Wood { board: 0.24 });
    m.add(
        part,
        Shape::Block { half: DVec3::new(half[0] + 0.1, half[1] + 0.1, 0.05), round: 0.0 },
        [0.0, 0.0, -0.05],
        boards,
    );
    m
}

/// A wall of the given length and height with its front at y = 0, facing -y, and a skirting board.
pub fn wall(length: f64, height: f64, color: DVec3) -> Model {
    let mut m = Model::default();
    let part = m.part("wall");
    let plaster = Material::matt(color).with(Pattern::Clouds { size: 0.7, amount: 0.10 });
    m.add(
        part,
        Shape::Block { half: DVec3::new(0.5 * length, 0.05, 0.5 * height), round: 0.0 },
        [0.0, 0.05, 0.5 * height],
        plaster,
    );
    let board = m.part("skirting board");
    m.block(board, [length, 0.02, 0.10], 0.0, [0.0, -0.01, 0.0], Material::matt(albedo([0.86, 0.84, 0.80])));
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::things::furniture::{ALONG_WALLS, ON_WALLS, SHELF, SINK, STOVE, WALL_CABINET};
    use rand::SeedableRng;

    fn all() -> impl Iterator<Item = &'static Class> {
        let hung = ON_WALLS.iter().map(|c| &c.0).chain([&SHELF.0, &WALL_CABINET.0, &SINK, &STOVE]);
        CLASSES.iter().chain(crate::things::props::PROPS).chain(ALONG_WALLS).chain(hung)
    }

    #[test]
    fn every_class_builds_in_every_colour_with_parts_that_own_pieces() {
        for class in all() {
            for &paint in class.paints {
                for seed in 0..5 {
                    let m = (class.build)(&PAINTS[paint], &mut ChaCha8Rng::seed_from_u64(seed));
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
            let m = (class.build)(&PAINTS[class.paints[0]], &mut ChaCha8Rng::seed_from_u64(1));
            let mut low = f64::INFINITY;
            for piece in &m.pieces {
                for face in 0..piece.shape.faces() {
                    for k in 0..400 {
                        let at = crate::things::shape::ChartPoint {
                            face,
                            u: f64::from(k % 20) / 19.0,
                            v: f64::from(k / 20) / 19.0,
                        };
                        low = low.min((piece.rotation * piece.shape.surface(at).0 + piece.offset).z);
                    }
                }
            }
            assert!((-1e-3..0.003).contains(&low), "{}: lowest point {low}", class.name);
        }
    }
}
