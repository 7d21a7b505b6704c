//! `gs-geom views`: from Gaussians alone, a dataset of photographs with poses.
//!
//! * `matter`: which Gaussians count and where they are, on the cubes of `grid`; `up`: which way is up
//! * `places`: where cameras may stand; `sight`: what each would see; `front`: from which side; `choice`: those that see most
//! * `coverage`: what the chosen ones show; `dataset`: the files; `options`

mod choice;
mod coverage;
mod dataset;
mod front;
mod grid;
mod matter;
mod options;
mod places;
mod sight;
#[cfg(test)]
mod testing;
mod up;

pub(crate) use options::Views;

use crate::memory;
use crate::options::{Background, bytes, note_shift};
use artifacts::role;
use choice::{Choice, ENOUGH};
use coverage::Coverage;
use dataset::{MODEL, Sheet, name};
use front::Front;
use glam::DVec3;
use gs_io::{Error, Result, Watched, hash_file, write_json};
use gs_raster::{RasterOptions, render};
use gs_scene::{Camera, Gaussians, Image};
use matter::{Inside, Matter};
use options::Look;
use places::{Lens, Places};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde_json::{Value, json};
use sight::{Bits, Candidate, Eye, members};
use stage::Stage;
use std::collections::BTreeMap;
use up::{Rule, up_of};

/// Cameras that are tried for what the first ones saw too little of, and how often.
const AIMED: usize = 128;
const ROUNDS: usize = 3;

/// How a scene is looked at.
struct Plan {
    cameras: Vec<Camera>,
    look: Look,
    inside: Inside,
    up: DVec3,
    rule: Rule,
    ground: bool,
    tried: usize,
    front: Front,
    /// What some camera that was tried sees.
    reachable: Bits,
}

