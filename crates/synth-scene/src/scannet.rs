//! Names of ScanNet's benchmark for what the catalogue has.

/// ScanNet's label ids (NYU40) and names that the open-vocabulary benchmark asks for.
const BENCHMARK: [(u32, &str); 19] = [
    (1, "wall"),
    (2, "floor"),
    (3, "cabinet"),
    (4, "bed"),
    (5, "chair"),
    (6, "sofa"),
    (7, "table"),
    (8, "door"),
    (9, "window"),
    (10, "bookshelf"),
    (11, "picture"),
    (12, "counter"),
    (14, "desk"),
    (16, "curtain"),
    (24, "refrigerator"),
    (28, "showercurtain"),
    (33, "toilet"),
    (34, "sink"),
    (36, "bathtub"),
];
/// Classes of the catalogue that the benchmark calls otherwise.
const CALLED: [(&str, &str); 5] = [
    ("armchair", "chair"),
    ("stool", "chair"),
    ("painting", "picture"),
    ("side table", "table"),
    ("wall cabinet", "cabinet"),
];
/// Id of furniture and props that the benchmark does not ask for ("otherprop").
const OTHER: u32 = 40;

/// The names of all classes that the benchmark asks for.
pub fn names() -> impl Iterator<Item = &'static str> {
    BENCHMARK.iter().map(|b| b.1)
}

/// What the benchmark calls a class of the catalogue, if it asks for it.
pub fn benchmark_name(class: &str) -> Option<&'static str> {
    let class = CALLED.iter().find(|c| c.0 == class).map_or(class, |c| c.1);
    names().find(|&n| n == class)
}

/// The label id of a class of the catalogue.
pub fn label(class: &str) -> u32 {
    let name = benchmark_name(class);
    BENCHMARK.iter().find(|b| Some(b.1) == name).map_or(OTHER, |b| b.0)
}
