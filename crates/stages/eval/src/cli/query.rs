//! `eval query` on the command line.

use super::{LanguageArgs, SMALLER, SceneArgs, load, mask_threshold, read_scene, words};
use crate::ask::Asker;
use crate::granularity::Granularity;
use crate::lerf::Rendering;
use crate::memory;
use crate::place::{self, Place};
use crate::query::{self, Asked, Divided, ShowOptions};
use crate::ranking::{Index, Ranked, Scoring};
use crate::scene::{LabelledScene, find_view, numbered};
use crate::segment;
use crate::silhouette::Silhouette;
use gs_io::{Error, Result};
use gs_scene::dataset::{Dataset, LoadOptions, Resolution};
use onnx_models::{Bounds, ClipImage, LabelMap, RgbImage, crop_mask};
use serde_json::{Value, json};
use stage::Stage;
use std::io::BufRead;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Rows of a printed ranking.
const ROWS: usize = 5;
/// Names that a place is given.
const NAMES: usize = 5;

#[derive(Debug, clap::Args)]
pub(super) struct QueryArgs {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    language: LanguageArgs,
    /// What to look for, in words; may be given several times
    #[arg(long, value_name = "WORDS", value_parser = words)]
    text: Vec<String>,
    /// A picture of what to look for (needs image.onnx in the --clip folder); may be given several times
    #[arg(long, value_name = "FILE")]
    image: Vec<PathBuf>,
    /// The part of the pictures to look for, in pixels
    #[arg(long, value_name = "X0,Y0,X1,Y1", requires = "image")]
    crop: Option<String>,
    /// What is at this pixel of this view? May be given several times
    #[arg(long, value_name = "VIEW:X,Y")]
    pixel: Vec<String>,
    /// What is at this point of the world? May be given several times
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    point: Vec<String>,
    /// Answer texts and pictures with the instance found, what it is a part of, or its parts
    #[arg(long, value_enum, default_value = "instance")]
    granularity: Granularity,
    /// Divide all Gaussians among the texts: labels.npy and segmentation.ply
    #[arg(long)]
    segment: bool,
    /// Keep everything loaded and read texts from standard input, one a line; with --out each gets a folder in it
    #[arg(long, conflicts_with_all = ["text", "image", "pixel", "point", "segment"])]
    interactive: bool,
    /// Views for the pictures, by name, with commas between [default: three in which the selection is seen well]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    views: Vec<String>,
    /// Show the selection as far as it is visible, or rendered alone
    #[arg(long, value_enum, default_value = "visible")]
    silhouette: Silhouette,
    /// A pixel belongs to the mask above this [default: 0.7 for selected, 0.5 for visible]
    #[arg(long, value_name = "VALUE")]
    alpha: Option<f32>,
    /// Size of the pictures: a divisor of the photographs', a width such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto")]
    resolution: Resolution,
    /// Output folder
    #[arg(long, value_name = "DIR", required_unless_present = "interactive")]
    out: Option<PathBuf>,
}

/// Numbers with commas between, as many as `N`.
fn numbers<T: std::str::FromStr + Copy + Default, const N: usize>(text: &str, option: &str) -> Result<[T; N]> {
    let parsed: Vec<T> = text.split(',').filter_map(|p| p.trim().parse().ok()).collect();
    let whole = text.split(',').count() == N;
    <[T; N]>::try_from(parsed).ok().filter(|_| whole).ok_or_else(|| {
        Error::new("not understood").field(option).found(text).expected(format!("{N} numbers with commas between"))
    })
}

/// Refuses what no scene can mend.
pub(super) fn check(a: &QueryArgs) -> Result<()> {
    if a.text.is_empty() && a.image.is_empty() && a.pixel.is_empty() && a.point.is_empty() && !a.interactive {
        return Err(Error::new("nothing is asked for")
            .field("--text")
            .expected("--text, --image, --pixel, --point or --interactive"));
    }
    if !a.image.is_empty() && a.language.clip.is_none() {
        return Err(no_image_encoder());
    }
    if a.segment && a.text.len() < 2 {
        return Err(Error::new("nothing to choose between")
            .field("--segment")
            .found(format!("{} texts", a.text.len()))
            .expected("at least two --text"));
    }
    mask_threshold(a.alpha, a.silhouette)?;
    a.language.selection().map(drop)
}

