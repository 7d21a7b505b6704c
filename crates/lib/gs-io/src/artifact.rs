//! Artifacts: safetensors files that say what they are and what they were made from.
//!
//! All metadata is one JSON string under the single key `cags` of safetensors' `__metadata__`, because safetensors
//! writes several keys in an order that changes from run to run. It holds format, version, the program and its version,
//! the parameters that shaped the data, and the content hash of each input. Nothing in it depends on the time, the
//! machine, a path or the number of threads: same inputs, same parameters, same bytes.
//!
//! The first entry of that JSON is a checksum of the whole file, so that a flipped bit anywhere in it is noticed when it is
//! read, not taken for a feature: the BLAKE3 hash of the file with 64 zeros in the place of the checksum's digits.

use crate::{Error, IoContext, Result, write_atomic};
use safetensors::tensor::{Dtype, Metadata, TensorInfo};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

const KEY: &str = "cags";

/// Longest header in bytes: safetensors' own bound.
const MOST_HEADER: u64 = 100_000_000;
/// Bytes that are read at a time of a tensor that is left in the file.
const PIECE: usize = 1 << 20;

/// What the checksum is made over in its own place: it is the BLAKE3 hash of the file with these 64 zeros.
const NO_CHECKSUM: &str = "0000000000000000000000000000000000000000000000000000000000000000";
/// What stands before the checksum's digits in the file's header, where the JSON is a string within JSON.
const BEFORE_CHECKSUM: &[u8] = br#""{\"checksum\":\""#;

/// Where the checksum's digits lie in a header, if it has one.
fn checksum_at(header: &[u8]) -> Option<std::ops::Range<usize>> {
    let start = header.windows(BEFORE_CHECKSUM.len()).position(|w| w == BEFORE_CHECKSUM)? + BEFORE_CHECKSUM.len();
    let range = start..start + NO_CHECKSUM.len();
    (range.end <= header.len()).then_some(range)
}

/// The checksum of a file whose digits lie at `at`.
fn checksum(bytes: &[u8], at: &std::ops::Range<usize>) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes[..at.start]).update(NO_CHECKSUM.as_bytes()).update(&bytes[at.end..]);
    hasher.finalize().to_hex().to_string()
}

/// Puts the right checksum into the bytes of an artifact that were changed on purpose, for tests of what readers check
/// beyond it. Bytes without a place for a checksum stay as they are.
pub fn seal(bytes: &mut [u8]) {
    if let Some(at) = checksum_at(bytes) {
        let digits = checksum(bytes, &at);
        bytes[at].copy_from_slice(digits.as_bytes());
    }
}

/// What an artifact says of itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Kind of artifact, such as `footprints`.
    pub format: String,
    /// Version of that format; a reader refuses another one.
    pub version: u32,
    /// Program and version that wrote it, such as `graph-precompute 0.1.0`.
    pub program: String,
    /// Every parameter that shaped the data.
    pub parameters: serde_json::Value,
    /// Content hash of each input, by role (`geometry`, `masks`, …). Inputs of inputs are included, so that two
    /// artifacts of one scene can be recognised as such.
    pub inputs: BTreeMap<String, String>,
    /// Whatever else belongs to the format: names of views, scale of a scene.
    #[serde(default, skip_serializing_if = "serde_json::Value::is_null")]
    pub extra: serde_json::Value,
}

/// Collects tensors, then writes them atomically, without a copy of them.
pub struct ArtifactWriter<'a> {
    provenance: Provenance,
    tensors: BTreeMap<String, (Dtype, Vec<usize>, Source<'a>)>,
}

/// Where a tensor's bytes are until they are written.
enum Source<'a> {
    Memory(&'a [u8]),
    File(File),
}

/// Element types that artifacts hold.
pub trait Element: bytemuck::Pod {
    /// The safetensors dtype.
    const DTYPE: Dtype;
}
macro_rules! element {
    ($($t:ty => $d:ident),*) => { $(impl Element for $t { const DTYPE: Dtype = Dtype::$d; })* };
}
element!(f32 => F32, f64 => F64, u8 => U8, u16 => U16, u32 => U32, u64 => U64, i32 => I32, i64 => I64);

