//! The vertices of a PLY file as rows of bytes with named columns.

use crate::middle::{less, shifted};
use gs_io::{Error, Result};
use rayon::prelude::*;
use std::borrow::Cow;

pub(crate) const AGAIN: &str = "export the PLY again";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// The type of the values of a rewritten row.
    fn rewritten(self) -> Self {
        if self == Self::F64 { self } else { Self::F32 }
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::I8 => "char",
            Self::U8 => "uchar",
            Self::I16 => "short",
            Self::U16 => "ushort",
            Self::I32 => "int",
            Self::U32 => "uint",
            Self::F32 => "float",
            Self::F64 => "double",
        }
    }

    #[inline]
    fn value(self, bytes: &[u8], big: bool) -> f64 {
        macro_rules! get {
            ($t:ty) => {{
                let mut b = [0u8; size_of::<$t>()];
                b.copy_from_slice(&bytes[..size_of::<$t>()]);
                f64::from(if big { <$t>::from_be_bytes(b) } else { <$t>::from_le_bytes(b) })
            }};
        }
        match self {
            Self::I8 => get!(i8),
            Self::U8 => get!(u8),
            Self::I16 => get!(i16),
            Self::U16 => get!(u16),
            Self::I32 => get!(i32),
            Self::U32 => get!(u32),
            Self::F32 => get!(f32),
            Self::F64 => get!(f64),
        }
    }
}

#[derive(Debug, Clone)]
enum Property {
    Scalar(String, Scalar),
    List(Scalar, Scalar),
}

#[derive(Debug, Clone)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

impl Element {
    /// Whether its rows are used as they lie in the file: binary and without lists.
    fn is_as_it_lies(&self, encoding: Encoding) -> bool {
        encoding != Encoding::Ascii && self.properties.iter().all(|p| matches!(p, Property::Scalar(..)))
    }
}

struct Header<'a> {
    encoding: Encoding,
    elements: Vec<Element>,
    comments: Vec<&'a str>,
    body: &'a [u8],
}

/// The comment lines of a file's header, and for each of `names` whether its vertices have that property.
pub(crate) fn read_header<'a, const N: usize>(bytes: &'a [u8], names: [&str; N]) -> Result<(Vec<&'a str>, [bool; N])> {
    let header = parse_header(bytes)?;
    let there = |name: &str| {
        let vertices = header.elements.iter().filter(|e| e.name == "vertex");
        vertices.flat_map(|e| &e.properties).any(|p| matches!(p, Property::Scalar(n, _) if n == name))
    };
    let there = names.map(there);
    Ok((header.comments, there))
}

/// How many vertices a file's header says that it has.
pub(crate) fn count_of_vertices(bytes: &[u8]) -> Result<u64> {
    let header = parse_header(bytes)?;
    header.elements.iter().find(|e| e.name == "vertex").map(|e| e.count as u64).ok_or_else(no_vertices)
}

fn parse_header(bytes: &[u8]) -> Result<Header<'_>> {
    let fail = |what: &str| Error::new(what).field("header").hint(AGAIN);
    let mut rest = bytes;
    let mut next_line = || -> Result<&'_ str> {
        let end = rest.iter().take(65_536).position(|&b| b == b'\n').ok_or_else(|| fail("the header does not end"))?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| fail("the header is not text"))?;
        rest = &rest[end + 1..];
        Ok(line.trim_end_matches('\r').trim())
    };
    if next_line()? != "ply" {
        return Err(fail("not a PLY file"));
    }
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut comments = Vec::new();
    loop {
        let line = next_line()?;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["end_header"] => break,
            ["comment", ..] => comments.push(line["comment".len()..].trim_start()),
            [] | ["obj_info", ..] => {}
            ["format", kind, _] => {
                encoding = Some(match kind {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return Err(fail("unknown format").found(kind)),
                });
            }
            ["element", name, count] => {
                let count = count
                    .parse()
                    .map_err(|_| Error::new("not a count").field(format!("element {name}")).found(count).hint(AGAIN))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", "list", count, item, _] => {
                let (Some(count), Some(item)) = (Scalar::parse(count), Scalar::parse(item)) else {
                    return Err(fail("unknown type").found(line));
                };
                let e = elements.last_mut().ok_or_else(|| fail("a property before any element"))?;
                e.properties.push(Property::List(count, item));
            }
            ["property", kind, name] => {
                let kind = Scalar::parse(kind).ok_or_else(|| fail("unknown type").found(line))?;
                let e = elements.last_mut().ok_or_else(|| fail("a property before any element"))?;
                if e.properties.iter().any(|p| matches!(p, Property::Scalar(n, _) if n == name)) {
                    return Err(fail("a property is named twice").found(name));
                }
                e.properties.push(Property::Scalar(name.into(), kind));
            }
            _ => return Err(fail("not understood").found(line)),
        }
    }
    let encoding = encoding.ok_or_else(|| fail("no format line"))?;
    Ok(Header { encoding, elements, comments, body: rest })
}

