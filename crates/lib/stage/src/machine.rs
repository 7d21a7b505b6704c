//! The machine that a run was made on.

use serde::{Deserialize, Serialize};
use std::path::Path;

/// What there is to say of a machine; empty or none where the system does not tell.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// Operating system and architecture, such as `linux x86_64`.
    pub system: String,
    /// Release of the kernel.
    pub kernel: String,
    /// Model of the processor.
    pub cpu: String,
    /// Cores that this process may use.
    pub cores: usize,
    /// Memory in bytes that the machine has, or that the program's control group leaves it.
    pub memory_bytes: Option<u64>,
}

/// The number after `key` in lines such as `MemTotal: 12 kB` or `inactive_file 4096`, in bytes.
fn amount(text: &str, key: &str) -> Option<u64> {
    let mut words = text.lines().find(|l| l.starts_with(key))?[key.len()..].split_whitespace();
    Some(words.next()?.parse::<u64>().ok()? * if words.next() == Some("kB") { 1024 } else { 1 })
}

fn read(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).unwrap_or_default()
}

/// Bytes that the program may take in all, and those of them that are free: the least of the machine's and of its control
/// groups' (both versions of Linux's). None where the system does not tell.
pub(crate) fn memory() -> Option<[u64; 2]> {
    let info = read("/proc/meminfo");
    let mut least = [amount(&info, "MemTotal:")?, amount(&info, "MemAvailable:")?];
    for line in read("/proc/self/cgroup").lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(group)) = (parts.next(), parts.next()) else { continue };
        let [root, limit, usage, cache] = match controllers {
            "" => ["/sys/fs/cgroup", "memory.max", "memory.current", "file "],
            c if c.split(',').any(|c| c == "memory") => {
                ["/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_cache "]
            }
            _ => continue,
        };
        for group in Path::new(group.trim_start_matches('/')).ancestors() {
            let folder = Path::new(root).join(group);
            let number = |name| read(folder.join(name)).trim().parse::<u64>().ok();
            if let (Some(limit), Some(used)) = (number(limit), number(usage)) {
                let cache = amount(&read(folder.join("memory.stat")), cache).unwrap_or(0);
                least = [least[0].min(limit), least[1].min(limit.saturating_sub(used.saturating_sub(cache)))];
            }
        }
    }
    Some(least)
}

impl Machine {
    /// This machine.
    pub fn here() -> Self {
        let value = |text: &str, key: &str| {
            let line = text.lines().find(|l| l.starts_with(key))?;
            Some(line.split_once(':')?.1.trim().to_string())
        };
        Self {
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            kernel: read("/proc/sys/kernel/osrelease").trim().into(),
            cpu: value(&read("/proc/cpuinfo"), "model name").unwrap_or_default(),
            cores: std::thread::available_parallelism().map_or(0, std::num::NonZero::get),
            memory_bytes: memory().map(|[all, _]| all),
        }
    }
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let cpu = if self.cpu.is_empty() { "unknown processor" } else { &self.cpu };
        write!(f, "{cpu}, {} cores, {}", self.cores, self.system)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_has_cores_and_on_linux_memory() {
        let here = Machine::here();
        assert!(here.cores > 0 && here.system.contains(std::env::consts::ARCH), "{here:?}");
        if cfg!(target_os = "linux") {
            let [all, free] = memory().unwrap();
            assert!(here.memory_bytes == Some(all) && free <= all && free > 1 << 26, "{here:?} {free}");
            assert!(!here.kernel.is_empty(), "{here:?}");
        }
    }
}
