//! The identity of a run: what the handshake tells every peer.

use magex_core::ids::RunId;
use std::time::Duration;

/// What every peer is told about the run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunIdentity {
    /// Identity of the run.
    pub run_id: RunId,
    /// Name of the run, for people.
    pub name: String,
    /// Fingerprint of the run's task.
    pub task_fingerprint: String,
    /// The run's configuration, TOML.
    pub run_config_toml: String,
    /// Seed of the run.
    pub seed: u64,
    /// An actor that says nothing for so long loses its leases.
    pub lease: Duration,
}
