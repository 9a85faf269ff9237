//! The live page as an observer of the run.

use crate::report::observer::{RunObserver, RunStart};
use crate::report::records::IterationMetrics;
use magex_core::trajectory::EvalOutcome;
use magex_proto::v1::IterationEvent;
use magex_proto::weights::Weights;
use magex_viewer::page::{LivePage, Phase, RunEnd};
use std::sync::Arc;

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