pub(super) fn run(a: &QueryArgs, stage: &Stage, json_lines: bool) -> Result<String> {
    let rendering = Rendering { silhouette: a.silhouette, threshold: mask_threshold(a.alpha, a.silhouette)? };
    let options = ShowOptions { views: a.views.clone(), rendering };
    let dataset = load(&a.scene.scene, &LoadOptions { resolution: a.resolution, ..LoadOptions::default() }, stage)?;
    let claim = |out: &PathBuf| {
        let outputs = stage.outputs(out.join("query.json")).folder(out);
        outputs.reads(a.scene.files(&dataset, &a.language)).reads(&a.image).claim()
    };
    let mut claim = a.out.as_ref().map(claim).transpose()?;
    stage.forecast(memory::of_query(&a.scene.sizes(&a.language, &dataset.views)), SMALLER)?;
    let scene = read_scene(&a.scene.instances, &a.scene.geometry, stage)?;
    let worded = !a.text.is_empty() || a.interactive;
    let given = a.language.clip.is_some() || a.language.text_features.is_some();
    let source = if worded || given { Some(a.language.source()?) } else { None };
    if let Some(source) = source.as_ref().filter(|_| worded || !a.image.is_empty()) {
        a.language.check_fits(source, &scene)?;
    }
    let source = source.filter(|s| s.dim() == scene.instances.dim);
    scene.check_dataset(&dataset)?;
    for view in &a.views {
        find_view(&dataset, view)?;
    }
    let asker = a.language.asker(&scene, source)?;
    if scene.instances.label.iter().all(|&l| l < 0) {
        stage.warn("all Gaussians are noise: every query selects nothing");
    }
    if a.interactive {
        interactive(a, &scene, &dataset, &asker, &options, stage, json_lines)?;
        if let Some(claim) = &mut claim {
            stage.record(claim, parameters(a, &rendering), scene.inputs.clone(), json!({}))?;
        }
        return Ok(String::new());
    }
    let mut asked = Vec::new();
    let mut divided = None;
    if !a.text.is_empty() {
        let mut features = Vec::new();
        for (text, feature) in a.text.iter().zip(asker.features(&a.text)?) {
            let unknown = || asker.source.as_ref().expect("texts have a source").unknown(text);
            let feature = feature.ok_or_else(unknown)?;
            asked.push(Asked { name: text.clone(), kind: "text", answer: asker.answer(&feature), place: None });
            features.push(feature);
        }
        if a.segment {
            let (labels, instances) = segment::divide(
                &asker.index,
                &scene.instances.label,
                scene.instances.len(),
                &features,
                &asker.scoring,
                a.language.threshold,
            );
            divided = Some(Divided { texts: a.text.clone(), labels, instances });
        }
    }
    for (path, feature) in a.image.iter().zip(image_features(a, &scene)?) {
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        asked.push(Asked { name, kind: "image", answer: asker.answer(&feature), place: None });
    }
    let mut asked: Vec<Asked> = asked
        .into_iter()
        .flat_map(|one| a.granularity.apply(&scene.instances, one, &mut |why| stage.warn(why)))
        .collect();
    let namer = Namer::new(&asker, &a.text)?;
    for text in &a.pixel {
        let bad = || Error::new("not understood").field("--pixel").found(text).expected("VIEW:X,Y");
        let (view, at) = text.rsplit_once(':').ok_or_else(bad)?;
        let view = find_view(&dataset, view)?;
        let (found, ranking) = place::at_pixel(&scene, &asker.index, view, numbers(at, "--pixel")?)?;
        asked.push(located(format!("pixel {text}"), "pixel", found, ranking, &asker, &namer));
    }
    for text in &a.point {
        let point: [f32; 3] = numbers(text, "--point")?;
        if point.iter().any(|v| !v.is_finite()) {
            return Err(Error::new("not a point").field("--point").found(text).expected("finite numbers"));
        }
        let (found, ranking) = place::at_point(&scene, &asker.index, point)?;
        asked.push(located(format!("point {text}"), "point", found, ranking, &asker, &namer));
    }
    let describe = asker.source.as_ref().map_or("none".into(), crate::text::TextSource::describe);
    let out = a.out.as_deref().expect("clap asks for it");
    let results = query::write(&scene, &dataset, describe, asked, divided, &options, out)?;
    for q in &results.queries {
        if q.selected.is_empty() {
            stage.warn(&format!("no instance passes for {:?}: nothing is selected", q.text));
        } else if q.gaussians == 0 {
            stage.warn(&format!("the instances selected for {:?} hold no Gaussian: nothing to show", q.text));
        }
    }
    let summary = json!({
        "queries": results.queries.len(), "instances": results.instances,
        "selected_nothing": results.queries.iter().filter(|q| q.gaussians == 0).count(),
    });
    if let Some(claim) = &mut claim {
        stage.record(claim, parameters(a, &rendering), scene.inputs.clone(), summary)?;
    }
    Ok(query::table(&results, ROWS))
}