impl<'a> ArtifactWriter<'a> {
    /// An artifact without tensors yet.
    pub fn new(provenance: Provenance) -> Self {
        Self { provenance, tensors: BTreeMap::new() }
    }

    /// Adds a tensor; `shape` must fit `data`.
    ///
    /// # Panics
    /// When the product of `shape` is not the number of values: a programming error.
    #[must_use]
    pub fn tensor<T: Element>(mut self, name: &str, shape: &[usize], data: &'a [T]) -> Self {
        assert_eq!(shape.iter().product::<usize>(), data.len(), "shape of {name}");
        let bytes = Source::Memory(bytemuck::cast_slice(data));
        self.tensors.insert(name.into(), (T::DTYPE, shape.to_vec(), bytes));
        self
    }

    /// Adds a tensor whose elements lie in `file`, from its beginning on, in the machine's byte order: for tensors that
    /// should not be held in memory.
    #[must_use]
    pub fn tensor_from_file<T: Element>(mut self, name: &str, shape: &[usize], file: File) -> Self {
        self.tensors.insert(name.into(), (T::DTYPE, shape.to_vec(), Source::File(file)));
        self
    }

    /// Writes the file through a temporary name. The same content gives the same bytes.
    pub fn write(self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        let fail = |e: &dyn std::fmt::Display| Error::new(format!("cannot serialise: {e}")).file(path);
        let json = serde_json::to_string(&self.provenance).map_err(|e| fail(&e))?;
        let json = format!("{{\"checksum\":\"{NO_CHECKSUM}\",{}", &json[1..]);
        // The format's order: larger elements first, so that all are aligned; then by name.
        let mut tensors: Vec<_> = self.tensors.into_iter().collect();
        tensors.sort_by(|(a, (x, ..)), (b, (y, ..))| y.cmp(x).then_with(|| a.cmp(b)));
        let (mut infos, mut offset) = (Vec::with_capacity(tensors.len()), 0);
        for (name, (dtype, shape, source)) in &tensors {
            let count: usize = shape.iter().product();
            let bytes = count * dtype.bitsize() / 8;
            let there = match source {
                Source::Memory(v) => v.len() as u64,
                Source::File(f) => f.metadata().at("read the scratch file of", path)?.len(),
            };
            if there != bytes as u64 {
                return Err(fail(&format!("{name} has {there} bytes, not {bytes}")));
            }
            let info = TensorInfo { dtype: *dtype, shape: shape.clone(), data_offsets: (offset, offset + bytes) };
            infos.push((name.clone(), info));
            offset += bytes;
        }
        let metadata = Metadata::new(Some(HashMap::from([(KEY.to_string(), json)])), infos).map_err(|e| fail(&e))?;
        let mut header = serde_json::to_vec(&metadata).map_err(|e| fail(&e))?;
        header.resize(header.len().next_multiple_of(8), b' ');
        let mut hasher = blake3::Hasher::new();
        hasher.update(&(header.len() as u64).to_le_bytes()).update(&header);
        for (_, (_, _, source)) in &mut tensors {
            match source {
                Source::Memory(bytes) => _ = hasher.update(bytes),
                Source::File(file) => {
                    file.seek(SeekFrom::Start(0)).at("read the scratch file of", path)?;
                    hasher.update_reader(file).at("read the scratch file of", path)?;
                }
            }
        }
        let digits = checksum_at(&header).ok_or_else(|| fail(&"no place for the checksum"))?;
        header[digits].copy_from_slice(hasher.finalize().to_hex().as_bytes());
        write_atomic(path, |out| {
            out.write_all(&(header.len() as u64).to_le_bytes()).at("write", path)?;
            out.write_all(&header).at("write", path)?;
            for (_, (_, _, source)) in tensors {
                match source {
                    Source::Memory(bytes) => out.write_all(bytes).at("write", path)?,
                    Source::File(mut file) => {
                        file.seek(SeekFrom::Start(0)).at("read the scratch file of", path)?;
                        std::io::copy(&mut file, &mut *out).at("write", path)?;
                    }
                }
            }
            Ok(())
        })
    }
}

