//! The networks of a run's executor.

use super::mat::Mat;
use super::{Independent, Network, Policy, build, feature_spec};
use crate::distribution::ActionHeads;
use crate::features::FeatureSpec;
use crate::params::{Entry, ParamBuilder, ParamError, Params};
use magex_core::config::{ExecutorConfig, ExecutorKind, RunConfig};

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
    config: ExecutorConfig,
    spec: FeatureSpec,
    heads: ActionHeads,
}

/// Policy and value function are two networks. Their order is that of their keys: 0 and 1.
const PARTS: [Part; 2] =
    [Part { name: "actor", policy: true, value: false }, Part { name: "critic", policy: false, value: true }];

/// Policy and value function share the encoder: one network, one optimiser.
const WHOLE: [Part; 1] = [Part { name: "transformer", policy: true, value: true }];

impl Model {
    /// The executor that a configuration names. `config.task` may have another team size than the weights were trained
    /// with, if the architecture allows it.
    pub fn new(config: &RunConfig) -> Result<Self, ParamError> {
        let heads = ActionHeads::new(config.task.action_heads())
            .ok_or_else(|| ParamError::Mismatch("an action component must have 1 to 16 choices".to_owned()))?;
        let spec = feature_spec(&config.executor, &config.task);
        Ok(Self { config: config.executor.clone(), spec, heads })
    }

    /// What the networks see.
    pub fn spec(&self) -> &FeatureSpec {
        &self.spec
    }

    /// Components of an action.
    pub fn heads(&self) -> &ActionHeads {
        &self.heads
    }

    /// H: width of the memory of the policy and of that of the value function, 0 for none.
    pub fn memory(&self) -> usize {
        self.config.memory()
    }

    /// The sets of parameters.
    pub fn parts(&self) -> &'static [Part] {
        if self.whole() { &WHOLE } else { &PARTS }
    }

    fn whole(&self) -> bool {
        matches!(self.config.kind, ExecutorKind::Mat | ExecutorKind::MatDec)
    }

    /// Names, shapes and initial distributions of the parameters of every part.
    pub fn layouts(&self) -> Result<Vec<Vec<Entry>>, ParamError> {
        let mut builders: Vec<ParamBuilder> = self.parts().iter().map(|_| ParamBuilder::layout()).collect();
        self.policy(&mut builders)?;
        if !self.whole() {
            self.value(&mut builders)?;
        }
        Ok(builders.into_iter().map(ParamBuilder::entries).collect())
    }

    /// The policy on the given parameters, one builder per part.
    pub fn policy(&self, parts: &mut [ParamBuilder]) -> Result<Box<dyn Policy>, ParamError> {
        if self.whole() {
            return Ok(Box::new(Mat::build(&self.config, &self.spec, &self.heads, &mut parts[0])?));
        }
        let (heads, head) = (self.heads.clone(), (self.heads.logits(), 0.01));
        let network = build(&self.config, &self.spec, head, false, &mut parts[0])?;
        Ok(Box::new(Independent { network, heads }))
    }

    /// The value function on the given parameters, one builder per part: one output per agent, in normalised units.
    pub fn value(&self, parts: &mut [ParamBuilder]) -> Result<Box<dyn Network>, ParamError> {
        if self.whole() {
            return Ok(Box::new(Mat::build(&self.config, &self.spec, &self.heads, &mut parts[0])?));
        }
        build(&self.config, &self.spec, (1, 1.0), true, &mut parts[1])
    }

    /// The policy of a weights file.
    pub fn load_policy(&self, weights: &[u8]) -> Result<Box<dyn Policy>, ParamError> {
        let load = |(part, layout): (&Part, Vec<Entry>)| {
            Ok(match part.policy {
                true => ParamBuilder::with(Params::load(layout, weights, part.name)?.tensors()?),
                false => ParamBuilder::layout(),
            })
        };
        let parts: Result<Vec<ParamBuilder>, ParamError> = self.parts().iter().zip(self.layouts()?).map(load).collect();
        self.policy(&mut parts?)
    }
}
