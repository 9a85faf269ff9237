//! The status of the run as the training thread reported it last.

use crate::serve::lock_order::{OrderedMutex, Rank};
use magex_core::ids::WeightsVersion;
use magex_proto::v1;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::time::Instant;

#[derive(Debug)]
pub(crate) struct RunStatusCache {
    /// Only fields that the training thread knows are set.
    reported: OrderedMutex<v1::RunStatus>,
    started: Instant,
    /// When something was achieved last, milliseconds after the start.
    progress: AtomicU64,
}

impl RunStatusCache {
    pub(crate) fn new() -> Self {
        let reported = OrderedMutex::new(Rank::Status, v1::RunStatus::default());
        Self { reported, started: Instant::now(), progress: AtomicU64::new(0) }
    }

    pub(crate) fn iteration(&self, report: &v1::IterationEvent) {
        let mut reported = self.reported.lock();
        reported.iteration = report.iterations_completed;
        reported.joint_env_steps = report.joint_env_steps_trained;
        reported.success = report.success.or(reported.success);
        reported.reward = report.reward.or(reported.reward);
        reported.metrics_json.clone_from(&report.metrics_json);
    }

    /// A result was accepted, or an iteration ended.
    pub(crate) fn progressed(&self) {
        self.progress.store(self.started.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    /// Since when nothing was achieved.
    pub(crate) fn since_progress(&self) -> Duration {
        self.started.elapsed().saturating_sub(Duration::from_millis(self.progress.load(Ordering::Relaxed)))
    }

    /// Iteration k uses version k, so k iterations are complete, in this process or before it.
    pub(crate) fn published(&self, version: WeightsVersion) {
        self.progressed();
        self.reported.lock().iteration = version.0;
    }

    /// What was reported, and the uptime; the other fields are empty.
    pub(crate) fn reported(&self) -> v1::RunStatus {
        v1::RunStatus { uptime_seconds: self.started.elapsed().as_secs_f64(), ..self.reported.lock().clone() }
    }

    pub(crate) fn finish(&self) {
        self.reported.lock().set_state(v1::RunState::Finished);
    }

    pub(crate) fn finished(&self) -> bool {
        self.reported.lock().state() == v1::RunState::Finished
    }

    /// The iteration that is being worked on.
    pub(crate) fn current_iteration(&self) -> u32 {
        self.reported.lock().iteration
    }
}
