//! The algorithms: what a batch of trajectories does to the networks. No connection, no clock, no file.

pub mod adam;
pub mod batch;
pub mod commander_ppo;
pub mod gae;
pub mod learned;
pub mod mappo;
pub mod stats;

use commander_ppo::CommanderPpo;
use learned::Learned;
use magex_nets::params::ParamError;
use mappo::Mappo;

/// Here rather than in [`learned`], which knows no algorithm.
impl Learned {
    /// Initial networks and optimisers.
    pub fn init(mappo: &Mappo, commander: &CommanderPpo) -> Result<Self, ParamError> {
        let mut networks = mappo.init()?;
        networks.push(commander.init()?);
        Ok(Self { networks, value_norm: mappo.value_norm() })
    }
}
