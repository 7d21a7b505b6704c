//! The loop: every way to densify, stopped and resumed, on any number of threads.

use super::*;
use crate::densification::adaptive::Adaptive;
use crate::photographs::masks::Masks;
use crate::start;
use crate::world::scene;
use gs_io::{Provenance, Watched};
use gs_scene::dataset::{self, LoadOptions, Split};
use poses::Poses;

/// A run in parts: after each of `stops` it goes on from a checkpoint file. Its state, with the PSNR on the held-out views.
fn trained(recipe: &Recipe, cache: usize, stops: &[u32]) -> (State, f64) {
    let dataset = dataset::load(scene().as_ref(), &LoadOptions::default()).unwrap();
    let watched = Watched::default();
    let photographs = |split: Split| {
        let views = dataset.views_of(split).collect();
        Photographs::load(views, Masks::default(), cache, &watched).unwrap()
    };
    let cameras: Vec<&Camera> = dataset.views_of(Split::Train).map(|v| &v.camera).collect();
    let extent = start::extent(&cameras, &dataset.points.positions);
    let first = start::from_points(&dataset.points, 2, extent).unwrap();
    let all: Vec<Camera> =
        [Split::Train, Split::Test].iter().flat_map(|s| dataset.views_of(*s).map(|v| v.camera.clone())).collect();
    let poses = recipe.poses.map(|_| Poses::new(&all, &all, &lenses(&all))).unwrap_or_default();
    let mut state = checkpoint::start(first, if recipe.exposure { cameras.len() } else { 0 }, poses);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("checkpoint");
    let (format, version) = (checkpoint::FORMAT.into(), checkpoint::VERSION);
    let provenance = Provenance { format, version, parameters: json!(recipe), ..Provenance::default() };
    for &stop in stops.iter().chain([&recipe.schedule.iterations]) {
        let (train, heldout) = (photographs(Split::Train), photographs(Split::Test));
        let mut trainer = Trainer::new(recipe.clone(), extent, train, heldout, state);
        while trainer.state.progress.iteration < stop {
            trainer.step().unwrap();
        }
        if trainer.is_done() {
            return (trainer.state.clone(), trainer.heldout().unwrap().psnr.unwrap());
        }
        checkpoint::write(&path, &trainer.state, provenance.clone()).unwrap();
        state = checkpoint::read(&path, &provenance).unwrap().unwrap();
    }
    unreachable!("a run ends");
}

fn recipe(strategy: Strategy, iterations: u32, max_gaussians: usize) -> Recipe {
    let recipe = Recipe::new(strategy, iterations);
    // The larger steps of short runs are too large for 160 iterations on 190 Gaussians.
    let rates = LearningRates::default();
    Recipe { seed: 7, rates, growth: Growth { every: 20, max_gaussians, ..recipe.growth }, ..recipe }
}

#[test]
fn every_way_is_the_same_for_any_threads_and_after_a_stop_and_keeps_to_the_most_gaussians() {
    let [mcmc, coarse, adaptive] = [(Strategy::Mcmc, 190), (Strategy::Adaptive, 300), (Strategy::Adaptive, 190)]
        .map(|(strategy, most)| recipe(strategy, 160, most));
    let ways = [
        Recipe { exposure: true, ..mcmc },
        Recipe { schedule: coarse.schedule.clone().coarse_to_fine(), antialias: true, ..coarse },
        Recipe { random_background: true, poses: Some(PoseRates::default()), ..adaptive },
    ];
    let on = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    for recipe in ways {
        let (whole, psnr) = on(1).install(|| trained(&recipe, 1 << 30, &[]));
        // Within a round of views, between densifications; photographs that are kept and photographs decoded anew.
        let (parts, _) = on(3).install(|| trained(&recipe, 0, &[37, 61, 62]));
        assert!(whole == parts, "{recipe:?}");
        let n = whole.gaussians.len();
        assert!(n <= recipe.growth.max_gaussians && whole.progress.densified != [0; 4], "{n}: {recipe:?}");
        assert!(psnr > 17.0, "{psnr}: {recipe:?}");
    }
}

/// What resets of the opacities leave behind must come back, plain surfaces that few large Gaussians cover among it.
#[test]
fn resets_heal_and_large_gaussians_stay_unless_asked() {
    let psnr = |reset_every: u32, max_scale: Option<f32>| {
        let mut recipe = Recipe::new(Strategy::Adaptive, 500);
        recipe.schedule = recipe.schedule.coarse_to_fine();
        recipe.rates = LearningRates::default();
        recipe.densification = Some(Way::Adaptive(Adaptive { reset_every, max_scale, ..Adaptive::default() }));
        recipe.growth = Growth { until: 300, max_gaussians: 10_000, ..recipe.growth };
        trained(&recipe, 1 << 30, &[]).1
    };
    let (never, reset, removed) = (psnr(0, None), psnr(100, None), psnr(100, Some(0.015)));
    assert!(reset > never - 1.5, "{reset} dB with resets, {never} without");
    assert!(removed < reset - 1.0, "{removed} dB without large Gaussians, {reset} with them");
}
