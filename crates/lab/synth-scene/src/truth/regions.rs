//! The regions that a segmentation model sees, which are not things: what an occluder cuts in two has two masks, and
//! what touches may have one. A model errs the same way in most views: it joins a candle and the glass beside it again
//! and again, and others never. So every pair of things has a tendency of its own for the whole scene.

use crate::render::Frame;
use crate::scene::Scene;
use artifacts::Level;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// How often things that lie apart have masks of their own at the levels `default`, `small`, `medium` and `large`, and how
/// often two that touch share one. The unit is the level at which a fault is the strongest. All of them follow
/// MobileSAM's masks of four ray-traced scenes (docs/granularity.md).
const APART: [f64; 4] = [0.7, 1.0, 0.8, 0.5];
const OBJECTS: [f64; 4] = [0.8, 0.35, 0.9, 1.15];
const BACKGROUNDS: [f64; 4] = [0.95, 0.15, 1.1, 1.2];
const ACROSS: [f64; 4] = [0.25, 0.05, 0.25, 0.3];
const PARTS: [f64; 4] = [1.5, 0.35, 2.0, 2.5];
/// Share of the image that an object covers when it is swallowed as often as that, and how this changes with the share:
/// small masks are swallowed more. Background is swallowed at any size.
const TYPICAL: f64 = 0.01;
const EXPONENT: f64 = -0.4;
/// Share of the views in which a pair does as ever; in the others it is drawn anew.
const AS_EVER: f64 = 0.8;
/// Pairs of pixels along which masks touch at least.
const TOUCH: usize = 6;
/// Share of the image that a piece covers at least to be a mask of its own.
const PIECE: f64 = 0.001;

/// Random numbers of pairs: every pair has a stream of its own, which no other pair and no other view changes.
pub(crate) struct Pairs {
    /// The generator of the scene's seed.
    pub rng: ChaCha8Rng,
    /// Where its streams for pairs begin.
    pub first: u64,
    pub view: u64,
}

impl Pairs {
    /// Two numbers of 0 to 1 for a pair of parts, or one part: one of the scene and one of the view.
    fn draw(&self, a: u32, b: u32) -> (f64, f64) {
        let mut rng = self.rng.clone();
        rng.set_stream(self.first + (u64::from(a) << 24 | u64::from(b)));
        let scene = rng.random();
        // A number takes two words.
        rng.set_word_pos(2 * (1 + u128::from(self.view)));
        (scene, rng.random())
    }
}

/// The masks of a level before they are painted.
pub(crate) struct Regions {
    /// Position in `parts` of the mask that owns each pixel, -1 for none, `[height][width]`.
    pub map: Vec<i32>,
    /// The parts that each mask shows, ascending.
    pub parts: Vec<Vec<u32>>,
}

impl Regions {
    /// All pixels of the parts of each mask; no part is in two of them.
    pub fn new(scene: &Scene, frame: &Frame, parts: Vec<Vec<u32>>) -> Self {
        let mut owner = vec![-1; scene.parts.len()];
        for (i, shown) in parts.iter().enumerate() {
            shown.iter().for_each(|&p| owner[p as usize] = i as i32);
        }
        let map = frame.part.iter().map(|&p| if p < 0 { -1 } else { owner[p as usize] }).collect();
        Self { map, parts }
    }

    /// Pixels of each mask.
    pub fn areas(&self) -> Vec<usize> {
        let mut areas = vec![0; self.parts.len()];
        self.map.iter().filter(|&&i| i >= 0).for_each(|&i| areas[i as usize] += 1);
        areas
    }

    /// Gives pieces of a mask that do not touch its largest one masks of their own, with probability `p` at the level
    /// `small`; in one view all pieces of a mask or none. Small pieces stay.
    pub fn tear(&mut self, frame: &Frame, level: Level, p: f64, pairs: &Pairs) {
        let least = (PIECE * self.map.len() as f64) as usize;
        let mut pieces: Vec<Vec<Vec<usize>>> = vec![Vec::new(); self.parts.len()];
        let mut seen: Vec<bool> = self.map.iter().map(|&i| i < 0).collect();
        for start in 0..self.map.len() {
            if seen[start] {
                continue;
            }
            seen[start] = true;
            let mut piece = vec![start];
            let mut next = 0;
            while let Some(&at) = piece.get(next) {
                next += 1;
                for n in neighbours(at, frame.width, frame.height) {
                    if !seen[n] && self.map[n] == self.map[start] {
                        seen[n] = true;
                        piece.push(n);
                    }
                }
            }
            if piece.len() >= least {
                pieces[self.map[start] as usize].push(piece);
            }
        }
        for (i, mut pieces) in pieces.into_iter().enumerate() {
            let first = self.parts[i][0];
            if pieces.len() < 2 || pairs.draw(first, first).1 >= p * APART[level.index()] {
                continue;
            }
            pieces.sort_by_key(Vec::len);
            pieces.pop();
            for piece in pieces {
                piece.iter().for_each(|&at| self.map[at] = self.parts.len() as i32);
                self.parts.push(Vec::new());
            }
        }
        self.gather(frame);
    }

