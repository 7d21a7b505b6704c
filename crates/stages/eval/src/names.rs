//! `eval names`: what is in the scene, by a vocabulary.

use crate::memory::{self, SMALLER, Sizes};
use crate::options::NamesOptions;
use artifacts::{Health, InstanceNames, Instances, Naming, called, role};
use gs_io::{Claim, Error, Result};
use query::{LabelledScene, TextSource, Vocabulary, name_instances};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::fmt::Write;

pub(crate) fn run(o: &NamesOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let out = o.out.clone().unwrap_or_else(|| InstanceNames::path_beside(&o.instances));
    let reads = [&o.instances, &o.geometry].into_iter().chain(&o.edits).chain(&o.texts.text_features);
    let claim = stage.outputs(&out).file(&out).reads(reads.chain(&o.vocabulary)).claim()?;
    let given = o.vocabulary.as_deref().map(|file| Vocabulary::read(file, 2)).transpose()?;
    stage.forecast(memory::of_query(&Sizes::new(&o.geometry, &o.texts, &[])), SMALLER)?;
    let scene = LabelledScene::read(&o.instances, &o.geometry, o.edits.as_deref())?;
    let by_masks = Health::of(&scene.artifact)?.map_or(Vec::new(), |health| health.names);
    let named_masks = scene.artifact.provenance().inputs.contains_key(role::MASK_NAMES);
    if !o.texts.given() && !named_masks {
        return Err(Error::new("nothing to compare names with")
            .field("--clip")
            .expected("--clip or --text-features, or masks with names")
            .hint("give the CLIP model that encoded the masks"));
    }
    if !o.texts.given() {
        if given.is_some() {
            stage.skipped("--vocabulary: without a text encoder only masks give names");
        }
        return finish(o, InstanceNames::by_masks(by_masks, scene.artifact.hash()), &scene, parameters, claim, stage);
    }
    let source = TextSource::open_for(&scene.artifact, scene.instances.dim(), &o.texts)?;
    let vocabulary = match (given, &source) {
        (Some(given), _) => given,
        (None, TextSource::Clip(_)) => Vocabulary::everyday(),
        (None, TextSource::Table(_)) => {
            let table = o.texts.text_features.as_deref().unwrap_or(&o.instances);
            Vocabulary::of_table(source.names()).map_err(|e| e.file(table))?
        }
    };
    if vocabulary.repeated > 0 {
        stage.warn(&format!("lines of the vocabulary that name something again are left out: {}", vocabulary.repeated));
    }
    let features = vocabulary.encode(&source, &o.templates.all(), "--vocabulary")?;
    // The names are of the instances as they were clustered: edits come and go.
    let before = o.edits.as_ref().map(|_| Instances::read(&o.instances)).transpose()?;
    let clustered = before.as_ref().map_or(&scene.instances, |(instances, _)| instances);
    let (mut named, by_chance) = name_instances(clustered, &vocabulary, &features, o.texts.min_support.unwrap_or(1));
    // A model that knows its classes is right more often than the nearest text.
    let sure: BTreeMap<u32, Naming> = by_masks.into_iter().filter(|n| n.sure).map(|n| (n.instance, n)).collect();
    named.retain(|n| !sure.contains_key(&n.instance));
    named.extend(sure.into_values());
    named.sort_by_key(|n| n.instance);
    let names = InstanceNames {
        format: InstanceNames::FORMAT.into(),
        version: InstanceNames::VERSION,
        instances: scene.artifact.hash().into(),
        source: source.describe(),
        model: source.hash()?,
        vocabulary: vocabulary.hash(),
        words: vocabulary.words.len(),
        by_chance,
        named,
    };
    finish(o, names, &scene, parameters, claim, stage)
}

