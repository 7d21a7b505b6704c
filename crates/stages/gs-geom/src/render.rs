//! `gs-geom render`.

use crate::memory::{self, Pictures};
use crate::options::{Render, bytes};
use artifacts::role;
use gs_io::{Error, Result, hash_file, write_bytes};
use gs_raster::{Rendered, render};
use gs_scene::Image;
use gs_scene::dataset::{Dataset, Split, View};
use serde_json::json;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;

impl Render {
    pub(crate) fn run(&self, stage: &Stage) -> Result<()> {
        let (scene, held) = self.scene.for_geometry(&self.geometry)?;
        let mut dataset = scene.load(stage)?;
        held.differs(&dataset).iter().for_each(|what| stage.warn(what));
        let needed = memory::of_renders(bytes(&self.geometry.geometry)?, &Pictures::of(&dataset)?, self.exr);
        stage.forecast(needed, "give a smaller --geometry or --resolution")?;
        let (gaussians, options) = self.geometry.read(self.scene.background, stage)?;
        dataset.follow(&gaussians, &self.geometry.geometry)?;
        let views = choose(&dataset, &self.views)?;
        let extensions: &[&str] = if self.exr { &["png", "exr"] } else { &["png"] };
        let names = views.iter().flat_map(|v| extensions.iter().map(|e| format!("{}.{e}", v.stem())));
        let reads = dataset.files.iter().cloned().chain([self.geometry.geometry.clone()]);
        let mut claim = stage.outputs(&self.out).files_in(&self.out, names).reads(reads).claim()?;
        let mut progress = stage.progress("view", views.len() as u64);
        for view in &views {
            stage.go_on()?;
            let r = render(&gaussians, &view.camera, &options);
            if self.exr {
                write_bytes(self.out.join(format!("{}.exr", view.stem())), &exr_bytes(&r)?)?;
            }
            let picture = Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None };
            picture.write_png(self.out.join(format!("{}.png", view.stem())))?;
            progress.step();
        }
        progress.finish(&[]);
        stage.info(&format!("{} views in {}", views.len(), self.out.display()));
        let inputs = BTreeMap::from([
            (role::DATASET.to_string(), dataset.hash()?),
            (role::GEOMETRY.to_string(), hash_file(&self.geometry.geometry)?),
        ]);
        stage.record(&mut claim, json!(scene), inputs, json!({"views": views.len()}))
    }
}

/// The views that `wanted` names, in the dataset's order.
fn choose<'a>(dataset: &'a Dataset, wanted: &str) -> Result<Vec<&'a View>> {
    let views: Vec<&View> = match wanted {
        "all" => dataset.views.iter().collect(),
        "test" => dataset.views_of(Split::Test).collect(),
        "train" => dataset.views_of(Split::Train).collect(),
        names => {
            let names: BTreeSet<&str> = names.split(',').map(str::trim).filter(|n| !n.is_empty()).collect();
            let is = |v: &View, name: &str| v.stem() == name || v.name == name;
            if let Some(unknown) = names.iter().find(|n| !dataset.views.iter().any(|v| is(v, n))) {
                let like = dataset.views.first().map_or("", |v| v.stem());
                let e = Error::new("no such view").file(&dataset.root).field("--views").found(unknown);
                return Err(e.expected(format!("a photograph's name such as {like}")));
            }
            dataset.views.iter().filter(|v| names.iter().any(|n| is(v, n))).collect()
        }
    };
    if views.is_empty() {
        return Err(Error::new("no views to render")
            .file(&dataset.root)
            .field("--views")
            .found(wanted)
            .hint("give --views all, or --holdout 8"));
    }
    let mut stems = BTreeSet::new();
    if let Some(twice) = views.iter().find(|v| !stems.insert(v.stem())) {
        return Err(Error::new("two views would have the same file name").file(&dataset.root).field(&twice.name));
    }
    Ok(views)
}

/// R, G, B, A and Z of a render as an OpenEXR file. Z is the mean depth of what is seen, 0 where nothing is.
fn exr_bytes(r: &Rendered) -> Result<Vec<u8>> {
    use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};
    let channel = |name: &str, values: Vec<f32>| AnyChannel::<FlatSamples>::new(name, FlatSamples::F32(values));
    let color = |c: usize| r.rgb.iter().skip(c).step_by(3).copied().collect();
    let depth = r.depth.iter().zip(&r.alpha).map(|(z, a)| if *a > 0.0 { z / a } else { 0.0 }).collect();
    let colors = ["R", "G", "B"].into_iter().enumerate().map(|(c, name)| channel(name, color(c)));
    let all = colors.chain([channel("A", r.alpha.clone()), channel("Z", depth)]).collect();
    let image = Image::from_channels((r.width as usize, r.height as usize), AnyChannels::sort(all));
    let mut bytes = Cursor::new(Vec::new());
    let written = image.write().non_parallel().to_buffered(&mut bytes);
    written.map_err(|e| Error::new(format!("cannot encode as OpenEXR: {e}")))?;
    Ok(bytes.into_inner())
}