impl Views {
    pub(crate) fn run(&self, stage: &Stage) -> Result<()> {
        let geometry = &self.geometry.geometry;
        let images = self.out.join("images");
        let outputs = stage.outputs(&self.out).files_in(&images, (0..self.views).map(name));
        let outputs = outputs.files_in(self.out.join("sparse/0"), MODEL);
        let outputs = outputs.files_in(&self.out, ["transforms.json", "contact.png", "views.json"]);
        let mut claim = outputs.reads([geometry]).drop_stale().claim()?;
        let pixels = u64::from(self.size.0) * u64::from(self.size.1);
        stage
            .forecast(memory::of_views(bytes(geometry)?, pixels, self.views), "give a smaller --geometry or --size")?;
        let watched = Watched::new([geometry]);
        let (g, options) = self.geometry.read(Background::Black, stage)?;
        let hash = hash_file(geometry)?;
        watched.check()?;
        let none =
            || Error::new("nothing to look at: every Gaussian is fainter than 0.1").file(geometry).found(g.len());
        let matter = Matter::of(&g).ok_or_else(none)?;
        let at = |&i: &u32| DVec3::from(g.means[i as usize].map(f64::from));
        let centres: Vec<DVec3> = matter.counted.iter().map(at).collect();
        let eye = Eye::new(&g, &options, &matter, &centres);
        stage.info(&format!(
            "{} of {} Gaussians count: {} are too faint, {} far away, {} floaters",
            matter.counted.len(),
            g.len(),
            matter.faint,
            matter.far,
            matter.floaters
        ));
        let plan = self.plan(&g, &eye, stage)?;
        let (coverage, cameras) = self.shoot(&plan, &eye, stage)?;
        dataset::write_cameras(&self.out, &plan.cameras, &g, &matter.counted)?;
        let summary = json!({
            "views": plan.cameras.len(), "look": plan.look, "seen": coverage.seen, "seen_by_8": coverage.seen_by_8, "reachable_by_8": coverage.reachable_by_8,
        });
        let mut made = json!({
                "geometry": hash, "parameters": self, "seed": stage.seed(),
                "look": plan.look, "inside": plan.inside, "up": plan.up.to_array(), "up_from": plan.rule,
                "ground": plan.ground, "candidates": plan.tried,
                "gaussians": {"all": g.len(), "faint": matter.faint, "far": matter.far, "floaters": matter.floaters},
                "box": {"low": matter.low.to_array(), "high": matter.high.to_array()},
                "coverage": coverage, "views": cameras,
        });
        note_shift(&mut made, g.shift);
        write_json(self.out.join("views.json"), &made)?;
        stage.info(&format!(
            "{} views in {}: {:.1} % of what counts is in at least one, {:.1} % in {ENOUGH} or more ({:.1} % of what can be seen)",
            plan.cameras.len(),
            self.out.display(),
            100.0 * coverage.seen, 100.0 * coverage.seen_by_8, 100.0 * coverage.reachable_by_8
        ));
        let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash)]);
        stage.record(&mut claim, json!(self), inputs, summary)
    }

    /// Chooses the cameras.
    fn plan(&self, g: &Gaussians, eye: &Eye<'_>, stage: &Stage) -> Result<Plan> {
        let (matter, rng) = (eye.matter, &mut ChaCha8Rng::seed_from_u64(stage.seed()));
        let inside = matter.inside(rng);
        let look = match self.look {
            Look::Auto if inside.is_room() => Look::InsideOut,
            Look::Auto => Look::OutsideIn,
            given => given,
        };
        let (up, rule) =
            self.up.map_or_else(|| up_of(g, matter, look == Look::InsideOut), |up| (up.0.into(), Rule::Given));
        let lens = Lens { size: (self.size.0, self.size.1), fov: self.fov.to_radians() };
        let nowhere = || {
            let e = Error::new("no place for a camera inside the scene").file(&self.geometry.geometry);
            e.hint("give --look outside-in")
        };
        let (mut places, look) = match Places::new(matter, eye.centres, up, look, lens, rng) {
            Some(places) => (places, look),
            None if self.look == Look::Auto => {
                let outside = Look::OutsideIn;
                (Places::new(matter, eye.centres, up, outside, lens, rng).ok_or_else(nowhere)?, outside)
            }
            None => return Err(nowhere()),
        };
        let [x, y, z] = up.to_array();
        let on = if places.ground { ", on the ground" } else { "" };
        let (shut, within) = (100.0 * inside.shut_off, 100.0 * inside.enclosure);
        stage.info(&format!(
            "looking {}: {shut:.0} % of the free space is shut off, {within:.0} % of the directions from the rest end in matter",
            look.name()
        ));
        stage.info(&format!("up {x:.3},{y:.3},{z:.3}, {}{on}", rule.name()));
        let mut choice = Choice::new(eye.centres.len(), matter.diagonal());
        let mut pool: Vec<Candidate> = Vec::new();
        let (mut tried, mut front) = (0, None);
        let mut reachable = vec![0u64; eye.centres.len().div_ceil(64)];
        let mut progress = stage.progress("candidates", (ROUNDS + 1) as u64);
        for round in 0..=ROUNDS {
            stage.go_on()?;
            let cameras = if round == 0 {
                places.all_over(rng)
            } else {
                let lacking = |i: &usize| choice.sightings[*i] < ENOUGH;
                let target = |i| (eye.centres[i], eye.widest[i]);
                let lacking: Vec<(DVec3, f64)> = (0..eye.centres.len()).filter(lacking).map(target).collect();
                places.aimed(&lacking, AIMED, rng)
            };
            tried += cameras.len();
            let good: Vec<Option<Candidate>> = cameras.into_par_iter().map(|c| eye.look(c)).collect();
            let good: Vec<Candidate> = good.into_iter().flatten().collect();
            let front = front.get_or_insert_with(|| Front::of(&good, eye.centres));
            let in_front = |mut c: Candidate| front.keep(&mut c.sight, c.camera.position(), eye.centres).then_some(c);
            let good: Vec<Candidate> = good.into_par_iter().filter_map(in_front).collect();
            for candidate in &good {
                reachable.iter_mut().zip(&candidate.sight.seen).for_each(|(all, one)| *all |= one);
            }
            pool.extend(good);
            // Half of the views are chosen before anything is aimed at.
            choice.take(&mut pool, (self.views * (round + ROUNDS)).div_ceil(2 * ROUNDS).min(self.views));
            progress.step();
        }
        progress.finish(&[]);
        if choice.cameras.is_empty() {
            let e = Error::new("no camera sees the scene").file(&self.geometry.geometry);
            return Err(e.found(format!("{tried} cameras tried")).hint("give --look, or another --fov"));
        }
        let (cameras, front) = (choice.cameras, front.expect("made in the first round"));
        Ok(Plan { cameras, look, inside, up, rule, ground: places.ground, tried, front, reachable })
    }

    /// Renders the views; what they cover, and each of them in words.
    fn shoot(&self, plan: &Plan, eye: &Eye<'_>, stage: &Stage) -> Result<(Coverage, Vec<Value>)> {
        let mut sightings = vec![0u8; eye.centres.len()];
        let (mut sheet, mut told) = (Sheet::new(self.size), Vec::new());
        let mut progress = stage.progress("view", plan.cameras.len() as u64);
        for (i, camera) in plan.cameras.iter().enumerate() {
            stage.go_on()?;
            let r = render(eye.gaussians, camera, &RasterOptions { depth: true, ..eye.options.clone() });
            let mut sight = eye.sight(camera, &r);
            plan.front.keep(&mut sight, camera.position(), eye.centres);
            members(&sight.seen).for_each(|k| sightings[k] = sightings[k].saturating_add(1));
            let shown = r.alpha.iter().filter(|&&a| a >= 0.5).count() as f64 / r.alpha.len() as f64;
            let image = Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None };
            image.write_png(self.out.join("images").join(name(i)))?;
            sheet.add(&image);
            told.push(json!({
                "name": name(i), "position": camera.position().to_array(), "forward": camera.rotation.row(2).to_array(),
                "gaussians": members(&sight.seen).count(), "shown": shown,
            }));
            progress.step();
        }
        progress.finish(&[]);
        sheet.write(&self.out.join("contact.png"))?;
        Ok((Coverage::of(&sightings, &plan.reachable, eye.centres), told))
    }
}