/// What shaped the answers, for the record.
fn parameters(a: &QueryArgs, rendering: &Rendering) -> Value {
    let mut parameters = a.language.parameters();
    parameters["command"] = json!("query");
    parameters["texts"] = json!(a.text);
    parameters["granularity"] = json!(a.granularity.name());
    parameters["pixels"] = json!(a.pixel);
    parameters["points"] = json!(a.point);
    parameters["alpha"] = json!(rendering.threshold);
    parameters
}

/// Features of the pictures: cut to the crop, padded to a square with black, as masks are shown to CLIP.
fn image_features(a: &QueryArgs, scene: &LabelledScene) -> Result<Vec<Vec<f32>>> {
    if a.image.is_empty() {
        return Ok(Vec::new());
    }
    let clip = a.language.clip.as_deref().ok_or_else(no_image_encoder)?;
    let encoder = ClipImage::open(clip_folder(clip), &a.language.engine())?;
    if encoder.dimension() != scene.instances.dim {
        return Err(Error::new("the image features are of another model than the masks'")
            .file(scene.path())
            .field("descriptor")
            .found(format!("dimension {}", scene.instances.dim))
            .expected(encoder.dimension()));
    }
    let one = |path: &PathBuf| {
        let image = gs_scene::Image::read(path)?;
        let (width, height) = (image.width as usize, image.height as usize);
        let picture = RgbImage { width, height, pixels: image.to_rgb8() };
        let [x0, y0, x1, y1] = match &a.crop {
            Some(text) => numbers::<usize, 4>(text, "--crop")?,
            None => [0, 0, width, height],
        };
        if x0 >= x1 || y0 >= y1 || x1 > width || y1 > height {
            return Err(Error::new("not a part of the picture")
                .file(path)
                .field("--crop")
                .found(format!("{x0},{y0},{x1},{y1}"))
                .expected(format!("X0 < X1 <= {width}, Y0 < Y1 <= {height}")));
        }
        let ids = vec![0; width * height];
        let map = LabelMap { width, height, ids: &ids };
        Ok(crop_mask(&picture, &map, 0, Bounds { x0, y0, x1, y1 }, encoder.size()))
    };
    let crops: Vec<Vec<u8>> = a.image.iter().map(one).collect::<Result<_>>()?;
    Ok(encoder.encode(&crops.concat())?.chunks_exact(encoder.dimension()).map(<[f32]>::to_vec).collect())
}

fn no_image_encoder() -> Error {
    Error::new("pictures need an image encoder").field("--image").expected("--clip with a folder that holds image.onnx")
}

/// `--clip` may name text.onnx itself; the image encoder lies beside it.
fn clip_folder(clip: &Path) -> &Path {
    if clip.is_dir() { clip } else { clip.parent().unwrap_or(Path::new("")) }
}

/// Texts that places may be called: those given, or all of a table.
struct Namer {
    texts: Vec<String>,
    features: Vec<Vec<f32>>,
}

impl Namer {
    fn new(asker: &Asker<'_>, texts: &[String]) -> Result<Self> {
        let Some(source) = &asker.source else { return Ok(Self { texts: Vec::new(), features: Vec::new() }) };
        let names = if texts.is_empty() { source.names() } else { texts.to_vec() };
        let found = asker.features(&names)?;
        let (texts, features) = names.into_iter().zip(found).filter_map(|(n, f)| Some((n, f?))).unzip();
        Ok(Self { texts, features })
    }

