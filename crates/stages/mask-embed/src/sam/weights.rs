//! The weights of SAM's mask decoder, found in its ONNX file.
//!
//! Exporters keep PyTorch's names for biases and norms. They rename the matrices of linear layers, which are found
//! through the operators that use them.

use onnx_models::Graph;

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

/// The file of a decoder.
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

    /// Scale and shift that were last applied to what the operator with the weights `end` reads: `x * scale + shift`.
    pub fn scale_and_shift_before(&self, end: &str) -> Option<[Vec<f32>; 2]> {
        let constant = |inputs: &[String]| inputs.iter().find_map(|i| self.graph.weights(self.bytes, i));
        let mut name = self.graph.consumer(self.name(end)?)?.inputs.first()?;
        for _ in 0..16 {
            let node = self.graph.producer(name)?;
            if node.op == "Add"
                && let Some((_, shift)) = constant(&node.inputs)
            {
                let scaled = node.inputs.iter().find_map(|i| self.graph.producer(i)).filter(|n| n.op == "Mul")?;
                return Some([constant(&scaled.inputs)?.1, shift]);
            }
            name = node.inputs.first()?;
        }
        None
    }
}
