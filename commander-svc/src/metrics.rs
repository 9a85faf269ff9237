//! The commander's Prometheus metrics, each declared once; docs/metrics.md says what they mean.

use crate::scheduler::AssignmentMethod;
use magex_runtime::metrics::{Gauge, Histogram, HistogramVec, IntCounter, IntCounterVec, Metrics};
use magex_runtime::net::call_metrics::Calls;
use std::time::Duration;

/// Methods of the service; the label of a metric.
const METHODS: [&str; 13] = [
    "Assign",
    "AssignMany",
    "AssignStream",
    "AssignBatch",
    "CreateMission",
    "UpdateMission",
    "GetAssignment",
    "ListAssignments",
    "WatchAssignments",
    "DeleteMission",
    "GetModel",
    "Act",
    "ActStream",
];

/// The commander's metrics.
#[derive(Debug)]
pub(crate) struct CommanderMetrics {
    pub(crate) calls: Calls,
    answers: IntCounterVec,
    answer_seconds: HistogramVec,
    fallbacks: IntCounter,
    acted_agents: IntCounter,
    act_seconds: Histogram,
    pub(crate) in_flight: Gauge,
    pub(crate) streams: Gauge,
    pub(crate) missions: Gauge,
    pub(crate) weights_version: Gauge,
    pub(crate) free_processors: Gauge,
    pub(crate) backlog: Gauge,
}

impl CommanderMetrics {
    /// Declares them.
    pub(crate) fn new(m: &Metrics) -> Self {
        let m = &m.of("commander");
        let metrics = Self {
            calls: Calls::new(m, &METHODS),
            answers: m.counters("answers_total", "Teams and shards answered, by method.", &["scheduler"]),
            answer_seconds: m.seconds_by("answer_seconds", "From a request to its answer, by method.", &["scheduler"]),
            fallbacks: m.counter("fallbacks_total", "Answers by another method than the requested one."),
            acted_agents: m.counter("policy_agents_total", "Agents whose actions a policy chose."),
            act_seconds: m.seconds("policy_seconds", "From a step of teams to the actions of its agents."),
            in_flight: m.gauge("inflight_calls", "Calls in flight."),
            streams: m.gauge("open_streams", "Open streams."),
            missions: m.gauge("missions", "Missions of clients."),
            weights_version: m.gauge("weights_version", "Version of the newest usable model; -1 without one."),
            free_processors: m.gauge("free_processors", "Processors free for large teams."),
            backlog: m.gauge("queue_messages", "Events that the slowest watcher has not received."),
        };
        // Every method appears in a scrape from the start.
        for method in AssignmentMethod::ALL {
            metrics.answers.with_label_values(&[method.name()]);
            metrics.answer_seconds.with_label_values(&[method.name()]);
        }
        metrics.weights_version.set(-1.0);
        metrics
    }

    /// Counts the actions of some agents.
    pub(crate) fn acted(&self, agents: usize, elapsed: Duration) {
        self.acted_agents.inc_by(agents as u64);
        self.act_seconds.observe(elapsed.as_secs_f64());
    }

    /// Counts an answer.
    pub(crate) fn answered(&self, by: AssignmentMethod, fallback: bool, elapsed: Duration) {
        self.answers.with_label_values(&[by.name()]).inc();
        self.answer_seconds.with_label_values(&[by.name()]).observe(elapsed.as_secs_f64());
        self.fallbacks.inc_by(u64::from(fallback));
    }
}
