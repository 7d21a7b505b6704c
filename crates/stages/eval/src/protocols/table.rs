//! `eval table`: the metrics of several scenes in the paper's table.

use super::classes::SETS;
use super::lerf::{self, LerfMetrics, outputs};
use super::pairs::Figures;
use super::published::SetRow;
use super::scannet::{self, ScanMetrics, SetFigures};
use crate::options::TableOptions;
use gs_io::{Error, IoContext, Result, write_bytes, write_json};
use report::sheet::Sheet;
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The metrics of scenes, by their protocol.
#[derive(Default)]
struct Scenes {
    lerfs: Vec<LerfMetrics>,
    scans: Vec<ScanMetrics>,
}

pub(crate) fn run(o: &TableOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let file = |given: &PathBuf| if given.is_dir() { given.join("metrics.json") } else { given.clone() };
    let paths: Vec<PathBuf> = o.scenes.iter().map(file).collect();
    let out = &o.out.out;
    let mut claim = outputs(out, stage).file(out.join("table.html")).reads(&paths).claim()?;
    let scenes = Scenes::read(&paths)?;
    if scenes.rules().len() > 1 {
        stage.warn("the scenes were scored by different rules: their mean means little");
    }
    let (sheet, summary) = if scenes.scans.is_empty() { of_lerfs(&scenes.lerfs) } else { of_scans(&scenes.scans) };
    let mut json = summary.clone();
    json["tables"] = sheet.json();
    let table = sheet.markdown();
    write_bytes(out.join("table.md"), table.as_bytes())?;
    write_bytes(out.join("table.html"), sheet.html().as_bytes())?;
    write_json(out.join("metrics.json"), &json)?;
    stage.record(&mut claim, parameters, BTreeMap::new(), summary)?;
    Ok(table)
}

impl Scenes {
    fn read(paths: &[PathBuf]) -> Result<Self> {
        let mut all = Self::default();
        let mut names = BTreeSet::new();
        for path in paths {
            let scene = all.add(path)?;
            if !names.insert(scene.clone()) {
                return Err(Error::new("a scene is given twice").file(path).field("scene").found(scene));
            }
        }
        if !all.lerfs.is_empty() && !all.scans.is_empty() {
            return Err(Error::new("scenes of two protocols").field("DIR").hint("make one table of each"));
        }
        Ok(all)
    }

    /// Reads the metrics of a scene; gives its name.
    fn add(&mut self, path: &Path) -> Result<String> {
        let hint = "make it with eval lerf or eval scannet";
        let bad = |e: serde_json::Error| Error::new(format!("not metrics of a protocol: {e}")).file(path).hint(hint);
        let bytes = std::fs::read(path).at("read", path)?;
        let value: Value = serde_json::from_slice(&bytes).map_err(bad)?;
        match value["protocol"].as_str() {
            Some(LerfMetrics::PROTOCOL) => {
                let m: LerfMetrics = serde_json::from_value(value).map_err(bad)?;
                let scene = m.scene.clone();
                self.lerfs.push(m);
                Ok(scene)
            }
            Some(ScanMetrics::PROTOCOL) => {
                let m: ScanMetrics = serde_json::from_value(value).map_err(bad)?;
                let sound = |s: &SetFigures| s.confusion.classes == s.size && s.confusion.is_sound();
                if !m.sets.iter().all(|s| SETS.contains(&s.size) && sound(s)) {
                    return Err(Error::new("a confusion matrix does not fit its classes").file(path).field("sets"));
                }
                let scene = m.scene.clone();
                self.scans.push(m);
                Ok(scene)
            }
            _ => {
                let e = Error::new("not metrics of a protocol").file(path).field("protocol");
                Err(e.expected("lerf-ovs or scannet").hint(hint))
            }
        }
    }

    fn rules(&self) -> BTreeSet<&str> {
        self.lerfs.iter().map(|m| m.rule.as_str()).chain(self.scans.iter().map(|m| m.rule.as_str())).collect()
    }
}

fn of_lerfs(scenes: &[LerfMetrics]) -> (Sheet, Value) {
    let over = |f: fn(&LerfMetrics) -> Figures| Figures::mean(&scenes.iter().map(f).collect::<Vec<_>>());
    let named: BTreeMap<&str, _> = scenes.iter().map(|m| (m.scene.as_str(), m.figures)).collect();
    let json = json!({
        "protocol": "lerf-ovs dataset", "figures": over(|m| m.figures), "frame_figures": over(|m| m.frame_figures),
        "scenes": named,
    });
    (lerf::sheet(scenes), json)
}

fn of_scans(scans: &[ScanMetrics]) -> (Sheet, Value) {
    let [mean, pooled] = scannet::summary(scans).map(|(_, row)| row);
    let sized = |row: SetRow| -> Value {
        let cell = |r: Option<(f64, f64)>| json!({"miou": r.map(|r| r.0), "macc": r.map(|r| r.1)});
        Value::Object(SETS.iter().zip(row).map(|(size, r)| (size.to_string(), cell(r))).collect())
    };
    let scenes: Vec<&str> = scans.iter().map(|m| m.scene.as_str()).collect();
    let json = json!({
        "protocol": "scannet dataset", "scenes": scenes, "mean_over_scenes": sized(mean), "pooled": sized(pooled),
    });
    (scannet::sheet(scans), json)
}
