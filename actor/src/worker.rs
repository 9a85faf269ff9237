//! The seam between the rollout pool and the rollout, and the worker of production.

use crate::environment::{EnvironmentError, EnvironmentSource, Environments};
use crate::goal_client::{GoalError, GrpcGoals};
use crate::pulse::Pulse;
use crate::rollout::{Roller, RolloutError};
use magex_core::config::RunConfig;
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_proto::v1::Welcome;
use magex_proto::weights::Weights;
use std::sync::Arc;

/// Turns shards into results. Belongs to one rollout thread and keeps no state that a result could depend on.
pub trait Worker: Send {
    /// Rolls out one shard with the weights that it names.
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError>;

    /// Called once, before any work: the worker beats this pulse while it gets on. A worker that does not is taken for stuck when
    /// a shard takes it eight times the time of a lease.
    fn beat(&mut self, _pulse: Pulse) {}
}

/// Why a shard failed.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// The goals are not available.
    #[error("goals: {0}")]
    Goals(#[from] GoalError),
    /// Anything else after which another attempt may succeed.
    #[error("{0}")]
    Retryable(String),
    /// A failure that every attempt would repeat.
    #[error("{0}")]
    Fatal(String),
}

impl WorkError {
    /// A failure that every attempt would repeat.
    pub fn fatal(reason: impl Into<String>) -> Self {
        Self::Fatal(reason.into())
    }

    /// Another attempt may succeed, here or at another actor.
    pub fn is_retryable(&self) -> bool {
        use GoalError::{Cancelled, Late, Unauthorized};
        matches!(self, Self::Retryable(_) | Self::Goals(Cancelled | Late(_) | Unauthorized(_)))
    }

    /// Every shard would fail in this way at this actor, though another actor may succeed.
    pub fn is_fatal_to_actor(&self) -> bool {
        matches!(self, Self::Goals(GoalError::Unauthorized(_)))
    }
}

/// Creates the worker of one rollout thread for the run of a learner. Together with a shard and its weights, the learner's
/// welcome determines every result. Called once per thread and run, and again after a worker panicked.
pub type MakeWorker = Arc<dyn Fn(&Welcome) -> Result<Box<dyn Worker>, WorkError> + Send + Sync>;

/// Rolls out shards. Keeps the executor of the latest weights, so that each version is loaded once.
#[derive(Debug)]
pub struct PolicyWorker {
    config: RunConfig,
    /// With the SHA-256 of its weights.
    roller: Option<(String, Roller)>,
    pulse: Pulse,
    environments: Option<Arc<Environments>>,
}

impl PolicyWorker {
    /// A worker for the run that the learner described.
    ///
    /// # Errors
    /// The configuration cannot be parsed, or this build gives its task another fingerprint than the learner does.
    pub fn new(welcome: &Welcome) -> Result<Self, WorkError> {
        let config =
            RunConfig::from_toml(&welcome.run_config_toml).map_err(|error| WorkError::fatal(error.to_string()))?;
        let own = config.task.fingerprint();
        if own != welcome.task_fingerprint {
            return Err(WorkError::fatal(format!(
                "task_fingerprint: the run's task is {own} to this actor and {} to the learner; use the same release on both \
                 sides",
                welcome.task_fingerprint
            )));
        }
        Ok(Self { config, roller: None, pulse: Pulse::default(), environments: None })
    }

    /// A factory of such workers. `source` says where the environments of a run with an external task come from.
    pub fn maker(source: Option<EnvironmentSource>) -> MakeWorker {
        Arc::new(move |welcome| {
            let mut worker = Self::new(welcome)?;
            if let Ok(external) = worker.config.task.external() {
                let missing = || EnvironmentError::Missing(external.environment.clone());
                let source = source.clone().ok_or_else(|| WorkError::fatal(missing().to_string()))?;
                // One for each thread: what a thread leaves behind is no concern of another.
                let environments = Environments::new(source, external);
                // The wrong one never takes a shard; one that is not there yet may be there for the first shard.
                match environments.prepare() {
                    Err(error) if error.is_permanent() => return Err(WorkError::fatal(error.to_string())),
                    Err(error) => tracing::warn!(reason = %error, "the environment is not there yet"),
                    Ok(()) => {}
                }
                worker.environments = Some(Arc::new(environments));
            }
            Ok(Box::new(worker))
        })
    }

    fn roller(&mut self, weights: &Weights) -> Result<&Roller, WorkError> {
        let roller = match self.roller.take() {
            Some((sha256, roller)) if sha256 == weights.sha256 => roller,
            _ => {
                let mut roller = Roller::new(&self.config, &weights.bytes)
                    .map_err(|error| WorkError::fatal(format!("weights version {}: {error}", weights.version)))?;
                roller.pulse = self.pulse.clone();
                roller.environments.clone_from(&self.environments);
                roller
            }
        };
        Ok(&self.roller.insert((weights.sha256.clone(), roller)).1)
    }
}

impl Worker for PolicyWorker {
    fn beat(&mut self, pulse: Pulse) {
        self.pulse = pulse;
    }

    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError> {
        self.roller(weights)?.rollout(shard, |request| goals.assign(request)).map_err(|error| match error {
            RolloutError::Goals(error) => WorkError::Goals(error),
            RolloutError::Environment(error) if !error.is_permanent() => WorkError::Retryable(error.to_string()),
            other => WorkError::fatal(other.to_string()),
        })
    }
}
