//! The actor's Prometheus metrics, each declared once; docs/metrics.md describes them.

use magex_core::ids::{Shard, ShardKind};
use magex_core::task::TaskConfig;
use magex_proto::v1::ShardTiming;
use magex_runtime::metrics::{Gauge, GaugeVec, Histogram, IntCounter, IntCounterVec, Metrics};

#[derive(Debug)]
pub(crate) struct ActorMetrics {
    shards: IntCounterVec,
    joint_steps: IntCounterVec,
    agent_steps: IntCounterVec,
    rollout: Histogram,
    goals_wait: Histogram,
    weights_wait: Histogram,
    pub(crate) upload: Histogram,
    pub(crate) upload_bytes: IntCounter,
    pub(crate) weights_bytes: IntCounter,
    pub(crate) weights_version: Gauge,
    pub(crate) connected: Gauge,
    pub(crate) reconnects: IntCounter,
    pub(crate) threads: Gauge,
    pub(crate) busy: Gauge,
    queue: GaugeVec,
}

/// Outcomes of shards; the label of a metric.
const OUTCOMES: [&str; 5] = ["done", "failed", "accepted", "duplicate", "rejected"];
/// Queues of an actor; the label of a metric.
const QUEUES: [&str; 3] = ["shards", "unacknowledged", "outbound"];

impl ActorMetrics {
    pub(crate) fn new(m: &Metrics) -> Self {
        let m = &m.of("actor");
        let metrics = Self {
            shards: m.counters("shards_total", "Shards by outcome.", &["outcome"]),
            joint_steps: m.counters("joint_steps_total", "Joint steps rolled out.", &["kind"]),
            agent_steps: m.counters("agent_steps_total", "Agent steps rolled out.", &["kind"]),
            rollout: m.seconds("rollout_seconds", "Rolling out a shard, waits excluded."),
            goals_wait: m.seconds("goals_wait_seconds", "Waiting for the goals of a shard."),
            weights_wait: m.seconds("weights_wait_seconds", "Waiting for the weights of a shard."),
            upload: m.seconds("upload_seconds", "From the result's encoding to the learner's acknowledgement."),
            upload_bytes: m.counter("upload_bytes_total", "Bytes of results handed to the connection."),
            weights_bytes: m.counter("weights_bytes_total", "Bytes of weights that arrived."),
            weights_version: m.gauge("weights_version", "Newest version of the weights that arrived."),
            connected: m.gauge("connected_state", "1 while a learner has accepted this actor, else 0."),
            reconnects: m.counter("reconnects_total", "Connections to a learner after the first."),
            threads: m.gauge("rollout_threads", "Rollout threads."),
            busy: m.gauge("busy_threads", "Rollout threads with a shard."),
            queue: m.gauges("queue_messages", "Messages that wait in the actor's queues.", &["queue"]),
        };
        // A scrape shows all of them from the start.
        OUTCOMES.iter().for_each(|outcome| metrics.shards.with_label_values(&[outcome]).inc_by(0));
        QUEUES.iter().for_each(|queue| metrics.queue(queue, 0));
        for kind in ["train", "eval"] {
            metrics.joint_steps.with_label_values(&[kind]).inc_by(0);
            metrics.agent_steps.with_label_values(&[kind]).inc_by(0);
        }
        metrics
    }

    pub(crate) fn outcome(&self, outcome: &str) {
        self.shards.with_label_values(&[outcome]).inc();
    }

    pub(crate) fn queue(&self, name: &str, messages: usize) {
        self.queue.with_label_values(&[name]).set(messages as f64);
    }

    pub(crate) fn done(&self, shard: &Shard, task: Option<&TaskConfig>, timing: &ShardTiming) {
        self.outcome("done");
        self.rollout.observe(timing.rollout_seconds.max(0.0));
        self.goals_wait.observe(timing.goals_wait_seconds.max(0.0));
        self.weights_wait.observe(timing.weights_wait_seconds.max(0.0));
        if let Some(task) = task {
            let kind = if shard.kind == ShardKind::Train { "train" } else { "eval" };
            let joint = u64::from(shard.episodes) * u64::from(task.horizon);
            self.joint_steps.with_label_values(&[kind]).inc_by(joint);
            self.agent_steps.with_label_values(&[kind]).inc_by(joint * task.agents as u64);
        }
    }
}
