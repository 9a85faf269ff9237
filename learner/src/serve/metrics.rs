//! The learner's Prometheus metrics, each declared once; docs/metrics.md describes them.

use crate::report::bottleneck::{Bottleneck, Stage};
use crate::report::records::IterationMetrics;
use crate::serve::ledger::Counters;
use crate::serve::ledger::checks::CheckTotals;
use magex_core::metrics_table::{REWARD, SUCCESS_RATE};
use magex_core::trajectory::ShardResult;
use magex_proto::v1::SubscriberRole;
use magex_runtime::metrics::{
    Gauge, GaugeGuard, GaugeVec, Histogram, HistogramVec, IntCounter, IntCounterVec, Metrics, raise_to,
};
use std::time::Duration;

#[derive(Debug)]
pub(crate) struct LearnerMetrics {
    shards: LeaseMetrics,
    episodes: LeaseMetrics,
    checks: IntCounterVec,
    rejections: IntCounterVec,
    pub(crate) oldest_lease: GaugeVec,
    pub(crate) hand_backs: GaugeVec,
    pub(crate) since_progress: Gauge,
    pub(crate) rolled_back: IntCounter,
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
    bottleneck: IntCounterVec,
    bottleneck_seconds: GaugeVec,
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

/// How a session ended; the label of a metric.
pub(crate) const ENDS: [&str; 5] = ["left", "silent", "replaced", "closing", "refused"];
/// Parts of an iteration; the label of a metric.
const PHASES: [&str; 5] = ["publish", "collect", "executor", "commander", "checkpoint"];

/// What a second computation of a shard gave; the label of a metric.
const CHECKS: [&str; 3] = ["same", "different", "given_up"];
/// What rejected a result; the label of a metric.
const REJECTIONS: [&str; 4] = ["damaged", "receipt", "update", "recomputed"];

/// What rejected a result, in the order of [`REJECTIONS`].
#[derive(Debug, Clone, Copy)]
pub(crate) enum Rejection {
    /// It did not arrive as it was sent.
    Damaged,
    /// The check on receipt: shape, range, consistency.
    Receipt,
    /// The update: it is not what the weights give.
    Update,
    /// A second computation.
    Recomputed,
}

impl LearnerMetrics {
    pub(crate) fn new(m: &Metrics) -> Self {
        let m = &m.of("learner");
        let metrics = Self {
            shards: LeaseMetrics::new(m, "shards", "Shards"),
            episodes: LeaseMetrics::new(m, "episodes", "Episodes"),
            checks: m.counters(
                "checks_total",
                "Shards computed a second time, by what the comparison gave.",
                &["outcome"],
            ),
            rejections: m.counters("rejections_total", "Results rejected, by the check that did it.", &["check"]),
            oldest_lease: m.gauges("oldest_lease_seconds", "Age of the oldest lease that an actor holds.", &["actor"]),
            hand_backs: m.gauges(
                "hand_backs",
                "Leases that an actor gave back in a row; from 2 on it is asked rarely.",
                &["actor"],
            ),
            since_progress: m.gauge(
                "since_progress_seconds",
                "Since the last result was accepted or the last iteration ended; 0 after the end of the run.",
            ),
            rolled_back: m.counter("roll_backs_total", "Returns to an earlier checkpoint after a conviction."),
            received_bytes: m.counter("received_bytes_total", "Bytes of results received."),
            joint_steps: m.counter("joint_steps_total", "Joint steps accepted into training batches."),
            agent_steps: m.counter("agent_steps_total", "Agent steps accepted into training batches."),
            actors_live: m.gauge("actors_live", "Actors connected."),
            actors_expected: m.gauge("actors_expected", "Actors connected, or missing for less than ten minutes."),
            actor_threads: m.gauge("actor_threads", "Rollout threads of the actors connected."),
            sessions_ended: m.counters("sessions_ended_total", "Connections of actors that ended.", &["reason"]),
            queue: m.gauges("queue_messages", "Messages that wait in the learner's queues.", &["queue"]),
            policy_lag: m.gauges(
                "policy_lag_versions",
                "Newest version of the weights minus that of the samples of the latest batch.",
                &["stat"],
            ),
            sample_age: m.gauges(
                "sample_age_seconds",
                "Age of the samples of the latest batch, from their arrival to the update.",
                &["stat"],
            ),
            iterations: m.counter("iterations_total", "Iterations completed."),
            phase: m.seconds_by("phase_seconds", "Wall time of the parts of an iteration.", &["phase"]),
            bottleneck: m.counters(
                "bottleneck_iterations_total",
                "Iterations by the stage that took most of their time.",
                &["stage"],
            ),
            bottleneck_seconds: m.gauges("bottleneck_seconds", "Seconds of the latest iteration by stage.", &["stage"]),
            weights_version: m.gauge("weights_version", "Newest version of the weights."),
            weights_bytes: m.gauge("weights_bytes", "Size of the newest weights."),
            weights_published: m.seconds(
                "weights_published_seconds",
                "From publishing weights to handing them to a subscriber's connection.",
            ),
            subscribers: m.gauges("subscribers", "Subscribers of the weights.", &["role"]),
            checkpoint: m.seconds("checkpoint_seconds", "Writing a checkpoint."),
            checkpoint_bytes: m.gauge("checkpoint_bytes", "Size of the latest checkpoint."),
            checkpoint_failures: m.counter("checkpoint_failures_total", "Checkpoints that could not be written."),
            skipped: m
                .counter("skipped_updates_total", "Minibatches skipped because a loss or a gradient was not finite."),
            success: m.gauge("success_ratio", "Success rate of the latest evaluation."),
            reward: m.gauge("reward_mean", "Mean reward per agent and step of the latest training episodes."),
        };
        // A scrape shows all of them from the start.
        ENDS.iter().for_each(|reason| metrics.sessions_ended.with_label_values(&[reason]).inc_by(0));
        PHASES.iter().for_each(|phase| drop(metrics.phase.with_label_values(&[phase])));
        for stage in Stage::ALL {
            metrics.bottleneck.with_label_values(&[stage.name()]).inc_by(0);
            metrics.bottleneck_seconds.with_label_values(&[stage.name()]).set(0.0);
        }
        for role in [SubscriberRole::Actor, SubscriberRole::Commander, SubscriberRole::Observer] {
            metrics.subscribers.with_label_values(&[role_name(role)]).set(0.0);
        }
        CHECKS.iter().for_each(|outcome| metrics.checks.with_label_values(&[outcome]).inc_by(0));
        REJECTIONS.iter().for_each(|check| metrics.rejections.with_label_values(&[check]).inc_by(0));
        set_stats(&metrics.policy_lag, &[]);
        set_stats(&metrics.sample_age, &[]);
        metrics
    }

