//! metrics.jsonl: one line per iteration, from 0: the number is the version of the weights that it evaluates and rolls out.
//! docs/metrics.md lists every field.

use crate::checkpoint::disk::{FileSystem, replace_file};
use crate::report::observer::{FileError, RunObserver};
use crate::report::records::IterationMetrics;
use magex_proto::v1::IterationEvent;
use magex_runtime::limits::explained;
use std::collections::{BTreeMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

/// Limit of the lines kept while the file cannot be written; the oldest are dropped first.
const MAX_WAITING: usize = 4096;

/// metrics.jsonl of a run folder. Lines that cannot be written wait until they can: neither a full disk nor a kill leaves half
/// a line in the middle.
#[derive(Debug)]
pub(crate) struct MetricsFile {
    path: PathBuf,
    file: File,
    /// Bytes of whole lines.
    length: u64,
    waiting: VecDeque<String>,
}

impl MetricsFile {
    pub(crate) fn create(folder: &Path) -> Result<Self, FileError> {
        let path = folder.join("metrics.jsonl");
        File::create(&path).map_err(|error| FileError { path: path.clone(), error })?;
        Self::open(path)
    }

    /// The file of a resumed run, truncated to the `iteration` iterations that the checkpoint contains, 0 to `iteration` - 1:
    /// the others will be repeated, with the same numbers.
    pub(crate) fn reopen(folder: &Path, iteration: u32) -> Result<Self, FileError> {
        let path = folder.join("metrics.jsonl");
        let io = |error| FileError { path: path.clone(), error };
        let bytes = std::fs::read(&path).or_else(|error| match error.kind() {
            ErrorKind::NotFound => Ok(Vec::new()),
            _ => Err(io(error)),
        })?;
        let trained = |line: &str| {
            let value = serde_json::from_str::<serde_json::Value>(line).ok().filter(|v| !v["executor"].is_null())?;
            value["iteration"].as_u64().filter(|&number| number < iteration.into())
        };
        let text = String::from_utf8_lossy(&bytes);
        // By number: each iteration is there once and in order, whatever wrote to the file.
        let lines: BTreeMap<u64, &str> = text.lines().filter_map(|line| Some((trained(line)?, line))).collect();
        let missing = u64::from(iteration).saturating_sub(lines.len() as u64);
        if missing > 0 {
            tracing::warn!(missing, path = %path.display(), "lines of earlier iterations are missing");
        }
        let kept: String = lines.values().flat_map(|line| [*line, "\n"]).collect();
        // Truncation works on a full disk, so a full disk does not keep a run from resuming.
        if bytes.starts_with(kept.as_bytes()) && path.exists() {
            let file = OpenOptions::new().write(true).open(&path).map_err(io)?;
            file.set_len(kept.len() as u64).map_err(io)?;
        } else {
            replace_file(&mut FileSystem, folder, "metrics.jsonl", kept.as_bytes()).map_err(io)?;
        }
        Self::open(path)
    }

    pub(crate) fn last_line(folder: &Path) -> Option<String> {
        let text = std::fs::read_to_string(folder.join("metrics.jsonl")).ok()?;
        text.lines().next_back().map(str::to_owned)
    }

    fn open(path: PathBuf) -> Result<Self, FileError> {
        let opened = OpenOptions::new().append(true).open(&path).and_then(|file| Ok((file.metadata()?.len(), file)));
        let (length, file) = opened.map_err(|error| FileError { path: path.clone(), error })?;
        Ok(Self { path, file, length, waiting: VecDeque::new() })
    }

    fn write_waiting(&mut self) -> std::io::Result<()> {
        while let Some(line) = self.waiting.front() {
            if let Err(error) = self.file.write_all(line.as_bytes()) {
                // A part of the line may be written. Truncation works on a full disk.
                self.file.set_len(self.length)?;
                return Err(explained(error));
            }
            self.length += line.len() as u64;
            self.waiting.pop_front();
        }
        Ok(())
    }
}

impl RunObserver for MetricsFile {
    /// Appends a line. If it cannot be written, it is written with the next one.
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        let failed_before = !self.waiting.is_empty();
        self.waiting.push_back(format!("{}\n", report.metrics_json));
        if self.waiting.len() > MAX_WAITING {
            self.waiting.pop_front();
        }
        match self.write_waiting() {
            Ok(()) if failed_before => tracing::info!("metrics.jsonl can be written again"),
            Ok(()) => {}
            Err(error) if failed_before => tracing::debug!(%error, "metrics.jsonl still cannot be written"),
            Err(error) => tracing::error!(%error, "metrics.jsonl cannot be written; its lines wait until it can"),
        }
    }

    fn went_back(&mut self, folder: &Path, iteration: u32, _joint_env_steps: u64) -> Result<(), FileError> {
        *self = Self::reopen(folder, iteration)?;
        Ok(())
    }

    fn sync(&mut self) {
        if let Err(error) = self.file.sync_data() {
            tracing::debug!(%error, "metrics.jsonl cannot be made durable");
        }
    }

    fn flush(&mut self) -> Result<(), FileError> {
        self.write_waiting().map_err(|error| FileError { path: self.path.clone(), error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt as _;

    fn line(iteration: u32) -> String {
        format!("{{\"iteration\":{iteration},\"executor\":{{}}}}\n")
    }

    #[test]
    fn iterations_that_a_resume_repeats_are_truncated_in_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let half = line(3)[..9].to_owned();
        std::fs::write(&path, line(0) + &line(1) + &line(2) + &half).unwrap();
        let file = std::fs::metadata(&path).unwrap().ino();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(0) + &line(1));
        // The file was truncated, not replaced.
        assert_eq!(std::fs::metadata(&path).unwrap().ino(), file);
        assert_eq!(MetricsFile::last_line(folder.path()).unwrap(), line(1).trim_end());
        // An invalid line in the middle is removed.
        std::fs::write(&path, line(0) + "half\n" + &line(1)).unwrap();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(0) + &line(1));
        // Two processes wrote at once.
        std::fs::write(&path, [2, 3, 0, 4, 1, 3, 2].map(line).concat()).unwrap();
        MetricsFile::reopen(folder.path(), 4).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), [0, 1, 2, 3].map(line).concat());
    }
}