/// An artifact, read and checked. It is held in memory, not mapped: a program that writes into the file or cuts it short
/// while a stage works on it would change numbers that were checked, or end the stage by a signal. Large tensors may be left
/// in the file, to be read in parts.
#[derive(Debug)]
pub struct Artifact {
    path: PathBuf,
    tensors: BTreeMap<String, Tensor>,
    provenance: Provenance,
    hash: String,
    file: Mutex<File>,
}

#[derive(Debug)]
struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    /// Where its bytes lie in the file.
    bytes: std::ops::Range<u64>,
    /// Its bytes, in words so that they are aligned; the last may be longer. None where they were left in the file.
    words: Option<Vec<u64>>,
}

impl Artifact {
    /// Opens `path` and checks that it is an artifact of this `format` and `version`.
    pub fn open(path: impl AsRef<Path>, format: &str, version: u32) -> Result<Self> {
        Self::open_leaving(path, format, version, &[])
    }

    /// [`Artifact::open`], but the tensors `left` are only checked, and stay in the file: [`Artifact::read`] reads them in parts.
    pub fn open_leaving(path: impl AsRef<Path>, format: &str, version: u32, left: &[&str]) -> Result<Self> {
        let path = path.as_ref();
        let mut file = File::open(path).at("open", path)?;
        let length = file.metadata().at("read", path)?.len();
        if length == 0 {
            return Err(Error::new("the file is empty").file(path).hint("run the stage that makes it again"));
        }
        let damaged = |e: &dyn std::fmt::Display| {
            Error::new(format!("not a safetensors artifact: {e}")).file(path).hint("run the stage that makes it again")
        };
        let header = header_of(&mut file).map_err(|e| damaged(&e))?;
        let metadata: Metadata = serde_json::from_slice(&header[8..]).map_err(|e| damaged(&e))?;
        let tensors =
            layout(&metadata, header.len() as u64, length).map_err(|(name, why)| damaged(&why).field(name))?;
        let json = metadata.metadata().as_ref().and_then(|m| m.get(KEY)).ok_or_else(|| {
            Error::new("no provenance: not written by this program").file(path).field(format!("__metadata__.{KEY}"))
        })?;
        let provenance = provenance_of(json).map_err(|e| damaged(&e).field(format!("__metadata__.{KEY}")))?;
        if provenance.format != format || provenance.version != version {
            return Err(Error::new("another kind of artifact")
                .file(path)
                .field("format")
                .found(format!("{} version {}", provenance.format, provenance.version))
                .expected(format!("{format} version {version}"))
                .hint("check the order of the arguments, or run the stage that makes it again"));
        }
        let at = checksum_at(&header).ok_or_else(|| damaged(&"it has no checksum"))?;
        let (mut whole, mut zeroed) = (blake3::Hasher::new(), blake3::Hasher::new());
        whole.update(&header);
        zeroed.update(&header[..at.start]).update(NO_CHECKSUM.as_bytes()).update(&header[at.end..]);
        let mut take = |bytes: &[u8]| {
            whole.update(bytes);
            zeroed.update(bytes);
        };
        let mut read = BTreeMap::new();
        for (name, mut tensor) in tensors {
            let count = (tensor.bytes.end - tensor.bytes.start) as usize;
            if left.contains(&name.as_str()) {
                let mut piece = vec![0u8; count.min(PIECE)];
                for from in (0..count).step_by(PIECE) {
                    let piece = &mut piece[..PIECE.min(count - from)];
                    file.read_exact(piece).at("read", path)?;
                    take(piece);
                }
            } else {
                let mut words = vec![0u64; count.div_ceil(8)];
                let bytes = &mut bytemuck::cast_slice_mut(&mut words)[..count];
                file.read_exact(bytes).at("read", path)?;
                take(bytes);
                tensor.words = Some(words);
            }
            read.insert(name, tensor);
        }
        if zeroed.finalize().to_hex().as_bytes() != &header[at] {
            return Err(Error::new("the file is damaged: its content does not have its checksum")
                .file(path)
                .field("checksum")
                .hint("copy it again, or delete it and run the stage that makes it"));
        }
        let hash = whole.finalize().to_hex().to_string();
        Ok(Self { path: path.to_path_buf(), tensors: read, provenance, hash, file: Mutex::new(file) })
    }

