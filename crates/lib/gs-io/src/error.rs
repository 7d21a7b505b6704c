//! The one error type of the workspace.

use crate::names::escaped;
use std::fmt;
use std::path::{Path, PathBuf};

/// Result with the workspace's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What kind of error it is, for programs that call these ones.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ErrorKind {
    /// An option, a file or a setting is not what it must be.
    #[default]
    Invalid,
    /// The system could not read or write a file.
    Io,
    /// It could be done, but something would be lost, or more taken than allowed.
    Refused,
    /// The person or the system asked the program to stop.
    Interrupted,
}

/// Why something could not be done, for the person who has to fix it: one line that names the file, the field, what
/// was found, what was expected and what to do.
///
/// ```
/// use gs_io::Error;
/// let e = Error::new("truncated file")
///     .file("scene/sparse/0/cameras.bin")
///     .field("camera count")
///     .found("18446744073709551615")
///     .expected("at most 12, by the file's length")
///     .hint("export the COLMAP model again");
/// assert_eq!(
///     e.to_string(),
///     "scene/sparse/0/cameras.bin: camera count: truncated file; found 18446744073709551615, \
///      expected at most 12, by the file's length; export the COLMAP model again"
/// );
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Error(Box<Parts>);

#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Parts {
    kind: ErrorKind,
    what: String,
    file: Option<PathBuf>,
    field: Option<String>,
    found: Option<String>,
    expected: Option<String>,
    hint: Option<String>,
}

impl Error {
    /// An error that says `what` is wrong.
    pub fn new(what: impl Into<String>) -> Self {
        Self(Box::new(Parts { what: what.into(), ..Parts::default() }))
    }

    /// An error of another kind than [`ErrorKind::Invalid`].
    pub fn of(kind: ErrorKind, what: impl Into<String>) -> Self {
        Self(Box::new(Parts { kind, what: what.into(), ..Parts::default() }))
    }

    /// Which kind of error it is.
    pub fn kind(&self) -> ErrorKind {
        self.0.kind
    }

    /// Names the file (or folder) at fault. The first file named stays: inner layers know best.
    #[must_use]
    pub fn file(mut self, file: impl AsRef<Path>) -> Self {
        self.0.file.get_or_insert_with(|| file.as_ref().to_path_buf());
        self
    }

    /// Names the field, tensor, property or option at fault. The first field named stays.
    #[must_use]
    pub fn field(mut self, field: impl Into<String>) -> Self {
        self.0.field.get_or_insert_with(|| field.into());
        self
    }

    /// The file at fault, if one is named.
    pub fn at_fault(&self) -> Option<&Path> {
        self.0.file.as_deref()
    }

    /// What was found there.
    #[must_use]
    pub fn found(mut self, found: impl fmt::Display) -> Self {
        self.0.found = Some(found.to_string());
        self
    }

    /// What was expected instead.
    #[must_use]
    pub fn expected(mut self, expected: impl fmt::Display) -> Self {
        self.0.expected = Some(expected.to_string());
        self
    }

    /// What the person can do about it.
    #[must_use]
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.0.hint.get_or_insert_with(|| hint.into());
        self
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let p = &self.0;
        let place = [p.file.as_ref().map(|f| f.display().to_string()), p.field.clone()];
        let values = [("found", &p.found), ("expected", &p.expected)];
        let values = values.iter().filter_map(|(word, v)| Some(format!("{word} {}", v.as_ref()?)));
        let values = values.collect::<Vec<_>>().join(", ");
        let mut line: String = place.iter().flatten().map(|part| format!("{part}: ")).collect();
        line += &p.what;
        for part in [Some(&values).filter(|v| !v.is_empty()), p.hint.as_ref()].into_iter().flatten() {
            line += &format!("; {part}");
        }
        f.write_str(&escaped(&line))
    }
}

impl std::error::Error for Error {}

/// Gives an [`std::io::Result`] the path it was about.
pub trait IoContext<T> {
    /// Turns an I/O error into an [`Error`] that says which `file` could not be handled, and how (`action`: "read",
    /// "create", …).
    fn at(self, action: &str, file: impl AsRef<Path>) -> Result<T>;
}

impl<T> IoContext<T> for std::io::Result<T> {
    fn at(self, action: &str, file: impl AsRef<Path>) -> Result<T> {
        self.map_err(|e| {
            let hint = match e.kind() {
                std::io::ErrorKind::NotFound => "check the path",
                std::io::ErrorKind::PermissionDenied | std::io::ErrorKind::ReadOnlyFilesystem => {
                    "check the permissions, or choose another output folder"
                }
                std::io::ErrorKind::StorageFull => "free some disk space",
                std::io::ErrorKind::FileTooLarge => "raise the limit on the length of files (ulimit -f)",
                std::io::ErrorKind::UnexpectedEof => "the file is cut short: make or copy it again",
                _ => "check the file and its folder",
            };
            Error::of(ErrorKind::Io, format!("cannot {action}: {e}")).file(file).hint(hint)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stays_one_line_and_keeps_the_innermost_file() {
        let e = Error::new("bad\nname").file("inner").file("outer").field("a").field("b");
        assert_eq!(e.to_string(), "inner: a: bad\\nname");
        let e = Error::new("no such view").file("été\t\x1b[31m/\u{85}").found("a\r\\").to_string();
        assert_eq!(e, "été\\t\\u{1b}[31m/\\u{85}: no such view; found a\\r\\");
        assert_eq!(escaped(&e), e);
    }

    #[test]
    fn io_errors_carry_their_path() {
        let e = std::fs::read("/no/such/file").at("read", "/no/such/file").unwrap_err();
        assert!(e.to_string().starts_with("/no/such/file: cannot read: "), "{e}");
        assert!(e.to_string().ends_with("check the path"), "{e}");
        assert_eq!((e.kind(), Error::new("x").kind()), (ErrorKind::Io, ErrorKind::Invalid));
    }
}