    /// Gives masks that touch to the larger of the two. `p` is the probability of two objects at level `large` where the
    /// smaller covers a hundredth of the image.
    pub fn swallow(&mut self, scene: &Scene, frame: &Frame, level: Level, p: f64, pairs: &Pairs) {
        let areas = self.areas();
        let thing = |i: usize| &scene.things[scene.parts[self.parts[i][0] as usize].thing as usize];
        // Two things share their longest border alone: of a thing shown in parts, one part is swallowed.
        let mut longest = BTreeMap::<(u32, u32), (usize, usize, usize)>::new();
        for ((a, b), border) in self.borders(frame.width).into_iter().filter(|&(_, border)| border >= TOUCH) {
            let whose = [a, b].map(|i| thing(i).parts.start);
            let key = if whose[0] == whose[1] { [a, b].map(|i| self.parts[i][0]) } else { whose };
            let best = longest.entry((key[0].min(key[1]), key[0].max(key[1]))).or_default();
            *best = (*best).max((border, a, b));
        }
        // A mask goes into one other at most, or crowded scenes would become one mask.
        let mut into: Vec<(usize, usize)> = (0..areas.len()).map(|i| (0, i)).collect();
        for ((x, y), (border, a, b)) in longest {
            let (small, large) = if (areas[a], a) < (areas[b], b) { (a, b) } else { (b, a) };
            let share = areas[small] as f64 / self.map.len() as f64;
            let size = (share / TYPICAL).powf(EXPONENT);
            let often = match (thing(small).background, thing(large).background) {
                _ if thing(small).parts == thing(large).parts => PARTS[level.index()] * size,
                (false, false) => OBJECTS[level.index()] * size,
                (true, true) => BACKGROUNDS[level.index()],
                _ => ACROSS[level.index()],
            };
            let (scene, view) = pairs.draw(x, y);
            let draw = if view < AS_EVER { scene } else { (view - AS_EVER) / (1.0 - AS_EVER) };
            if draw < p * often {
                into[small] = into[small].max((border, large));
            }
        }
        let root = |mut i: usize| {
            while into[i].1 != i {
                i = into[i].1;
            }
            i as i32
        };
        let roots: Vec<i32> = (0..into.len()).map(root).collect();
        self.map.iter_mut().filter(|i| **i >= 0).for_each(|i| *i = roots[*i as usize]);
        self.gather(frame);
    }

    /// Finds again which parts each mask shows, and drops masks without pixels.
    fn gather(&mut self, frame: &Frame) {
        self.parts.iter_mut().for_each(Vec::clear);
        for (&i, &part) in self.map.iter().zip(&frame.part).filter(|(i, _)| **i >= 0) {
            let shown = &mut self.parts[i as usize];
            if let Err(at) = shown.binary_search(&(part as u32)) {
                shown.insert(at, part as u32);
            }
        }
        let mut count = 0;
        let renamed: Vec<i32> = self
            .parts
            .iter()
            .map(|p| {
                count += i32::from(!p.is_empty());
                count - 1
            })
            .collect();
        self.parts.retain(|parts| !parts.is_empty());
        self.map.iter_mut().filter(|i| **i >= 0).for_each(|i| *i = renamed[*i as usize]);
    }

    /// How many pairs of neighbouring pixels each two masks have, by their positions.
    fn borders(&self, width: usize) -> BTreeMap<(usize, usize), usize> {
        let mut out = BTreeMap::new();
        for (at, &a) in self.map.iter().enumerate() {
            let right = (at % width + 1 < width).then(|| self.map[at + 1]);
            for b in right.into_iter().chain(self.map.get(at + width).copied()) {
                if a != b && a >= 0 && b >= 0 {
                    *out.entry((a.min(b) as usize, a.max(b) as usize)).or_default() += 1;
                }
            }
        }
        out
    }
}

/// The pixels left of, right of, above and below a pixel.
pub(crate) fn neighbours(at: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (at % width, at / width);
    [
        (x > 0).then(|| at - 1),
        (x + 1 < width).then(|| at + 1),
        (y > 0).then(|| at - width),
        (y + 1 < height).then(|| at + width),
    ]
    .into_iter()
    .flatten()
}
