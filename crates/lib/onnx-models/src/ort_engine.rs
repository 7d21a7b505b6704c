//! ONNX Runtime, loaded at run time from the path of its shared library.

use crate::{Data, Kind, Model, Tensor, ValueInfo};
use gs_io::{Error, Result};
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::builder::GraphOptimizationLevel;
use ort::session::{Session, SessionInputValue};
use ort::value::{Outlet, TensorElementType, TensorRef, ValueType};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The library that this process has loaded; there can be only one.
static LOADED: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

const TELEMETRY: &str = "ORT_DISABLE_TELEMETRY";

struct OrtModel {
    path: PathBuf,
    inputs: Vec<ValueInfo>,
    outputs: Vec<ValueInfo>,
    /// Element type of each input that is integer, to widen or narrow to.
    wide: Vec<bool>,
    session: Mutex<Session>,
}

fn environment(library: &Path) -> Result<Environment> {
    let fail = |what: String| Error::new(what).file(library).field("--onnx-runtime");
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((path, env)) = &*loaded {
        return if path == library {
            Ok(env.clone())
        } else {
            Err(fail("a process can load one ONNX Runtime only".into()).found(path.display()))
        };
    }
    if std::env::var_os(TELEMETRY).is_none_or(|v| v != "1") {
        return Err(fail(format!("{TELEMETRY} is not 1"))
            .hint(format!("ONNX Runtime 1.29 and later send usage data without it: set {TELEMETRY}=1")));
    }
    let unusable = |e: &dyn std::fmt::Display| {
        fail(format!("cannot load ONNX Runtime: {e}"))
            .hint("give the path of libonnxruntime.so, version 1.20 or later, or leave the option out")
    };
    let env = ort::init_from(library).map_err(|e| unusable(&e))?;
    let env = env.with_name("onnx-models").with_telemetry(false).build().map_err(|e| unusable(&e))?;
    // Faults come back as errors; the library's own log would repeat them on standard error.
    env.set_log_level(LogLevel::Fatal);
    *loaded = Some((library.to_path_buf(), env.clone()));
    Ok(env)
}

pub(crate) fn open(
    path: &Path,
    bytes: Vec<u8>,
    external: bool,
    names: Vec<String>,
    library: &Path,
) -> Result<Box<dyn Model>> {
    let fail = |e: &dyn std::fmt::Display| {
        Error::new(format!("ONNX Runtime cannot load the model: {e}")).file(path).hint("check the file")
    };
    let env = environment(library)?;
    // Level3 is refused by libraries before 1.24; All is the same there and later.
    let session = Session::builder(&env)
        .map_err(|e| fail(&e))?
        .with_optimization_level(GraphOptimizationLevel::All)
        .map_err(|e| fail(&e))?
        .with_intra_threads(rayon::current_num_threads())
        .map_err(|e| fail(&e))?
        // Threads that spin between two runs keep the program's own threads from the cores.
        .with_intra_op_spinning(false)
        .map_err(|e| fail(&e))
        .and_then(|mut b| {
            if external { b.commit_from_file(path) } else { b.commit_from_memory(&bytes) }.map_err(|e| fail(&e))
        })?;
    let inputs = session.inputs().iter().map(info).collect();
    let outputs = names
        .iter()
        .map(|n| {
            let found = session.outputs().iter().find(|o| o.name() == n);
            found.map(info).ok_or_else(|| Error::new("no such output").file(path).field(n))
        })
        .collect::<Result<Vec<_>>>()?;
    let is_i64 = |o: &Outlet| matches!(o.dtype(), ValueType::Tensor { ty: TensorElementType::Int64, .. });
    let wide = session.inputs().iter().map(is_i64).collect();
    Ok(Box::new(OrtModel { path: path.to_path_buf(), inputs, outputs, wide, session: Mutex::new(session) }))
}

fn info(o: &Outlet) -> ValueInfo {
    let (shape, kind) = match o.dtype() {
        ValueType::Tensor { ty, shape, .. } => {
            let kind = match ty {
                TensorElementType::Float32 => Kind::Float,
                TensorElementType::Int32 | TensorElementType::Int64 => Kind::Integer,
                _ => Kind::Other,
            };
            (Some(shape.iter().map(|&d| usize::try_from(d).ok()).collect()), Some(kind))
        }
        _ => (None, Some(Kind::Other)),
    };
    ValueInfo { name: o.name().to_string(), shape, kind }
}

impl Model for OrtModel {
    fn path(&self) -> &Path {
        &self.path
    }

    fn inputs(&self) -> &[ValueInfo] {
        &self.inputs
    }

    fn outputs(&self) -> &[ValueInfo] {
        &self.outputs
    }

    fn run_checked(&self, inputs: &[(&str, Tensor)]) -> Result<Vec<Tensor<'static>>> {
        let fail =
            |e: &dyn std::fmt::Display| Error::new(format!("ONNX Runtime cannot run the model: {e}")).file(&self.path);
        // Owned integer copies of the declared width, kept alive while views of them are in use.
        let mut wide = Vec::new();
        let mut narrow = Vec::new();
        for (name, tensor) in inputs {
            let is_wide = self.inputs.iter().position(|i| i.name == *name).is_some_and(|i| self.wide[i]);
            wide.push(if is_wide { tensor.to_i64() } else { None });
            narrow.push(if is_wide { None } else { tensor.to_i32() });
        }
        let mut values: Vec<(&str, SessionInputValue)> = Vec::with_capacity(inputs.len());
        for (i, (name, tensor)) in inputs.iter().enumerate() {
            let shape: Vec<i64> = tensor.shape.iter().map(|&d| d as i64).collect();
            let value: SessionInputValue = match (&tensor.data, &wide[i], &narrow[i]) {
                (Data::F32(v), ..) => TensorRef::from_array_view((shape, v.as_ref())).map_err(|e| fail(&e))?.into(),
                (_, Some(v), _) => TensorRef::from_array_view((shape, v.as_ref())).map_err(|e| fail(&e))?.into(),
                (_, _, Some(v)) => TensorRef::from_array_view((shape, v.as_ref())).map_err(|e| fail(&e))?.into(),
                _ => return Err(fail(&"an integer does not fit 32 bits").field(format!("input {name}"))),
            };
            values.push((name, value));
        }
        let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
        let results = session.run(values).map_err(|e| fail(&e))?;
        self.outputs
            .iter()
            .map(|info| {
                let value = results.get(&info.name).ok_or_else(|| fail(&"missing output").field(&info.name))?;
                let dims = |s: &[i64]| s.iter().map(|&d| d as usize).collect::<Vec<usize>>();
                if let Ok((shape, v)) = value.try_extract_tensor::<f32>() {
                    return Ok(Tensor::f32(&dims(shape), v.to_vec()));
                }
                if let Ok((shape, v)) = value.try_extract_tensor::<i64>() {
                    return Ok(Tensor::i64(&dims(shape), v.to_vec()));
                }
                match value.try_extract_tensor::<i32>() {
                    Ok((shape, v)) => Ok(Tensor::i32(&dims(shape), v.to_vec())),
                    Err(e) => Err(fail(&e).field(format!("output {}", info.name))),
                }
            })
            .collect()
    }
}