fn cut_short(element: &str, rows: usize, count: usize) -> Error {
    Error::new("the file is cut short or its count lies")
        .field(format!("element {element}"))
        .found(format!("{rows} rows"))
        .expected(format!("{count} rows, as its header says"))
        .hint(AGAIN)
}

/// The properties of a position.
const PLACE: [&str; 3] = ["x", "y", "z"];

/// Rows a thread takes at a time.
const ROWS: usize = 4096;

/// A scalar property of the vertices.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Column {
    at: usize,
    scalar: Scalar,
    big: bool,
    /// The type that the header names; `scalar` is that of the rows, which may have been rewritten.
    named: Scalar,
}

impl Column {
    /// Its value in a row of words, where it is one ([`Table::words`]).
    pub(crate) fn word(self, row: &[u8]) -> u32 {
        let bytes = [row[self.at], row[self.at + 1], row[self.at + 2], row[self.at + 3]];
        if self.big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) }
    }

    /// Its value in a row, where it is a byte ([`Table::bytes`]).
    pub(crate) fn byte(self, row: &[u8]) -> u8 {
        row[self.at]
    }

    /// Whether the file stores it as a float or double.
    pub(crate) fn is_float(self) -> bool {
        matches!(self.named, Scalar::F32 | Scalar::F64)
    }

    /// The type of its values in the rows, as a header names it.
    pub(super) fn type_name(self) -> &'static str {
        self.scalar.name()
    }
}

/// The rows of an element. Binary rows without lists stay where they lie in the file; all others are rewritten
/// as little-endian floats and doubles, without their lists.
pub(crate) struct Table<'a> {
    pub(crate) name: String,
    pub(crate) count: usize,
    stride: usize,
    columns: Vec<(String, Column)>,
    rows: Cow<'a, [u8]>,
}

impl<'a> Table<'a> {
    fn new(element: &Element, encoding: Encoding, rows: Cow<'a, [u8]>) -> Self {
        let as_is = element.is_as_it_lies(encoding);
        let (mut stride, mut columns) = (0, Vec::new());
        for p in &element.properties {
            let Property::Scalar(name, named) = p else { continue };
            let scalar = if as_is { *named } else { named.rewritten() };
            let big = as_is && encoding == Encoding::Big;
            columns.push((name.clone(), Column { at: stride, scalar, big, named: *named }));
            stride += scalar.size();
        }
        Self { name: element.name.clone(), count: element.count, stride, columns, rows }
    }

