//! `mask-embed tokenize`: token ids of the captions of synthetic scenes, for the training of the small encoder, so that
//! training and queries share one tokenizer.

use crate::args::TokenizeArgs;
use crate::finished::write_json;
use artifacts::{MaskTruth, TrueScene};
use gs_io::{Error, IoContext, Result};
use onnx_models::Tokenizer;
use serde_json::json;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// All folders called `truth` under `folder`, sorted.
fn truths(folder: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let mut inner = Vec::new();
    for entry in std::fs::read_dir(folder).at("list", folder)? {
        let path = entry.at("list", folder)?.path();
        if path.is_dir() && !path.is_symlink() {
            inner.push(path);
        }
    }
    inner.sort();
    for path in inner {
        if path.file_name().is_some_and(|n| n == "truth") {
            found.push(path);
        } else {
            truths(&path, found)?;
        }
    }
    Ok(())
}

/// Writes the ids of every caption, name, class and coloured class that the truths under a folder hold.
///
/// # Errors
/// When there is no truth, one cannot be read, or the output cannot be written.
pub fn run(args: &TokenizeArgs, stage: &Stage) -> Result<()> {
    let mut claim = stage.outputs(&args.out).file(&args.out).claim()?;
    let mut folders = Vec::new();
    truths(&args.truth, &mut folders)?;
    if folders.is_empty() {
        return Err(Error::new("no synthetic scene under this folder")
            .file(&args.truth)
            .expected("folders truth/ with scene.json and masks.json"));
    }
    let mut texts = BTreeSet::new();
    for folder in &folders {
        for object in TrueScene::read(folder.join("scene.json"))?.objects {
            texts.insert(format!("{} {}", object.color, object.class).trim().to_string());
            texts.extend([object.name, object.class]);
        }
        texts.extend(MaskTruth::read_all(folder.join("masks.json"))?.into_values().flatten().map(|m| m.caption));
    }
    let tokenizer = Tokenizer::new();
    let ids: BTreeMap<String, Vec<i32>> = texts
        .into_iter()
        .map(|text| {
            let mut ids = tokenizer.encode(&text, 77, -1);
            ids.retain(|&i| i >= 0 && i != Tokenizer::START && i != Tokenizer::END);
            (text, ids)
        })
        .collect();
    write_json(&args.out, &ids)?;
    stage.info(&format!("{} texts of {} scenes", ids.len(), folders.len()));
    stage.record(&mut claim, json!({}), BTreeMap::new(), json!({ "texts": ids.len() }))
}
