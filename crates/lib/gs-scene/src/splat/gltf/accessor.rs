//! Numbers in the buffers of a glTF.

use base64::Engine as _;
use gs_io::{Error, IoContext, Result};
use serde_json::Value;
use std::borrow::Cow;
use std::path::Path;

/// The buffers of a file.
pub(super) struct Buffers<'a>(Vec<Cow<'a, [u8]>>);

impl<'a> Buffers<'a> {
    /// The binary chunk, what stands in the file itself, and files beside it.
    pub(super) fn open(description: &Value, binary: Option<&'a [u8]>, path: &Path) -> Result<Self> {
        let mut all = Vec::new();
        for (i, buffer) in description["buffers"].as_array().into_iter().flatten().enumerate() {
            let field = format!("buffers[{i}]");
            all.push(match (buffer["uri"].as_str(), binary) {
                (None, Some(binary)) if i == 0 => Cow::Borrowed(binary),
                (None, _) => {
                    return Err(Error::new("no data").field(field).expected("a uri or the binary chunk of a GLB"));
                }
                (Some(uri), _) => match uri.strip_prefix("data:") {
                    Some(data) => {
                        let data = data.split_once(";base64,").map_or("", |(_, data)| data);
                        let bytes = base64::engine::general_purpose::STANDARD.decode(data);
                        Cow::Owned(bytes.map_err(|e| Error::new(format!("not base64: {e}")).field(field))?)
                    }
                    None => {
                        let file = path.with_file_name(crate::splat::plain_name(uri)?);
                        Cow::Owned(std::fs::read(&file).at("read", &file)?)
                    }
                },
            });
        }
        Ok(Self(all))
    }

    /// Bytes of all of them.
    pub(super) fn bytes(&self) -> usize {
        self.0.iter().map(|b| b.len()).sum()
    }

    /// An accessor by its number; errors are for its field.
    pub(super) fn accessor(&self, description: &Value, index: u64) -> Result<Accessor<'_>> {
        let accessor = &description["accessors"][index as usize];
        let number = |value: &Value| value.as_u64().and_then(|v| usize::try_from(v).ok());
        if !accessor["sparse"].is_null() {
            return Err(Error::new("sparse accessors are not read").hint("export the glTF without them"));
        }
        let component = Component::of(number(&accessor["componentType"]).unwrap_or(0))
            .ok_or_else(|| Error::new("unknown component type").found(&accessor["componentType"]))?;
        let channels = match accessor["type"].as_str() {
            Some("SCALAR") => 1,
            Some("VEC2") => 2,
            Some("VEC3") => 3,
            Some("VEC4") => 4,
            _ => return Err(Error::new("unknown type").found(&accessor["type"]).expected("SCALAR or VEC2 to VEC4")),
        };
        let view = number(&accessor["bufferView"])
            .ok_or_else(|| Error::new("no bufferView").hint("export the glTF without compression"))?;
        let view = &description["bufferViews"][view];
        if !view["extensions"].is_null() {
            return Err(Error::new("compressed buffers are not read").hint("export the glTF without compression"));
        }
        let buffer = number(&view["buffer"]).and_then(|b| self.0.get(b)).ok_or_else(|| Error::new("no such buffer"))?;
        let or_zero = |value: &Value| if value.is_null() { Some(0) } else { number(value) };
        let row = component.bytes() * channels;
        let stride = if view["byteStride"].is_null() { Some(row) } else { number(&view["byteStride"]) };
        let place = || -> Option<(&[u8], usize, usize)> {
            let (count, stride) = (number(&accessor["count"])?, stride.filter(|s| *s >= row)?);
            let start = or_zero(&view["byteOffset"])?;
            let data = buffer.get(start..start.checked_add(number(&view["byteLength"])?)?)?;
            let data = data.get(or_zero(&accessor["byteOffset"])?..)?;
            let needed = count.checked_sub(1).map_or(Some(0), |last| last.checked_mul(stride)?.checked_add(row))?;
            Some((data.get(..needed)?, count, stride))
        };
        let (data, count, stride) = place().ok_or_else(|| {
            Error::new("its numbers do not lie in its buffer")
                .found(format!("{accessor} of {view}"))
                .expected(format!("at most the {} bytes of the buffer", buffer.len()))
        })?;
        let normalized = accessor["normalized"] == true;
        Ok(Accessor { data, count, stride, component, channels, normalized })
    }
}

#[derive(Debug, Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    F32,
}

impl Component {
    fn of(number: usize) -> Option<Self> {
        Some(match number {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::F32 => 4,
        }
    }

    /// A number; whole ones are shares of the most where they are normalized.
    fn value(self, b: &[u8], normalized: bool) -> f32 {
        let (value, most) = match self {
            Self::I8 => (f32::from(i8::from_le_bytes([b[0]])), 127.0),
            Self::U8 => (f32::from(b[0]), 255.0),
            Self::I16 => (f32::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            Self::U16 => (f32::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            Self::F32 => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        };
        if normalized { (value / most).max(-1.0) } else { value }
    }
}

/// Vectors of numbers in a buffer.
pub(super) struct Accessor<'a> {
    data: &'a [u8],
    count: usize,
    stride: usize,
    component: Component,
    channels: usize,
    normalized: bool,
}

impl Accessor<'_> {
    /// All of them, of `N` numbers each.
    pub(super) fn vectors<const N: usize>(&self) -> Result<Vec<[f32; N]>> {
        if self.channels != N {
            return Err(Error::new("vectors of another size").found(self.channels).expected(N));
        }
        let bytes = self.component.bytes();
        let row = |i: usize| {
            let row = &self.data[i * self.stride..];
            std::array::from_fn(|k| self.component.value(&row[k * bytes..], self.normalized))
        };
        Ok((0..self.count).map(row).collect())
    }
}