    fn names(&self, index: &Index<'_>, scoring: &Scoring, instance: u32) -> Vec<(String, f32)> {
        let score = |f: &Vec<f32>| index.scores(f, scoring)[instance as usize];
        let mut names: Vec<(String, f32)> =
            self.texts.iter().zip(&self.features).filter_map(|(t, f)| Some((t.clone(), score(f)?))).collect();
        names.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        names.truncate(NAMES);
        names
    }
}

/// The instance with the largest share of a place is the answer, whatever the options of selection say.
fn located(
    name: String,
    kind: &'static str,
    mut place: Place,
    ranking: Vec<Ranked>,
    asker: &Asker<'_>,
    namer: &Namer,
) -> Asked {
    if let Some(first) = ranking.first() {
        place.names = namer.names(&asker.index, &asker.scoring, first.instance);
    }
    let selected: Vec<u32> = ranking.first().map(|r| r.instance).into_iter().collect();
    let answer = crate::ask::Answered {
        score: ranking.first().map(|r| r.score),
        gaussians: asker.index.members(&selected),
        selected,
        ranking,
    };
    Asked { name, kind, answer, place: Some(place) }
}

/// Reads texts line by line until the end, or `:quit`. A text that cannot be answered is said so and does not end it.
fn interactive(
    a: &QueryArgs,
    scene: &LabelledScene,
    dataset: &Dataset,
    asker: &Asker<'_>,
    options: &ShowOptions,
    stage: &Stage,
    json_lines: bool,
) -> Result<()> {
    let source = asker.source.as_ref().expect("opened for texts");
    stage.info(&format!("{} instances, {}; a text a line, :quit to end", scene.instances.len(), source.describe()));
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|e| Error::new(format!("cannot read the texts: {e}")).field("standard input"))?;
        let text = line.trim();
        if text == ":quit" || stage.interrupted() {
            break;
        }
        if text.is_empty() {
            continue;
        }
        let started = Instant::now();
        let feature = asker.features(&[text.to_string()])?.remove(0);
        let encoding = started.elapsed();
        let Some(feature) = feature else {
            stage.warn(&source.unknown(text).to_string());
            continue;
        };
        let started = Instant::now();
        let answer = asker.answer(&feature);
        let took = started.elapsed();
        let asked = Asked { name: text.into(), kind: "text", answer, place: None };
        let asked = a.granularity.apply(&scene.instances, asked, &mut |why| stage.warn(why));
        let shown = match &a.out {
            None => asked.iter().map(query::unwritten).collect(),
            Some(out) => {
                let folder = out.join(free_name(out, text));
                query::write(scene, dataset, source.describe(), asked, None, options, &folder)?.queries
            }
        };
        let mut printed = String::new();
        for one in &shown {
            printed += &if json_lines {
                serde_json::to_string(one).map_err(|e| Error::new(e.to_string()))? + "\n"
            } else {
                query::answer_table(one, ROWS)
            };
        }
        if !json_lines {
            let ms = |t: std::time::Duration| t.as_secs_f64() * 1e3;
            printed += &format!("\n  {:.1} ms encoding, {:.2} ms query\n", ms(encoding), ms(took));
        }
        if !stage.print(&printed)? {
            break;
        }
    }
    Ok(())
}

/// The name of a new folder for a text: earlier answers stay.
fn free_name(out: &Path, text: &str) -> String {
    let taken = |number: usize| {
        let prefix = format!("{number:02}-");
        let entries = std::fs::read_dir(out).into_iter().flatten().flatten();
        entries.into_iter().any(|e| e.file_name().to_string_lossy().starts_with(&prefix))
    };
    let number = (1..).find(|&n| !taken(n)).unwrap_or(usize::MAX);
    numbered(number, text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_all_there_or_an_error() {
        assert_eq!(numbers::<u32, 2>("3, 4", "--pixel").unwrap(), [3, 4]);
        assert_eq!(numbers::<f32, 3>("-1,2.5,1e2", "--point").unwrap(), [-1.0, 2.5, 100.0]);
        for bad in ["", "3", "3,", "3,4,5", "3,x", "-1,2", "3,4,"] {
            let e = numbers::<u32, 2>(bad, "--pixel").unwrap_err().to_string();
            assert!(e.contains("--pixel: not understood") && e.contains("2 numbers"), "{bad}: {e}");
        }
    }
}