    /// What the artifact says of itself.
    pub fn provenance(&self) -> &Provenance {
        &self.provenance
    }

    /// Content hash of the file.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Where it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether there is a tensor `name`.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    fn expect<T: Element>(&self, name: &str, shape: &[Option<usize>]) -> Result<&Tensor> {
        let tensor = self.tensors.get(name).ok_or_else(|| self.fail("missing tensor", name))?;
        let fits =
            tensor.shape.len() == shape.len() && tensor.shape.iter().zip(shape).all(|(&s, e)| e.is_none_or(|e| e == s));
        if tensor.dtype != T::DTYPE || !fits {
            let want: Vec<String> = shape.iter().map(|e| e.map_or("any".into(), |e| e.to_string())).collect();
            return Err(self
                .fail("another tensor than expected", name)
                .found(format!("{:?} {:?}", tensor.dtype, tensor.shape))
                .expected(format!("{:?} [{}]", T::DTYPE, want.join(", "))));
        }
        Ok(tensor)
    }

    fn fail(&self, what: &str, name: &str) -> Error {
        Error::new(what).file(&self.path).field(name).hint("run the stage that makes it again")
    }

    /// The tensor `name`, without a copy. `shape` gives the expected extents, `None` where any will do.
    ///
    /// # Panics
    /// When it was left in the file.
    pub fn tensor<T: Element>(&self, name: &str, shape: &[Option<usize>]) -> Result<&[T]> {
        let tensor = self.expect::<T>(name, shape)?;
        let words = tensor.words.as_ref().expect("not left in the file");
        Ok(&bytemuck::cast_slice(words)[..tensor.shape.iter().product()])
    }

    /// The extents of tensor `name`, left in the file or not. `shape` gives those expected, `None` where any will do.
    pub fn extents<T: Element>(&self, name: &str, shape: &[Option<usize>]) -> Result<&[usize]> {
        Ok(&self.expect::<T>(name, shape)?.shape)
    }

    /// Some values of `name` from the file, by their places in it. They were checked when it was opened, but not now: somebody may have
    /// written into the file since.
    ///
    /// # Errors
    /// When the file can no longer be read.
    ///
    /// # Panics
    /// When the tensor is of another type, or shorter.
    pub fn read<T: Element>(&self, name: &str, values: std::ops::Range<usize>) -> Result<Vec<T>> {
        let tensor = self.tensors.get(name).ok_or_else(|| self.fail("missing tensor", name))?;
        let there = tensor.dtype == T::DTYPE && values.end <= tensor.shape.iter().product();
        assert!(there, "values {values:?} of {name}");
        let mut out = vec![T::zeroed(); values.len()];
        let mut file = self.file.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let from = tensor.bytes.start + (values.start * size_of::<T>()) as u64;
        file.seek(SeekFrom::Start(from)).at("read", &self.path)?;
        file.read_exact(bytemuck::cast_slice_mut(&mut out)).at("read", &self.path)?;
        Ok(out)
    }

    /// Checks that this artifact was made from the input of the given role with this hash.
    pub fn expect_input(&self, role: &str, hash: &str) -> Result<()> {
        match self.provenance.inputs.get(role) {
            Some(h) if h == hash => Ok(()),
            other => Err(Error::new(format!("made from another {role} than the one given"))
                .file(&self.path)
                .field(format!("inputs.{role}"))
                .found(other.map_or("none", |h| short(h)))
                .expected(short(hash))
                .hint("artifacts of different scenes or runs do not mix: give those of one run, or run make again")),
        }
    }
}

