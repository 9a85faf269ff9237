//! senders.jsonl: which actor computed which shard that was trained on, one line per iteration. If an actor turns out to compute
//! wrong results, it tells what they are in. No number of the run depends on it.

use crate::origin::Origin;
use crate::report::observer::{FileError, RunObserver};
use magex_core::ids::{Shard, ShardKind};
use serde::Serialize;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};

const FILE: &str = "senders.jsonl";

#[derive(Serialize)]
struct Line<'a> {
    iteration: u32,
    shards: Vec<Sent<'a>>,
}

#[derive(Serialize)]
struct Sent<'a> {
    index: u32,
    actor: &'a str,
    /// Hexadecimal, as in the log.
    process: String,
    sha256: &'a str,
}

/// senders.jsonl of a run folder.
#[derive(Debug)]
pub(crate) struct SendersFile {
    path: PathBuf,
    failed: bool,
}

impl SendersFile {
    /// The file of a run that continues after `iteration` iterations: later lines are removed.
    pub(crate) fn open(folder: &Path, iteration: u32) -> Self {
        let mut file = Self { path: folder.join(FILE), failed: false };
        if let Err(error) = file.cut(iteration) {
            file.complain(&error);
        }
        file
    }

    fn cut(&self, iteration: u32) -> std::io::Result<()> {
        let text = match std::fs::read_to_string(&self.path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            read => read?,
        };
        let number = |line: &str| serde_json::from_str::<serde_json::Value>(line).ok()?["iteration"].as_u64();
        let earlier =
            |line: &&str| line.ends_with('\n') && number(line).is_some_and(|number| number < iteration.into());
        let length = text.split_inclusive('\n').take_while(earlier).map(str::len).sum::<usize>();
        if length == text.len() {
            return Ok(());
        }
        OpenOptions::new().write(true).open(&self.path)?.set_len(length as u64)
    }

    fn append(&self, line: &str) -> std::io::Result<()> {
        OpenOptions::new().append(true).create(true).open(&self.path)?.write_all(line.as_bytes())
    }

    /// Training does not depend on the file.
    fn complain(&mut self, error: &std::io::Error) {
        if !std::mem::replace(&mut self.failed, true) {
            tracing::warn!(%error, path = %self.path.display(), "cannot be written; it will not tell which actor computed what");
        }
    }
}

impl RunObserver for SendersFile {
    fn senders(&mut self, iteration: u32, results: &[(Shard, Origin)]) {
        let trained = results.iter().filter(|(shard, _)| shard.kind == ShardKind::Train);
        let shards = trained.map(|(shard, origin)| Sent {
            index: shard.index,
            actor: &origin.actor,
            process: format!("{:x}", origin.process),
            sha256: &origin.digest,
        });
        let line = Line { iteration, shards: shards.collect() };
        if line.shards.is_empty() {
            return;
        }
        let text = serde_json::to_string(&line).map(|line| line + "\n").map_err(std::io::Error::other);
        match text.and_then(|text| self.append(&text)) {
            Ok(()) => self.failed = false,
            Err(error) => self.complain(&error),
        }
    }

    fn went_back(&mut self, iteration: u32, _joint_env_steps: u64) -> Result<(), FileError> {
        self.cut(iteration).map_err(|error| FileError { path: self.path.clone(), error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::train_shard;

    #[test]
    fn a_line_per_iteration_is_cut_back_with_the_run() {
        let folder = tempfile::tempdir().unwrap();
        let read = || std::fs::read_to_string(folder.path().join(FILE)).unwrap();
        let mut file = SendersFile::open(folder.path(), 0);
        let origin = |index: u64| Origin { actor: "a".into(), process: 0xab + index, digest: format!("d{index}") };
        for iteration in 0..3 {
            file.senders(
                iteration,
                &[(train_shard(iteration, 0, 2), origin(0)), (train_shard(iteration, 1, 2), origin(1))],
            );
        }
        let first = "{\"iteration\":0,\"shards\":[{\"index\":0,\"actor\":\"a\",\"process\":\"ab\",\"sha256\":\"d0\"},\
                     {\"index\":1,\"actor\":\"a\",\"process\":\"ac\",\"sha256\":\"d1\"}]}";
        assert_eq!((read().lines().count(), read().lines().next()), (3, Some(first)));
        file.went_back(2, 0).unwrap();
        assert_eq!(read().lines().count(), 2);
        // Half a line, as a kill leaves it.
        file.append("{\"iteration\":2,\"sh").unwrap();
        SendersFile::open(folder.path(), 2);
        assert_eq!(read().lines().count(), 2);
        SendersFile::open(folder.path(), 1);
        assert_eq!(read(), format!("{first}\n"));
    }
}
