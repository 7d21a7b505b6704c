//! The weights of SAM's encoder and mask decoder, found in their ONNX files.
//!
//! Exporters keep PyTorch's names for biases and norms. They rename the matrices of linear layers, which are found
//! through the operators that use them.

use onnx_models::{Graph, Node};

/// A matrix `[rows][columns]` of a file.
pub(super) struct Matrix {
    pub rows: usize,
    pub columns: usize,
    pub values: Vec<f32>,
}

impl Matrix {
    pub fn transposed(&self) -> Self {
        let at = |i: usize| self.values[i % self.rows * self.columns + i / self.rows];
        let values = (0..self.values.len()).map(at).collect();
        Self { rows: self.columns, columns: self.rows, values }
    }
}

/// A linear layer `x W + b`.
pub(super) struct Layer {
    /// Inputs x outputs.
    pub weight: Matrix,
    pub bias: Vec<f32>,
    /// Names of the values that it reads and makes.
    pub reads: String,
    pub makes: String,
}

/// The file of an encoder or a decoder.
pub(super) struct File<'a> {
    pub graph: &'a Graph,
    pub bytes: &'a [u8],
}

impl File<'_> {
    /// Name of the constant array whose name ends with `end`.
    fn name(&self, end: &str) -> Option<&str> {
        self.graph.initializers.keys().find(|n| n.ends_with(end)).map(String::as_str)
    }

    /// Shape and values of the constant array whose name ends with `end`.
    pub fn array(&self, end: &str) -> Option<(Vec<usize>, Vec<f32>)> {
        self.graph.weights(self.bytes, self.name(end)?)
    }

    /// Values of the constant array whose name ends with `end`.
    pub fn vector(&self, end: &str) -> Option<Vec<f32>> {
        Some(self.array(end)?.1)
    }

    fn matrix(&self, name: &str) -> Option<Matrix> {
        match self.graph.weights(self.bytes, name)? {
            (shape, values) if shape.len() == 2 => Some(Matrix { rows: shape[0], columns: shape[1], values }),
            _ => None,
        }
    }

    /// The linear layer whose PyTorch name ends with `end`: Gemm, or MatMul followed by Add.
    pub fn layer(&self, end: &str) -> Option<Layer> {
        let bias = self.name(&format!("{end}.bias"))?;
        let last = self.graph.consumer(bias)?;
        let (first, weight) = if last.op == "Gemm" {
            (last, self.matrix(last.inputs.get(1)?)?.transposed())
        } else {
            let product = last.inputs.iter().find(|i| *i != bias)?;
            let product = self.graph.producer(product).filter(|n| n.op == "MatMul")?;
            (product, self.matrix(product.inputs.get(1)?)?)
        };
        let bias = self.vector(bias)?;
        (bias.len() == weight.columns && !weight.values.is_empty()).then(|| Layer {
            weight,
            bias,
            reads: first.inputs[0].clone(),
            makes: last.outputs[0].clone(),
        })
    }

    /// Shape, weights and bias of the convolution whose path in PyTorch ends with `end`; zeros where it has no bias.
    pub fn convolution(&self, end: &str) -> Option<(Vec<usize>, Vec<f32>, Vec<f32>)> {
        let node = self.made(&format!("{end}/Conv_output_0")).filter(|n| n.op == "Conv")?;
        let (shape, weights) = self.graph.weights(self.bytes, node.inputs.get(1)?)?;
        let bias = match node.inputs.get(2) {
            Some(name) => self.graph.weights(self.bytes, name)?.1,
            None => vec![0.0; *shape.first()?],
        };
        (bias.len() == *shape.first()? && shape.iter().all(|n| *n > 0)).then_some((shape, weights, bias))
    }

    /// The operator that makes a value whose name ends with `end`.
    fn made(&self, end: &str) -> Option<&Node> {
        self.graph.producers.iter().find(|(name, _)| name.ends_with(end)).map(|(_, node)| node)
    }

    /// Shape and values of the constant array that an operator reads which makes a value whose name ends with `end`.
    pub fn added_to(&self, end: &str) -> Option<(Vec<usize>, Vec<f32>)> {
        self.array_of(&self.made(end)?.inputs)
    }

    /// The constant array, of more than one value, among so many values.
    fn array_of(&self, names: &[String]) -> Option<(Vec<usize>, Vec<f32>)> {
        names.iter().filter_map(|name| self.graph.weights(self.bytes, name)).find(|(_, values)| values.len() > 1)
    }

    /// Scale and shift that were last applied to what the operator with the weights `end` reads: `x * scale + shift`.
    pub fn scale_and_shift_before(&self, end: &str) -> Option<[Vec<f32>; 2]> {
        self.scale_and_shift(self.graph.consumer(self.name(end)?)?.inputs.first()?)
    }

    /// Those that were last applied to the graph's only output.
    pub fn last_scale_and_shift(&self) -> Option<[Vec<f32>; 2]> {
        let [output] = &self.graph.outputs[..] else { return None };
        self.scale_and_shift(output)
    }

    fn scale_and_shift<'a>(&'a self, mut name: &'a str) -> Option<[Vec<f32>; 2]> {
        for _ in 0..16 {
            let node = self.graph.producer(name)?;
            if node.op == "Add"
                && let Some((_, shift)) = self.array_of(&node.inputs)
            {
                let scaled = node.inputs.iter().find_map(|i| self.graph.producer(i)).filter(|n| n.op == "Mul")?;
                return Some([self.array_of(&scaled.inputs)?.1, shift]);
            }
            name = node.inputs.first()?;
        }
        None
    }
}
