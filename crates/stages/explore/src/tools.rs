//! What programs ask: each tool takes JSON and answers JSON. `serve` gives them over HTTP, `mcp` over the Model Context
//! Protocol; docs/door.md has a session.

use crate::answers;
use crate::world::{Edited, World};
use gs_io::{Error, Result};
use gs_scene::Labelled;
use gs_scene::splat::Format;
use objects::{Object, Up};
use schemars::JsonSchema;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use std::path::{Component, Path};

/// Most objects that one question is answered with.
const MOST: usize = 100;

/// Whom a tool asks.
pub struct Asked<'a> {
    pub world: &'a World,
    pub edited: &'a Edited,
    /// Folder that `export` writes into; none where the person who started the program gave none.
    pub exports: Option<&'a Path>,
}

/// A question that can be asked.
pub struct Tool {
    pub name: &'static str,
    /// For an agent: what is answered, and in what units.
    pub about: &'static str,
    /// JSON schema of the arguments.
    pub schema: fn() -> Map<String, Value>,
    answer: fn(&Asked, Value) -> Result<Value>,
}

/// All of them.
pub const TOOLS: [Tool; 5] = [
    Tool {
        name: "list",
        about: "The objects of the scene: id, name and whether that is sure or a guess, centre, size and volume of the box, number of \
                Gaussians. Lengths are in units of the scene; metres_per_unit is null where nobody measured one.",
        schema: schema::<List>,
        answer: |asked, v| Ok(list(asked, &parsed(v)?)),
    },
    Tool {
        name: "find",
        about: "The objects that a text describes, best first: those that a person named so, then by the cosine of the \
                text's feature and the object's. There is always a best: matches says whether it is better than by chance, null \
                where that is not known.",
        schema: schema::<Find>,
        answer: |asked, v| find(asked, &parsed(v)?),
    },
    Tool {
        name: "measure",
        about: "Size and volume of an object; with a second one also the distance of their centres and the gap between them. In \
                units of the scene, and in metres where a person measured a length.",
        schema: schema::<Measure>,
        answer: |asked, v| measure(asked, &parsed(v)?),
    },
    Tool {
        name: "relations",
        about: "What is on, in, under or next to what, by boxes and gravity: of all objects, or of one.",
        schema: schema::<Relations>,
        answer: |asked, v| relations(asked, &parsed(v)?),
    },
    Tool {
        name: "export",
        about: "Writes objects, or the scene without them, as a file of Gaussians into the folder that was allowed when the \
                program was started. Never overwrites a file.",
        schema: schema::<Export>,
        answer: |asked, v| export(asked, &parsed(v)?),
    },
];

/// The answer of a tool. `arguments` is an object; null where there are none.
///
/// # Errors
/// When there is no such tool, or the arguments are wrong.
pub fn ask(tool: &str, arguments: Value, asked: &Asked) -> Result<Value> {
    let known = || TOOLS.map(|t| t.name).join(", ");
    let found = TOOLS.iter().find(|t| t.name == tool);
    let tool = found.ok_or_else(|| Error::new("no such tool").found(tool).expected(known()))?;
    let mut arguments = if arguments.is_null() { json!({}) } else { arguments };
    whole_numbers(&mut arguments);
    check(&arguments, &(tool.schema)().into(), "arguments")?;
    (tool.answer)(asked, arguments).map(rounded)
}

/// Makes 17.0 the integer that JSON's schemas take it for.
fn whole_numbers(value: &mut Value) {
    match value {
        Value::Number(n) => {
            if let Some(v) = n.as_f64().filter(|v| n.is_f64() && v.fract() == 0.0 && v.abs() <= 2f64.powi(53)) {
                *value = json!(v as i64);
            }
        }
        Value::Array(a) => a.iter_mut().for_each(whole_numbers),
        Value::Object(o) => o.values_mut().for_each(whole_numbers),
        _ => {}
    }
}

