//! What every engine offers: open a model, ask for its inputs and outputs, run it.

use crate::{Graph, Tensor, ort_engine, rten_engine};
use gs_io::{Error, IoContext, Result, hash_files};
use serde::{Serialize, Serializer};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Which engine runs the models, as every program asks for it.
#[derive(Debug, Clone, Default, clap::Args, Serialize)]
pub struct EngineArgs {
    /// Run the models with ONNX Runtime instead of the built-in engine: path of libonnxruntime.so, version 1.20 or later.
    /// Needs ORT_DISABLE_TELEMETRY=1 in the environment [default: the built-in engine, rten]
    #[arg(long, value_name = "LIBRARY")]
    #[serde(rename = "engine", serialize_with = "engine_name")]
    pub onnx_runtime: Option<PathBuf>,
}

#[allow(clippy::ref_option, reason = "serde asks for this type")]
fn engine_name<S: Serializer>(library: &Option<PathBuf>, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.serialize_str(if library.is_some() { "onnxruntime" } else { "rten" })
}

impl EngineArgs {
    /// Options for [`open`], for models of which several runs go on at a time.
    pub fn options(&self) -> EngineOptions {
        EngineOptions { onnx_runtime: self.onnx_runtime.clone(), threads_per_run: 1 }
    }
}

/// Which engine runs the models, and on how many threads.
#[derive(Debug, Clone, Default)]
pub struct EngineOptions {
    /// Path of ONNX Runtime's shared library (`libonnxruntime.so`, version 1.20 or later); rten runs the model when
    /// there is none.
    ///
    /// ONNX Runtime 1.29 and later send usage data unless the environment holds `ORT_DISABLE_TELEMETRY=1`, and no call
    /// comes early enough to stop them; so the library is not loaded without that variable.
    pub onnx_runtime: Option<PathBuf>,
    /// Threads of one [`Model::run`] with rten: 1 for models that [`parallel_map`] runs several at a time, 0 for those
    /// of rayon's pool that the run is called in. ONNX Runtime always uses all, one run after another.
    pub threads_per_run: usize,
}

/// Which values of the graph a model gives.
#[derive(Debug, Clone, Copy)]
pub enum Outputs<'a> {
    /// Those that the file declares as outputs.
    Declared,
    /// These, in this order; any value of the graph will do, and nothing that they do not need is computed.
    Values(&'a [&'a str]),
}

/// Element type of a tensor. Engines differ in integer width (rten has 32 bits only), so widths are converted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 32-bit floats.
    Float,
    /// Integers of 32 or 64 bits; 8-bit numbers from 0; truth values, as 0 and 1.
    Integer,
    /// Anything else.
    Other,
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Float => "floats",
            Self::Integer => "integers",
            Self::Other => "another type",
        })
    }
}

/// What a model declares about an input or output.
#[derive(Debug, Clone, PartialEq)]
pub struct ValueInfo {
    /// Its name.
    pub name: String,
    /// Extents; `None` where they are free. `None` altogether when the model does not say.
    pub shape: Option<Vec<Option<usize>>>,
    /// Its element type, if the model declares it.
    pub kind: Option<Kind>,
}

impl ValueInfo {
    /// The extent of `axis` where the model fixes it.
    pub fn fixed(&self, axis: usize) -> Option<usize> {
        self.shape.as_ref()?.get(axis)?.filter(|&n| n > 0)
    }

    fn shape_text(&self) -> String {
        let dims = self.shape.iter().flatten().map(|d| d.map_or("any".into(), |d| d.to_string()));
        format!("[{}]", dims.collect::<Vec<String>>().join(", "))
    }
}

/// An opened model. Runs may be started from several threads at once.
pub trait Model: Send + Sync {
    /// Where it was read from.
    fn path(&self) -> &Path;

    /// Its inputs.
    fn inputs(&self) -> &[ValueInfo];

    /// Its outputs, in the order in which [`Model::run`] gives them.
    fn outputs(&self) -> &[ValueInfo];

    /// Runs inputs that [`Model::run`] has checked.
    ///
    /// # Errors
    /// When the engine fails.
    fn run_checked(&self, inputs: &[(&str, Tensor)]) -> Result<Vec<Tensor<'static>>>;

    /// Runs the model on named inputs.
    ///
    /// # Errors
    /// When an input is missing, unknown, of another type or shape than the model declares, or when the engine fails.
    fn run(&self, inputs: &[(&str, Tensor)]) -> Result<Vec<Tensor<'static>>> {
        check_inputs(self.path(), self.inputs(), inputs)?;
        self.run_checked(inputs)
    }
}

