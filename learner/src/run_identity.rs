//! The identity of a run, as the handshake sends it to every peer.

use magex_core::ids::RunId;
use std::time::Duration;

/// What the handshake says about the run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunIdentity {
    /// Identity of the run.
    pub run_id: RunId,
    /// Display name of the run.
    pub name: String,
    /// Fingerprint of the run's task.
    pub task_fingerprint: String,
    /// The run's configuration, TOML.
    pub run_config_toml: String,
    /// Seed of the run.
    pub seed: u64,
    /// Silence after which an actor loses its leases.
    pub lease: Duration,
}