/// Checks the types of arguments, and says in JSON's words what is wrong. Which arguments there are is checked where they are read.
fn check(value: &Value, schema: &Value, field: &str) -> Result<()> {
    let (article, kind) = match value {
        Value::Null => ("", "null"),
        Value::Bool(_) => ("a ", "boolean"),
        Value::Number(n) if n.is_f64() => ("a ", "number"),
        Value::Number(_) => ("an ", "integer"),
        Value::String(_) => ("a ", "string"),
        Value::Array(_) => ("an ", "array"),
        Value::Object(_) => ("an ", "object"),
    };
    let kinds = match &schema["type"] {
        Value::Array(kinds) => kinds.clone(),
        one => vec![one.clone()],
    };
    let most = if schema["format"] == "uint32" { u64::from(u32::MAX) } else { u64::MAX };
    let fits = kind != "integer" || schema["minimum"] != 0 || value.as_u64().is_some_and(|v| v <= most);
    if !fits || !kinds.iter().any(|k| k == kind) {
        let found = if matches!(value, Value::Number(_)) { format!("{kind} {value}") } else { kind.into() };
        let expected = match kinds[0].as_str().unwrap_or_default() {
            "integer" if schema["format"] == "uint32" => format!("an integer, 0 to {most}"),
            "integer" => "an integer, 0 or more".into(),
            "array" => "an array".into(),
            "object" => "an object".into(),
            other => format!("a {other}"),
        };
        return Err(Error::new("not understood").field(field).found(format!("{article}{found}")).expected(expected));
    }
    match value {
        Value::Object(of) => {
            let known = |name: &str| schema["properties"].get(name);
            of.iter().try_for_each(|(name, v)| known(name).map_or(Ok(()), |own| check(v, own, name)))
        }
        Value::Array(of) => of.iter().try_for_each(|v| check(v, &schema["items"], field)),
        _ => Ok(()),
    }
}

/// All numbers with fractions to four digits: nobody needs more, and agents pay for each.
fn rounded(answer: Value) -> Value {
    match answer {
        Value::Number(n) if n.is_f64() => {
            let v = n.as_f64().unwrap_or_default();
            format!("{v:.3e}").parse::<f64>().map_or(Value::Null, |v| json!(v))
        }
        Value::Array(a) => a.into_iter().map(rounded).collect(),
        Value::Object(o) => o.into_iter().map(|(k, v)| (k, rounded(v))).collect::<Map<_, _>>().into(),
        other => other,
    }
}

