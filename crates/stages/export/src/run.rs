//! The commands: each claims its outputs, reads the scene and writes.

use crate::hull::hull;
use crate::names;
use crate::options::{
    Inputs, MeshFormat, MeshesOptions, ObjectsOptions, PointsOptions, SceneOptions, SplatsOptions, UpOptions,
    UsdOptions,
};
use crate::points::{self, PointFormat};
use crate::unseen::unseen;
use crate::usd::{self, Prim, StageOptions};
use gs_io::{Claim, Error, Outputs, Result};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Labelled};
use objects::{Ids, Names, ObjectBox, Scene, Up, members, solid_centers};
use query::LabelledScene;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::path::Path;

/// `export scene`.
pub fn scene(o: &SceneOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let mut claim = o.inputs.reads(stage.outputs(&o.out).file(&o.out)).reads(&o.query).reads(&o.names).claim()?;
    let labelled = o.inputs.read(stage)?;
    let names = names::read(o.names.as_deref(), o.query.as_deref(), &labelled)?;
    let (up, cameras) = o.up.find(&labelled, stage)?;
    let mut scene = describe(&labelled, &names, up);
    if !cameras.is_empty() {
        let boxes: Vec<ObjectBox> = scene.objects.iter().map(|object| object.bounds).collect();
        let shares = unseen(labelled.gaussians(), &labelled.raster, &cameras, &boxes);
        scene.objects.iter_mut().zip(shares).for_each(|(object, share)| object.unseen = Some(share));
    }
    scene.write(&o.out)?;
    let summary = json!({
        "objects": scene.objects.len(), "relations": scene.relations.len(),
        "named": scene.objects.iter().filter(|o| o.name.is_some()).count(),
    });
    stage.info(&format!(
        "wrote {}: {} objects, {} relations",
        o.out.display(),
        scene.objects.len(),
        scene.relations.len()
    ));
    stage.record(&mut claim, parameters, labelled.inputs, summary)
}

/// `export objects`.
pub fn objects(o: &ObjectsOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let mut claim = claim_folder(&o.out, "objects", &o.inputs, stage)?;
    let labelled = o.inputs.read(stage)?;
    let splats = splats_of(&labelled, &o.inputs)?;
    let wanted = wanted(&labelled, &o.only, "--only")?;
    let members = members(&labelled.instances.label, labelled.instances.len());
    let mut lost = Vec::new();
    for &id in &wanted {
        let file = o.out.join(format!("{}.{}", stem(id), o.format.extension()));
        lost.extend(splats.write(&file, &members[id as usize])?.1);
    }
    lost.dedup();
    lost.iter().for_each(|what| stage.warn(what));
    stage.info(&format!("wrote {} objects into {}", wanted.len(), o.out.display()));
    stage.record(&mut claim, parameters, labelled.inputs.clone(), json!({ "objects": wanted.len() }))
}

/// `export splats`.
pub fn splats(o: &SplatsOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let outputs = stage.outputs(&o.out).file(&o.out).files(o.ids.then(|| Ids::path(&o.out)));
    let mut claim = o.inputs.reads(outputs.drop_stale()).reads(&o.names).claim()?;
    let labelled = o.inputs.read(stage)?;
    let label = &labelled.instances.label;
    let only = if o.only.is_empty() { None } else { Some(wanted(&labelled, &o.only, "--only")?) };
    let without = if o.without.is_empty() { Vec::new() } else { wanted(&labelled, &o.without, "--without")? };
    let meant = |l: i32| match u32::try_from(l) {
        Ok(id) => only.as_ref().is_none_or(|only| only.contains(&id)) && !without.contains(&id),
        Err(_) => only.is_none(),
    };
    let which: Vec<u32> = (0..label.len() as u32).filter(|&i| meant(label[i as usize])).collect();
    if which.is_empty() {
        return Err(Error::new("nothing is left to write").field("--without").hint("leave some objects"));
    }
    let write = |splats: &Labelled<'_>| -> Result<Vec<u32>> {
        let (order, lost) = splats.write(&o.out, &which)?;
        lost.iter().for_each(|what| stage.warn(what));
        Ok(order)
    };
    let mut splats = splats_of(&labelled, &o.inputs)?;
    let order = if o.ids {
        let mut written: Vec<u32> = which.iter().filter_map(|&i| u32::try_from(label[i as usize]).ok()).collect();
        written.sort_unstable();
        written.dedup();
        let (objects, classes) = objects::classes(&written, &names::read(o.names.as_deref(), None, &labelled)?);
        let of: BTreeMap<i32, i32> = objects.iter().map(|o| (o.instance_id as i32, o.class_id)).collect();
        let class: Vec<i32> = label.iter().map(|l| of.get(l).copied().unwrap_or(-1)).collect();
        splats = splats.with(("instance_id", label)).with(("class_id", &class));
        let order = write(&splats)?;
        let own = order.iter().map(|&i| label[i as usize]).collect();
        Ids::of(&o.out, own)?.called(objects, classes).write(&o.out)?;
        order
    } else {
        write(&splats)?
    };
    stage.info(&format!("wrote {}: {} of {} Gaussians", o.out.display(), order.len(), label.len()));
    stage.record(&mut claim, parameters, labelled.inputs.clone(), json!({ "gaussians": order.len() }))
}

