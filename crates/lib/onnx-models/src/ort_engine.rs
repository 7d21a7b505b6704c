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

/// Integers as an input has them.
enum Integers {
    I64(Vec<i64>),
    I32(Vec<i32>),
    U8(Vec<u8>),
    Bool(Vec<bool>),
}

const TELEMETRY: &str = "ORT_DISABLE_TELEMETRY";

struct OrtModel {
    path: PathBuf,
    inputs: Vec<ValueInfo>,
    outputs: Vec<ValueInfo>,
    /// Element type of each input, to convert integers to.
    types: Vec<TensorElementType>,
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
    let element = |o: &Outlet| match o.dtype() {
        ValueType::Tensor { ty, .. } => *ty,
        _ => TensorElementType::Undefined,
    };
    let types = session.inputs().iter().map(element).collect();
    Ok(Box::new(OrtModel { path: path.to_path_buf(), inputs, outputs, types, session: Mutex::new(session) }))
}

fn info(o: &Outlet) -> ValueInfo {
    let (shape, kind) = match o.dtype() {
        ValueType::Tensor { ty, shape, .. } => {
            let kind = match ty {
                TensorElementType::Float32 => Kind::Float,
                TensorElementType::Int32
                | TensorElementType::Int64
                | TensorElementType::Uint8
                | TensorElementType::Bool => Kind::Integer,
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
        // Integers of the declared type, kept alive while views of them are in use.
        let convert = |(name, tensor): &(&str, Tensor)| {
            let at = self.inputs.iter().position(|i| i.name == *name);
            Some(match at.map(|i| self.types[i]) {
                Some(TensorElementType::Int64) => Integers::I64(tensor.to_i64()?.into_owned()),
                Some(TensorElementType::Uint8) => Integers::U8(tensor.to_u8()?),
                Some(TensorElementType::Bool) => Integers::Bool(tensor.to_i32()?.iter().map(|&v| v != 0).collect()),
                _ => Integers::I32(tensor.to_i32()?.into_owned()),
            })
        };
        let converted: Vec<Option<Integers>> = inputs.iter().map(convert).collect();
        let mut values: Vec<(&str, SessionInputValue)> = Vec::with_capacity(inputs.len());
        for ((name, tensor), integers) in inputs.iter().zip(&converted) {
            let shape: Vec<i64> = tensor.shape.iter().map(|&d| d as i64).collect();
            let value: ort::Result<SessionInputValue> = match (&tensor.data, integers) {
                (Data::F32(v), _) => TensorRef::from_array_view((shape, v.as_ref())).map(Into::into),
                (_, Some(Integers::I64(v))) => TensorRef::from_array_view((shape, &v[..])).map(Into::into),
                (_, Some(Integers::I32(v))) => TensorRef::from_array_view((shape, &v[..])).map(Into::into),
                (_, Some(Integers::U8(v))) => TensorRef::from_array_view((shape, &v[..])).map(Into::into),
                (_, Some(Integers::Bool(v))) => TensorRef::from_array_view((shape, &v[..])).map(Into::into),
                _ => return Err(fail(&"an integer does not fit the input").field(format!("input {name}"))),
            };
            values.push((name, value.map_err(|e| fail(&e))?));
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
                if let Ok((shape, v)) = value.try_extract_tensor::<bool>() {
                    return Ok(Tensor::i32(&dims(shape), v.iter().map(|&v| i32::from(v)).collect::<Vec<_>>()));
                }
                match value.try_extract_tensor::<i32>() {
                    Ok((shape, v)) => Ok(Tensor::i32(&dims(shape), v.to_vec())),
                    Err(e) => Err(fail(&e).field(format!("output {}", info.name))),
                }
            })
            .collect()
    }
}
