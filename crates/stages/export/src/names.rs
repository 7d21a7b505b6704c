//! What objects are called: by queries (`query.json` of `eval query`), and by a vocabulary (`names.json` of `eval names`).

use artifacts::{InstanceNames, called};
use gs_io::{Error, IoContext, Result};
use objects::{Name, NameSource, Names};
use query::LabelledScene;
use serde::Deserialize;
use stage::RunRecord;
use std::collections::BTreeMap;
use std::path::Path;

/// The part of the file that names objects.
#[derive(Deserialize)]
struct Answers {
    queries: Vec<Answer>,
}

#[derive(Deserialize)]
struct Answer {
    text: String,
    kind: String,
    ranking: Vec<Rank>,
}

#[derive(Deserialize)]
struct Rank {
    instance: u32,
    score: f32,
}

/// Names of a vocabulary, a guess among them; what the text says that an instance answers best goes before them.
///
/// # Errors
/// When a file is not of its kind, or about other instances.
pub fn read(names: Option<&Path>, query: Option<&Path>, scene: &LabelledScene) -> Result<Names> {
    let by_words = names.map(|path| InstanceNames::read(path, scene.artifact.hash())).transpose()?;
    let mut all: Names = called(by_words.as_ref(), &scene.remarks).into_iter().map(|(k, c)| (k, c.into())).collect();
    all.extend(query.map_or(Ok(Names::new()), |path| of_query(path, scene))?);
    Ok(all)
}

/// The text that each instance answers best, of those that no other instance answers better.
///
/// # Errors
/// When the file is not such a file, or its record says that it is about other instances.
fn of_query(path: &Path, scene: &LabelledScene) -> Result<Names> {
    let bytes = std::fs::read(path).at("read", path)?;
    let answers: Answers = serde_json::from_slice(&bytes)
        .map_err(|e| Error::new(format!("not a query.json of eval query: {e}")).file(path))?;
    let record = RunRecord::read(path)?;
    let (found, expected) = (record.inputs.get("instances"), scene.artifact.hash());
    if found.map(String::as_str) != Some(expected) {
        return Err(Error::new("queries of other instances")
            .file(RunRecord::path(path))
            .field("inputs.instances")
            .found(found.map_or("none".into(), |f| format!("{f:.12}")))
            .expected(format!("{expected:.12} ({})", scene.path().display()))
            .hint("run eval query again"));
    }
    Ok(best(&answers.queries))
}

/// Each text calls its first instance; of several that call the same one the highest score does, of equals the first.
fn best(answers: &[Answer]) -> Names {
    let mut best: BTreeMap<u32, (f32, &str)> = BTreeMap::new();
    for answer in answers.iter().filter(|a| a.kind == "text" && !a.text.trim().is_empty()) {
        let Some(first) = answer.ranking.first() else { continue };
        let held = best.entry(first.instance).or_insert((f32::NEG_INFINITY, ""));
        if first.score > held.0 {
            *held = (first.score, &answer.text);
        }
    }
    let named = best.into_iter().filter(|(_, (_, text))| !text.is_empty());
    named.map(|(id, (_, text))| (id, Name { text: text.into(), from: NameSource::Query, sure: true })).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_text_of_an_instance_names_it() {
        let answer = |text: &str, kind: &str, ranking: &[(u32, f32)]| Answer {
            text: text.into(),
            kind: kind.into(),
            ranking: ranking.iter().map(|&(instance, score)| Rank { instance, score }).collect(),
        };
        let names = best(&[
            answer("cup", "text", &[(3, 0.5), (4, 0.4)]),
            answer("mug", "text", &[(3, 0.7)]),
            answer("tumbler", "text", &[(3, 0.7)]),
            answer("photo.png", "image", &[(5, 0.9)]),
            answer("nothing", "text", &[]),
            answer("table", "text", &[(0, 0.1)]),
        ]);
        let names: Vec<(u32, String)> = names.into_iter().map(|(id, name)| (id, name.to_string())).collect();
        assert_eq!(names, [(0, "table".into()), (3, "mug".into())]);
    }
}
