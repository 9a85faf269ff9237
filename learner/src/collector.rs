//! The trainer's view of the actors: publish weights, hand out a plan, get its results.

use crate::bound::Collected;
use crate::ingest::describe;
use crate::ledger::PlanError;
use crate::metrics::IterationMetrics;
use crate::state::{Shared, lock};
use crate::weights::Weights;
use magex_core::ids::{Iteration, Shard, ShardKind, WeightsVersion};
use magex_core::trajectory::ShardResult;
use std::fmt;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Gets plans done. Called from the training thread, which it blocks.
pub trait Collector: Send {
    /// Makes a version of the weights known to all actors and commanders. Comes before every plan that names it.
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError>;

    /// Gets every shard of a plan done, on whichever actors there are. The results are in the order of the plan.
    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError>;

    /// Tells whoever watches the run what happened.
    fn event(&mut self, event: RunEvent);

    /// Whether the trainer should write a checkpoint and return after the current iteration.
    fn stop_requested(&self) -> Option<StopReason>;

    /// Whether somebody asked for a checkpoint since the last call.
    fn checkpoint_requested(&mut self) -> bool {
        false
    }

    /// Where the time of the last plan's shards went; `None` if there is no network that it could have gone to.
    fn collected(&self) -> Option<Collected> {
        None
    }

    /// Takes note of how the run stood when it was resumed.
    fn resumed(&mut self, _before: &IterationReport) {}

    /// Takes note of what an iteration was like, for whoever operates the run.
    fn measured(&mut self, _metrics: &IterationMetrics) {}

    /// Takes note of a checkpoint that was written to this folder, or could not be.
    fn checkpointed(&mut self, _took: Duration, _written: Option<&Path>) {}
}

/// Why the learner stops before the end of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StopReason {
    /// The process was told to stop.
    Shutdown,
    /// An operator asked for it.
    Drain(String),
}

impl fmt::Display for StopReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shutdown => f.write_str("shutdown"),
            Self::Drain(reason) if reason.is_empty() => f.write_str("drain"),
            Self::Drain(reason) => write!(f, "drain: {reason}"),
        }
    }
}

/// Why a plan did not get done.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The learner stops; nothing of the plan is kept.
    #[error("stopped ({0})")]
    Stopped(StopReason),
    /// A shard failed on every attempt.
    #[error("{} failed on every attempt, the last time with: {reason}", describe(.shard))]
    Shard {
        /// Which.
        shard: Shard,
        /// What the last actor said.
        reason: String,
    },
    /// The plan makes no sense.
    #[error("plan: {0}")]
    Plan(#[from] PlanError),
    /// The plan names weights that no actor can have.
    #[error("plan: names weights version {0}, which is not among the latest two that were published")]
    Version(WeightsVersion),
    /// Anything else.
    #[error("{0}")]
    Other(String),
}

/// Something that happened in the run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEvent {
    /// An iteration was completed.
    Iteration(IterationReport),
    /// Something to tell a person.
    Log(String),
    /// A checkpoint was written.
    Checkpoint {
        /// Iterations completed in it.
        iteration: Iteration,
        /// Where it is.
        path: String,
    },
    /// The run is complete.
    Finished {
        /// Its summary, one JSON object on one line.
        summary_json: String,
    },
}

/// What an iteration was like.
#[derive(Debug, Clone, PartialEq)]
pub struct IterationReport {
    /// Iterations completed.
    pub iteration: Iteration,
    /// Joint steps trained on so far.
    pub joint_env_steps: u64,
    /// Success rate, 0..=1, if it was measured.
    pub success: Option<f32>,
    /// Mean reward per agent and step.
    pub reward: Option<f32>,
    /// All metrics, one JSON object on one line.
    pub metrics_json: String,
}

impl IterationReport {
    /// What a line of metrics.jsonl says; `None` if it is not one.
    pub(crate) fn of(line: String) -> Option<Self> {
        let metrics: serde_json::Value = serde_json::from_str(&line).ok()?;
        Some(Self {
            iteration: Iteration(u32::try_from(metrics["iteration"].as_u64()?).ok()?),
            joint_env_steps: metrics["joint_env_steps"].as_u64()?,
            success: metrics["success_rate"].as_f64().map(|x| x as f32),
            reward: metrics["reward"].as_f64().map(|x| x as f32),
            metrics_json: line,
        })
    }
}

/// The collector whose actors connect over gRPC. Made by [`crate::service::learner_service`].
#[derive(Debug)]
pub struct GrpcCollector {
    shared: Arc<Shared>,
    collected: Collected,
}

impl GrpcCollector {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared, collected: Collected::default() }
    }

    /// Hands out a plan and returns at once; actors that wait for work get it now.
    pub fn open(&mut self, plan: Vec<Shard>) -> Result<(), CollectError> {
        if let Some(shard) = plan.iter().find(|shard| !self.shared.board.is_kept(shard.version)) {
            return Err(CollectError::Version(shard.version));
        }
        self.shared.open(plan)?;
        Ok(())
    }

    /// Blocks until the open plan is done.
    pub fn wait(&mut self) -> Result<Vec<ShardResult>, CollectError> {
        let results = self.shared.wait()?;
        let (collected, ages) = lock(&self.shared.tally).close(Instant::now());
        self.collected = collected;
        let newest = self.shared.board.latest().map_or(0, |weights| weights.version.0);
        let training = results.iter().map(ShardResult::shard).filter(|shard| shard.kind == ShardKind::Train);
        let lags: Vec<f64> = training.map(|shard| f64::from(newest.saturating_sub(shard.version.0))).collect();
        self.shared.gauges.batch(&lags, &ages);
        Ok(results)
    }
}

impl Collector for GrpcCollector {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        if weights.run_id != self.shared.run.run_id {
            let own = &self.shared.run.run_id;
            return Err(CollectError::Other(format!("weights of run '{}' published to run '{own}'", weights.run_id)));
        }
        self.shared.publish(weights.clone());
        Ok(())
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        self.open(plan)?;
        self.wait()
    }

    fn event(&mut self, event: RunEvent) {
        self.shared.record(event);
    }

    fn resumed(&mut self, before: &IterationReport) {
        self.shared.reported(before);
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.shared.stop_requested()
    }

    fn checkpoint_requested(&mut self) -> bool {
        self.shared.take_checkpoint_request()
    }

    fn collected(&self) -> Option<Collected> {
        Some(self.collected)
    }

    fn measured(&mut self, metrics: &IterationMetrics) {
        self.shared.gauges.iteration(metrics);
        let (bound, timing) = (&metrics.timing.bound, &metrics.timing);
        tracing::info!(
            iteration = metrics.iteration,
            joint_env_steps = metrics.joint_env_steps,
            success_rate = metrics.success_rate,
            reward = metrics.reward,
            bound_by = bound.by.name(),
            actor_s = bound.actor_s,
            learner_s = bound.learner_s,
            network_s = bound.network_s,
            collect_s = timing.collect_s,
            "iteration"
        );
    }

    fn checkpointed(&mut self, took: Duration, written: Option<&Path>) {
        self.shared.gauges.checkpoint(took, written.map(size_of));
    }
}

/// Bytes of the files in a folder.
fn size_of(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    entries.filter_map(|entry| entry.metadata().ok()).map(|meta| meta.len()).sum()
}