/// All tools with the schemas of their arguments.
pub fn described() -> Value {
    let one = |t: &Tool| json!({"name": t.name, "about": t.about, "arguments": (t.schema)()});
    json!({"tools": TOOLS.iter().map(one).collect::<Vec<_>>()})
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct List {
    /// Only so many, those with most Gaussians.
    most: Option<usize>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Find {
    /// What is looked for, such as "green kettle".
    text: String,
    /// Most objects in the answer, 1 to 100.
    #[serde(default = "few")]
    most: usize,
}

fn few() -> usize {
    5
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Measure {
    /// Id of an object.
    object: u32,
    /// Id of another: measure also from one to the other.
    other: Option<u32>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Relations {
    /// Id of an object: only what is said of it.
    object: Option<u32>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Export {
    /// Ids of objects.
    objects: Vec<u32>,
    /// Everything but these objects.
    #[serde(default)]
    others: bool,
    /// Name of the new file, without folders: .ply, .compressed.ply, .spz, .sog, .splat or .glb. Only a PLY holds the ids of objects.
    file: String,
}

fn schema<T: JsonSchema>() -> Map<String, Value> {
    let schema = schemars::schema_for!(T).to_value();
    schema.as_object().cloned().unwrap_or_default()
}

fn parsed<T: DeserializeOwned>(arguments: Value) -> Result<T> {
    serde_json::from_value(arguments).map_err(|e| Error::new(format!("not understood: {e}")).field("arguments"))
}

/// What all answers say of an object.
fn brief(o: &Object) -> Value {
    let mut brief = json!({
        "id": o.id, "name": o.name.as_ref().map(|n| &n.text), "sure": o.name.as_ref().map(|n| n.sure), "centre": o.bounds.center, "size": size(o), "volume": o.volume,
        "gaussians": o.gaussians, "score": o.score,
    });
    if let Some(note) = &o.note {
        brief["note"] = json!(note);
    }
    brief
}

/// Sides of the box; of an upright one the third is its height.
fn size(o: &Object) -> [f32; 3] {
    o.bounds.half_size.map(|h| 2.0 * h)
}

/// An object in a sentence.
fn called(o: &Object) -> String {
    let name = o.name.as_ref().map_or("object".into(), ToString::to_string);
    format!("{name} ({})", o.id)
}

fn object<'a>(asked: &'a Asked, id: u32, field: &str) -> Result<&'a Object> {
    let scene = asked.edited.objects(asked.world);
    scene.object(id).ok_or_else(|| {
        let expected = match (scene.objects.first(), scene.objects.last()) {
            (Some(first), Some(last)) => format!("an id that list answers, {} to {}", first.id, last.id),
            _ => "none: the scene has no objects".into(),
        };
        Error::new("no such object").field(field).found(id).expected(expected)
    })
}

fn list(asked: &Asked, list: &List) -> Value {
    let scene = asked.edited.objects(asked.world);
    let mut objects: Vec<&Object> = scene.objects.iter().collect();
    if let Some(most) = list.most {
        objects.sort_by_key(|o| (std::cmp::Reverse(o.gaussians), o.id));
        objects.truncate(most);
    }
    json!({
        "objects": objects.into_iter().map(brief).collect::<Vec<_>>(),
        "of": scene.objects.len(),
        "metres_per_unit": scene.metres_per_unit,
        "up": scene.up.as_ref().map(|u: &Up| u.direction.map(|v| (1e4 * v).round() / 1e4)),
    })
}

fn find(asked: &Asked, find: &Find) -> Result<Value> {
    if find.text.trim().is_empty() || !(1..=MOST).contains(&find.most) {
        let e = Error::new("not a question").field("text, most");
        return Err(e.expected(format!("a text that is not empty, and 1 to {MOST}")));
    }
    let answers::Found { scores, named, verdict, .. } = answers::find(asked.world, asked.edited, &find.text)?;
    let scene = asked.edited.objects(asked.world);
    let score = |o: &Object| scores.get(o.id as usize).copied().flatten();
    let mut found: Vec<(&Object, Option<f32>, bool)> = scene
        .objects
        .iter()
        .map(|o| (o, score(o), named.contains(&o.id)))
        .filter(|(_, score, named)| score.is_some() || *named)
        .collect();
    let by = |s: Option<f32>| s.unwrap_or(f32::NEG_INFINITY);
    found.sort_by(|a, b| b.2.cmp(&a.2).then(by(b.1).total_cmp(&by(a.1))).then(a.0.id.cmp(&b.0.id)));
    let one = |&(o, cosine, named): &(&Object, Option<f32>, bool)| json!({"id": o.id, "name": o.name.as_ref().map(|n| &n.text), "named_so": named, "cosine": cosine, "centre": o.bounds.center});
    let matches = if named.is_empty() { verdict.map(|v| v.matches) } else { Some(true) };
    let by_chance = verdict.map(|v| v.by_chance);
    Ok(
        json!({"text": find.text, "matches": matches, "by_chance": by_chance, "found": found.iter().take(find.most).map(one).collect::<Vec<_>>()}),
    )
}

fn measure(asked: &Asked, measure: &Measure) -> Result<Value> {
    let scale = asked.edited.objects(asked.world).metres_per_unit;
    let o = object(asked, measure.object, "object")?;
    let metres = |v: f64| scale.map(|s| s * v);
    let side = size(o).map(f64::from);
    let mut answer = json!({
        "object": called(o), "size": side, "size_metres": scale.map(|s| side.map(|v| s * v)),
        "upright": o.bounds.upright, "volume": o.volume, "volume_cubic_metres": scale.map(|s| s.powi(3) * f64::from(o.volume)),
    });
    if let Some(other) = measure.other {
        let other = object(asked, other, "other")?;
        let apart = distance(o.bounds.center, other.bounds.center);
        let gap = gap(asked, o.id, other.id);
        answer["other"] = json!(called(other));
        answer["between_centres"] = json!({"units": apart, "metres": metres(apart)});
        answer["gap"] = json!({"units": gap, "metres": gap.and_then(metres)});
    }
    Ok(answer)
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f64 {
    (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

/// Least distance between centres of solid Gaussians of two objects; none where one has none.
fn gap(asked: &Asked, a: u32, b: u32) -> Option<f64> {
    let (g, label) = (asked.world.gaussians(), &asked.edited.instances.label);
    let of = |id: u32| -> Vec<u32> {
        (0..label.len() as u32).filter(|&i| u32::try_from(label[i as usize]) == Ok(id)).collect()
    };
    let points = objects::solid_centers(g, &of(a));
    let nearest = query::nearest_solid(g, &points, |i| u32::try_from(label[i]) == Ok(b));
    let gaps = points.iter().zip(nearest).filter_map(|(&p, n)| Some(distance(p, g.means[n? as usize])));
    gaps.min_by(f64::total_cmp)
}

fn relations(asked: &Asked, relations: &Relations) -> Result<Value> {
    let scene = asked.edited.objects(asked.world);
    if let Some(id) = relations.object {
        object(asked, id, "object")?;
    }
    let wanted = |r: &&objects::Relation| relations.object.is_none_or(|id| r.subject == id || r.object == id);
    let named = |id: u32| scene.object(id).map_or(String::new(), called);
    let one = |r: &objects::Relation| {
        let kind = serde_json::to_value(r.relation).unwrap_or_default();
        let says = format!("{} is {} {}", named(r.subject), kind.as_str().unwrap_or_default(), named(r.object));
        json!({"subject": r.subject, "relation": kind, "object": r.object, "says": says})
    };
    let known = if scene.up.is_some() { "on, in, under, next to" } else { "in, next to: nothing says what is up" };
    Ok(json!({"relations": scene.relations.iter().filter(wanted).map(one).collect::<Vec<_>>(), "known": known}))
}

fn export(asked: &Asked, export: &Export) -> Result<Value> {
    let folder = asked.exports.ok_or_else(|| {
        let e = Error::new("nothing may be written");
        e.hint("whoever starts explore allows it with --exports FOLDER")
    })?;
    let name = Path::new(&export.file);
    let plain = matches!(name.components().collect::<Vec<_>>()[..], [Component::Normal(_)]);
    let bad = export.file.starts_with('.') || export.file.contains(['/', '\\']);
    if !plain || bad || gs_io::check_name(&export.file).is_err() {
        let e = Error::new("not a name of a file").field("file").found(format!("{:?}", export.file));
        return Err(e.expected("a name without folders, control characters or a dash before it, such as mug.ply"));
    }
    Format::to_write(name)?;
    let mut meant = BTreeSet::new();
    for &id in &export.objects {
        meant.insert(i32::try_from(object(asked, id, "objects")?.id).unwrap_or(i32::MAX));
    }
    let label = &asked.edited.instances.label;
    let which: Vec<u32> =
        (0..label.len() as u32).filter(|&i| meant.contains(&label[i as usize]) != export.others).collect();
    if which.is_empty() {
        return Err(Error::new("nothing is left to write").field("objects").expected("at least one object"));
    }
    std::fs::create_dir_all(folder).map_err(|e| Error::new(format!("cannot make the folder: {e}")).file(folder))?;
    let path = folder.join(name);
    // What comes there while it is written stays, too.
    let taken = || Error::new("a file of this name is there").file(&path).hint("choose another name");
    if path.symlink_metadata().is_ok() {
        return Err(taken());
    }
    let _new = gs_io::expect_new(&path);
    let own = vec![concat!("made by explore ", env!("CARGO_PKG_VERSION")).into()];
    let world = asked.world;
    let (order, lost) =
        Labelled::new(&world.scene.geometry, &world.source.geometry, label, own)?.write(&path, &which)?;
    let mut written = json!({"file": path, "gaussians": order.len(), "of": label.len()});
    if !lost.is_empty() {
        written["lost"] = lost.into();
    }
    Ok(written)
}
