//! Checkpoints and the last files of a run, and what happens when they cannot be written.

use super::{TrainError, Trainer};
use crate::checkpoint::disk::replace_file;
use crate::checkpoint::{self, Progress};
use crate::collector::Collector;
use crate::report::observer::FileError;
use crate::run_events::{RunEvent, StopReason};
use magex_proto::v1::CheckpointEvent;
use magex_runtime::backoff::Backoff;
use magex_runtime::trace;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How long writing the last files is retried before the run ends with an error.
const LAST_FILES_PATIENCE: Duration = Duration::from_secs(300);

impl Trainer {
    /// Writes a checkpoint. If it cannot be written, training continues: the previous checkpoint remains valid, the next one is
    /// attempted on schedule, and a resume repeats the iterations in between with the same bits.
    pub(super) fn save(&mut self) {
        let _span = tracing::info_span!(target: trace::TARGET, "checkpoint").entered();
        let (iteration, clock) = (self.progress.iteration, Instant::now());
        let written = self.checkpoint();
        let (took, folder) = (clock.elapsed(), written.as_deref().ok());
        self.notify(|observer| observer.checkpoint(took, folder));
        match written {
            Ok(path) => {
                if self.failed_checkpoints > 0 {
                    tracing::info!(failed = self.failed_checkpoints, "checkpoints can be written again");
                }
                self.failed_checkpoints = 0;
                self.event(&RunEvent::Checkpoint(CheckpointEvent { iteration, path: path.display().to_string() }));
            }
            Err(error) => {
                self.failed_checkpoints += 1;
                let failed = self.failed_checkpoints;
                tracing::error!(%error, iteration, failed, "checkpoint failed; the previous one remains valid, the next is attempted on schedule");
                let text = format!(
                    "no checkpoint of iteration {iteration}: {error}; {failed} failed in a row, the previous one remains valid"
                );
                self.event(&RunEvent::Log(text));
            }
        }
    }

    /// Writes the last files of a run and retries for [`LAST_FILES_PATIENCE`]. Returns the reason if a stop is requested
    /// meanwhile.
    pub(super) fn write_last_files(
        &mut self,
        collector: &dyn Collector,
        files: &[(&str, &[u8])],
    ) -> Result<Option<StopReason>, TrainError> {
        let (start, mut backoff, mut reported) = (Instant::now(), Backoff::default(), false);
        loop {
            let Err(error) = self.write_files(files) else { return Ok(None) };
            if start.elapsed() >= LAST_FILES_PATIENCE {
                self.is_there().map_err(|_| TrainError::Gone(self.place.folder().to_owned()))?;
                return Err(TrainError::LastFiles(error, LAST_FILES_PATIENCE.as_secs()));
            }
            if !reported {
                reported = true;
                let patience_s = LAST_FILES_PATIENCE.as_secs();
                tracing::error!(%error, patience_s, "the run's last files cannot be written; retrying");
                self.event(&RunEvent::Log(format!("the run's last files cannot be written: {error}; retrying")));
            }
            let until = Instant::now() + backoff.next_wait();
            while Instant::now() < until {
                // A stop ends the retries at once; a resume starts them again.
                if let Some(reason) = collector.stop_requested() {
                    return Ok(Some(reason));
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        }
    }

    fn write_files(&mut self, files: &[(&str, &[u8])]) -> Result<(), FileError> {
        self.is_there()?;
        self.observers.iter_mut().try_for_each(|observer| observer.flush())?;
        for (name, bytes) in files {
            replace_file(&*self.disk, self.place.folder(), name, bytes)
                .map_err(|error| FileError { path: self.place.folder().join(name), error })?;
        }
        Ok(())
    }

    pub(super) fn checkpoint(&mut self) -> Result<PathBuf, TrainError> {
        self.is_there()?;
        // A checkpoint has the lines of its iterations, also after a power cut: a resume does not write them again.
        self.observers.iter_mut().try_for_each(|observer| observer.flush())?;
        self.observers.iter_mut().try_for_each(|observer| observer.sync())?;
        let progress = Progress { wall_s: self.wall_s(), ..self.progress.clone() };
        let (folder, keep) = (self.place.folder(), (self.config.run.keep_checkpoints, self.unconfirmed_since));
        Ok(checkpoint::write_keeping(&*self.disk, folder, &progress, &self.learned, keep)?)
    }

    /// A checkpoint in a folder that was removed would make one without the other files of a run.
    fn is_there(&self) -> Result<(), FileError> {
        self.place.check().map_err(|error| FileError { path: self.place.folder().to_owned(), error })
    }
}
