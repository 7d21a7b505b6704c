//! Text features that are kept beside the model: a list of texts is encoded once, not at every start of a program.

use crate::TextSource;
use gs_io::{Artifact, ArtifactWriter, Provenance, Result, hash_bytes};
use onnx_models::ClipText;
use std::path::PathBuf;

/// Format name in the file.
const FORMAT: &str = "texts";
/// Counts up whenever an encoder's texts come out otherwise, so that features of before are not taken.
const VERSION: u32 = 1;
/// Role of the hash of all that the features follow from.
const KEY: &str = "texts";

/// [`TextSource::encode_in`], but the features of a model are kept in its folder as `cags-texts-<hash>.safetensors`; a table is
/// looked up. The hash is of the model, its `clip.json`, the templates and the texts. A file that is damaged or of
/// something else is made again; where none can be written, the texts are encoded every time.
///
/// # Errors
/// When the encoder fails.
pub fn encode_cached(source: &TextSource, templates: &[String], texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
    let TextSource::Clip(clip) = source else { return source.encode_in(templates, texts) };
    let key = key(clip, templates, texts);
    let path = path(clip, &key);
    if let Some(kept) = read(&path, &key, texts.len(), clip.dimension()) {
        return Ok(kept.into_iter().map(Some).collect());
    }
    let features = source.encode_in(templates, texts)?;
    if let Some(rows) = features.iter().cloned().collect::<Option<Vec<Vec<f32>>>>() {
        let provenance = Provenance {
            format: FORMAT.into(),
            version: VERSION,
            program: concat!("query ", env!("CARGO_PKG_VERSION")).into(),
            inputs: [(KEY.into(), key)].into(),
            ..Provenance::default()
        };
        let values = rows.concat();
        let writer = ArtifactWriter::new(provenance);
        // A folder that cannot be written costs time, nothing else.
        let _ = writer.tensor("features", &[rows.len(), clip.dimension()], &values).write(path);
    }
    Ok(features)
}

/// Hash of all that the features follow from.
fn key(clip: &ClipText, templates: &[String], texts: &[String]) -> String {
    hash_bytes(serde_json::json!([clip.hash(), clip.config(), templates, texts]).to_string().as_bytes())
}

/// The file of a key, beside the model.
fn path(clip: &ClipText, key: &str) -> PathBuf {
    clip.path().with_file_name(format!("cags-texts-{key:.12}.safetensors"))
}

/// The features in the file, if they are those of the key.
fn read(path: &PathBuf, key: &str, texts: usize, dimension: usize) -> Option<Vec<Vec<f32>>> {
    let kept = Artifact::open(path, FORMAT, VERSION).ok()?;
    kept.expect_input(KEY, key).ok()?;
    let values = kept.tensor::<f32>("features", &[Some(texts), Some(dimension)]).ok()?;
    Some(values.chunks_exact(dimension).map(<[f32]>::to_vec).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use onnx_models::EngineOptions;
    use std::path::Path;

    /// A copy of the small CLIP.
    fn model() -> (tempfile::TempDir, TextSource) {
        let dir = tempfile::tempdir().unwrap();
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../testdata/clip-tiny/text.onnx");
        std::fs::copy(from, dir.path().join("text.onnx")).unwrap();
        let source = open(dir.path());
        (dir, source)
    }

    fn open(dir: &Path) -> TextSource {
        TextSource::Clip(Box::new(ClipText::open(dir, &EngineOptions::default()).unwrap()))
    }

    fn files(dir: &Path) -> Vec<PathBuf> {
        let kept = |p: &PathBuf| p.file_name().unwrap().to_string_lossy().starts_with("cags-texts-");
        let mut files: Vec<PathBuf> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).filter(kept).collect();
        files.sort();
        files
    }

    #[test]
    fn texts_are_encoded_once_and_read_the_same() {
        let (dir, source) = model();
        let texts = ["mug".to_string(), "green kettle".into()];
        let first = encode_cached(&source, &[], &texts).unwrap();
        assert_eq!(first, source.encode_in(&[], &texts).unwrap());
        let kept = files(dir.path());
        assert_eq!(kept.len(), 1);
        assert_eq!(encode_cached(&source, &[], &texts).unwrap(), first);
        // It is read, not made again.
        let provenance = Artifact::open(&kept[0], FORMAT, VERSION).unwrap().provenance().clone();
        let other = vec![0.5f32; 2 * source.dim()];
        ArtifactWriter::new(provenance).tensor("features", &[2, source.dim()], &other).write(&kept[0]).unwrap();
        assert_eq!(encode_cached(&source, &[], &texts).unwrap()[0].as_ref().unwrap()[0], 0.5);
        // A damaged one is made again.
        std::fs::write(&kept[0], "x").unwrap();
        assert_eq!(encode_cached(&source, &[], &texts).unwrap(), first);
        assert_eq!(encode_cached(&source, &[], &texts).unwrap(), first);
    }

    #[test]
    fn other_texts_templates_and_settings_have_files_of_their_own() {
        let (dir, source) = model();
        let of = |source: &TextSource, templates: &[&str], text: &str| {
            let templates: Vec<String> = templates.iter().map(|t| (*t).into()).collect();
            encode_cached(source, &templates, &[text.to_string()]).unwrap().remove(0).unwrap()
        };
        of(&source, &[], "mug");
        of(&source, &["a photo of a {}"], "mug");
        of(&source, &[], "bowl");
        assert_eq!(files(dir.path()).len(), 3);
        std::fs::write(dir.path().join("clip.json"), r#"{"name": "small"}"#).unwrap();
        of(&open(dir.path()), &[], "mug");
        assert_eq!(files(dir.path()).len(), 4);
    }

    #[test]
    fn a_folder_that_cannot_be_written_does_no_harm() {
        let (dir, source) = model();
        let texts = ["mug".to_string()];
        let right = source.encode_in(&[], &texts).unwrap();
        let TextSource::Clip(clip) = &source else { unreachable!() };
        // A folder stands where the file would be.
        std::fs::create_dir(path(clip, &key(clip, &[], &texts))).unwrap();
        assert_eq!(encode_cached(&source, &[], &texts).unwrap(), right);
        assert_eq!(files(dir.path()).len(), 1);
    }
}
