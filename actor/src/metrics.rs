//! The actor's Prometheus metrics, each declared once; docs/metrics.md describes them.

use magex_core::ids::{Shard, ShardKind};
use magex_core::task::TaskConfig;
use magex_proto::v1::ShardTiming;
use magex_runtime::metrics::{Counter, Counters, Gauge, Gauges, Metrics, Seconds};
use std::time::Duration;

/// The metrics of an actor.
#[derive(Debug)]
pub(crate) struct ActorMetrics {
    shards: Counters,
    joint_steps: Counters,
    agent_steps: Counters,
    rollout: Seconds,
    goals_wait: Seconds,
    weights_wait: Seconds,
    pub(crate) upload: Seconds,
    pub(crate) upload_bytes: Counter,
    pub(crate) weights_bytes: Counter,
    pub(crate) weights_version: Gauge,
    pub(crate) connected: Gauge,
    pub(crate) reconnects: Counter,
    pub(crate) threads: Gauge,
    pub(crate) busy: Gauge,
    queue: Gauges,
}

/// Outcomes of shards; the label of a metric.
const OUTCOMES: [&str; 5] = ["done", "failed", "accepted", "duplicate", "rejected"];
/// Queues of an actor; the label of a metric.
const QUEUES: [&str; 3] = ["shards", "unacknowledged", "outbound"];

impl ActorMetrics {
    /// Declares all of them.
    pub(crate) fn new(m: &Metrics) -> Self {
        let metrics = Self {
            shards: m.counters("magex_actor_shards_total", "Shards by outcome.", &["outcome"]),
            joint_steps: m.counters("magex_actor_joint_steps_total", "Joint steps rolled out.", &["kind"]),
            agent_steps: m.counters("magex_actor_agent_steps_total", "Agent steps rolled out.", &["kind"]),
            rollout: m.seconds("magex_actor_rollout_seconds", "Rolling out a shard, waits excluded."),
            goals_wait: m.seconds("magex_actor_goals_wait_seconds", "Waiting for the goals of a shard."),
            weights_wait: m.seconds("magex_actor_weights_wait_seconds", "Waiting for the weights of a shard."),
            upload: m
                .seconds("magex_actor_upload_seconds", "From the result's encoding to the learner's acknowledgement."),
            upload_bytes: m.counter("magex_actor_upload_bytes_total", "Bytes of results handed to the connection."),
            weights_bytes: m.counter("magex_actor_weights_bytes_total", "Bytes of weights that arrived."),
            weights_version: m.gauge("magex_actor_weights_version", "Newest version of the weights that arrived."),
            connected: m.gauge("magex_actor_connected_state", "1 while a learner has accepted this actor, else 0."),
            reconnects: m.counter("magex_actor_reconnects_total", "Connections to a learner after the first."),
            threads: m.gauge("magex_actor_rollout_threads", "Rollout threads."),
            busy: m.gauge("magex_actor_busy_threads", "Rollout threads with a shard."),
            queue: m.gauges("magex_actor_queue_messages", "Messages that wait in the actor's queues.", &["queue"]),
        };
        // A scrape shows all of them from the start.
        OUTCOMES.iter().for_each(|outcome| metrics.shards.with(&[outcome]).add(0));
        QUEUES.iter().for_each(|queue| metrics.queue(queue, 0));
        for kind in ["train", "eval"] {
            metrics.joint_steps.with(&[kind]).add(0);
            metrics.agent_steps.with(&[kind]).add(0);
        }
        metrics
    }

    /// Counts a shard with this outcome.
    pub(crate) fn outcome(&self, outcome: &str) {
        self.shards.with(&[outcome]).add(1);
    }

    pub(crate) fn queue(&self, name: &str, messages: usize) {
        self.queue.with(&[name]).set(messages as f64);
    }

    /// A shard was rolled out.
    pub(crate) fn done(&self, shard: &Shard, task: Option<&TaskConfig>, timing: &ShardTiming) {
        self.outcome("done");
        let time = |seconds: f64| Duration::try_from_secs_f64(seconds).unwrap_or_default();
        self.rollout.observe(time(timing.rollout_seconds));
        self.goals_wait.observe(time(timing.goals_wait_seconds));
        self.weights_wait.observe(time(timing.weights_wait_seconds));
        if let Some(task) = task {
            let kind = if shard.kind == ShardKind::Train { "train" } else { "eval" };
            let joint = u64::from(shard.episodes) * u64::from(task.horizon);
            self.joint_steps.with(&[kind]).add(joint);
            self.agent_steps.with(&[kind]).add(joint * task.agents as u64);
        }
    }
}