    pub(crate) fn rejected(&self, check: Rejection) {
        self.rejections.with_label_values(&[REJECTIONS[check as usize]]).inc();
    }

    /// Sets the metrics of the ledger. Called under its lock.
    pub(crate) fn ledger(&self, shards: &Counters, episodes: &Counters, queued: usize, checks: &CheckTotals) {
        for (outcome, total) in CHECKS.iter().zip([checks.same, checks.different, checks.given_up]) {
            raise_to(&self.checks.with_label_values(&[outcome]), total);
        }
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

    pub(crate) fn accepted(&self, (joint, agent): (u64, u64)) {
        self.joint_steps.inc_by(joint);
        self.agent_steps.inc_by(agent);
    }

    pub(crate) fn batch(&self, lags: &[f64], ages: &[f64]) {
        set_stats(&self.policy_lag, lags);
        set_stats(&self.sample_age, ages);
    }

    pub(crate) fn iteration(&self, metrics: &IterationMetrics) {
        let timing = &metrics.timing;
        self.iterations.inc_by(u64::from(metrics.executor.is_some()));
        let spent = [timing.publish_s, timing.collect_s, timing.executor_s, timing.commander_s, timing.checkpoint_s];
        for (phase, seconds) in PHASES.iter().zip(spent) {
            self.phase.with_label_values(&[phase]).observe(seconds.max(0.0));
        }
        let Bottleneck { stage, actor_s, learner_s, network_s, .. } = timing.bottleneck;
        self.bottleneck.with_label_values(&[stage.name()]).inc();
        for (stage, seconds) in Stage::ALL.iter().zip([actor_s, learner_s, network_s]) {
            self.bottleneck_seconds.with_label_values(&[stage.name()]).set(seconds);
        }
        if let Some(skipped) = metrics.executor.as_ref().and_then(|update| update.get("skipped_minibatches")) {
            self.skipped.inc_by(skipped as u64);
        }
        for (gauge, metric) in [(&self.success, SUCCESS_RATE), (&self.reward, REWARD)] {
            if let Some(value) = metrics.episodes.get(metric) {
                gauge.set(value);
            }
        }
    }

    /// A checkpoint of `bytes` was written, or could not be written.
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
struct LeaseMetrics {
    counters: [IntCounter; 6],
    outstanding: Gauge,
    residual: Gauge,
}

impl LeaseMetrics {
    fn new(m: &Metrics, noun: &str, title: &str) -> Self {
        let name = |what: &str| format!("{noun}_{what}");
        let counter = |what: &str, help: &str| m.counter(&name(&format!("{what}_total")), &format!("{title} {help}."));
        Self {
            counters: [
                counter("leased", "leased"),
                counter("trained", "accepted into a batch"),
                counter("duplicate", "dropped: complete already, or no longer needed"),
                counter("expired", "lost with their session"),
                counter("rejected", "rejected: the result was invalid"),
                counter("failed", "returned by the actor without a result"),
            ],
            outstanding: m.gauge(&name("outstanding"), &format!("{title} leased now.")),
            residual: m.gauge(&name("residual"), &format!("{title} that did not end in exactly one way; always 0.")),
        }
    }

    fn set(&self, c: &Counters) {
        let totals = [c.leased, c.trained, c.duplicate, c.expired, c.rejected, c.failed];
        self.counters.iter().zip(totals).for_each(|(counter, total)| raise_to(counter, total));
        self.outstanding.set(c.outstanding as f64);
        self.residual.set(c.residual as f64);
    }
}

/// Joint steps and agent steps of a training result; zero of an evaluation.
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

/// Sets minimum, mean and maximum; zeros if there are no values.
fn set_stats(gauges: &GaugeVec, values: &[f64]) {
    let count = values.len().max(1) as f64;
    let smallest = values.iter().copied().reduce(f64::min).unwrap_or(0.0);
    let largest = values.iter().copied().reduce(f64::max).unwrap_or(0.0);
    for (stat, value) in [("min", smallest), ("mean", values.iter().sum::<f64>() / count), ("max", largest)] {
        gauges.with_label_values(&[stat]).set(value);
    }
}