/// The length of the header as 8 bytes, and the header.
fn header_of(file: &mut File) -> std::io::Result<Vec<u8>> {
    let mut header = vec![0; 8];
    file.read_exact(&mut header)?;
    let length = u64::from_le_bytes(header[..].try_into().expect("8 bytes"));
    if length > MOST_HEADER || file.take(length).read_to_end(&mut header)? as u64 != length {
        return Err(std::io::Error::other("the header is longer than the file"));
    }
    Ok(header)
}

/// The tensors in the order of their bytes, which must fill the file from `start` to `length`; else the one at fault, and why.
fn layout(
    metadata: &Metadata,
    start: u64,
    length: u64,
) -> std::result::Result<Vec<(String, Tensor)>, (String, String)> {
    // A tensor without elements takes no room whatever its other extents say; nothing real is wider than this.
    let widest = length.max(1 << 16);
    let mut out = Vec::new();
    let mut at = start;
    for name in metadata.offset_keys() {
        let info = metadata.info(&name).expect("a name of its own");
        let wrong = |why: &str| (name.clone(), why.to_string());
        if info.shape.iter().any(|&extent| extent as u64 > widest) {
            return Err(wrong("an extent is out of proportion to the file"));
        }
        let count = info.shape.iter().try_fold(info.dtype.bitsize() as u64 / 8, |n, &e| n.checked_mul(e as u64));
        let (from, to) = info.data_offsets;
        let end = count.and_then(|n| at.checked_add(n)).filter(|end| *end <= length);
        let end = end.ok_or_else(|| wrong("its extents exceed the file"))?;
        if [from, to].map(|offset| start.checked_add(offset as u64)) != [Some(at), Some(end)] {
            return Err(wrong("its bytes are not where they should be"));
        }
        out.push((name, Tensor { dtype: info.dtype, shape: info.shape.clone(), bytes: at..end, words: None }));
        at = end;
    }
    if at == length { Ok(out) } else { Err(("length".into(), "the file does not end with its last tensor".into())) }
}

/// The format of the artifact at `path`, by its header alone; None where it is not an artifact.
pub(crate) fn format_of(path: &Path) -> Option<String> {
    let header = header_of(&mut File::open(path).ok()?).ok()?;
    let metadata: Metadata = serde_json::from_slice(&header[8..]).ok()?;
    Some(provenance_of(metadata.metadata().as_ref()?.get(KEY)?).ok()?.format)
}

/// Reads what an artifact says of itself, but for the checksum. Nothing else may be in it: a flipped bit in the name of the
/// checksum would hide it, and with it every other one.
fn provenance_of(json: &str) -> serde_json::Result<Provenance> {
    let mut entries: serde_json::Map<String, serde_json::Value> = serde_json::from_str(json)?;
    entries.remove("checksum");
    serde_json::from_value(entries.into())
}

