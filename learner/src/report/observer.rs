//! Observers of a run: metrics.jsonl, TensorBoard, the live page, Prometheus and event streams follow one interface.

use crate::origin::Origin;
use crate::report::records::IterationMetrics;
use crate::run_events::RunEvent;
use magex_core::ids::{RunId, Shard};
use magex_core::trajectory::EvalOutcome;
use magex_proto::v1::IterationEvent;
use magex_proto::weights::Weights;
use magex_viewer::page::{LivePage, Phase, RunEnd};
use std::fmt::Debug;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

/// A file of the run folder that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {error}")]
pub struct FileError {
    /// The file.
    pub path: PathBuf,
    /// The system's error.
    pub error: std::io::Error,
}

/// The run as an observer finds it.
#[derive(Debug, Clone, Copy)]
pub struct RunStart<'a> {
    /// Identity of the run.
    pub run_id: &'a RunId,
    /// Folder of the run.
    pub folder: &'a Path,
    /// The last iteration of an earlier process, if the run is resumed.
    pub before: Option<&'a IterationEvent>,
}

/// Follows a run. The training thread calls every observer of the trainer's list, in the order of the list, and waits: an
/// observer must not block on a network or a reader. Nothing that an observer does changes a number of the run.
pub trait RunObserver: Debug + Send {
    /// Called once, before any other method.
    fn begin(&mut self, _start: RunStart<'_>) {}

    /// Whether an episode of every evaluation should be recorded for this observer.
    fn wants_recording(&self) -> bool {
        false
    }

    /// The training thread enters another phase of the iteration.
    fn phase(&mut self, _phase: Phase) {}

    /// A version of the weights was published.
    fn published(&mut self, _weights: &Weights) {}

    /// An evaluation was collected.
    fn evaluated(&mut self, _outcomes: &[EvalOutcome]) {}

    /// An iteration is going to be trained on these results of actors.
    fn senders(&mut self, _iteration: u32, _results: &[(Shard, Origin)]) {}

    /// The run went back to a checkpoint of `iteration` iterations and this number of joint steps: what is later did not happen.
    ///
    /// # Errors
    /// A file cannot be cut back.
    fn went_back(&mut self, _iteration: u32, _joint_env_steps: u64) -> Result<(), FileError> {
        Ok(())
    }

    /// An iteration is complete. `report` has its line of metrics.jsonl; [`Self::event`] receives it next.
    fn iteration(&mut self, _metrics: &IterationMetrics, _report: &IterationEvent) {}

    /// An attempt to write a checkpoint ended. `written` is its folder; `None` if it could not be written.
    fn checkpoint(&mut self, _took: Duration, _written: Option<&Path>) {}

    /// Something happened: an iteration, a message, a checkpoint, or the end of the run.
    fn event(&mut self, _event: &RunEvent) {}

    /// Makes what was written so far durable, before a checkpoint that contains it.
    ///
    /// # Errors
    /// A file cannot be made durable.
    fn sync(&mut self) -> Result<(), FileError> {
        Ok(())
    }

    /// Writes what an earlier error left unwritten, before the summary.
    ///
    /// # Errors
    /// A file still cannot be written.
    fn flush(&mut self) -> Result<(), FileError> {
        Ok(())
    }

    /// Training ends in this process.
    fn end(&mut self, _end: &RunEnd) {}
}

/// Sends the events of a run to another thread. Events after the receiver is gone are dropped.
impl RunObserver for Sender<RunEvent> {
    fn event(&mut self, event: &RunEvent) {
        let _ = self.send(event.clone());
    }
}

impl RunObserver for Arc<LivePage> {
    fn begin(&mut self, start: RunStart<'_>) {
        LivePage::begin(self, start.run_id, start.folder);
    }

    fn wants_recording(&self) -> bool {
        true
    }

    fn phase(&mut self, phase: Phase) {
        LivePage::phase(self, phase);
    }

    fn published(&mut self, weights: &Weights) {
        LivePage::published(self, weights);
    }

    fn evaluated(&mut self, outcomes: &[EvalOutcome]) {
        LivePage::evaluated(self, outcomes);
    }

    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        self.line(&report.metrics_json);
    }

    fn end(&mut self, end: &RunEnd) {
        self.ended(end.clone());
    }
}
