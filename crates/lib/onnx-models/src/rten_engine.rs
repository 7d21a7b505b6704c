//! rten: pure Rust, the default engine.

use crate::{Data, Kind, Model, Tensor, ValueInfo};
use gs_io::{Error, Result};
use rten::{DataType, Dimension, ModelOptions, NodeId, RunOptions, ThreadPool, Value, ValueType, ValueView};
use rten_tensor::{AsView, Layout, TensorView};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

struct RtenModel {
    path: PathBuf,
    model: rten::Model,
    inputs: Vec<ValueInfo>,
    /// Inputs of 8-bit numbers.
    bytes: Vec<NodeId>,
    outputs: Vec<ValueInfo>,
    output_ids: Vec<NodeId>,
    threads: usize,
    /// Idle thread pools and their threads: a run takes one, so that runs at the same time do not share threads.
    pools: Mutex<Vec<(usize, Arc<ThreadPool>)>>,
}

pub(crate) fn open(
    path: &Path,
    bytes: Vec<u8>,
    external: bool,
    names: Vec<String>,
    threads: usize,
) -> Result<Box<dyn Model>> {
    let options = ModelOptions::with_all_ops();
    let loaded = if external { options.load_file(path) } else { options.load(bytes) };
    let model = loaded.map_err(|e| {
        Error::new(format!("rten cannot load the model: {e}"))
            .file(path)
            .hint("try --onnx-runtime with the path of libonnxruntime.so")
    })?;
    let info = |id: NodeId| {
        let node = model.node_info(id);
        ValueInfo {
            name: node.as_ref().and_then(rten::NodeInfo::name).unwrap_or_default().to_string(),
            shape: node.as_ref().and_then(rten::NodeInfo::shape).map(|s| {
                s.iter()
                    .map(|d| match d {
                        Dimension::Fixed(n) => Some(*n),
                        Dimension::Symbolic(_) => None,
                    })
                    .collect()
            }),
            kind: node.as_ref().and_then(rten::NodeInfo::dtype).map(|t| match t {
                ValueType::Tensor(DataType::Float) => Kind::Float,
                ValueType::Tensor(DataType::Int32 | DataType::UInt8) => Kind::Integer,
                _ => Kind::Other,
            }),
        }
    };
    let inputs = model.input_ids().iter().map(|&id| info(id)).collect();
    let is_u8 = |id: &NodeId| {
        let kind = model.node_info(*id).and_then(|n| n.dtype());
        matches!(kind, Some(ValueType::Tensor(DataType::UInt8)))
    };
    let bytes = model.input_ids().iter().copied().filter(is_u8).collect();
    let output_ids = names
        .iter()
        .map(|n| model.find_node(n).ok_or_else(|| Error::new("no such output").file(path).field(n)))
        .collect::<Result<Vec<_>>>()?;
    let outputs = output_ids.iter().map(|&id| info(id)).collect();
    Ok(Box::new(RtenModel {
        path: path.to_path_buf(),
        inputs,
        bytes,
        outputs,
        output_ids,
        threads,
        pools: Mutex::default(),
        model,
    }))
}

impl Model for RtenModel {
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
        let fail = |e: &dyn std::fmt::Display| Error::new(format!("rten cannot run the model: {e}")).file(&self.path);
        // Integers are narrowed first, so that views of them live long enough.
        let narrowed: Vec<Option<Cow<[i32]>>> = inputs.iter().map(|(_, t)| t.to_i32()).collect();
        let bytes: Vec<Option<Vec<u8>>> = inputs.iter().map(|(_, t)| t.to_u8()).collect();
        let mut views = Vec::with_capacity(inputs.len());
        for (((name, tensor), ints), bytes) in inputs.iter().zip(&narrowed).zip(&bytes) {
            let id = self.model.node_id(name).map_err(|e| fail(&e))?;
            let is_u8 = self.bytes.contains(&id);
            let view: ValueView = match (&tensor.data, ints, bytes) {
                (Data::F32(v), ..) => TensorView::from_data(&tensor.shape[..], v.as_ref()).into(),
                (_, _, Some(v)) if is_u8 => TensorView::from_data(&tensor.shape[..], &v[..]).into(),
                (_, Some(v), _) if !is_u8 => TensorView::from_data(&tensor.shape[..], v.as_ref()).into(),
                _ => {
                    let bits = if is_u8 { 8 } else { 32 };
                    return Err(fail(&format!("an integer does not fit {bits} bits")).field(format!("input {name}")));
                }
            };
            views.push((id, view.into()));
        }
        let threads = if self.threads == 0 { rayon::current_num_threads() } else { self.threads };
        let idle = || self.pools.lock().expect("no panic holds this lock");
        let taken = {
            let mut idle = idle();
            idle.iter().position(|(n, _)| *n == threads).map(|i| idle.swap_remove(i).1)
        };
        let pool = taken.unwrap_or_else(|| Arc::new(ThreadPool::with_num_threads(threads)));
        let options = RunOptions::default().with_thread_pool(Some(Arc::clone(&pool)));
        let values = self.model.run(views, &self.output_ids, Some(options));
        idle().push((threads, pool));
        let values = values.map_err(|e| fail(&e))?;
        values
            .into_iter()
            .zip(&self.outputs)
            .map(|(value, info)| match value {
                Value::FloatTensor(t) => Ok(Tensor::f32(t.shape(), t.to_vec())),
                Value::Int32Tensor(t) => Ok(Tensor::i32(t.shape(), t.to_vec())),
                other => Err(fail(&"an output is neither floats nor integers")
                    .field(format!("output {}", info.name))
                    .found(other.dtype())),
            })
            .collect()
    }
}
