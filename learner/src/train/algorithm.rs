//! The algorithms that train an executor, as the training loop sees them.

use crate::train::batch::Batch;
use crate::train::commander_ppo::CommanderPpo;
use crate::train::gae::ValueNorm;
use crate::train::learned::Learned;
use crate::train::mappo::Mappo;
use crate::train::qmix::Qmix;
use crate::train::stats::UpdateStats;
use crate::train::suspect::{Suspect, UpdateError};
use magex_core::about::About;
use magex_core::config::{Algorithm as Name, RunConfig};
use magex_core::trajectory::Trajectory;
use magex_nets::params::ParamError;

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
            Self::Qmix(qmix) => {
                qmix.check_actions(learned, trajectories)?;
                Ok(qmix.update(learned, trajectories, iteration)?)
            }
        }
    }
}

impl Learned {
    /// Initial networks and optimisers, and an empty replay buffer for algorithms that have one. Here rather than in
    /// [`crate::train::learned`], which knows no algorithm.
    pub fn init(config: &RunConfig, algorithm: &Algorithm, commander: &CommanderPpo) -> Result<Self, ParamError> {
        let (mut networks, value_norm, replay) = match algorithm {
            Algorithm::Mappo(mappo) => (mappo.init()?, mappo.value_norm(), None),
            Algorithm::Qmix(qmix) => (qmix.init()?, ValueNorm::new(false), Some(qmix.replay())),
        };
        networks.push(commander.init()?);
        Ok(Self { networks, value_norm, replay, about: About::of(config) })
    }
}
