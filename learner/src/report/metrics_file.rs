//! metrics.jsonl: one line per iteration, from 0: the number is the version of the weights that it evaluates and rolls out.
//! docs/metrics.md lists every field.

use crate::checkpoint::disk::{Disk, Place, identity, replace_file};
use crate::report::observer::{FileError, RunObserver};
use crate::report::records::IterationMetrics;
use magex_proto::v1::IterationEvent;
use std::collections::{BTreeMap, VecDeque};
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const NAME: &str = "metrics.jsonl";

/// Limit of the lines kept while the file cannot be written; the oldest are dropped first.
const MAX_WAITING: usize = 4096;

/// metrics.jsonl of a run folder. Lines that cannot be written wait until they can: neither a full disk nor a kill leaves half
/// a line in the middle.
#[derive(Debug)]
pub(crate) struct MetricsFile {
    disk: Arc<dyn Disk>,
    place: Place,
    path: PathBuf,
    /// Which file it is, and the bytes of whole lines in it.
    identity: Option<(u64, u64)>,
    length: u64,
    waiting: VecDeque<String>,
    /// Its entry in the folder would not survive a power cut yet.
    fresh: bool,
}

impl MetricsFile {
    pub(crate) fn create(disk: Arc<dyn Disk>, place: Place) -> Result<Self, FileError> {
        let mut file = Self::of(disk, place);
        file.disk.write(&file.path, b"").map_err(|error| file.failed(error))?;
        (file.identity, file.fresh) = (identity(&file.path), true);
        Ok(file)
    }

    /// The file of a resumed run, truncated to the `iteration` iterations that the checkpoint contains, 0 to `iteration` - 1:
    /// the others will be repeated, with the same numbers. Also returns the iterations whose lines are missing.
    pub(crate) fn reopen(disk: Arc<dyn Disk>, place: Place, iteration: u32) -> Result<(Self, Vec<u32>), FileError> {
        let mut file = Self::of(disk, place);
        let bytes = std::fs::read(&file.path).or_else(|error| match error.kind() {
            ErrorKind::NotFound => Ok(Vec::new()),
            _ => Err(file.failed(error)),
        })?;
        let text = String::from_utf8_lossy(&bytes);
        // By number: each iteration is there once and in order, whatever wrote to the file.
        let numbered = |line| Some((number(line).filter(|&number| number < iteration)?, line));
        let lines: BTreeMap<u32, &str> = text.lines().filter_map(numbered).collect();
        let missing = (0..iteration).filter(|number| !lines.contains_key(number)).collect();
        let kept: String = lines.values().flat_map(|line| [*line, "\n"]).collect();
        // Truncation works on a full disk, so a full disk does not keep a run from resuming.
        let prepared = if bytes.starts_with(kept.as_bytes()) && file.path.exists() {
            file.disk.truncate(&file.path, kept.len() as u64)
        } else {
            replace_file(&*file.disk, file.place.folder(), NAME, kept.as_bytes())
        };
        prepared.map_err(|error| file.failed(error))?;
        (file.identity, file.length) = (identity(&file.path), kept.len() as u64);
        Ok((file, missing))
    }

    pub(crate) fn last_line(folder: &Path) -> Option<String> {
        let text = std::fs::read_to_string(folder.join(NAME)).ok()?;
        text.lines().next_back().map(str::to_owned)
    }

    fn of(disk: Arc<dyn Disk>, place: Place) -> Self {
        let path = place.folder().join(NAME);
        Self { disk, place, path, identity: None, length: 0, waiting: VecDeque::new(), fresh: false }
    }

    fn failed(&self, error: Error) -> FileError {
        FileError { path: self.path.clone(), error }
    }

    fn write_waiting(&mut self) -> Result<(), Error> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        self.place.check()?;
        self.find()?;
        while let Some(line) = self.waiting.front() {
            if let Err(error) = self.disk.append(&self.path, line.as_bytes()) {
                // A part of the line may be written. Truncation works on a full disk.
                self.disk.truncate(&self.path, self.length)?;
                return Err(error);
            }
            self.length += line.len() as u64;
            self.waiting.pop_front();
        }
        Ok(())
    }

    /// Another program may have removed the file, replaced it, or cut it: that is said, and the lines that follow are written
    /// to what is there.
    fn find(&mut self) -> Result<(), Error> {
        let there = identity(&self.path);
        let length = std::fs::metadata(&self.path).map_or(0, |file| file.len());
        if there == self.identity && length >= self.length {
            return Ok(());
        }
        if there.is_none() {
            self.disk.write(&self.path, b"")?;
            self.fresh = true;
        }
        let bytes = std::fs::read(&self.path)?;
        self.length = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last as u64 + 1);
        self.disk.truncate(&self.path, self.length)?;
        self.identity = identity(&self.path);
        let lines = bytes.iter().filter(|&&byte| byte == b'\n').count();
        tracing::error!(
            path = %self.path.display(), lines,
            "another program removed, replaced or cut this file; lines of earlier iterations are missing from it"
        );
        Ok(())
    }
}

/// The number of a line of an iteration that was trained.
fn number(line: &str) -> Option<u32> {
    let value = serde_json::from_str::<serde_json::Value>(line).ok().filter(|value| !value["executor"].is_null())?;
    value["iteration"].as_u64()?.try_into().ok()
}

