//! The networks of a run's executor.

use super::mat::Mat;
use super::{Act, Distance, Independent, Mixer, Network, Policy, QNetwork, build, feature_spec};
use crate::distribution::ActionHeads;
use crate::features::FeatureSpec;
use crate::params::{Entry, Init, ParamBuilder, ParamError, Params};
use magex_core::config::{Algorithm, ExecutorKind, RunConfig};

/// A named set of parameters with an optimiser of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// Its name in weights files and checkpoints.
    pub name: &'static str,
    /// The policy reads it: actors need it.
    pub policy: bool,
    /// The value function reads it.
    pub value: bool,
}

/// How parameters are grouped into networks, and what policy and value function are on them. An executor in which the two
/// share an encoder has one part that both read; rollout, update and checkpoint only follow this list.
#[derive(Debug, Clone)]
pub struct Model {
    config: RunConfig,
    spec: FeatureSpec,
    heads: ActionHeads,
}

/// Policy and value function are two networks. Their order is that of their keys: 0 and 1.
const PARTS: [Part; 2] =
    [Part { name: "actor", policy: true, value: false }, Part { name: "critic", policy: false, value: true }];

/// Policy and value function share the encoder: one network, one optimiser.
const WHOLE: [Part; 1] = [Part { name: "transformer", policy: true, value: true }];

/// QMIX: one optimiser for both. Actors need the action values alone.
const QMIX: [Part; 2] =
    [Part { name: "agent", policy: true, value: false }, Part { name: "mixer", policy: false, value: true }];

/// MASER has a distance between observations, too.
const MASER: [Part; 3] = [QMIX[0], QMIX[1], Part { name: "distance", policy: false, value: false }];

impl Model {
    /// The executor that a configuration names. `config.task` may have another team size than the weights were trained
    /// with, if the architecture allows it.
    pub fn new(config: &RunConfig) -> Result<Self, ParamError> {
        let heads = match config.task.shape(1).moves {
            0 => ActionHeads::new(config.task.action_heads())
                .ok_or_else(|| ParamError::Mismatch("an action component must have 1 to 256 choices".to_owned()))?,
            moves => ActionHeads::gaussian(moves),
        };
        let spec = feature_spec(&config.executor, &config.task);
        Ok(Self { config: config.clone(), spec, heads })
    }

    /// What the networks see.
    pub fn spec(&self) -> &FeatureSpec {
        &self.spec
    }

    /// Components of an action.
    pub fn heads(&self) -> &ActionHeads {
        &self.heads
    }

    /// H: width of what a policy, or a value function, carries from step to step, 0 for nothing. Action values carry the last
    /// action, too.
    pub fn memory(&self) -> usize {
        let last_action = self.config.run.algorithm.off_policy() && self.config.qmix.last_action;
        self.config.executor.memory() + if last_action { self.heads.logits() } else { 0 }
    }

    /// The sets of parameters.
    pub fn parts(&self) -> &'static [Part] {
        match self.config.run.algorithm {
            Algorithm::Qmix => &QMIX,
            Algorithm::Maser => &MASER,
            Algorithm::Mappo if self.whole() => &WHOLE,
            Algorithm::Mappo => &PARTS,
        }
    }

    fn whole(&self) -> bool {
        matches!(self.config.executor.kind, ExecutorKind::Mat | ExecutorKind::MatDec)
    }

    /// Names, shapes and initial distributions of the parameters of every part.
    pub fn layouts(&self) -> Result<Vec<Vec<Entry>>, ParamError> {
        let mut builders: Vec<ParamBuilder> = self.parts().iter().map(|_| ParamBuilder::layout()).collect();
        if self.config.run.algorithm.off_policy() {
            self.q_network(&mut builders[0])?;
            self.mixer(&mut builders[1])?;
            if let Some(distance) = builders.get_mut(2) {
                self.distance(distance)?;
            }
        } else {
            self.policy(&mut builders)?;
            if !self.whole() {
                self.value(&mut builders)?;
            }
        }
        Ok(builders.into_iter().map(ParamBuilder::entries).collect())
    }

    /// The policy on the given parameters, one builder per part.
    pub fn policy(&self, parts: &mut [ParamBuilder]) -> Result<Box<dyn Policy>, ParamError> {
        if self.whole() {
            return Ok(Box::new(Mat::build(&self.config.executor, &self.spec, &self.heads, &mut parts[0])?));
        }
        let (heads, moves) = (self.heads.clone(), self.heads.moves());
        let outputs = if moves > 0 { moves } else { heads.logits() };
        let network = build(&self.config.executor, &self.spec, (outputs, 0.01), false, &mut parts[0])?;
        let log_deviations = match moves {
            0 => None,
            _ => Some(parts[0].tensor("log_deviations", &[1, moves], Init::Constant(0.0))?),
        };
        Ok(Box::new(Independent { network, heads, log_deviations }))
    }

    /// The value function on the given parameters, one builder per part: one output per agent, in normalised units.
    pub fn value(&self, parts: &mut [ParamBuilder]) -> Result<Box<dyn Network>, ParamError> {
        if self.whole() {
            return Ok(Box::new(Mat::build(&self.config.executor, &self.spec, &self.heads, &mut parts[0])?));
        }
        build(&self.config.executor, &self.spec, (1, 1.0), true, &mut parts[1])
    }

    /// The action values of QMIX.
    pub fn q_network(&self, params: &mut ParamBuilder) -> Result<QNetwork, ParamError> {
        QNetwork::build(&self.config, &self.spec, &self.heads, params)
    }

    /// The mixing network of QMIX.
    pub fn mixer(&self, params: &mut ParamBuilder) -> Result<Mixer, ParamError> {
        Mixer::build(&self.config, &self.spec, params)
    }

    /// The distance between observations of MASER.
    pub fn distance(&self, params: &mut ParamBuilder) -> Result<Distance, ParamError> {
        Distance::build(&self.config, &self.spec, &self.heads, params)
    }

    /// What acts, out of a weights file: the policy, or the action values.
    pub fn load_policy(&self, weights: &[u8]) -> Result<Box<dyn Act>, ParamError> {
        let load = |(part, layout): (&Part, Vec<Entry>)| {
            Ok(match part.policy {
                true => ParamBuilder::with(Params::load(layout, weights, part.name)?.tensors()?),
                false => ParamBuilder::layout(),
            })
        };
        let parts: Result<Vec<ParamBuilder>, ParamError> = self.parts().iter().zip(self.layouts()?).map(load).collect();
        let mut parts = parts?;
        if self.config.run.algorithm.off_policy() {
            return Ok(Box::new(self.q_network(&mut parts[0])?));
        }
        Ok(self.policy(&mut parts)?)
    }
}
