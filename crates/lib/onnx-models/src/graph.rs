//! The little of the ONNX file format that is needed to give a model other outputs and to read its weights.
//!
//! An ONNX file is a protobuf message ModelProto whose field 7 is the GraphProto; its field 1 repeats nodes, field 12
//! outputs. A value inside the graph becomes an output by being named there, which every engine understands, and what
//! no output needs any longer is not computed.

use gs_io::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

const MODEL_GRAPH: u64 = 7;
const GRAPH_NODE: u64 = 1;
const GRAPH_INITIALIZER: u64 = 5;
const GRAPH_OUTPUT: u64 = 12;
const NODE_INPUT: u64 = 1;
const NODE_OUTPUT: u64 = 2;
const NODE_OP_TYPE: u64 = 4;
const NODE_ATTRIBUTE: u64 = 5;
/// AttributeProto.t, what a Constant makes.
const ATTRIBUTE_TENSOR: u64 = 5;
const VALUE_NAME: u64 = 1;
const TENSOR_DIMS: u64 = 1;
const TENSOR_TYPE: u64 = 2;
const TENSOR_NAME: u64 = 8;
const TENSOR_RAW: u64 = 9;
/// TensorProto.external_data: pairs of key and value, of which `location` names a file beside the model.
const TENSOR_EXTERNAL: u64 = 13;
const PAIR_KEY: u64 = 1;
const PAIR_VALUE: u64 = 2;
/// TensorProto.DataType of 32-bit floats.
const FLOAT: u64 = 1;

/// One operator of the graph.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Node {
    /// Operator, such as `Gather`.
    pub op: String,
    /// Names of the values it reads.
    pub inputs: Vec<String>,
    /// Names of the values it makes.
    pub outputs: Vec<String>,
}

/// The nodes and outputs of an ONNX file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Operators by the name of a value they make.
    pub producers: BTreeMap<String, Node>,
    /// Names of the declared outputs.
    pub outputs: Vec<String>,
    /// Where in the file each constant array lies, by its name.
    pub initializers: BTreeMap<String, Range<usize>>,
    /// Names of the files beside the model that hold weights.
    pub external_data: BTreeSet<String>,
    /// Whether a node holds a graph of its own (If, Loop, Scan), which may read any value without naming it as an input.
    pub nested: bool,
}

/// A field of a protobuf message: number, what it holds, and the bytes of the whole field.
struct Field {
    number: u64,
    value: Value,
    whole: Range<usize>,
}

enum Value {
    Varint(u64),
    Bytes(Range<usize>),
    Other,
}

fn damaged() -> Error {
    Error::new("not an ONNX model").hint("give an .onnx file; a text file of a few lines is a Git LFS pointer")
}

fn varint(bytes: &[u8], at: &mut usize) -> Result<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let &b = bytes.get(*at).ok_or_else(damaged)?;
        *at += 1;
        value |= u64::from(b & 127) << shift;
        if b < 128 {
            return Ok(value);
        }
    }
    Err(damaged())
}

fn fields(bytes: &[u8], range: Range<usize>) -> Result<Vec<Field>> {
    let message = bytes.get(..range.end).ok_or_else(damaged)?;
    let mut at = range.start;
    let mut found = Vec::new();
    while at < range.end {
        let start = at;
        let tag = varint(message, &mut at)?;
        let value = match tag & 7 {
            0 => Value::Varint(varint(message, &mut at)?),
            2 => {
                let len = usize::try_from(varint(message, &mut at)?).map_err(|_| damaged())?;
                let begin = at;
                at = begin.checked_add(len).filter(|&e| e <= range.end).ok_or_else(damaged)?;
                Value::Bytes(begin..at)
            }
            size @ (1 | 5) => {
                at += if size == 1 { 8 } else { 4 };
                Value::Other
            }
            _ => return Err(damaged()),
        };
        if at > range.end {
            return Err(damaged());
        }
        found.push(Field { number: tag >> 3, value, whole: start..at });
    }
    Ok(found)
}

/// Where the fields `number` of a message lie that hold a text or a message.
fn messages(bytes: &[u8], message: &Range<usize>, number: u64) -> Result<Vec<Range<usize>>> {
    let inner = |f: Field| match f.value {
        Value::Bytes(r) if f.number == number => Some(r),
        _ => None,
    };
    Ok(fields(bytes, message.clone())?.into_iter().filter_map(inner).collect())
}

/// The texts of the fields `number` of a message.
fn texts(bytes: &[u8], message: &Range<usize>, number: u64) -> Result<Vec<String>> {
    let text = |r: Range<usize>| String::from_utf8(bytes[r].to_vec()).map_err(|_| damaged());
    messages(bytes, message, number)?.into_iter().map(text).collect()
}

fn graph_range(bytes: &[u8]) -> Result<(Range<usize>, Range<usize>)> {
    let model = fields(bytes, 0..bytes.len())?;
    let mut graphs = model.into_iter().filter(|f| f.number == MODEL_GRAPH);
    match (graphs.next(), graphs.next()) {
        (Some(Field { value: Value::Bytes(inner), whole, .. }), None) => Ok((inner, whole)),
        _ => Err(damaged()),
    }
}

fn push_varint(out: &mut Vec<u8>, mut v: u64) {
    while v >= 128 {
        out.push(v as u8 | 128);
        v >>= 7;
    }
    out.push(v as u8);
}

fn push_bytes(out: &mut Vec<u8>, number: u64, bytes: &[u8]) {
    push_varint(out, number << 3 | 2);
    push_varint(out, bytes.len() as u64);
    out.extend_from_slice(bytes);
}