    /// The table on its own, without the file.
    pub(super) fn into_owned(self) -> Table<'static> {
        let Table { count, stride, columns, rows, name } = self;
        Table { count, stride, columns, rows: Cow::Owned(rows.into_owned()), name }
    }

    /// All properties with their names, in the order of the file.
    pub(super) fn columns(&self) -> impl Iterator<Item = (&str, Column)> {
        self.columns.iter().map(|(name, column)| (name.as_str(), *column))
    }

    /// Appends the bytes of a value, little-endian.
    pub(super) fn put(&self, row: usize, column: Column, out: &mut Vec<u8>) {
        let start = row * self.stride + column.at;
        let value = &self.rows[start..start + column.scalar.size()];
        match column.big {
            true => out.extend(value.iter().rev()),
            false => out.extend_from_slice(value),
        }
    }

    /// The column of a property, where there is one.
    pub(crate) fn find(&self, name: &str) -> Option<Column> {
        self.columns.iter().find(|(n, _)| n == name).map(|(_, c)| *c)
    }

    /// How many properties have a name that begins so.
    pub(crate) fn count_of(&self, prefix: &str) -> usize {
        self.columns.iter().filter(|(n, _)| n.starts_with(prefix)).count()
    }

    /// The columns of properties that the file stores as `uint`, in binary.
    pub(crate) fn words<const N: usize>(&self, names: [&str; N]) -> Result<[Column; N]> {
        self.of_type(names, Scalar::U32, "uint")
    }

    /// The columns of properties that the file stores as `uchar`, in binary.
    pub(crate) fn bytes(&self, names: &[String]) -> Result<Vec<Column>> {
        names.iter().map(|name| self.of_type([name], Scalar::U8, "uchar").map(|[c]| c)).collect()
    }

    fn of_type<const N: usize>(&self, names: [&str; N], scalar: Scalar, expected: &str) -> Result<[Column; N]> {
        let mut all = Vec::with_capacity(N);
        for name in names {
            let found = self.find(name).filter(|c| c.scalar == scalar);
            all.push(found.ok_or_else(|| {
                Error::new("no such property in a binary PLY")
                    .field(format!("element {}, property {name}", self.name))
                    .expected(format!("property {expected} {name}"))
                    .hint(AGAIN)
            })?);
        }
        Ok(std::array::from_fn(|i| all[i]))
    }

    /// The rows as they lie, in order.
    pub(crate) fn rows(&self) -> std::slice::ChunksExact<'_, u8> {
        self.rows.chunks_exact(self.stride.max(1))
    }

    /// The values of some columns, `[count][columns]`.
    pub(crate) fn gather(&self, columns: &[Column]) -> Vec<f32> {
        let mut out = vec![0.0; self.count * columns.len()];
        if out.is_empty() {
            return out;
        }
        // Nearly every 3DGS file holds little-endian floats only: then a row is an array of words.
        let floats = self.columns.iter().all(|(_, c)| c.scalar == Scalar::F32 && !c.big);
        let words: Vec<usize> = columns.iter().map(|c| c.at / 4).collect();
        let rows = self.rows.par_chunks(ROWS * self.stride);
        out.par_chunks_mut(ROWS * columns.len()).zip(rows).for_each(|(out, rows)| {
            for (values, row) in out.chunks_exact_mut(columns.len()).zip(rows.chunks_exact(self.stride)) {
                if floats {
                    let (row, _) = row.as_chunks::<4>();
                    for (value, &word) in values.iter_mut().zip(&words) {
                        *value = f32::from_le_bytes(row[word]);
                    }
                } else {
                    for (value, column) in values.iter_mut().zip(columns) {
                        *value = column.scalar.value(&row[column.at..], column.big) as f32;
                    }
                }
            }
        });
        out
    }

    /// The positions x y z and their shift: zeros where they are no doubles, or are not far from the origin.
    pub(crate) fn places(&self) -> Result<([f64; 3], Vec<[f32; 3]>)> {
        match self.doubles() {
            Some(columns) => Ok(shifted(&self.exact(columns))),
            None => Ok(([0.0; 3], self.arrays(PLACE)?)),
        }
    }

    /// The positions x y z less a shift.
    pub(crate) fn places_less(&self, shift: [f64; 3]) -> Result<Vec<[f32; 3]>> {
        let less_shift = |p: [f64; 3]| less(p, shift);
        match self.doubles() {
            Some(columns) => Ok(self.exact(columns).into_iter().map(less_shift).collect()),
            None => Ok(self.arrays(PLACE)?.into_iter().map(|p| less_shift(p.map(f64::from))).collect()),
        }
    }

    /// The columns of x y z where some of them are doubles.
    fn doubles(&self) -> Option<[Column; 3]> {
        let [x, y, z] = PLACE.map(|name| self.find(name));
        Some([x?, y?, z?]).filter(|columns| columns.iter().any(|c| c.scalar == Scalar::F64))
    }

    fn exact(&self, columns: [Column; 3]) -> Vec<[f64; 3]> {
        self.rows().map(|row| columns.map(|c| c.scalar.value(&row[c.at..], c.big))).collect()
    }

    /// The values of some properties, `[count][properties]`.
    pub(crate) fn values(&self, names: &[impl AsRef<str>]) -> Result<Vec<f32>> {
        let column = |name: &str| {
            self.find(name).ok_or_else(|| {
                Error::new("the vertices lack a property").field(name).hint(
                    "give another kind of PLY: 3DGS Gaussians have f_dc_*, opacity, scale_* and rot_*, scans' labels label",
                )
            })
        };
        Ok(self.gather(&names.iter().map(|name| column(name.as_ref())).collect::<Result<Vec<_>>>()?))
    }

    /// The values of a few properties, one array a vertex.
    pub(crate) fn arrays<const N: usize>(&self, names: [&str; N]) -> Result<Vec<[f32; N]>> {
        Ok(self.values(&names)?.as_chunks().0.to_vec())
    }
}

/// Takes numbers off the front of an element's data, one encoding like another.
struct Numbers<'a> {
    rest: &'a [u8],
    encoding: Encoding,
    /// The current line's words, in ascii.
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Numbers<'a> {
    fn start_row(&mut self) -> Result<()> {
        if self.encoding == Encoding::Ascii {
            let end = self.rest.iter().position(|&b| b == b'\n').unwrap_or(self.rest.len());
            let line: &'a [u8] = &self.rest[..end];
            self.rest = &self.rest[(end + 1).min(self.rest.len())..];
            self.words = std::str::from_utf8(line).map_err(|_| Error::new("not text"))?.split_ascii_whitespace();
        }
        Ok(())
    }

    /// The next number of the row; none where the data end.
    fn next(&mut self, scalar: Scalar) -> Result<Option<f64>> {
        if self.encoding == Encoding::Ascii {
            let parse = |w: &str| w.parse().map_err(|_| Error::new("not a number").found(w));
            return self.words.next().map(parse).transpose();
        }
        let Some((head, rest)) = self.rest.split_at_checked(scalar.size()) else { return Ok(None) };
        self.rest = rest;
        Ok(Some(scalar.value(head, self.encoding == Encoding::Big)))
    }
}