fn check_inputs(path: &Path, declared: &[ValueInfo], given: &[(&str, Tensor)]) -> Result<()> {
    let names = || declared.iter().map(|d| d.name.as_str()).collect::<Vec<_>>().join(", ");
    let wrong = |what: &str, name: &str| {
        let hint = "this is not the kind of model asked for";
        Error::new(what).file(path).field(format!("input {name}")).hint(hint)
    };
    for (name, tensor) in given {
        let Some(d) = declared.iter().find(|d| d.name == *name) else {
            return Err(wrong("the model has no such input", name).expected(format!("one of {}", names())));
        };
        if tensor.shape.iter().product::<usize>() != tensor.len() {
            return Err(Error::new("the number of values does not fit the shape")
                .file(path)
                .field(format!("input {name}"))
                .found(format!("{} values", tensor.len()))
                .expected(format!("{:?}", tensor.shape)));
        }
        if let Some(kind) = d.kind
            && kind != tensor.kind()
        {
            return Err(wrong("the input is of another type", name).found(kind).expected(tensor.kind()));
        }
        let fits = d.shape.as_ref().is_none_or(|s| {
            s.len() == tensor.shape.len() && s.iter().zip(&tensor.shape).all(|(d, &n)| d.is_none_or(|d| d == n))
        });
        if !fits {
            let found = format!("{} in the model", d.shape_text());
            return Err(wrong("the input has another shape", name)
                .found(found)
                .expected(format!("{:?}", tensor.shape)));
        }
    }
    let unknown = declared.iter().find(|d| given.iter().all(|(name, _)| *name != d.name));
    unknown.map_or(Ok(()), |d| Err(wrong("the model has an input that this program does not know", &d.name)))
}

/// Opens an ONNX file with the engine that `options` choose.
///
/// # Errors
/// When the file is missing or not an ONNX model, a wanted output does not exist, the engine lacks an operator,
/// or ONNX Runtime cannot be loaded.
pub fn open(path: impl AsRef<Path>, outputs: Outputs, options: &EngineOptions) -> Result<Box<dyn Model>> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).at("read", path)?;
    let graph = Graph::parse(&bytes).map_err(|e| e.file(path))?;
    let (bytes, names) = match outputs {
        Outputs::Declared => (bytes, graph.outputs.clone()),
        Outputs::Values(names) => {
            let rewritten = graph.with_outputs(&bytes, names).map_err(|e| e.file(path))?;
            (rewritten, names.iter().map(ToString::to_string).collect())
        }
    };
    // Weights in a separate file are found by the engine beside the model: only then does it have to read it itself.
    let external = matches!(outputs, Outputs::Declared) && !graph.external_data.is_empty();
    match &options.onnx_runtime {
        Some(library) => ort_engine::open(path, bytes, external, names, library),
        None => {
            refuse_quantised(&graph).map_err(|e| e.file(path))?;
            rten_engine::open(path, bytes, external, names, options.threads_per_run)
        }
    }
}

/// rten's sums of 8-bit integers overflow on processors without VNNI: of a CLIP encoder, features with a cosine of 0.9 to the truth.
fn refuse_quantised(graph: &Graph) -> Result<()> {
    let integer = |op: &&str| ["MatMulInteger", "ConvInteger"].contains(op);
    let found = graph.producers.values().map(|n| n.op.as_str()).find(integer);
    found.map_or(Ok(()), |op| {
        Err(Error::new("a graph of 8-bit integers, which the built-in engine gets wrong on many processors")
            .found(op)
            .expected("floats of 32 or 16 bits")
            .hint("fetch another variant (make clip VARIANT=fp16), or give --onnx-runtime"))
    })
}

/// Content hash of a model: of its file, and of the files beside it that hold its weights.
///
/// # Errors
/// When one of them cannot be read, or the file is not an ONNX model.
pub fn hash_model(path: &Path) -> Result<String> {
    let graph = Graph::parse(&std::fs::read(path).at("read", path)?).map_err(|e| e.file(path))?;
    let beside = graph.external_data.iter().map(|name| (name.as_str(), path.with_file_name(name)));
    if let Some((_, missing)) = beside.clone().find(|(_, p)| !p.is_file()) {
        let e = Error::new("the weights of the model are missing").file(path).expected(missing.display());
        return Err(e.hint("copy them beside the model"));
    }
    hash_files([("", path.to_path_buf())].into_iter().chain(beside))
}

/// Calls `f(0..count)` on as many threads as rayon has and returns the results in order, for work that runs models:
/// inside rayon's own pool a thread that waits for an engine would begin other work and keep it from finishing.
///
/// # Errors
/// The error of the lowest index that fails.
pub fn parallel_map<R: Send>(count: usize, f: impl Fn(usize) -> Result<R> + Sync) -> Result<Vec<R>> {
    let threads = rayon::current_num_threads().min(count);
    if threads <= 1 {
        return (0..count).map(f).collect();
    }
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<Option<Result<R>>>> = Mutex::new((0..count).map(|_| None).collect());
    let work = || {
        for i in std::iter::repeat_with(|| next.fetch_add(1, Ordering::Relaxed)).take_while(|&i| i < count) {
            let r = f(i);
            if r.is_err() {
                // Work not yet begun has higher indices, whose errors would not be the one reported.
                next.store(count, Ordering::Relaxed);
            }
            results.lock().expect("no panic holds this lock")[i] = Some(r);
        }
    };
    std::thread::scope(|scope| {
        let begun = (0..threads).filter(|_| std::thread::Builder::new().spawn_scoped(scope, work).is_ok()).count();
        // Where the system has no more threads to give, those there are do the work; this one does it where there is none.
        if begun == 0 {
            work();
        }
    });
    let results = results.into_inner().expect("no panic holds this lock");
    results.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_order_and_the_lowest_error_wins() {
        let squares = parallel_map(1000, |i| Ok(i * i)).unwrap();
        assert!(squares.iter().enumerate().all(|(i, &s)| s == i * i));
        let e = parallel_map(100, |i| if i >= 3 { Err(Error::new(format!("at {i}"))) } else { Ok(()) }).unwrap_err();
        assert_eq!(e.to_string(), "at 3");
        assert!(parallel_map(0, |_| Ok(0u8)).unwrap().is_empty());
    }
}
