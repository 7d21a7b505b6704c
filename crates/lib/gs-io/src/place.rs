//! Where files are, and which is which.

use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// `<path><suffix>`: the name of a file beside another.
pub fn with_suffix(path: impl AsRef<Path>, suffix: &str) -> PathBuf {
    let mut name = path.as_ref().as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// The folder that a file lies in.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// The file that `path` leads to through symbolic links, there or not.
pub(crate) fn resolve(path: &Path) -> PathBuf {
    let mut target = path.to_path_buf();
    // More links than systems follow are a circle.
    for _ in 0..40 {
        let Ok(next) = std::fs::read_link(&target) else { break };
        target = folder_of(&target).join(next);
    }
    target
}

/// The one name of a file, there or not: its folder without links, and its own name.
pub(crate) fn place(path: &Path) -> PathBuf {
    let folder = folder_of(path);
    let folder = folder.canonicalize().unwrap_or_else(|_| match folder.file_name() {
        // A folder that will be made has the same name before and after.
        Some(_) => place(folder),
        None => std::path::absolute(folder).unwrap_or_else(|_| folder.into()),
    });
    folder.join(path.file_name().unwrap_or_default())
}

/// Device and number of a file, where the system has them.
pub(crate) fn node(m: &Metadata) -> Option<(u64, u64)> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        Some((m.dev(), m.ino()))
    }
    #[cfg(not(unix))]
    {
        let _ = m;
        None
    }
}

/// What tells one file from another, whatever it is called.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Identity {
    Node(u64, u64),
    Path(PathBuf),
}

/// The identity of what stands at `path`, through links; None where nothing does.
pub(crate) fn identity(path: &Path) -> Option<Identity> {
    match node(&std::fs::metadata(path).ok()?) {
        Some((device, number)) => Some(Identity::Node(device, number)),
        None => path.canonicalize().ok().map(Identity::Path),
    }
}

/// Length, time of the last change, and [`node`]: a copy under the same name is another file.
pub(crate) type Stamp = (u64, Option<SystemTime>, Option<(u64, u64)>);

/// How a file is now.
pub(crate) fn stamp(m: &Metadata) -> Stamp {
    (m.len(), m.modified().ok(), node(m))
}
