//! Watches a run from outside: how long an iteration takes, whether a gap is explained in a log, and the memory of processes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A run that stands still for longer must have said why.
pub(crate) const GAP: Duration = Duration::from_secs(10);

/// Counts warnings and errors in logs that grow.
#[derive(Debug, Default)]
pub(crate) struct Logs {
    read: BTreeMap<PathBuf, u64>,
    pub(crate) warnings: u64,
}

impl Logs {
    pub(crate) fn look(&mut self, logs: &[PathBuf]) {
        for path in logs {
            let from = self.read.entry(path.clone()).or_default();
            let Ok(mut file) = File::open(path) else { continue };
            let mut bytes = Vec::new();
            if file.seek(SeekFrom::Start(*from)).is_err() || file.read_to_end(&mut bytes).is_err() {
                continue;
            }
            // Whole lines only.
            let end = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1);
            *from += end as u64;
            let text = String::from_utf8_lossy(&bytes[..end]).into_owned();
            assert!(!text.contains("panicked at"), "{}: {text}", path.display());
            let lines = text.lines();
            self.warnings += lines.filter(|line| line.contains(" WARN ") || line.contains("ERROR")).count() as u64;
        }
    }
}

/// The longest time without an iteration.
#[derive(Debug)]
pub(crate) struct Gaps {
    iteration: u32,
    since: Instant,
    /// When the iteration was still that one.
    seen: Instant,
    warnings: u64,
    pub(crate) longest: Duration,
    pub(crate) explained: u32,
}

impl Default for Gaps {
    fn default() -> Self {
        Self {
            iteration: 0,
            since: Instant::now(),
            seen: Instant::now(),
            warnings: 0,
            longest: Duration::ZERO,
            explained: 0,
        }
    }
}

impl Gaps {
    /// The learner's answer at this moment, if it answers.
    pub(crate) fn look(&mut self, iteration: Option<u32>, warnings: u64) {
        let Some(iteration) = iteration else { return };
        if iteration == self.iteration {
            self.seen = Instant::now();
            return;
        }
        // At least: between two looks, which faults keep apart, the next one may have come at once.
        let gap = self.seen.saturating_duration_since(self.since);
        self.longest = self.longest.max(gap);
        if gap > GAP {
            assert!(warnings > self.warnings, "no iteration after {} for {gap:?}, and no log says why", self.iteration);
            self.explained += 1;
        }
        (self.iteration, self.since, self.seen, self.warnings) = (iteration, Instant::now(), Instant::now(), warnings);
    }
}

/// Resident memory of a process over time.
#[derive(Debug, Default)]
pub(crate) struct Memory(Vec<(f64, f64)>);

impl Memory {
    pub(crate) fn look(&mut self, pid: u32, since: Instant) {
        let text = std::fs::read_to_string(Path::new("/proc").join(pid.to_string()).join("status")).unwrap_or_default();
        let kib =
            text.lines().find_map(|line| line.strip_prefix("VmRSS:")?.split_whitespace().next()?.parse::<f64>().ok());
        if let Some(kib) = kib {
            self.0.push((since.elapsed().as_secs_f64() / 3600.0, kib / 1024.0));
        }
    }

    /// Values at a few moments, the first and the last among them.
    pub(crate) fn course(&self) -> String {
        const MOMENTS: usize = 6;
        let last = self.0.len().saturating_sub(1);
        let at = |k: usize| self.0.get(k * last / MOMENTS).map_or(0.0, |at| at.1);
        (0..=MOMENTS).map(|k| format!("{:.1}", at(k))).collect::<Vec<_>>().join(" ")
    }

    /// Slope of the least squares in MiB per hour, without the first third: caches fill.
    pub(crate) fn slope(&self) -> f64 {
        let late = &self.0[self.0.len() / 3..];
        let count = late.len().max(1) as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| late.iter().map(of).sum::<f64>() / count;
        let (x, y) = (mean(|at| at.0), mean(|at| at.1));
        let (mut above, mut below) = (0.0, 1e-12);
        for (hour, mib) in late {
            above += (hour - x) * (mib - y);
            below += (hour - x) * (hour - x);
        }
        above / below
    }
}