/// `export points`.
pub fn points(o: &PointsOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let format = PointFormat::of(&o.out)?;
    let mut claim = o.inputs.reads(stage.outputs(&o.out).file(&o.out)).claim()?;
    let labelled = o.inputs.read(stage)?;
    let (g, whole) = (labelled.gaussians(), labelled.geometry.whole());
    let solid = |&i: &u32| whole[i as usize] && g.opacity(i as usize) >= o.min_opacity;
    let which: Vec<u32> = (0..g.len() as u32).filter(solid).collect();
    if which.is_empty() {
        stage.warn("no Gaussian is solid enough to be a point: give a lower --min-opacity");
    } else if format == PointFormat::Las
        && let Some(coarse) = points::coarse(g, &which)
    {
        stage.warn(&coarse);
    }
    points::write(&o.out, format, g, &labelled.instances.label, &which)?;
    stage.info(&format!("wrote {}: {} points of {} Gaussians", o.out.display(), which.len(), g.len()));
    stage.record(&mut claim, parameters, labelled.inputs.clone(), json!({ "points": which.len() }))
}

/// `export meshes`.
pub fn meshes(o: &MeshesOptions, parameters: Value, stage: &Stage) -> Result<()> {
    let mut claim = claim_folder(&o.out, "meshes", &o.inputs, stage)?;
    let labelled = o.inputs.read(stage)?;
    let wanted = wanted(&labelled, &o.only, "--only")?;
    let scene = describe(&labelled, &Names::new(), None);
    let members = members(&labelled.instances.label, labelled.instances.len());
    let (mut flat, shift) = (Vec::new(), labelled.gaussians().shift);
    for object in scene.objects.iter().filter(|object| wanted.contains(&object.id)) {
        let centers = solid_centers(labelled.gaussians(), &members[object.id as usize]);
        let (mesh, is_box) = hull(&centers, &object.bounds, o.vertices);
        flat.extend(is_box.then_some(object.id));
        let stem = stem(object.id);
        match o.format {
            MeshFormat::Obj => mesh.write_obj(&o.out.join(format!("{stem}.obj")), &stem, shift)?,
            MeshFormat::Ply => mesh.write_ply(&o.out.join(format!("{stem}.ply")), shift)?,
        }
    }
    if !flat.is_empty() {
        stage.warn(&format!("boxes in place of hulls, since the centres span no volume: objects {flat:?}"));
    }
    stage.info(&format!("wrote {} meshes into {}", wanted.len(), o.out.display()));
    let summary = json!({ "meshes": wanted.len(), "boxes": flat });
    stage.record(&mut claim, parameters, labelled.inputs.clone(), summary)
}

