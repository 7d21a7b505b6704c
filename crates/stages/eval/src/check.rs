//! `eval check`: whether labels, texts and masks of a benchmark's scene can be read and fit together, before hours of work
//! rest on them.

use crate::options::{Benchmark, CheckOptions};
use crate::protocols::instances;
use crate::protocols::scannet::ScanFiles;
use crate::scene::folder_name;
use crate::score::labels;
use artifacts::{LerfScene, MaskFeatures, MaskFolder};
use gs_io::{Error, Result};
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution};
use query::{TextSource, TextTable};
use stage::Stage;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Warnings of a dataset that are said; a scan can have lost hundreds of poses.
const WARNINGS: usize = 3;

/// Reads the parts of a scene, each of which is said to be good; each that is not is an error of its own; the first of them ends the run.
pub(crate) fn run(o: &CheckOptions, stage: &Stage) -> Result<String> {
    let dataset = dataset::load(&o.scene, &LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 })?;
    dataset.warnings.iter().take(WARNINGS).for_each(|w| stage.warn(w));
    let (labels, asked) = match o.benchmark {
        Benchmark::LerfOvs => check_labels(o, &dataset, stage),
        Benchmark::Scannet => check_scan(&o.scene),
    }
    .map_or_else(|e| (Err(e), None), |(said, asked)| (Ok(said), Some(asked)));
    let texts = o.text_features.as_deref().map(|path| Ok(TextSource::Table(TextTable::read(path)?))).transpose();
    let dim = texts.as_ref().ok().and_then(|t| t.as_ref().map(TextSource::dim));
    let texts = texts.and_then(|t| t.map_or(Ok(String::new()), |t| check_texts(o, &t, asked.as_ref())));
    let masks = o.masks.as_deref().map_or(Ok(String::new()), |folder| check_masks(folder, &dataset, dim));
    let mut said = format!("{} views with poses\n", dataset.views.len());
    let mut faults = Vec::new();
    for part in [labels, texts, masks] {
        match part {
            Ok(line) => said += &line,
            Err(e) => faults.push(e),
        }
    }
    faults.iter().skip(1).for_each(|e| stage.error(e));
    faults.into_iter().next().map_or(Ok(said), Err)
}

/// Reads the labels of the frames that are scored; gives the texts that will be asked for them.
fn check_labels(o: &CheckOptions, dataset: &Dataset, stage: &Stage) -> Result<(String, BTreeSet<String>)> {
    let none =
        || Error::new("the scene has no labels").file(o.scene.join("label")).expected("a folder of <frame>.json");
    let folder = labels::folder(o.labels.labels.as_deref(), &o.scene)?.ok_or_else(none)?;
    let benchmark = LerfScene::named(&folder_name(&o.scene));
    let (mut frames, mut pairs, mut asked) = (0, 0, BTreeSet::new());
    for path in labels::list(&folder)?.into_iter().filter(|p| p.extension().is_some_and(|e| e == "json")) {
        let mut labels = labels::read(&path)?;
        labels::straighten(std::slice::from_mut(&mut labels), &dataset.views);
        if benchmark.is_some_and(|b| !b.scores_frame(&labels.frame)) {
            continue;
        }
        match dataset.views.iter().find(|v| v.stem() == labels.frame) {
            // Refuses labels of another shape than the photograph.
            Some(view) => _ = labels.camera(view)?,
            None => stage.warn(&format!("{}: no photograph of this name: its labels score 0", path.display())),
        }
        if labels.categories.is_empty() {
            stage.warn(&format!("{}: no object is labelled", path.display()));
        }
        for (category, mask) in labels.categories {
            if category.trim().is_empty() {
                let e = Error::new("a category without a name")
                    .file(&path)
                    .field("category")
                    .found(format!("{category:?}"));
                return Err(e
                    .expected("the text that is asked")
                    .hint("name the object in the label file, or delete it"));
            }
            if mask.count() == 0 {
                stage.warn(&format!("{}: {category}: its polygons hold no pixel: it scores 0", path.display()));
            }
            pairs += 1;
            asked.insert(category);
        }
        frames += 1;
    }
    // What the benchmark does not ask scores 0 whatever the texts are.
    asked.retain(|c| benchmark.is_none_or(|b| b.queries.contains(&c.as_str())));
    if asked.is_empty() {
        let e = Error::new("no labelled object is scored")
            .file(&folder)
            .found(format!("{frames} frames of this benchmark"));
        return Err(e.hint("give the labels that belong to this scene"));
    }
    Ok((format!("labels of {frames} frames, {pairs} objects, {} texts asked\n", asked.len()), asked))
}

/// Reads the labelled vertices of a scan, and its instances where it has some.
fn check_scan(folder: &Path) -> Result<(String, BTreeSet<String>)> {
    let files = ScanFiles::find(folder)?;
    let (_, labels) = gs_scene::ply::read_labels(&files.labels, "label", [0.0; 3])?;
    let of = |(segments, objects): &(PathBuf, PathBuf)| instances::read_truth(segments, objects, labels.len());
    let objects = files.instances.as_ref().map(of).transpose()?;
    let objects = objects.map_or(0, |truth| truth.into_iter().filter(|&i| i >= 0).collect::<BTreeSet<_>>().len());
    let names = artifacts::NYU40.iter().map(|c| c.1.to_string()).collect();
    Ok((format!("labels of {} vertices, {objects} objects\n", labels.len()), names))
}

/// Every text that is asked must have a feature.
fn check_texts(o: &CheckOptions, source: &TextSource, asked: Option<&BTreeSet<String>>) -> Result<String> {
    let known: BTreeSet<String> = source.names().into_iter().collect();
    let Some(asked) = asked else { return Ok(String::new()) };
    let lacking: Vec<&str> = asked.difference(&known).map(String::as_str).collect();
    if lacking.is_empty() {
        return Ok(format!("text features of all {} texts, dimension {}\n", asked.len(), source.dim()));
    }
    let some = lacking.iter().take(3).copied().collect::<Vec<_>>().join(", ");
    let e = Error::new("texts that will be asked have no feature").file(o.text_features.as_ref().unwrap_or(&o.scene));
    let e = e.found(format!("{} of {} without, such as {some}", lacking.len(), asked.len()));
    Err(e.hint("add them to the table, or give a CLIP model, which takes any words"))
}

/// Reads the id maps of one view, and their features where there are some. `dim` is the dimension of the texts.
fn check_masks(folder: &Path, dataset: &Dataset, dim: Option<usize>) -> Result<String> {
    let stems = artifacts::stems(folder)?;
    let of_view = dataset.views.iter().find(|v| stems.binary_search_by(|s| s.as_str().cmp(v.stem())).is_ok());
    let Some(view) = of_view else {
        let e = Error::new("no id map is of a photograph of the scene").file(folder);
        let found = stems.first().map_or("none".to_string(), |s| format!("{} such as {s}_s.npy", stems.len()));
        let e = e.found(found).expected(format!("{}_s.npy and so on", dataset.views[0].stem()));
        return Err(e.hint("give the maps of this scene, named after its photographs"));
    };
    let maps = MaskFolder::open(folder).read(view)?;
    let said = format!("{}_s.npy: {}x{} pixels, {} masks", view.stem(), maps.width(), maps.height(), maps.id_count());
    Ok(match MaskFeatures::of_view(folder, view.stem(), maps.id_count(), dim)? {
        Some(features) => format!("{said}, features of dimension {}\n", features.dim()),
        None => said + "\n",
    })
}
