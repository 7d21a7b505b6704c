//! ScanNet's label ids, which scans are written with and scored by.

/// The NYU40 ids that are scored, with their names as the texts that are asked, verbatim ("showercurtain" is one word).
pub const NYU40: [(u32, &str); 19] = [
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
