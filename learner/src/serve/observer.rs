//! The service as an observer of the run: Prometheus, the status, the event streams and the log.

use crate::report::observer::{RunObserver, RunStart};
use crate::report::records::IterationMetrics;
use crate::run_events::RunEvent;
use crate::serve::shared::Shared;
use magex_core::metrics_table::{REWARD, SUCCESS_RATE};
use magex_proto::v1::IterationEvent;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// Made by [`crate::serve::service::LearnerHandle::observer`].
#[derive(Debug)]
pub struct ServiceObserver {
    pub(crate) shared: Arc<Shared>,
}

impl RunObserver for ServiceObserver {
    /// The status shows the last iteration of an earlier process; watchers receive only new events.
    fn begin(&mut self, start: RunStart<'_>) {
        if let Some(before) = start.before {
            self.shared.status.iteration(before);
        }
    }

    fn iteration(&mut self, metrics: &IterationMetrics, _report: &IterationEvent) {
        self.shared.metrics.iteration(metrics);
        let bottleneck = &metrics.timing.bottleneck;
        tracing::info!(
            iteration = metrics.iteration,
            joint_env_steps = metrics.joint_env_steps,
            success_rate = metrics.episodes.get(SUCCESS_RATE),
            reward = metrics.episodes.get(REWARD),
            bottleneck = bottleneck.stage.name(),
            actor_s = bottleneck.actor_s,
            learner_s = bottleneck.learner_s,
            network_s = bottleneck.network_s,
            collect_s = metrics.timing.collect_s,
            "iteration"
        );
    }

    fn checkpoint(&mut self, took: Duration, written: Option<&Path>) {
        self.shared.metrics.checkpoint(took, written.map(size_of));
    }

    fn event(&mut self, event: &RunEvent) {
        match event {
            RunEvent::Iteration(report) => self.shared.status.iteration(report),
            RunEvent::Finished(_) => self.shared.status.finish(),
            RunEvent::Log(_) | RunEvent::Checkpoint(_) => {}
        }
        self.shared.events.push(event.clone());
        if matches!(event, RunEvent::Finished(_)) {
            self.shared.control.complete.cancel();
        }
    }
}

fn size_of(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    entries.filter_map(|entry| entry.metadata().ok()).map(|meta| meta.len()).sum()
}
