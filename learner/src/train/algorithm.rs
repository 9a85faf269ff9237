//! The algorithms that train an executor, as the training loop sees them.

use crate::train::batch::Batch;
use crate::train::commander_ppo::CommanderPpo;
use crate::train::gae::ValueNorm;
use crate::train::learned::Learned;
use crate::train::mappo::Mappo;
use crate::train::qmix::Qmix;
use crate::train::stats::UpdateStats;
use magex_core::config::{Algorithm as Name, RunConfig};
use magex_core::trajectory::Trajectory;
use magex_nets::commander::CommanderError;
use magex_nets::params::ParamError;

/// A result that the weights which it names do not give: its numbers were made elsewhere, or changed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field}: differs by {error:e} from what the weights give, where {limit:e} is allowed")]
pub struct Suspect {
    /// Which of the iteration's trajectories.
    pub trajectory: usize,
    /// Which numbers of it.
    pub field: &'static str,
    /// Largest difference.
    pub error: f64,
    /// Largest difference that is allowed.
    pub limit: f64,
}

/// Why an update failed. What is learned may have changed by then.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    /// A trajectory is not what it says.
    #[error(transparent)]
    Suspect(#[from] Suspect),
    /// The executor's networks could not be updated.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The commander could not be updated.
    #[error(transparent)]
    Commander(#[from] CommanderError),
}

impl From<candle_core::Error> for UpdateError {
    fn from(error: candle_core::Error) -> Self {
        Self::Weights(error.into())
    }
}

/// Largest difference between the log-probabilities of an actor or commander and those that the learner recomputes. They have the
/// same bits where both run the same operations; across batch shapes and processors single precision leaves less than this.
pub const LOG_PROB_TOLERANCE: f64 = 1e-4;

/// The trajectory that an episode of the batch of all of them belongs to.
pub(crate) fn trajectory_of(trajectories: impl Iterator<Item = usize>, episode: usize) -> usize {
    let mut end = 0;
    trajectories
        .take_while(|episodes| {
            end += episodes;
            end <= episode
        })
        .count()
}

/// The algorithm that a configuration names, with its settings.
#[derive(Debug)]
pub enum Algorithm {
    /// On the iteration's own episodes.
    Mappo(Box<Mappo>),
    /// On episodes out of a replay buffer: QMIX and MASER.
    Qmix(Box<Qmix>),
}

impl Algorithm {
    /// Checks that the task's actions fit, and fixes the sizes.
    pub fn new(config: &RunConfig) -> Result<Self, ParamError> {
        Ok(match config.run.algorithm {
            Name::Mappo => Self::Mappo(Box::new(Mappo::new(config)?)),
            Name::Qmix | Name::Maser => Self::Qmix(Box::new(Qmix::new(config)?)),
        })
    }

    /// One update after an iteration's trajectories. `progress` in [0, 1] is the share of the budget spent.
    pub fn update(
        &self,
        learned: &mut Learned,
        seed: u64,
        trajectories: &[Trajectory],
        iteration: u32,
        progress: f64,
    ) -> Result<UpdateStats, UpdateError> {
        match self {
            Self::Mappo(mappo) => {
                let update = mappo.update(learned, &Batch::new(seed, mappo.spec(), trajectories), iteration, progress);
                update.map_err(|error| match error {
                    // The batch knows episodes only.
                    UpdateError::Suspect(Suspect { trajectory: episode, field, error, limit }) => {
                        let episodes = trajectories.iter().map(|t| t.shape.episodes);
                        Suspect { trajectory: trajectory_of(episodes, episode), field, error, limit }.into()
                    }
                    other => other,
                })
            }
            Self::Qmix(qmix) => Ok(qmix.update(learned, trajectories, iteration)?),
        }
    }
}

impl Learned {
    /// Initial networks and optimisers, and an empty replay buffer for algorithms that have one. Here rather than in
    /// [`crate::train::learned`], which knows no algorithm.
    pub fn init(algorithm: &Algorithm, commander: &CommanderPpo) -> Result<Self, ParamError> {
        let (mut networks, value_norm, replay) = match algorithm {
            Algorithm::Mappo(mappo) => (mappo.init()?, mappo.value_norm(), None),
            Algorithm::Qmix(qmix) => (qmix.init()?, ValueNorm::new(false), Some(qmix.replay())),
        };
        networks.push(commander.init()?);
        Ok(Self { networks, value_norm, replay })
    }
}
