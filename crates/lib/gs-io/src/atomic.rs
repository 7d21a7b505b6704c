//! Outputs that appear whole or not at all.

use crate::expected::put;
use crate::place::{folder_of, resolve};
use crate::{IoContext, Result};
use std::fs;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Creates a folder and its parents.
pub fn create_dir(dir: impl AsRef<Path>) -> Result<()> {
    fs::create_dir_all(&dir).at("create the folder", &dir)
}

/// Writes `path` through `fill`: to a temporary name in the same folder, flushed to the disk, then renamed. A crash, a
/// full disk or an error from `fill` leaves whatever stood at `path` untouched, and so does a file that another program put
/// there since this one took the right to write ([`crate::Outputs::claim`]). A symbolic link stays, and the file that it
/// leads to is written; a file keeps its permissions.
pub fn write_atomic(path: impl AsRef<Path>, fill: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let given = path.as_ref();
    let path = &resolve(given);
    let folder = folder_of(path);
    create_dir(folder)?;
    let stem = path.file_name().unwrap_or_default().to_string_lossy();
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{stem}.");
    builder.prefix(&prefix).suffix(".partial");
    #[cfg(unix)]
    {
        // tempfile's default is 0600; an artifact is an ordinary file, subject to the umask.
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    let file = builder.tempfile_in(folder).at("create a file beside", path)?;
    let mut out = BufWriter::with_capacity(1 << 20, file);
    fill(&mut out)?;
    let file = out.into_inner().map_err(std::io::IntoInnerError::into_error).at("write", path)?;
    if let Ok(old) = fs::metadata(path) {
        file.as_file().set_permissions(old.permissions()).at("keep the permissions of", path)?;
    }
    file.as_file().sync_all().at("flush", path)?;
    put(file, given, path)
}

/// Writes `bytes` to `path` as [`write_atomic`] does.
pub fn write_bytes(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let path = path.as_ref();
    write_atomic(path, |w| w.write_all(bytes).at("write", path))
}

/// Writes a value as JSON for people, with line breaks, as [`write_atomic`] does.
pub fn write_json(path: impl AsRef<Path>, value: &impl serde::Serialize) -> Result<()> {
    let path = path.as_ref();
    let json = serde_json::to_vec_pretty(value).map_err(|e| crate::Error::new(e.to_string()).file(path))?;
    write_bytes(path, &json)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Error;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_litter() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.bin");
        write_bytes(&path, b"good").unwrap();
        let e = write_atomic(&path, |w| {
            w.write_all(b"half").at("write", &path)?;
            Err(Error::new("no more"))
        });
        assert!(e.is_err());
        assert_eq!(fs::read(&path).unwrap(), b"good");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn links_and_permissions_stay() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let dir = tempfile::tempdir().unwrap();
        let [real, link, dangling] = ["real", "link", "dangling"].map(|n| dir.path().join(n));
        fs::write(&real, "old").unwrap();
        fs::set_permissions(&real, fs::Permissions::from_mode(0o640)).unwrap();
        symlink("real", &link).unwrap();
        symlink("new", &dangling).unwrap();
        write_bytes(&link, b"one").unwrap();
        write_bytes(&dangling, b"two").unwrap();
        assert!(link.is_symlink() && dangling.is_symlink());
        assert_eq!(fs::read(&real).unwrap(), b"one");
        assert_eq!(fs::metadata(&real).unwrap().permissions().mode() & 0o777, 0o640);
        assert_eq!(fs::read(dir.path().join("new")).unwrap(), b"two");
    }

    #[test]
    fn a_file_in_the_way_of_a_folder_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let blocker = dir.path().join("f");
        fs::write(&blocker, "x").unwrap();
        let e = write_bytes(blocker.join("a.bin"), b"1").unwrap_err().to_string();
        assert!(e.contains("cannot create the folder"), "{e}");
    }
}
