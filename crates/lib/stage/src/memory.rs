//! Amounts of memory, and what a run may take.

use crate::allocator::HINT;
use crate::{Stage, machine};
use gs_io::{Error, ErrorKind, Result};
use std::fmt;
use std::str::FromStr;

/// A number of bytes, written and read as `512M`, `2G`, `1.5G`, `64K` or `0` (powers of 1024).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
pub struct Bytes(pub u64);

impl FromStr for Bytes {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let plain = s.strip_suffix("iB").or_else(|| s.strip_suffix('B')).unwrap_or(s);
        let power = plain.chars().last().and_then(|unit| "KMGT".find(unit.to_ascii_uppercase()));
        let digits = &plain[..plain.len() - usize::from(power.is_some())];
        // A bare number could be taken for megabytes as well as bytes.
        let unit = power.map_or(0.0, |p| 1024f64.powi(p as i32 + 1));
        let value = digits.parse().ok().filter(|v| (0.0..1e6).contains(v) && (unit > 0.0 || *v == 0.0));
        value.map(|v: f64| Self((v * unit) as u64)).ok_or_else(|| {
            Error::new("not an amount of memory").found(s).expected("a number with a unit such as 512M or 2G, or 0")
        })
    }
}

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (unit, shift) in [("T", 40), ("G", 30), ("M", 20), ("K", 10)] {
            if self.0 >= 1 << shift {
                let value = self.0 as f64 / (1u64 << shift) as f64;
                let digits = usize::from(value.fract() != 0.0 && value < 100.0);
                return write!(f, "{value:.digits$}{unit}");
            }
        }
        write!(f, "{}", self.0)
    }
}

impl Stage {
    /// Says how much memory the run will take at its peak, and [`Self::needs_at_once`] it.
    pub fn forecast(&self, bytes: u64, hint: &str) -> Result<()> {
        self.info(&format!("memory: about {} at the peak", Bytes(bytes)));
        self.needs_at_once(bytes, hint)
    }

    /// Notes how much memory the run will take at its peak for the record, refuses more than `--memory-limit`, and warns of
    /// more than is free. `hint` says what would take less.
    pub fn needs(&self, bytes: u64, hint: &str) -> Result<()> {
        self.compare(bytes, hint, false)
    }

    /// The same, but without `--memory-limit` what the machine, or the program's control group, has in all is the limit.
    /// Forecasts are up to a quarter above the peak: less above the limit is a warning.
    pub fn needs_at_once(&self, bytes: u64, hint: &str) -> Result<()> {
        self.compare(bytes, hint, true)
    }

    fn compare(&self, bytes: u64, hint: &str, at_once: bool) -> Result<()> {
        *self.predicted.lock().expect("no panic holds this lock") = Some(bytes);
        // The first is kept.
        let _ = HINT.set(hint.into());
        match (self.common.memory_limit, machine::memory()) {
            (Some(limit), _) if bytes > limit.0 => return Err(too_much(bytes, limit, hint).field("--memory-limit")),
            (None, Some([all, _])) if at_once && bytes / 5 * 4 > all => {
                let hint = format!("{hint}, or --memory-limit to try it all the same");
                return Err(too_much(bytes, Bytes(all), &hint).field("memory of this machine or its control group"));
            }
            // What the program holds already is part of both.
            (None, Some([_, free])) if bytes > free + crate::peak_rss_bytes().unwrap_or(0) => {
                self.warn(&format!("memory: about {} needed, {} free; {hint}", Bytes(bytes), Bytes(free)));
            }
            _ => {}
        }
        Ok(())
    }
}

fn too_much(bytes: u64, limit: Bytes, hint: &str) -> Error {
    Error::of(ErrorKind::Refused, "the run needs more memory than it may take")
        .found(format!("about {} needed", Bytes(bytes)))
        .expected(format!("at most {limit}"))
        .hint(hint)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CommonArgs;

    #[test]
    fn amounts_are_read_and_written() {
        for (s, n) in
            [("2G", 2u64 << 30), ("512M", 512 << 20), ("1.5GiB", 3 << 29), ("64kB", 65_536), ("0", 0), ("1T", 1 << 40)]
        {
            assert_eq!(s.parse::<Bytes>().unwrap(), Bytes(n), "{s}");
        }
        for wrong in ["", "G", "2048", "-1G", "nanG", "infG", "2X", "1e9G"] {
            assert!(wrong.parse::<Bytes>().is_err(), "{wrong}");
        }
        for (n, s) in [(2u64 << 30, "2G"), (3 << 29, "1.5G"), (700 << 20, "700M"), (12, "12")] {
            assert_eq!(Bytes(n).to_string(), s);
        }
    }

    #[test]
    fn more_than_the_limit_is_refused() {
        let stage = |limit: Option<&str>| {
            let memory_limit = limit.map(|l| l.parse().unwrap());
            Stage::new("gs-geom", &CommonArgs { quiet: true, memory_limit, ..CommonArgs::default() })
        };
        assert!(stage(None).needs(u64::MAX, "").is_ok());
        assert!(stage(Some("2M")).needs(2 << 20, "").is_ok());
        let e = stage(Some("2M")).needs(3 << 20, "give fewer").unwrap_err().to_string();
        assert!(
            e.contains("--memory-limit") && e.contains("3M") && e.contains("2M") && e.contains("give fewer"),
            "{e}"
        );
    }
}