/// Writes the names, and says what they are.
fn finish(
    o: &NamesOptions,
    names: InstanceNames,
    scene: &LabelledScene,
    parameters: Value,
    mut claim: Claim,
    stage: &Stage,
) -> Result<String> {
    let out = o.out.clone().unwrap_or_else(|| InstanceNames::path_beside(&o.instances));
    if names.named.is_empty() {
        stage.warn("no instance has a descriptor or a mask with a name: nothing is named");
    }
    names.write(&out)?;
    let sure = names.named.iter().filter(|n| n.sure).count();
    let summary =
        json!({"instances": scene.instances.len(), "named": names.named.len(), "sure": sure, "words": names.words});
    stage.record(&mut claim, parameters, scene.inputs.clone(), summary)?;
    stage.info(&format!("wrote {}", out.display()));
    Ok(table(&names, scene))
}

/// How often a name is given: surely, and as a guess.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Count {
    pub(crate) name: String,
    pub(crate) sure: usize,
    pub(crate) unsure: usize,
}

impl Count {
    /// "4", or "4 (1 unsure)".
    pub(crate) fn describe(&self) -> String {
        let all = self.sure + self.unsure;
        if self.unsure > 0 { format!("{all} ({} unsure)", self.unsure) } else { all.to_string() }
    }
}

/// How many of each there are, most first; of equals those that are sure, then by name.
pub(crate) fn counts(all: impl IntoIterator<Item = (String, bool)>) -> Vec<Count> {
    let mut counted = BTreeMap::<String, Count>::new();
    for (name, sure) in all {
        let count = counted.entry(name.clone()).or_insert(Count { name, sure: 0, unsure: 0 });
        *if sure { &mut count.sure } else { &mut count.unsure } += 1;
    }
    let mut counts: Vec<Count> = counted.into_values().collect();
    counts.sort_by(|a, b| (b.sure + b.unsure, b.sure).cmp(&(a.sure + a.unsure, a.sure)).then(a.name.cmp(&b.name)));
    counts
}

/// What is there for the terminal: how many of each, then every instance.
fn table(names: &InstanceNames, scene: &LabelledScene) -> String {
    let there = |k: u32| scene.instances.count.get(k as usize).is_some_and(|&n| n > 0);
    let called: Vec<_> = called(Some(names), &scene.remarks).into_iter().filter(|(k, _)| there(*k)).collect();
    let mut s = String::new();
    let _ = writeln!(s, "{} things by {} names ({})", called.len(), names.words, names.source);
    for count in counts(called.iter().map(|(_, c)| (c.name.clone(), c.sure))) {
        let _ = writeln!(s, "  {} x {}", count.name, count.describe());
    }
    let _ = writeln!(s, "  {:>8} {:>10} {:>7}  name", "instance", "Gaussians", "margin");
    for (k, c) in &called {
        let naming = names.named.iter().find(|n| n.instance == *k).filter(|_| !c.by_person);
        let margin = naming.map_or("-".into(), |n| format!("{:.4}", n.margin));
        let how = naming.map_or("  (a person said so)".into(), rest);
        let _ = writeln!(s, "  {k:>8} {:>10} {margin:>7}  {c}{how}", scene.instances.count[*k as usize]);
    }
    s
}

/// The score of the best name, and the others with theirs.
fn rest(naming: &Naming) -> String {
    let others = naming.names.iter().skip(1).map(|n| format!("{} {:.3}", n.name, n.score)).collect::<Vec<_>>();
    let score = naming.names.first().map_or(String::new(), |n| format!(" {:.3}", n.score));
    if others.is_empty() { score } else { format!("{score}, or {}", others.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_there_is_most_of_comes_first() {
        let all = [("mug", true), ("plate", true), ("plate", false), ("bowl", false), ("plate", true)];
        let counts = counts(all.map(|(name, sure)| (name.to_string(), sure)));
        let said: Vec<String> = counts.iter().map(|c| format!("{} x {}", c.name, c.describe())).collect();
        assert_eq!(said, ["plate x 3 (1 unsure)", "mug x 1", "bowl x 1 (1 unsure)"]);
    }
}