impl Graph {
    /// Reads nodes and outputs from the bytes of an ONNX file.
    ///
    /// # Errors
    /// When the bytes are not an ONNX model.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let (range, _) = graph_range(bytes)?;
        let mut graph = Self::default();
        for field in fields(bytes, range)? {
            let Value::Bytes(inner) = field.value else { continue };
            match field.number {
                GRAPH_NODE => {
                    let of = |number| texts(bytes, &inner, number);
                    let op = of(NODE_OP_TYPE)?.pop().unwrap_or_default();
                    graph.nested |= ["If", "Loop", "Scan"].contains(&op.as_str());
                    let node = Node { op, inputs: of(NODE_INPUT)?, outputs: of(NODE_OUTPUT)? };
                    if node.op == "Constant" {
                        let arrays = messages(bytes, &inner, NODE_ATTRIBUTE)?
                            .into_iter()
                            .map(|a| messages(bytes, &a, ATTRIBUTE_TENSOR));
                        let array = arrays.collect::<Result<Vec<_>>>()?.concat().pop();
                        graph.initializers.extend(node.outputs.first().cloned().zip(array));
                    }
                    for output in &node.outputs {
                        graph.producers.insert(output.clone(), node.clone());
                    }
                }
                GRAPH_OUTPUT => graph.outputs.extend(texts(bytes, &inner, VALUE_NAME)?),
                GRAPH_INITIALIZER => {
                    for f in fields(bytes, inner.clone())? {
                        if let (TENSOR_EXTERNAL, Value::Bytes(pair)) = (f.number, f.value)
                            && texts(bytes, &pair, PAIR_KEY)? == ["location"]
                        {
                            graph.external_data.extend(texts(bytes, &pair, PAIR_VALUE)?);
                        }
                    }
                    let names = texts(bytes, &inner, TENSOR_NAME)?;
                    graph.initializers.extend(names.into_iter().map(|name| (name, inner.clone())));
                }
                _ => {}
            }
        }
        if graph.outputs.is_empty() {
            return Err(damaged());
        }
        Ok(graph)
    }

    /// The same model with the values `names` as its only outputs, without what they do not need: ONNX Runtime computes every
    /// node that it is given.
    ///
    /// # Errors
    /// When no node makes such a value.
    pub fn with_outputs(&self, bytes: &[u8], names: &[&str]) -> Result<Vec<u8>> {
        if let Some(name) = names.iter().find(|n| !self.producers.contains_key(**n)) {
            return Err(Error::new("the model has no such value")
                .field(*name)
                .expected(format!("an output such as {}", self.outputs.join(", "))));
        }
        let needed = self.needed(names);
        let (range, whole) = graph_range(bytes)?;
        let mut graph = Vec::with_capacity(range.len());
        for field in fields(bytes, range)? {
            let makes = match (field.number, &field.value) {
                (GRAPH_NODE, Value::Bytes(node)) => texts(bytes, node, NODE_OUTPUT)?,
                (GRAPH_INITIALIZER, Value::Bytes(array)) => texts(bytes, array, TENSOR_NAME)?,
                (GRAPH_OUTPUT, _) => continue,
                _ => Vec::new(),
            };
            if makes.is_empty() || self.nested || makes.iter().any(|n| needed.contains(n.as_str())) {
                graph.extend_from_slice(&bytes[field.whole]);
            }
        }
        for name in names {
            let mut value = Vec::new();
            push_bytes(&mut value, VALUE_NAME, name.as_bytes());
            push_bytes(&mut graph, GRAPH_OUTPUT, &value);
        }
        let mut model = bytes[..whole.start].to_vec();
        push_bytes(&mut model, MODEL_GRAPH, &graph);
        model.extend_from_slice(&bytes[whole.end..]);
        Ok(model)
    }

    /// The values that the values `names` are made from, and these.
    fn needed<'a>(&'a self, names: &[&'a str]) -> BTreeSet<&'a str> {
        let mut needed = BTreeSet::new();
        let mut open = names.to_vec();
        while let Some(name) = open.pop() {
            if needed.insert(name)
                && let Some(node) = self.producers.get(name)
            {
                open.extend(node.inputs.iter().map(String::as_str));
            }
        }
        needed
    }

    /// Shape and values of the constant array `name`; `None` where there is none, or where its values are no 32-bit floats
    /// within the file.
    pub fn weights(&self, bytes: &[u8], name: &str) -> Option<(Vec<usize>, Vec<f32>)> {
        let (mut shape, mut values, mut kind) = (Vec::new(), Vec::new(), 0);
        for f in fields(bytes, self.initializers.get(name)?.clone()).ok()? {
            match (f.number, f.value) {
                (TENSOR_DIMS, Value::Varint(n)) => shape.push(usize::try_from(n).ok()?),
                (TENSOR_DIMS, Value::Bytes(packed)) => {
                    let mut at = packed.start;
                    while at < packed.end {
                        shape.push(usize::try_from(varint(bytes, &mut at).ok()?).ok()?);
                    }
                }
                (TENSOR_TYPE, Value::Varint(t)) => kind = t,
                (TENSOR_RAW, Value::Bytes(r)) => {
                    values = bytes[r].as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
                }
                _ => {}
            }
        }
        let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))?;
        (kind == FLOAT && values.len() == count).then_some((shape, values))
    }

    /// An operator that reads the value `name`.
    pub fn consumer(&self, name: &str) -> Option<&Node> {
        self.producers.values().find(|n| n.inputs.iter().any(|i| i == name))
    }

    /// The operator that makes the value `name`.
    pub fn producer(&self, name: &str) -> Option<&Node> {
        self.producers.get(name)
    }
}
