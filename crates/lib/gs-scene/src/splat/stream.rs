//! Numbers from the front of a stream of bytes, which knows where it stands.

use gs_io::{Error, Result};
use std::io::Read;

/// Items that are read at a time.
const BLOCK: usize = 1 << 14;

/// A stream of bytes, often decompressed ones.
pub(crate) struct Stream<R> {
    reader: R,
    /// Bytes taken so far.
    at: u64,
}

impl<R: Read> Stream<R> {
    pub fn new(reader: R) -> Self {
        Self { reader, at: 0 }
    }

    /// Fills `bytes`, which are of `field`.
    pub fn fill(&mut self, bytes: &mut [u8], field: &str) -> Result<()> {
        let at = self.at;
        self.at += bytes.len() as u64;
        self.reader.read_exact(bytes).map_err(|e| {
            let what = match e.kind() {
                std::io::ErrorKind::UnexpectedEof => "the file is cut short or its count lies".to_string(),
                _ => format!("cannot be unpacked: {e}"),
            };
            Error::new(what)
                .field(format!("{field}, byte {at} of the unpacked data"))
                .expected(format!("{} bytes more", bytes.len()))
                .hint("copy or export the file again")
        })
    }

    /// The next `N` bytes.
    pub fn array<const N: usize>(&mut self, field: &str) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        self.fill(&mut bytes, field)?;
        Ok(bytes)
    }

    /// What `take` makes of each of `count` items of `N` bytes. The list grows as the items come.
    pub fn items<const N: usize, T>(
        &mut self,
        count: usize,
        field: &str,
        mut take: impl FnMut(&[u8; N]) -> T,
    ) -> Result<Vec<T>> {
        let mut all = Vec::new();
        let mut block = vec![[0u8; N]; BLOCK.min(count)];
        while all.len() < count {
            let n = BLOCK.min(count - all.len());
            self.fill(block[..n].as_flattened_mut(), field)?;
            // Room for all as soon as a part of them is there: no more is claimed than a hundredth that came.
            if all.len() == all.capacity() {
                all.reserve_exact((count - all.len()).min(100 * all.len().max(n)));
            }
            all.extend(block[..n].iter().map(&mut take));
        }
        Ok(all)
    }

    /// Checks that nothing follows.
    pub fn end(mut self, field: &str) -> Result<()> {
        match self.reader.read(&mut [0]) {
            Ok(0) => Ok(()),
            Ok(_) => Err(Error::new("goes on where it should end")
                .field(format!("{field}, byte {} of the unpacked data", self.at))
                .hint("copy or export the file again")),
            Err(e) => Err(Error::new(format!("cannot be unpacked: {e}")).field(field)),
        }
    }

    /// Leaves out the next `count` bytes.
    pub fn skip(&mut self, count: u64, field: &str) -> Result<()> {
        let skipped = std::io::copy(&mut (&mut self.reader).take(count), &mut std::io::sink());
        match skipped {
            Ok(n) if n == count => {
                self.at += n;
                Ok(())
            }
            _ => Err(Error::new("the file is cut short").field(format!("{field}, byte {}", self.at))),
        }
    }

    /// The next `count` bytes, to read elsewhere.
    pub fn part(&mut self, count: u64) -> std::io::Take<&mut R> {
        self.at += count;
        (&mut self.reader).take(count)
    }

    /// All that follows, at most `most` bytes of it.
    pub fn rest(&mut self, most: u64, field: &str) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let read = (&mut self.reader).take(most).read_to_end(&mut bytes);
        read.map_err(|e| Error::new(format!("cannot be unpacked: {e}")).field(field))?;
        self.at += bytes.len() as u64;
        Ok(bytes)
    }
}
