//! The four scenes of LERF-OVS: which frames are scored, and which texts are asked (docs/protocols.md). Synthetic scenes
//! in its layout are named and labelled by it, and scenes are scored by it.

/// A scene of the benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LerfScene {
    /// Name of its folder.
    pub name: &'static str,
    /// Numbers of the labelled frames; `frame_00041.json` is 41.
    pub frames: &'static [u32],
    /// The texts that are asked, verbatim; they are also names in files. A labelled category that is not among them is
    /// never asked for and scores 0.
    pub queries: &'static [&'static str],
    /// (frame, category) pairs behind the published numbers, as their denominators say.
    pub pairs: usize,
}

/// The scenes in the order of the paper's table.
pub const LERF_OVS: [LerfScene; 4] = [
    LerfScene {
        name: "waldo_kitchen",
        frames: &[53, 66, 89, 140, 154],
        queries: &[
            "Stainless steel pots",
            "dark cup",
            "refrigerator",
            "frog cup",
            "pot",
            "spatula",
            "plate",
            "spoon",
            "toaster",
            "ottolenghi",
            "plastic ladle",
            "sink",
            "ketchup",
            "cabinet",
            "red cup",
            "pour-over vessel",
            "knife",
            "yellow desk",
        ],
        pairs: 22,
    },
    LerfScene {
        name: "ramen",
        frames: &[6, 24, 60, 65, 81, 119, 128],
        queries: &[
            "nori",
            "sake cup",
            "kamaboko",
            "corn",
            "spoon",
            "egg",
            "onion segments",
            "plate",
            "napkin",
            "bowl",
            "glass of water",
            "hand",
            "chopsticks",
            "wavy noodles",
        ],
        pairs: 71,
    },
    LerfScene {
        name: "figurines",
        frames: &[41, 105, 152, 195],
        queries: &[
            "jake",
            "pirate hat",
            "pikachu",
            "rubber duck with hat",
            "porcelain hand",
            "red apple",
            "tesla door handle",
            "waldo",
            "bag",
            "toy cat statue",
            "miffy",
            "green apple",
            "pumpkin",
            "rubics cube",
            "old camera",
            "rubber duck with buoy",
            "red toy chair",
            "pink ice cream",
            "spatula",
            "green toy chair",
            "toy elephant",
        ],
        pairs: 56,
    },
    LerfScene {
        name: "teatime",
        frames: &[2, 25, 43, 107, 129, 140],
        queries: &[
            "sheep",
            "yellow pouf",
            "stuffed bear",
            "coffee mug",
            "tea in a glass",
            "apple",
            "coffee",
            "hooves",
            "bear nose",
            "dall-e brand",
            "plate",
            "paper napkin",
            "three cookies",
            "bag of cookies",
        ],
        pairs: 59,
    },
];

impl LerfScene {
    /// The scene of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        LERF_OVS.iter().find(|s| s.name == name)
    }

    /// Whether a labelled frame (the stem of its file) is one that is scored.
    pub fn scores_frame(&self, stem: &str) -> bool {
        stem.strip_prefix("frame_").and_then(|n| n.parse().ok()).is_some_and(|n| self.frames.contains(&n))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn the_tables_have_the_published_sizes() {
        let sizes: Vec<(usize, usize, usize)> =
            LERF_OVS.iter().map(|s| (s.frames.len(), s.queries.len(), s.pairs)).collect();
        assert_eq!(sizes, [(5, 18, 22), (7, 14, 71), (4, 21, 56), (6, 14, 59)]);
        assert_eq!(sizes.iter().map(|s| s.0).sum::<usize>(), 22);
        assert_eq!(sizes.iter().map(|s| s.2).sum::<usize>(), 208);
        for s in LERF_OVS {
            assert_eq!(s.queries.iter().collect::<BTreeSet<_>>().len(), s.queries.len(), "{}", s.name);
        }
        assert!(LerfScene::named("ramen").unwrap().scores_frame("frame_00006"));
        assert!(!LerfScene::named("ramen").unwrap().scores_frame("frame_00007"));
        assert!(!LerfScene::named("ramen").unwrap().scores_frame("00006"));
        assert_eq!(LerfScene::named("Ramen"), None);
    }

    #[test]
    #[ignore = "needs ../shared/data/text/opengaussian_text_features.json; run make test-data"]
    fn every_query_has_a_feature_in_opengaussians_table() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../../../shared/data/text/opengaussian_text_features.json");
        let table: std::collections::BTreeMap<String, serde_json::Value> =
            serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        for query in LERF_OVS.iter().flat_map(|s| s.queries) {
            assert!(table.contains_key(*query), "{query}");
        }
        for (_, name) in crate::NYU40 {
            assert!(table.contains_key(name), "{name}");
        }
    }
}
