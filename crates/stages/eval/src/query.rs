//! `eval query`: what texts, pictures and places mean.
//!
//! The library `query` has the features of texts and compares them with the instances; `ask` selects, `granularity` makes an
//! answer coarser or finer, `place` answers for pixels and points, `image` for pictures, `segment` divides the cloud;
//! `show` writes the answers, `interactive` answers texts one by one.

pub mod ask;
mod granularity;
mod image;
mod interactive;
mod place;
pub mod segment;
pub(crate) mod show;

use self::ask::{Asked, Asker};
use crate::memory::{self, SMALLER, Sizes};
use crate::options::QueryOptions;
use crate::scene::{find_view, load};
use gs_io::Result;
use gs_scene::dataset::LoadOptions;
use query::{LabelledScene, TextSource};
use serde_json::{Value, json};
use stage::Stage;

pub(crate) fn run(o: &QueryOptions, parameters: Value, stage: &Stage, json_lines: bool) -> Result<String> {
    let load_options = LoadOptions { resolution: o.views.resolution, ..LoadOptions::default() };
    let mut dataset = load(&o.inputs.scene, &load_options, stage)?;
    let out = o.out.as_deref();
    let claim = out.map(|out| {
        let outputs = stage.outputs(out.join("query.json")).folder(out);
        let tables = o.texts.text_features.iter().chain(&o.choice.features);
        outputs.reads(o.inputs.files(&dataset)).reads(tables.chain(&o.image)).claim()
    });
    let mut claim = claim.transpose()?;
    stage.forecast(memory::of_query(&Sizes::new(&o.inputs.geometry, &o.texts, &dataset.views)), SMALLER)?;
    let scene = o.inputs.read(&mut dataset, stage)?;
    let source = source(o, &scene)?;
    for view in &o.views.views {
        find_view(&dataset, view)?;
    }
    let mut asker = Asker::new(&scene, source, &o.choice, o.texts.min_support, o.granularity)?;
    if scene.all_noise() {
        stage.warn("all Gaussians are noise: every query selects nothing");
    }
    if !o.text.is_empty() || o.interactive {
        asker.judge()?;
    }
    let (summary, printed) = match out {
        Some(out) if !o.interactive => {
            let known = |s: &TextSource| s.known(&asker.templates, &o.text, "--text");
            let features = asker.source.as_ref().map_or(Ok(Vec::new()), known)?;
            let mut asked = answers(o, &features, &scene, &asker, stage)?;
            asked.extend(place::answers(o, &scene, &dataset, &asker)?);
            asked.iter_mut().for_each(|one| one.name(&scene.remarks.names));
            let divided = o.segment.then(|| segment::write(o, &features, &scene, &dataset, &asker, out));
            let segmentation = divided.transpose()?;
            let results = show::write(o, &scene, &dataset, &asker, asked, segmentation, out)?;
            results.warnings().for_each(|w| stage.warn(&w));
            let nothing = results.queries.iter().filter(|q| q.gaussians == 0).count();
            let summary =
                json!({"queries": results.queries.len(), "instances": results.instances, "selected_nothing": nothing});
            (summary, show::table(&results))
        }
        _ => {
            interactive::run(o, &scene, &dataset, &asker, stage, json_lines)?;
            (json!({}), String::new())
        }
    };
    if let Some(claim) = &mut claim {
        stage.record(claim, parameters, scene.inputs.clone(), summary)?;
    }
    Ok(printed)
}

/// The source of text features; none where only pictures or places are asked for, and it does not fit the instances.
fn source(o: &QueryOptions, scene: &LabelledScene) -> Result<Option<TextSource>> {
    if !o.text.is_empty() || !o.image.is_empty() || o.interactive {
        return TextSource::open_for(&scene.artifact, scene.instances.dim(), &o.texts).map(Some);
    }
    if !o.texts.given() {
        return Ok(None);
    }
    Ok(Some(TextSource::open(&o.texts)?).filter(|s| s.dim() == scene.instances.dim()))
}

/// The answers to texts, of these features, and to pictures.
fn answers(
    o: &QueryOptions,
    features: &[Vec<f32>],
    scene: &LabelledScene,
    asker: &Asker<'_>,
    stage: &Stage,
) -> Result<Vec<Asked>> {
    let texts = o.text.iter().zip(features);
    let mut asked: Vec<Asked> = texts.map(|(t, f)| Asked::new(t.clone(), "text", None, asker.answer_text(f))).collect();
    if let Some(clip) = o.texts.clip.as_deref().filter(|_| !o.image.is_empty()) {
        for (path, feature) in o.image.iter().zip(image::features(&o.image, clip, &o.texts.engine, scene)?) {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            asked.push(Asked::new(name, "image", None, asker.answer(&feature)));
        }
    }
    let warn = |why: &str| stage.warn(why);
    Ok(asked.into_iter().flat_map(|one| granularity::apply(o.granularity, &scene.instances, one, &warn)).collect())
}
