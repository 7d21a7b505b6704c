//! What is too large for memory, in files without a name that go with the process.

use bytemuck::Pod;
use gs_io::{IoContext, Result};
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

const READ: &str = "read a scratch file in";
const WRITE: &str = "write a scratch file in";

/// A scratch file in the folder in which `output` will lie, and this folder.
fn file_beside(output: &Path) -> Result<(File, PathBuf)> {
    let folder = match output.parent() {
        Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
        _ => PathBuf::from("."),
    };
    gs_io::create_dir(&folder)?;
    Ok((tempfile::tempfile_in(&folder).at("create a scratch file in", &folder)?, folder))
}

/// Values in a scratch file: written once, read often, by several threads.
#[derive(Debug)]
pub struct Scratch {
    file: Mutex<File>,
    length: u64,
    folder: PathBuf,
}

impl Scratch {
    /// An empty one in the folder in which `output` will lie.
    ///
    /// # Errors
    /// When it cannot be made there.
    pub fn beside(output: &Path) -> Result<Self> {
        let (file, folder) = file_beside(output)?;
        Ok(Self { file: Mutex::new(file), length: 0, folder })
    }

    /// Adds values. Returns where they lie.
    ///
    /// # Errors
    /// When the disk is full.
    pub fn push<T: Pod>(&mut self, values: &[T]) -> Result<u64> {
        let at = self.length;
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let file = self.file.get_mut().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(at)).at(WRITE, &self.folder)?;
        file.write_all(bytes).at(WRITE, &self.folder)?;
        self.length += bytes.len() as u64;
        Ok(at)
    }

    /// The `count` values that lie at `at`.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn read<T: Pod>(&self, at: u64, count: usize) -> Result<Vec<T>> {
        let mut out = vec![T::zeroed(); count];
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(at)).at(READ, &self.folder)?;
        file.read_exact(bytemuck::cast_slice_mut(&mut out)).at(READ, &self.folder)?;
        Ok(out)
    }
}

/// Entries of footprints in scratch files, so that no more than one view's are in memory while they are
/// computed.
#[derive(Debug)]
pub struct ScratchEntries {
    col: BufWriter<File>,
    weight: BufWriter<File>,
    /// Entries so far.
    pub count: u64,
    folder: PathBuf,
}

impl ScratchEntries {
    /// Bytes worked on at a time when columns are numbered anew.
    const CHUNK: usize = 1 << 20;

    /// Scratch files in the folder in which `output` will lie.
    ///
    /// # Errors
    /// When they cannot be made there.
    pub fn beside(output: &Path) -> Result<Self> {
        let ((col, folder), (weight, _)) = (file_beside(output)?, file_beside(output)?);
        Ok(Self { col: BufWriter::new(col), weight: BufWriter::new(weight), count: 0, folder })
    }

    /// Adds an entry.
    ///
    /// # Errors
    /// When the disk is full.
    pub fn push(&mut self, col: u32, weight: f32) -> Result<()> {
        self.count += 1;
        self.col.write_all(&col.to_ne_bytes()).at(WRITE, &self.folder)?;
        self.weight.write_all(&weight.to_ne_bytes()).at(WRITE, &self.folder)
    }

    /// Replaces every column `c` by `position[c]`.
    ///
    /// # Errors
    /// When a scratch file cannot be read or written.
    pub fn renumber(&mut self, position: &[u32]) -> Result<()> {
        let folder = &self.folder;
        self.col.flush().at(WRITE, folder)?;
        let file = self.col.get_mut();
        let (mut at, end) = (0, 4 * self.count);
        let mut bytes = vec![0u8; Self::CHUNK];
        while at < end {
            let some = &mut bytes[..Self::CHUNK.min((end - at) as usize)];
            file.seek(SeekFrom::Start(at)).at(READ, folder)?;
            file.read_exact(some).at(READ, folder)?;
            for c in some.chunks_exact_mut(4) {
                let old = u32::from_ne_bytes([c[0], c[1], c[2], c[3]]);
                c.copy_from_slice(&position[old as usize].to_ne_bytes());
            }
            file.seek(SeekFrom::Start(at)).at(WRITE, folder)?;
            file.write_all(some).at(WRITE, folder)?;
            at += some.len() as u64;
        }
        Ok(())
    }

    /// The files of columns and of weights.
    pub(crate) fn finish(self) -> Result<(File, File)> {
        let folder = self.folder;
        let done = |w: BufWriter<File>| w.into_inner().map_err(std::io::IntoInnerError::into_error).at(WRITE, &folder);
        Ok((done(self.col)?, done(self.weight)?))
    }
}
