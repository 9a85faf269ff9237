//! The commander's Prometheus metrics, each declared once; docs/metrics.md says what they mean.

use crate::assign_service::Answering;
use crate::mission_service::Keeper;
use crate::scheduler::SchedulerKind;
use crate::model_store::Store;
use magex_runtime::net::in_flight::{Admission, Kind};
use magex_runtime::net::call_metrics::Calls;
use magex_runtime::metrics::{Counter, Counters, Gauge, Metrics, SecondsBy};
use std::sync::{Arc, Weak};
use std::time::Duration;

const SCHEDULERS: [SchedulerKind; 5] = [
    SchedulerKind::Learned,
    SchedulerKind::Exact,
    SchedulerKind::Makespan,
    SchedulerKind::Greedy,
    SchedulerKind::Random,
];

/// Methods of the service; the label of a metric.
const METHODS: [&str; 11] = [
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
];

/// Everything that the commander counts.
#[derive(Debug)]
pub(crate) struct CommanderGauges {
    pub(crate) calls: Calls,
    answers: Counters,
    answer_seconds: SecondsBy,
    fallbacks: Counter,
    in_flight: Gauge,
    streams: Gauge,
    missions: Gauge,
    weights_version: Gauge,
    free_processors: Gauge,
    backlog: Gauge,
}

impl CommanderGauges {
    /// Declares them.
    pub(crate) fn new(m: &Metrics) -> Self {
        let gauges = Self {
            calls: Calls::new(m, "commander", &METHODS),
            answers: m.counters(
                "magex_commander_answers_total",
                "Teams and shards answered, by who answered.",
                &["scheduler"],
            ),
            answer_seconds: m.seconds_by(
                "magex_commander_answer_seconds",
                "From a request to its answer, by who answered.",
                &["scheduler"],
            ),
            fallbacks: m
                .counter("magex_commander_fallbacks_total", "Answers by another scheduler than the one asked for."),
            in_flight: m.gauge("magex_commander_inflight_calls", "Calls that are being answered."),
            streams: m.gauge("magex_commander_open_streams", "Streams that are open."),
            missions: m.gauge("magex_commander_missions", "Missions of clients that are kept."),
            weights_version: m
                .gauge("magex_commander_weights_version", "Version of the newest model that can answer; -1 without."),
            free_processors: m.gauge("magex_commander_free_processors", "Processors that are free for large teams."),
            backlog: m.gauge("magex_commander_queue_messages", "Events that the slowest watcher has yet to see."),
        };
        // A scrape shows all of them from the start.
        for kind in SCHEDULERS {
            gauges.answers.with(&[&kind.to_string()]).add(0);
            drop(gauges.answer_seconds.with(&[&kind.to_string()]));
        }
        gauges.weights_version.set(-1.0);
        gauges
    }

    /// An answer went out.
    pub(crate) fn answered(&self, by: SchedulerKind, fallback: bool, took: Duration) {
        let name = by.to_string();
        self.answers.with(&[&name]).add(1);
        self.answer_seconds.with(&[&name]).observe(took);
        self.fallbacks.add(u64::from(fallback));
    }
}

/// Sets what is only known by looking, before every scrape, for as long as the service is there.
pub(crate) fn watch(
    metrics: &Metrics,
    gauges: &Arc<CommanderGauges>,
    store: &Arc<Store>,
    keeper: &Arc<Keeper>,
    admission: &Arc<Admission>,
    answering: &Arc<Answering>,
) {
    let gauges = gauges.clone();
    let all: (Weak<Store>, Weak<Keeper>, Weak<Admission>, Weak<Answering>) =
        (Arc::downgrade(store), Arc::downgrade(keeper), Arc::downgrade(admission), Arc::downgrade(answering));
    metrics.before_scrape(move || {
        let alive = (all.0.upgrade(), all.1.upgrade(), all.2.upgrade(), all.3.upgrade());
        let (Some(store), Some(keeper), Some(admission), Some(answering)) = alive else { return };
        gauges.in_flight.set(admission.count(Kind::Call) as f64);
        gauges.streams.set(admission.count(Kind::Stream) as f64);
        gauges.missions.set(keeper.count() as f64);
        gauges.backlog.set(keeper.backlog() as f64);
        gauges.weights_version.set(store.latest().map_or(-1.0, |(key, _)| f64::from(key.version.0)));
        gauges.free_processors.set(answering.free_processors() as f64);
    });
}