/// `export usd`.
pub fn usd(o: &UsdOptions, parameters: Value, stage: &Stage) -> Result<()> {
    usd::check_name(&o.out)?;
    let mut claim = o.inputs.reads(stage.outputs(&o.out).file(&o.out)).claim()?;
    let labelled = o.inputs.read(stage)?;
    let (up, _) = o.up.find(&labelled, stage)?;
    let scene = describe(&labelled, &Names::new(), up);
    let (g, whole) = (labelled.gaussians(), labelled.geometry.whole());
    let mut members = members(&labelled.instances.label, labelled.instances.len());
    let mut prims: Vec<Prim> = Vec::new();
    for object in &scene.objects {
        let gaussians = std::mem::take(&mut members[object.id as usize]);
        let (collider, _) = hull(&solid_centers(g, &gaussians), &object.bounds, o.vertices);
        let name = object.name.as_ref().map(|n| n.text.clone());
        prims.push(Prim { id: Some(object.id), name, gaussians, collider: Some(collider) });
    }
    let others = |&i: &u32| labelled.instances.label[i as usize] < 0 && whole[i as usize];
    let gaussians = (0..g.len() as u32).filter(others).collect();
    prims.push(Prim { id: None, name: None, gaussians, collider: None });
    let options = StageOptions { up, metres_per_unit: labelled.remarks.metres_per_unit, sh_degree: o.sh };
    usd::write(&o.out, g, &prims, &options)?;
    stage.info(&format!("wrote {}: {} objects", o.out.display(), scene.objects.len()));
    stage.record(&mut claim, parameters, labelled.inputs.clone(), json!({ "objects": scene.objects.len() }))
}

impl Inputs {
    fn reads(&self, outputs: Outputs) -> Outputs {
        outputs.reads([&self.geometry, &self.instances]).reads(&self.edits)
    }

    fn read(&self, stage: &Stage) -> Result<LabelledScene> {
        let scene = LabelledScene::read(&self.instances, &self.geometry, self.edits.as_deref())?;
        if let Some(damage) = scene.geometry.damage() {
            stage.skipped(&damage);
        }
        if scene.all_noise() {
            stage.warn("no Gaussian belongs to an object");
        }
        Ok(scene)
    }
}

impl UpOptions {
    /// What is up: as a person said, or by the cameras of the dataset; with these.
    fn find(&self, scene: &LabelledScene, stage: &Stage) -> Result<(Option<Up>, Vec<Camera>)> {
        let Some(folder) = &self.scene else { return Ok((self.up, Vec::new())) };
        let mut dataset = dataset::load(folder, &LoadOptions::default())?;
        scene.check_dataset(&mut dataset)?;
        let cameras: Vec<Camera> = dataset.views.into_iter().map(|view| view.camera).collect();
        let up = Up::of_cameras(&cameras);
        if up.is_none() {
            stage.warn("the cameras do not tell what is up: give --up");
        }
        Ok((up, cameras))
    }
}

fn splats_of<'a>(scene: &'a LabelledScene, inputs: &Inputs) -> Result<Labelled<'a>> {
    let own = vec![concat!("made by export ", env!("CARGO_PKG_VERSION")).into()];
    Labelled::new(&scene.geometry, &inputs.geometry, &scene.instances.label, own)
}

fn describe(labelled: &LabelledScene, names: &Names, up: Option<Up>) -> Scene {
    let inputs = labelled.inputs.clone();
    objects::describe(&labelled.instances, labelled.gaussians(), &labelled.remarks, names, up, inputs)
}

/// The right to write a folder of files whose names follow from the scene.
fn claim_folder(out: &Path, main: &str, inputs: &Inputs, stage: &Stage) -> Result<Claim> {
    inputs.reads(stage.outputs(out.join(main)).folder(out).drop_stale()).claim()
}

/// Name of an object's file, without its extension.
fn stem(id: u32) -> String {
    format!("object_{id:04}")
}

/// The ids that an option names, ascending; all objects' where it names none.
fn wanted(scene: &LabelledScene, ids: &[u32], option: &str) -> Result<Vec<u32>> {
    let count = &scene.instances.count;
    let all: Vec<u32> = (0..count.len() as u32).filter(|&k| count[k as usize] > 0).collect();
    if let Some(id) = ids.iter().find(|id| all.binary_search(id).is_err()) {
        let expected = match (all.first(), all.last()) {
            (Some(first), Some(last)) => format!("ids of objects, {first} to {last}"),
            _ => "none: the scene has no objects".into(),
        };
        return Err(Error::new("no such object").field(option).found(id).expected(expected));
    }
    if ids.is_empty() {
        return Ok(all);
    }
    Ok(all.into_iter().filter(|id| ids.contains(id)).collect())
}
