//! The learner's Prometheus metrics, each declared once; docs/metrics.md says what they mean.

use crate::report::bottleneck::BoundBy;
use crate::report::metrics_file::IterationMetrics;
use crate::serve::ledger;
use magex_core::trajectory::ShardResult;
use magex_proto::v1::SubscriberRole;
use magex_runtime::metrics::{
    Gauge, GaugeGuard, GaugeVec, Histogram, HistogramVec, IntCounter, IntCounterVec, Metrics, raise_to,
};
use std::time::Duration;

/// Everything that the learner counts.
#[derive(Debug)]
pub(crate) struct LearnerGauges {
    shards: Fates,
    episodes: Fates,
    pub(crate) received_bytes: IntCounter,
    joint_steps: IntCounter,
    agent_steps: IntCounter,
    pub(crate) actors_live: Gauge,
    pub(crate) actors_expected: Gauge,
    pub(crate) actor_threads: Gauge,
    sessions_ended: IntCounterVec,
    queue: GaugeVec,
    policy_lag: GaugeVec,
    sample_age: GaugeVec,
    iterations: IntCounter,
    phase: HistogramVec,
    bound: IntCounterVec,
    bound_seconds: GaugeVec,
    pub(crate) weights_version: Gauge,
    pub(crate) weights_bytes: Gauge,
    pub(crate) weights_published: Histogram,
    subscribers: GaugeVec,
    checkpoint: Histogram,
    checkpoint_bytes: Gauge,
    checkpoint_failures: IntCounter,
    skipped: IntCounter,
    success: Gauge,
    reward: Gauge,
}

/// How a connection ended; the label of a metric.
pub(crate) const ENDS: [&str; 5] = ["left", "silent", "replaced", "closing", "refused"];
/// Parts of an iteration; the label of a metric.
const PHASES: [&str; 5] = ["publish", "collect", "executor", "commander", "checkpoint"];

impl LearnerGauges {
    /// Declares them.
    pub(crate) fn new(m: &Metrics) -> Self {
        let gauges = Self {
            shards: Fates::new(m, "shards", "Shards"),
            episodes: Fates::new(m, "episodes", "Episodes"),
            received_bytes: m.counter("magex_learner_received_bytes_total", "Bytes of results that came in."),
            joint_steps: m.counter("magex_learner_joint_steps_total", "Joint steps that came in to be trained on."),
            agent_steps: m.counter("magex_learner_agent_steps_total", "Agent steps that came in to be trained on."),
            actors_live: m.gauge("magex_learner_actors_live", "Actors connected."),
            actors_expected: m.gauge("magex_learner_actors_expected", "Actors connected, or lost lately and not back."),
            actor_threads: m.gauge("magex_learner_actor_threads", "Rollout threads of the actors connected."),
            sessions_ended: m.counters(
                "magex_learner_sessions_ended_total",
                "Connections of actors that ended.",
                &["reason"],
            ),
            queue: m.gauges("magex_learner_queue_messages", "What waits in the learner's queues.", &["queue"]),
            policy_lag: m.gauges(
                "magex_learner_policy_lag_versions",
                "Newest version of the weights minus that of the samples of the latest batch.",
                &["stat"],
            ),
            sample_age: m.gauges(
                "magex_learner_sample_age_seconds",
                "Age of the samples of the latest batch, from their arrival to the update.",
                &["stat"],
            ),
            iterations: m.counter("magex_learner_iterations_total", "Iterations completed."),
            phase: m.seconds_by("magex_learner_phase_seconds", "Wall time of the parts of an iteration.", &["phase"]),
            bound: m.counters("magex_learner_bound_iterations_total", "Iterations by what they waited for.", &["by"]),
            bound_seconds: m.gauges(
                "magex_learner_bound_seconds",
                "Seconds of the latest iteration by what it waited for.",
                &["by"],
            ),
            weights_version: m.gauge("magex_learner_weights_version", "Newest version of the weights."),
            weights_bytes: m.gauge("magex_learner_weights_bytes", "Size of the newest weights."),
            weights_published: m.seconds(
                "magex_learner_weights_published_seconds",
                "From publishing weights to having handed them to a subscriber's connection.",
            ),
            subscribers: m.gauges("magex_learner_subscribers", "Subscribers of the weights.", &["role"]),
            checkpoint: m.seconds("magex_learner_checkpoint_seconds", "Writing a checkpoint."),
            checkpoint_bytes: m.gauge("magex_learner_checkpoint_bytes", "Size of the latest checkpoint."),
            checkpoint_failures: m
                .counter("magex_learner_checkpoint_failures_total", "Checkpoints that could not be written."),
            skipped: m.counter(
                "magex_learner_skipped_updates_total",
                "Minibatches whose gradient was not finite; they changed nothing.",
            ),
            success: m.gauge("magex_learner_success_ratio", "Success rate of the latest evaluation."),
            reward: m
                .gauge("magex_learner_reward_mean", "Mean reward per agent and step of the latest training episodes."),
        };
        // A scrape shows all of them from the start.
        ENDS.iter().for_each(|reason| gauges.sessions_ended.with_label_values(&[reason]).inc_by(0));
        PHASES.iter().for_each(|phase| drop(gauges.phase.with_label_values(&[phase])));
        for by in BoundBy::ALL {
            gauges.bound.with_label_values(&[by.name()]).inc_by(0);
            gauges.bound_seconds.with_label_values(&[by.name()]).set(0.0);
        }
        for role in [SubscriberRole::Actor, SubscriberRole::Commander, SubscriberRole::Observer] {
            gauges.subscribers.with_label_values(&[role_name(role)]).set(0.0);
        }
        set_stats(&gauges.policy_lag, &[]);
        set_stats(&gauges.sample_age, &[]);
        gauges
    }