fn short(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    fn sample() -> ArtifactWriter<'static> {
        let provenance = Provenance {
            format: "sample".into(),
            version: 1,
            program: "test 0".into(),
            parameters: serde_json::json!({"k": 16}),
            inputs: BTreeMap::from([("geometry".into(), "ab".repeat(32)), ("masks".into(), "cd".repeat(32))]),
            extra: serde_json::Value::Null,
        };
        ArtifactWriter::new(provenance).tensor("a", &[2, 2], &[1f32, 2.0, 3.0, 4.0]).tensor("b", &[3], &[1u8, 2, 3])
    }

    #[test]
    fn same_content_same_bytes_and_reads_back() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.safetensors");
        sample().write(&p).unwrap();
        let first = std::fs::read(&p).unwrap();
        sample().write(&p).unwrap();
        assert_eq!(first, std::fs::read(&p).unwrap());
        let a = Artifact::open(&p, "sample", 1).unwrap();
        assert_eq!(a.tensor::<f32>("a", &[Some(2), None]).unwrap(), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(a.tensor::<u8>("b", &[None]).unwrap(), [1, 2, 3]);
        assert!(a.expect_input("geometry", &"ab".repeat(32)).is_ok());
        let e = a.expect_input("geometry", &"00".repeat(32)).unwrap_err().to_string();
        assert!(e.contains("made from another geometry") && e.contains("abababababab"), "{e}");
        let left = Artifact::open_leaving(&p, "sample", 1, &["b"]).unwrap();
        assert_eq!(
            (left.extents::<u8>("b", &[None]).unwrap()[0], left.read::<u8>("b", 1..3).unwrap()),
            (3, vec![2, 3])
        );
        assert_eq!((left.hash(), left.tensor::<f32>("a", &[None, None]).unwrap()[3]), (a.hash(), 4.0));
        let e = a.tensor::<u32>("a", &[None]).unwrap_err().to_string();
        assert!(e.contains("found F32 [2, 2], expected U32 [any]"), "{e}");
        assert!(Artifact::open(&p, "graph", 1).is_err());
    }

    #[test]
    fn a_file_without_a_checksum_or_with_another_one_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.safetensors");
        let metadata = HashMap::from([(KEY.to_string(), serde_json::to_string(&sample().provenance).unwrap())]);
        let tensors: [(&str, safetensors::tensor::TensorView<'_>); 0] = [];
        std::fs::write(&p, safetensors::serialize(tensors, Some(metadata)).unwrap()).unwrap();
        let e = Artifact::open(&p, "sample", 1).unwrap_err().to_string();
        assert!(e.contains("it has no checksum"), "{e}");
        sample().write(&p).unwrap();
        let mut bytes = std::fs::read(&p).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&p, &bytes).unwrap();
        let e = Artifact::open(&p, "sample", 1).unwrap_err().to_string();
        assert!(e.contains("a.safetensors: checksum: the file is damaged"), "{e}");
        seal(&mut bytes);
        std::fs::write(&p, &bytes).unwrap();
        assert_eq!(Artifact::open(&p, "sample", 1).unwrap().tensor::<u8>("b", &[None]).unwrap(), [1, 2, 2]);
    }

    #[test]
    fn an_empty_tensor_of_an_absurd_width_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.safetensors");
        sample().tensor::<f32>("c", &[0, 1 << 40], &[]).write(&p).unwrap();
        let e = Artifact::open(&p, "sample", 1).unwrap_err().to_string();
        assert!(e.contains("c: not a safetensors artifact: an extent"), "{e}");
    }

    #[test]
    fn files_are_those_of_safetensors_itself_and_tensors_may_come_from_files() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.safetensors");
        let values = [0.5f64, 2.0, -1.0];
        let scratch = |bytes: &[u8]| {
            let path = dir.path().join("scratch");
            std::fs::write(&path, bytes).unwrap();
            File::open(path).unwrap()
        };
        sample().tensor_from_file::<f64>("c", &[3], scratch(bytemuck::cast_slice(&values))).write(&p).unwrap();
        let found = std::fs::read(&p).unwrap();
        let (_, metadata) = SafeTensors::read_metadata(&found).unwrap();
        let views: Vec<_> = SafeTensors::deserialize(&found).unwrap().tensors();
        assert_eq!(views.len(), 3);
        assert!(found == safetensors::serialize(views, metadata.metadata().clone()).unwrap());
        assert_eq!(Artifact::open(&p, "sample", 1).unwrap().tensor::<f64>("c", &[Some(3)]).unwrap(), values);
        let short = sample().tensor_from_file::<f64>("c", &[3], scratch(&[0; 23])).write(&p).unwrap_err().to_string();
        assert!(short.contains("c has 23 bytes, not 24"), "{short}");
        assert!(found == std::fs::read(&p).unwrap());
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.safetensors");
        sample().write(&p).unwrap();
        let mut bytes = std::fs::read(&p).unwrap();
        let opens = |bytes: &[u8]| {
            std::fs::write(&p, bytes).unwrap();
            let left = Artifact::open_leaving(&p, "sample", 1, &["a"]).is_ok();
            assert_eq!(Artifact::open(&p, "sample", 1).is_ok(), left);
            left
        };
        for bit in 0..8 * bytes.len() {
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(!opens(&bytes), "bit {bit}");
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        assert!(opens(&bytes) && (0..bytes.len()).all(|length| !opens(&bytes[..length])));
    }
}
