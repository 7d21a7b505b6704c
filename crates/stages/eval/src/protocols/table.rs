//! `eval table`: the metrics of several scenes in the paper's table.

use super::lerf::LerfFigures;
use super::metrics::{Metrics, Protocol, outputs, sheet};
use super::scannet::ScanFigures;
use crate::options::TableOptions;
use gs_io::{Error, IoContext, Result, write_bytes, write_json};
use report::sheet::Sheet;
use serde_json::Value;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub(crate) fn run(o: &TableOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let file = |given: &PathBuf| if given.is_dir() { given.join("metrics.json") } else { given.clone() };
    let paths: Vec<PathBuf> = o.scenes.iter().map(file).collect();
    let out = &o.out;
    let mut claim = outputs(out, stage).file(out.join("table.html")).reads(&paths).claim()?;
    let read = |path: &PathBuf| {
        let bytes = std::fs::read(path).at("read", path)?;
        serde_json::from_slice(&bytes).map_err(|e| not_metrics(path, Some(e)))
    };
    let files: Vec<Value> = paths.iter().map(read).collect::<Result<_>>()?;
    let lerf = files.first().is_some_and(|f| f["protocol"] == LerfFigures::NAME);
    let tabulate = if lerf { tabulate::<LerfFigures> } else { tabulate::<ScanFigures> };
    let (sheet, summary) = tabulate(&paths, files, stage)?;
    let mut json = summary.clone();
    json["tables"] = sheet.json();
    let table = sheet.markdown();
    write_bytes(out.join("table.md"), table.as_bytes())?;
    write_bytes(out.join("table.html"), sheet.html().as_bytes())?;
    write_json(out.join("metrics.json"), &json)?;
    stage.record(&mut claim, parameters, BTreeMap::new(), summary)?;
    Ok(table)
}

fn not_metrics(path: &Path, why: Option<serde_json::Error>) -> Error {
    let what = "not metrics of a protocol";
    let what = why.map_or(what.into(), |why| format!("{what}: {why}"));
    Error::new(what).file(path).field("protocol").hint("make it with eval lerf or eval scannet")
}

/// The table of scenes by one protocol, and its summary.
fn tabulate<F: Protocol>(paths: &[PathBuf], files: Vec<Value>, stage: &Stage) -> Result<(Sheet, Value)> {
    let mut scenes: Vec<Metrics<F>> = Vec::new();
    for (path, file) in paths.iter().zip(files) {
        if file["protocol"] != F::NAME {
            return Err(if [LerfFigures::NAME, ScanFigures::NAME].iter().any(|name| file["protocol"] == *name) {
                Error::new("scenes of two protocols").file(path).field("protocol").hint("make one table of each")
            } else {
                not_metrics(path, None).expected("lerf-ovs or scannet")
            });
        }
        let scene: Metrics<F> = serde_json::from_value(file).map_err(|e| not_metrics(path, Some(e)))?;
        if !scene.figures.is_sound() {
            return Err(Error::new("a confusion matrix does not fit its classes").file(path).field("sets"));
        }
        if scenes.iter().any(|s| s.scene == scene.scene) {
            return Err(Error::new("a scene is given twice").file(path).field("scene").found(scene.scene));
        }
        scenes.push(scene);
    }
    if scenes.iter().map(|s| &s.rule).collect::<BTreeSet<_>>().len() > 1 {
        stage.warn("the scenes were scored by different rules: their mean means little");
    }
    Ok((sheet(&scenes), F::summary(&scenes)))
}