    /// How the ledger stands. Callers hold its lock.
    pub(crate) fn ledger(&self, shards: &ledger::Counters, episodes: &ledger::Counters, queued: usize) {
        self.shards.set(shards);
        self.episodes.set(episodes);
        self.queue("shards", queued);
    }

    pub(crate) fn queue(&self, name: &str, messages: usize) {
        self.queue.with_label_values(&[name]).set(messages as f64);
    }

    pub(crate) fn session_ended(&self, reason: &str) {
        self.sessions_ended.with_label_values(&[reason]).inc();
    }

    pub(crate) fn subscriber(&self, role: SubscriberRole) -> GaugeGuard {
        GaugeGuard::new(self.subscribers.with_label_values(&[role_name(role)]))
    }

    /// A result with so many joint steps and agent steps was taken into the batch.
    pub(crate) fn accepted(&self, (joint, agent): (u64, u64)) {
        self.joint_steps.inc_by(joint);
        self.agent_steps.inc_by(agent);
    }

    /// The batch is complete.
    pub(crate) fn batch(&self, lags: &[f64], ages: &[f64]) {
        set_stats(&self.policy_lag, lags);
        set_stats(&self.sample_age, ages);
    }

    /// An iteration is complete.
    pub(crate) fn iteration(&self, metrics: &IterationMetrics) {
        let timing = &metrics.timing;
        self.iterations.inc_by(u64::from(metrics.executor.is_some()));
        let spent = [timing.publish_s, timing.collect_s, timing.executor_s, timing.commander_s, timing.checkpoint_s];
        for (phase, seconds) in PHASES.iter().zip(spent) {
            self.phase.with_label_values(&[phase]).observe(seconds.max(0.0));
        }
        let bound = &timing.bound;
        self.bound.with_label_values(&[bound.by.name()]).inc();
        for (by, seconds) in BoundBy::ALL.iter().zip([bound.actor_s, bound.learner_s, bound.network_s]) {
            self.bound_seconds.with_label_values(&[by.name()]).set(seconds);
        }
        if let Some(update) = &metrics.executor {
            self.skipped.inc_by(update.skipped as u64);
        }
        if let Some(success) = metrics.success_rate {
            self.success.set(success);
        }
        if let Some(reward) = metrics.reward {
            self.reward.set(reward);
        }
    }

    /// A checkpoint was written, with so many bytes, or could not be.
    pub(crate) fn checkpoint(&self, took: Duration, bytes: Option<u64>) {
        self.checkpoint.observe(took.as_secs_f64());
        match bytes {
            Some(bytes) => self.checkpoint_bytes.set(bytes as f64),
            None => self.checkpoint_failures.inc(),
        }
    }
}

/// The conservation ledger, of shards or of episodes.
#[derive(Debug)]
struct Fates {
    counters: [IntCounter; 6],
    outstanding: Gauge,
    residual: Gauge,
}

impl Fates {
    fn new(m: &Metrics, noun: &str, people: &str) -> Self {
        let name = |what: &str| format!("magex_learner_{noun}_{what}");
        let counter = |what: &str, help: &str| m.counter(&name(&format!("{what}_total")), &format!("{people} {help}."));
        Self {
            counters: [
                counter("leased", "handed out"),
                counter("trained", "taken into a batch"),
                counter("duplicate", "dropped: done already, or no longer wanted"),
                counter("expired", "lost with their actor"),
                counter("rejected", "refused: the result was not usable"),
                counter("failed", "given back by the actor"),
            ],
            outstanding: m.gauge(&name("outstanding"), &format!("{people} that are handed out now.")),
            residual: m.gauge(&name("residual"), &format!("{people} that ended in no way or in two; always 0.")),
        }
    }

    fn set(&self, c: &ledger::Counters) {
        let totals = [c.leased, c.trained, c.duplicate, c.expired, c.rejected, c.failed];
        self.counters.iter().zip(totals).for_each(|(counter, total)| raise_to(counter, total));
        self.outstanding.set(c.outstanding as f64);
        self.residual.set(c.residual() as f64);
    }
}

/// Joint steps and agent steps that a result brings to train on.
pub(crate) fn steps_of(result: &ShardResult) -> (u64, u64) {
    let ShardResult::Train(trajectory) = result else { return (0, 0) };
    let shape = &trajectory.shape;
    let joint = (shape.steps * shape.episodes) as u64;
    (joint, joint * shape.agents as u64)
}

fn role_name(role: SubscriberRole) -> &'static str {
    match role {
        SubscriberRole::Actor => "actor",
        SubscriberRole::Commander => "commander",
        SubscriberRole::Observer | SubscriberRole::Unspecified => "observer",
    }
}

/// Smallest, mean and largest; zeros of nothing.
fn set_stats(gauges: &GaugeVec, values: &[f64]) {
    let count = values.len().max(1) as f64;
    let smallest = values.iter().copied().reduce(f64::min).unwrap_or(0.0);
    let largest = values.iter().copied().reduce(f64::max).unwrap_or(0.0);
    for (stat, value) in [("min", smallest), ("mean", values.iter().sum::<f64>() / count), ("max", largest)] {
        gauges.with_label_values(&[stat]).set(value);
    }
}
