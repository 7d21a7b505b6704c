//! What the commands do. [`train`] is the stage's own story; what it needs at each step is in a file beside this one.

mod finish;
pub(crate) mod forecast;
pub(crate) mod init;
mod iterate;
pub(crate) mod outputs;

use crate::budget;
use crate::densification::Way;
use crate::options::{Args, Background, Command, PictureSizes, Preset, Train};
use crate::photographs::masks::{Alpha, Masks};
use crate::photographs::{Photographs, full_share};
use crate::training::poses::PoseRates;
use crate::training::schedule::LearningRates;
use crate::training::{Recipe, Trainer, checkpoint};
use artifacts::role;
use forecast::{cache_bytes, forecast_start, most_gaussians};
use gs_io::{Claim, Error, Provenance, Result, hash_bytes, hash_file};
use gs_scene::dataset::{Dataset, HOLDOUT, Split, View};
use gs_scene::{Camera, HoldOut, Learnt, splat};
use gs_sfm::Refine;
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;

impl Program for Args {
    const NAME: &'static str = "gs-geom";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        let Command::Train(train) = &self.command else { return Ok(()) };
        match splat::Format::of_name(&train.out) {
            None | Some(splat::Format::Ply) => Ok(()),
            Some(_) => Err(Error::new("a training writes PLY")
                .field("--out")
                .found(train.out.display())
                .expected("a name that ends in .ply")
                .hint("make other formats of it with gs-geom convert")),
        }
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match self.command {
            Command::Train(mut options) => {
                options.scene.held.holdout.get_or_insert(HOLDOUT);
                train(&options, stage)
            }
            Command::Render(options) => options.run(stage),
            Command::Eval(options) => options.run(stage),
            Command::Views(options) => options.run(stage),
            Command::Inspect(options) => options.run(self.common.json, stage),
            Command::Convert(options) => options.run(stage),
        }
    }
}

/// `gs-geom train`, with a plan where there is a budget of time.
fn train(options: &Train, stage: &Stage) -> Result<()> {
    // From here on a signal ends the run with a checkpoint.
    stage.interrupted();
    let dataset = options.scene.load(stage)?;
    let masks = options.masks.load(&dataset, stage)?;
    let mut claim = outputs::claim(options, &dataset, &masks, stage)?;
    match options.time_budget {
        Some(seconds) => {
            let (planned, plan) = budget::plan_for(options, seconds, &dataset, &masks, stage)?;
            let dataset = planned.scene.load_quietly()?;
            let masks = masks.with_borders(&dataset, stage)?;
            learn(&planned, plan, &dataset, masks, &mut claim, stage)
        }
        None => learn(options, Value::Null, &dataset, masks, &mut claim, stage),
    }
}

/// The run itself; `plan` is how its options came about, for the record.
fn learn(
    options: &Train,
    plan: Value,
    dataset: &Dataset,
    masks: Masks,
    claim: &mut Claim,
    stage: &Stage,
) -> Result<()> {
    let (train, heldout) = init::split(options, dataset)?;
    let recipe = options.recipe(most_gaussians(options, dataset), stage.seed(), masks.alpha());
    let watched = outputs::watched(options, dataset, &masks);
    let forecast = forecast_start(options, dataset, &masks, &recipe.growth, stage)?;
    let photographs = Photographs::load(train.clone(), masks.clone(), cache_bytes(options), &watched)?;
    let run = provenance(options, &recipe, dataset, &masks, stage)?;

    let cameras: Vec<&Camera> = train.iter().map(|v| &v.camera).collect();
    let extent = crate::start::extent(&cameras, &dataset.points.positions);
    let mut state = match iterate::saved(options, &run, stage) {
        Some(state) => state,
        None => {
            let exposures = if options.exposure { train.len() } else { 0 };
            let (gaussians, poses) = init::start(options, dataset, &cameras, extent, stage)?;
            checkpoint::start(gaussians, exposures, poses)
        }
    };
    state.gaussians.shift = dataset.shift;
    outputs::check_finite(options, &state)?;
    let (width, height, n) = (cameras[0].width, cameras[0].height, state.gaussians.len());
    let counts = format!("{} training views and {} held out", train.len(), heldout.len());
    stage.info(&format!("{counts}, {width}x{height} pixels; {n} Gaussians; extent {extent:.3}"));
    if let Some(sizes) = recipe.schedule.sizes() {
        stage.info(&format!("picture sizes: {sizes}"));
    }
    let forecast = forecast::forecast(options, forecast, dataset, &state.gaussians, stage)?;
    // The training views' smaller pictures are not there yet.
    let left = full_share(cache_bytes(options)).saturating_sub(photographs.kept_bytes());
    let heldout = Photographs::load(heldout, masks, left, &watched)?;
    let mut trainer = Trainer::new(recipe, extent, photographs, heldout, state);
    let before = stage::cpu_seconds();
    let done = iterate::iterate(options, &mut trainer, &run, &watched, stage).and_then(|()| {
        watched.check()?;
        let cpu_seconds = stage::cpu_seconds().zip(before).map(|(now, before)| now - before);
        finish::finish(options, dataset, &mut trainer, &run, &forecast, plan, cpu_seconds, claim, stage)
    });
    done.inspect_err(|_| iterate::rescue(options, &trainer, &run, stage))
}

