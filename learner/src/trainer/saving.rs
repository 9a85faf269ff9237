//! What the trainer writes down, and what it does when the disk does not take it.

use super::{TrainError, Trainer};
use crate::checkpoint::disk::{FileSystem, replace_file};
use crate::checkpoint::{self, Progress};
use crate::collector::Collector;
use crate::run_events::{RunEvent, StopReason};
use magex_core::ids::Iteration;
use magex_runtime::backoff::Backoff;
use magex_runtime::trace;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How long the files that a run leaves behind are tried again before the run ends without them.
const LAST_FILES_PATIENCE: Duration = Duration::from_secs(300);

impl Trainer {
    /// A checkpoint, if the disk takes it. If not, the one before stands and training goes on: the next one that is due is
    /// another attempt, and what lies between can be done again with the same bits.
    pub(super) fn save(&mut self, collector: &mut dyn Collector) {
        let _span = tracing::info_span!(target: trace::TARGET, "checkpoint").entered();
        let (iteration, clock) = (Iteration(self.progress.iteration), Instant::now());
        let written = self.checkpoint();
        collector.checkpointed(clock.elapsed(), written.as_deref().ok());
        match written {
            Ok(path) => {
                if self.failed_checkpoints > 0 {
                    tracing::info!(failed = self.failed_checkpoints, "checkpoints can be written again");
                }
                self.failed_checkpoints = 0;
                collector.event(RunEvent::Checkpoint { iteration, path: path.display().to_string() });
            }
            Err(error) => {
                self.failed_checkpoints += 1;
                let failed = self.failed_checkpoints;
                tracing::error!(%error, iteration = iteration.0, failed, "no checkpoint; the one before stands, the next is tried when it is due");
                let text = format!(
                    "no checkpoint of iteration {iteration}: {error}; {failed} in a row failed, the one before stands"
                );
                collector.event(RunEvent::Log(text));
            }
        }
    }

    /// Writes what a run leaves behind, again and again for [`LAST_FILES_PATIENCE`] if the disk does not take it. The reason,
    /// if the learner is told to stop meanwhile.
    pub(super) fn write_at_last(
        &mut self,
        collector: &mut dyn Collector,
        files: &[(&str, &[u8])],
    ) -> Result<Option<StopReason>, TrainError> {
        let (start, mut backoff, mut said) = (Instant::now(), Backoff::default(), false);
        loop {
            let Err(error) = self.write_files(files) else { return Ok(None) };
            if start.elapsed() >= LAST_FILES_PATIENCE {
                let TrainError::Io { path, error } = error else { return Err(error) };
                return Err(TrainError::LastFiles { path, error, waited: LAST_FILES_PATIENCE.as_secs() });
            }
            if !said {
                said = true;
                let patience_s = LAST_FILES_PATIENCE.as_secs();
                tracing::error!(%error, patience_s, "the run's last files cannot be written; trying until they can");
                collector.event(RunEvent::Log(format!(
                    "the run's last files cannot be written: {error}; trying until they can"
                )));
            }
            let until = Instant::now() + backoff.next_wait();
            while Instant::now() < until {
                // Before the end of the run a stop is obeyed at once; a resume comes back here.
                if let Some(reason) = collector.stop_requested() {
                    return Ok(Some(reason));
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        }
    }

    fn write_files(&mut self, files: &[(&str, &[u8])]) -> Result<(), TrainError> {
        self.metrics.flush()?;
        for (name, bytes) in files {
            replace_file(&mut FileSystem, &self.folder, name, bytes)
                .map_err(|error| TrainError::Io { path: self.folder.join(name), error })?;
        }
        Ok(())
    }

    pub(super) fn checkpoint(&mut self) -> Result<PathBuf, TrainError> {
        // A checkpoint that survives a power cut has the lines of its iterations.
        self.metrics.sync();
        let progress =
            Progress { wall_s: self.progress.wall_s + self.started.elapsed().as_secs_f64(), ..self.progress.clone() };
        Ok(checkpoint::write(&self.folder, &progress, &self.learned, self.config.run.keep_checkpoints)?)
    }
}