/// Numbers for people: `0–3, 7`.
pub(crate) fn ranges(numbers: &[u32]) -> String {
    let mut spans: Vec<(u32, u32)> = Vec::new();
    for &number in numbers {
        match spans.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => spans.push((number, number)),
        }
    }
    let told = |(first, last): (u32, u32)| if first == last { first.to_string() } else { format!("{first}–{last}") };
    spans.into_iter().map(told).collect::<Vec<_>>().join(", ")
}

impl RunObserver for MetricsFile {
    /// Appends a line. If it cannot be written, it is written with the next one.
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        let failed_before = !self.waiting.is_empty();
        self.waiting.push_back(format!("{}\n", report.metrics_json));
        if self.waiting.len() > MAX_WAITING
            && let Some(line) = self.waiting.pop_front()
        {
            tracing::error!(iteration = ?number(&line), "too many lines wait for metrics.jsonl: this one is lost");
        }
        match self.write_waiting() {
            Ok(()) if failed_before => tracing::info!("metrics.jsonl can be written again"),
            Ok(()) => {}
            Err(error) if failed_before => tracing::debug!(%error, "metrics.jsonl still cannot be written"),
            Err(error) => tracing::error!(%error, "metrics.jsonl cannot be written; its lines wait until it can"),
        }
    }

    fn went_back(&mut self, iteration: u32, _joint_env_steps: u64) -> Result<(), FileError> {
        let mut waiting = std::mem::take(&mut self.waiting);
        waiting.retain(|line| number(line).is_some_and(|number| number < iteration));
        (*self, _) = Self::reopen(self.disk.clone(), self.place.clone(), iteration)?;
        self.waiting = waiting;
        Ok(())
    }

    fn sync(&mut self) -> Result<(), FileError> {
        let synced = self.disk.sync(&self.path).and_then(|()| match self.fresh {
            true => self.disk.sync(self.place.folder()),
            false => Ok(()),
        });
        synced.map_err(|error| self.failed(error))?;
        self.fresh = false;
        Ok(())
    }

    fn flush(&mut self) -> Result<(), FileError> {
        self.write_waiting().map_err(|error| self.failed(error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::disk::FileSystem;

    fn line(iteration: u32) -> String {
        format!("{{\"iteration\":{iteration},\"executor\":{{}}}}\n")
    }

    fn reopen(folder: &Path, iteration: u32) -> (MetricsFile, Vec<u32>) {
        MetricsFile::reopen(Arc::new(FileSystem), Place::of(folder), iteration).unwrap()
    }

    #[test]
    fn iterations_that_a_resume_repeats_are_truncated_in_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(NAME);
        let half = line(3)[..9].to_owned();
        std::fs::write(&path, line(0) + &line(1) + &line(2) + &half).unwrap();
        let file = identity(&path);
        assert!(reopen(folder.path(), 2).1.is_empty());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(0) + &line(1));
        // The file was truncated, not replaced.
        assert_eq!(identity(&path), file);
        assert_eq!(MetricsFile::last_line(folder.path()).unwrap(), line(1).trim_end());
        // An invalid line in the middle is removed.
        std::fs::write(&path, line(0) + "half\n" + &line(1)).unwrap();
        reopen(folder.path(), 2);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(0) + &line(1));
        // Two processes wrote at once.
        std::fs::write(&path, [2, 3, 0, 4, 1, 3, 2].map(line).concat()).unwrap();
        assert!(reopen(folder.path(), 4).1.is_empty());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), [0, 1, 2, 3].map(line).concat());
        // What is not there is named.
        std::fs::write(&path, [1, 2, 5].map(line).concat()).unwrap();
        assert_eq!(reopen(folder.path(), 7).1, [0, 3, 4, 6]);
        std::fs::remove_file(&path).unwrap();
        assert_eq!(ranges(&reopen(folder.path(), 3).1), "0–2");
        assert_eq!(ranges(&[0, 3, 4, 6]), "0, 3–4, 6");
    }

    #[test]
    fn lines_wait_while_the_folder_is_away_and_go_on_in_what_another_program_left() {
        let place = tempfile::tempdir().unwrap();
        let (run, away) = (place.path().join("run"), place.path().join("away"));
        std::fs::create_dir(&run).unwrap();
        let mut file = MetricsFile::create(Arc::new(FileSystem), Place::of(&run)).unwrap();
        let mut add = |number: u32| {
            file.waiting.push_back(line(number));
            file.write_waiting()
        };
        let text = || std::fs::read_to_string(run.join(NAME)).unwrap();
        add(0).unwrap();
        std::fs::rename(&run, &away).unwrap();
        let error = add(1).unwrap_err().to_string();
        assert!(error.contains("the run folder was removed or moved"), "{error}");
        // Another folder in its place gets nothing.
        std::fs::create_dir(&run).unwrap();
        assert!(add(2).unwrap_err().to_string().contains("replaced"));
        assert!(!run.join(NAME).exists());
        std::fs::remove_dir(&run).unwrap();
        std::fs::rename(&away, &run).unwrap();
        add(3).unwrap();
        assert_eq!(text(), [0, 1, 2, 3].map(line).concat());
        std::fs::remove_file(run.join(NAME)).unwrap();
        add(4).unwrap();
        assert_eq!(text(), line(4));
        std::fs::write(run.join(NAME), &line(4)[..5]).unwrap();
        add(5).unwrap();
        assert_eq!(text(), line(5));
    }
}
