//! How training ends.

use crate::checkpoint::CheckpointError;
use crate::report::observer::FileError;
use crate::report::records::Summary;
use crate::run_events::{CollectError, StopReason};
use magex_core::config::ConfigError;
use magex_nets::commander::CommanderError;
use magex_nets::params::ParamError;
use std::path::PathBuf;

/// Why training stopped with an error.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A plan could not be collected.
    #[error(transparent)]
    Collect(#[from] CollectError),
    /// A checkpoint could not be read or written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The networks could not be built or updated.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The commander could not be built or updated.
    #[error(transparent)]
    Commander(#[from] CommanderError),
    /// A file of the run folder could not be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The run is complete, but its last files cannot be written.
    #[error(
        "{0}, for {1} s; free disk space or fix the permissions, then continue with --resume, which repeats only the end of \
         the run"
    )]
    LastFiles(FileError, u64),
    /// The closing evaluation returned no episodes.
    #[error("results: the final evaluation returned no episodes")]
    EmptyEvaluation,
    /// Results could not be serialised.
    #[error("results: {0}")]
    Serialise(#[from] serde_json::Error),
    /// The run folder belongs to another configuration.
    #[error(
        "{}: the checkpoint was made with another configuration; resume without a configuration file, or start a new run",
        .0.display()
    )]
    OtherConfiguration(PathBuf),
    /// The configuration could not be serialised.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The training threads could not be started.
    #[error("training threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl TrainError {
    /// Whether the configuration or the command line is at fault, not the run.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::OtherConfiguration(_) | Self::Config(_) | Self::Threads(_))
    }
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub enum TrainOutcome {
    /// Target reached or budget spent.
    Finished(Box<Summary>),
    /// Stopped on request; the run resumes from its last checkpoint.
    Stopped(StopReason),
}
