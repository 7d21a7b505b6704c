//! Tensors that go into and come out of models.

use crate::Kind;
use std::borrow::Cow;

/// Values in C order.
#[derive(Debug, Clone, PartialEq)]
pub enum Data<'a> {
    /// 32-bit floats.
    F32(Cow<'a, [f32]>),
    /// 32-bit integers.
    I32(Cow<'a, [i32]>),
    /// 64-bit integers.
    I64(Cow<'a, [i64]>),
}

/// An array with its shape; inputs may borrow their values.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor<'a> {
    /// Extent of each axis.
    pub shape: Vec<usize>,
    /// As many values as the product of the shape.
    pub data: Data<'a>,
}

impl<'a> Tensor<'a> {
    /// A tensor of floats, borrowed or owned.
    pub fn f32(shape: &[usize], data: impl Into<Cow<'a, [f32]>>) -> Self {
        Self { shape: shape.to_vec(), data: Data::F32(data.into()) }
    }

    /// A tensor of 32-bit integers, borrowed or owned.
    pub fn i32(shape: &[usize], data: impl Into<Cow<'a, [i32]>>) -> Self {
        Self { shape: shape.to_vec(), data: Data::I32(data.into()) }
    }

    /// A tensor of 64-bit integers, borrowed or owned.
    pub fn i64(shape: &[usize], data: impl Into<Cow<'a, [i64]>>) -> Self {
        Self { shape: shape.to_vec(), data: Data::I64(data.into()) }
    }

    /// The same tensor, borrowed.
    pub fn view(&self) -> Tensor<'_> {
        let data = match &self.data {
            Data::F32(v) => Data::F32(Cow::Borrowed(v)),
            Data::I32(v) => Data::I32(Cow::Borrowed(v)),
            Data::I64(v) => Data::I64(Cow::Borrowed(v)),
        };
        Tensor { shape: self.shape.clone(), data }
    }

    /// Number of values.
    pub(crate) fn len(&self) -> usize {
        match &self.data {
            Data::F32(v) => v.len(),
            Data::I32(v) => v.len(),
            Data::I64(v) => v.len(),
        }
    }

    /// Floats or whole numbers.
    pub fn kind(&self) -> Kind {
        match self.data {
            Data::F32(_) => Kind::Float,
            Data::I32(_) | Data::I64(_) => Kind::Integer,
        }
    }

    /// The values as floats, if they are.
    pub fn as_f32(&self) -> Option<&[f32]> {
        match &self.data {
            Data::F32(v) => Some(v),
            _ => None,
        }
    }

    /// The values as 32-bit integers; `None` for floats and for numbers out of range.
    pub fn to_i32(&self) -> Option<Cow<'_, [i32]>> {
        match &self.data {
            Data::F32(_) => None,
            Data::I32(v) => Some(Cow::Borrowed(v)),
            Data::I64(v) => v.iter().map(|&x| i32::try_from(x).ok()).collect::<Option<Vec<_>>>().map(Cow::Owned),
        }
    }

    /// The values as 8-bit numbers; `None` for floats and for numbers out of range.
    pub(crate) fn to_u8(&self) -> Option<Vec<u8>> {
        self.to_i32()?.iter().map(|&v| u8::try_from(v).ok()).collect()
    }

    /// The values as 64-bit integers; `None` for floats.
    pub fn to_i64(&self) -> Option<Cow<'_, [i64]>> {
        match &self.data {
            Data::F32(_) => None,
            Data::I32(v) => Some(Cow::Owned(v.iter().map(|&x| i64::from(x)).collect())),
            Data::I64(v) => Some(Cow::Borrowed(v)),
        }
    }
}
