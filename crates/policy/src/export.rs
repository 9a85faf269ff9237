//! What every export shares: the policy, what it says about itself, and why it cannot be exported.

use crate::acting::check_simulated;
use crate::tensors::Tensors;
use magex_core::about::About;
use magex_core::config::RunConfig;
use magex_core::sha256;
use magex_nets::params::ParamError;

/// Why a policy was not exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The weights do not fit the configuration.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The decoder of `mat` is written out agent by agent.
    #[error(
        "the mat executor decodes agent by agent, which is written out for up to {most} agents; this run has {agents}; --format torch \
         can, and so can mat-dec, dicg, flat, local and the graph executors as ONNX"
    )]
    TooLarge {
        /// N of the run.
        agents: usize,
        /// The limit.
        most: usize,
    },
}

/// A policy to export.
#[derive(Debug)]
pub struct Source<'a> {
    pub(crate) config: &'a RunConfig,
    pub(crate) tensors: Tensors,
    pub(crate) about: About,
    weights_sha256: String,
}

impl<'a> Source<'a> {
    /// The policy of a weights file.
    ///
    /// # Errors
    /// The weights do not fit the configuration.
    pub fn load(config: &'a RunConfig, weights: &[u8]) -> Result<Self, ExportError> {
        check_simulated(config)?;
        let tensors = Tensors::load(config, weights)?;
        Ok(Self { config, about: About::of(config), weights_sha256: sha256::hex(weights), tensors })
    }

    /// The identity of the policy in any format: SHA-256 of its tensors, ordered by name.
    pub fn policy_sha256(&self) -> String {
        self.tensors.sha256()
    }

    /// What an exported file says about itself: keys and values, all different.
    pub(crate) fn metadata(&self) -> Vec<(&'static str, String)> {
        let (task, about) = (&self.config.task, &self.about);
        let size = if self.config.executor.kind.fixed_team_size() { task.agents.to_string() } else { "any".into() };
        let choices: Vec<String> = about.actions.choices.iter().map(usize::to_string).collect();
        vec![
            ("run", about.run.clone()),
            ("weights_sha256", self.weights_sha256.clone()),
            ("policy_sha256", self.tensors.sha256()),
            ("magex_version", env!("CARGO_PKG_VERSION").to_owned()),
            ("format", about.format.to_string()),
            ("task", task.name.to_string()),
            ("executor", self.config.executor.kind.to_string()),
            ("team_size", size),
            ("half_side", (task.side / 2.0).to_string()),
            ("step_seconds", about.units.step_seconds.to_string()),
            ("length_unit", about.units.length.clone()),
            ("speed_unit", about.units.speed.clone()),
            ("action_code", about.actions.code.clone()),
            ("action_choices", choices.join(",")),
            ("memory", about.memory.to_string()),
            ("about", about.to_json()),
        ]
    }
}