/// Reads an element row by row: the scalars as little-endian floats, doubles as doubles, the lists skipped. Returns what lies behind it.
fn read_rows<'a>(element: &Element, encoding: Encoding, body: &'a [u8], rows: &mut Vec<u8>) -> Result<&'a [u8]> {
    let mut numbers = Numbers { rest: body, encoding, words: "".split_ascii_whitespace() };
    for row in 0..element.count {
        let at = |e: Error| e.field(format!("{} {row}", element.name)).hint(AGAIN);
        let short = || cut_short(&element.name, row, element.count);
        numbers.start_row().map_err(at)?;
        for p in &element.properties {
            match p {
                Property::Scalar(_, s) => {
                    let v = numbers.next(*s).map_err(at)?.ok_or_else(short)?;
                    match s.rewritten() {
                        Scalar::F64 => rows.extend(v.to_le_bytes()),
                        _ => rows.extend((v as f32).to_le_bytes()),
                    }
                }
                Property::List(count, item) => {
                    let n = numbers.next(*count).map_err(at)?.ok_or_else(short)?;
                    // A count that lies meets the data's end.
                    for _ in 0..n as u64 {
                        numbers.next(*item).map_err(at)?.ok_or_else(short)?;
                    }
                }
            }
        }
    }
    Ok(numbers.rest)
}

/// Takes an element's rows off the front of `body`: as they lie there, or rewritten as [`read_rows`] does.
fn take_rows<'a>(element: &Element, encoding: Encoding, body: &mut &'a [u8]) -> Result<Cow<'a, [u8]>> {
    // The smallest row that the encoding allows bounds how many the file can hold.
    let smallest = |p: &Property| match (encoding, p) {
        (Encoding::Ascii, _) => 2,
        (_, Property::Scalar(_, s) | Property::List(s, _)) => s.size(),
    };
    let stride: usize = element.properties.iter().map(smallest).sum();
    let least = stride.max(1);
    let short = || cut_short(&element.name, body.len() / least, element.count);
    // The last line of a text may lack its end.
    if element.count > (body.len() + 1) / least {
        return Err(short());
    }
    if element.is_as_it_lies(encoding) {
        let total = stride.checked_mul(element.count);
        let (head, rest) = total.and_then(|t| body.split_at_checked(t)).ok_or_else(short)?;
        *body = rest;
        return Ok(Cow::Borrowed(head));
    }
    let mut owned = Vec::new();
    *body = read_rows(element, encoding, body, &mut owned)?;
    Ok(Cow::Owned(owned))
}

/// Reads the first elements of these names of a PLY file. The others are walked through and left out: nothing may follow the
/// last one.
pub(crate) fn read_elements<'a, const N: usize>(bytes: &'a [u8], names: [&str; N]) -> Result<[Option<Table<'a>>; N]> {
    let header = parse_header(bytes)?;
    let mut body = header.body;
    let mut tables = [const { None }; N];
    for element in &header.elements {
        let rows = take_rows(element, header.encoding, &mut body)?;
        if let Some(i) = names.iter().position(|name| *name == element.name)
            && tables[i].is_none()
        {
            tables[i] = Some(Table::new(element, header.encoding, rows));
        }
    }
    if !body.trim_ascii().is_empty() {
        let counts: Vec<String> = header.elements.iter().map(|e| format!("element {} {}", e.name, e.count)).collect();
        return Err(Error::new("the file goes on after its last element, or a count in its header is too small")
            .field("header")
            .found(format!("{} bytes more", body.len()))
            .expected(format!("the end of the file after {}, as the header says", counts.join(", ")))
            .hint(AGAIN));
    }
    Ok(tables)
}

/// What is said of a file without vertices.
pub(crate) fn no_vertices() -> Error {
    Error::new("the file has no vertices").field("element vertex").hint(AGAIN)
}

/// Reads the vertices of a PLY file, as [`read_elements`] does.
pub(crate) fn read(bytes: &[u8]) -> Result<Table<'_>> {
    let [vertices] = read_elements(bytes, ["vertex"])?;
    vertices.ok_or_else(no_vertices)
}
