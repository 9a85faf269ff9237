//! What learning changes: named networks with their optimisers, and the statistics of the value targets.

use crate::train::gae::ValueNorm;
use crate::train::replay::Replay;
use magex_core::about::About;
use magex_nets::params::{ParamError, Params};
use magex_nets::weights_file;

/// What an optimiser remembers of one network's gradients.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Moments {
    /// Running mean, one value per parameter; empty for optimisers without one (RMSprop) and for networks without an optimiser.
    pub first: Vec<f32>,
    /// Running mean of the squares, one value per parameter; empty for networks without an optimiser.
    pub second: Vec<f32>,
    /// Updates done.
    pub steps: u64,
}

/// One set of parameters with its optimiser.
#[derive(Debug, Clone, PartialEq)]
pub struct Network {
    /// Its name in weights files and checkpoints.
    pub name: String,
    /// The parameters; none for a scheduler that is not learned.
    pub params: Params,
    /// State of the optimiser.
    pub moments: Moments,
    /// Whether actors and commanders need it.
    pub published: bool,
}

impl Network {
    /// With an Adam that has done no step.
    pub fn new(name: &str, params: Params, published: bool) -> Self {
        Self { name: name.to_owned(), moments: Moments::adam(params.values.len()), params, published }
    }
}

/// Everything that learning changes. A checkpoint holds exactly this: an algorithm with other networks adds them to the list.
#[derive(Debug, Clone, PartialEq)]
pub struct Learned {
    /// The executor's networks in the order of [`magex_nets::executor::Model::parts`], then the commander's.
    pub networks: Vec<Network>,
    /// Running statistics of returns.
    pub value_norm: ValueNorm,
    /// The replay buffer of an off-policy algorithm.
    pub replay: Option<Replay>,
    /// What the weights say about themselves.
    pub about: About,
}

impl Learned {
    /// The network of a name.
    pub fn network(&self, name: &str) -> Option<&Network> {
        self.networks.iter().find(|network| network.name == name)
    }

    /// Lends the network of a name, with its place in the list, to which it must return.
    pub(crate) fn take(&mut self, name: &str) -> Result<(usize, Network), ParamError> {
        let place = self.networks.iter().position(|network| network.name == name);
        let place = place.ok_or_else(|| ParamError::Mismatch(format!("there is no network named {name}")))?;
        Ok((place, self.networks.remove(place)))
    }

    /// The weights file: all networks. Its SHA-256 is the identity of what was learned.
    pub fn weights(&self) -> Result<Vec<u8>, ParamError> {
        self.file(|_| true)
    }

    /// What actors and commanders need.
    pub fn broadcast(&self) -> Result<Vec<u8>, ParamError> {
        self.file(|network| network.published)
    }

    fn file(&self, which: fn(&Network) -> bool) -> Result<Vec<u8>, ParamError> {
        let networks = self.networks.iter().filter(|network| which(network));
        let named: Vec<(&str, &Params)> = networks.map(|network| (network.name.as_str(), &network.params)).collect();
        weights_file::write(&named, &self.about)
    }
}
