//! The status of the run: a cache of what the training thread reported, and the message that GetRun returns.

use crate::run_events::IterationReport;
use crate::serve::lock_order::{OrderedMutex, Rank};
use magex_core::ids::WeightsVersion;
use magex_proto::v1;
use std::time::Instant;

#[derive(Debug, Default)]
struct Reported {
    iterations: u32,
    joint_env_steps: u64,
    success: Option<f32>,
    reward: Option<f32>,
    metrics_json: String,
    finished: bool,
}

/// What the training thread reported last.
#[derive(Debug)]
pub(crate) struct RunStatusCache {
    reported: OrderedMutex<Reported>,
    started: Instant,
}

impl RunStatusCache {
    pub(crate) fn new() -> Self {
        Self { reported: OrderedMutex::new(Rank::Status, Reported::default()), started: Instant::now() }
    }

    pub(crate) fn iteration(&self, report: &IterationReport) {
        let mut reported = self.reported.lock();
        reported.iterations = report.iteration.0;
        reported.joint_env_steps = report.joint_env_steps;
        reported.success = report.success.or(reported.success);
        reported.reward = report.reward.or(reported.reward);
        reported.metrics_json.clone_from(&report.metrics_json);
    }

    /// Iteration k uses version k, so k iterations are complete, in this process or before it.
    pub(crate) fn published(&self, version: WeightsVersion) {
        self.reported.lock().iterations = version.0;
    }

    /// Writes what was reported, and the uptime, into the answer of `GetRun`.
    pub(crate) fn fill(&self, status: &mut v1::RunStatus) {
        let reported = self.reported.lock();
        status.iteration = reported.iterations;
        status.joint_env_steps = reported.joint_env_steps;
        status.success = reported.success;
        status.reward = reported.reward;
        status.metrics_json.clone_from(&reported.metrics_json);
        status.uptime_seconds = self.started.elapsed().as_secs_f64();
    }

    pub(crate) fn finish(&self) {
        self.reported.lock().finished = true;
    }

    pub(crate) fn finished(&self) -> bool {
        self.reported.lock().finished
    }

    /// The iteration that is being worked on.
    pub(crate) fn current_iteration(&self) -> u32 {
        self.reported.lock().iterations
    }
}