/// Largest Gaussians with `--preset 3dgs`, as a share of the scene's extent.
const STOCK_MAX_SCALE: f32 = 0.1;

impl Train {
    /// The hyper-parameters that the options amount to.
    pub(crate) fn recipe(&self, max_gaussians: usize, seed: u64, alpha: Alpha) -> Recipe {
        let stock = self.preset == Some(Preset::Stock);
        let mut recipe = Recipe::new(self.densify, self.iterations);
        if self.schedule == PictureSizes::Coarse {
            recipe.schedule = recipe.schedule.coarse_to_fine();
        }
        if stock && let Some(Way::Adaptive(way)) = &mut recipe.densification {
            way.max_scale = Some(STOCK_MAX_SCALE);
            way.split_reach = None;
        }
        if stock {
            recipe.rates = self.densify.rates(LearningRates::default());
        }
        recipe.growth.every = self.densify_every.unwrap_or(recipe.growth.every);
        recipe.growth.max_gaussians = max_gaussians;
        Recipe {
            seed,
            background: self.scene.background.color(),
            random_background: self.scene.background == Background::Random,
            alpha,
            antialias: self.antialias,
            exposure: self.exposure,
            poses: (self.refine_poses != Refine::Off).then(PoseRates::default),
            ..recipe
        }
    }
}

/// What the result is made from: all options, what they amount to, and the hashes of the inputs.
fn provenance(options: &Train, recipe: &Recipe, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<Provenance> {
    let mut parameters = json!(options);
    if let (Value::Object(all), Value::Object(resolved)) = (&mut parameters, json!(recipe)) {
        all.extend(resolved);
    }
    parameters[Learnt::VIEWS] = json!(learnt_views(options, dataset, stage)?);
    let mut inputs = BTreeMap::from([(role::DATASET.to_string(), dataset.hash()?)]);
    if let Some(init) = options.init.file() {
        inputs.insert("init".into(), hash_file(init)?);
    }
    if init::has_depths(options, dataset) {
        let own = dataset.views_of(Split::Train).filter_map(View::depth_path);
        let hashes = own.map(hash_file).collect::<Result<Vec<String>>>()?;
        inputs.insert("depths".into(), hash_bytes(hashes.concat().as_bytes()));
    }
    if let Some(hash) = masks.hash()? {
        inputs.insert("photograph_masks".into(), hash);
    }
    Ok(stage.provenance(checkpoint::FORMAT, checkpoint::VERSION, parameters, inputs))
}

/// Which views the Gaussians are learnt from, for later stages; `None` where those of `--init` may have been learnt from more.
fn learnt_views(options: &Train, dataset: &Dataset, stage: &Stage) -> Result<Option<String>> {
    let every = options.scene.held.holdout.unwrap_or(HOLDOUT);
    if let Some(init) = options.init.file().filter(|_| dataset.held_out(every).any(|held| held))
        && splat::holds_gaussians(init)?
        && HoldOut::of(init, Some(every))?.seen(dataset).is_none_or(|seen| seen > 0)
    {
        stage.warn(
            "the Gaussians of --init may have been learnt from views held out here: no stage will call these unseen",
        );
        return Ok(None);
    }
    Ok(Some(Learnt::hash(dataset, every)))
}
