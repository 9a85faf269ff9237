//! How training ends.

use crate::checkpoint::CheckpointError;
use crate::report::observer::FileError;
use crate::report::records::Summary;
use crate::run_events::{CollectError, StopReason};
use crate::train::suspect::UpdateError;
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
    /// The networks could not be built.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The networks could not be updated.
    #[error(transparent)]
    Update(#[from] UpdateError),
    /// Wrong results were trained on, and no checkpoint from before them is left.
    #[error(
        "{what}, and its results have been trained on since iteration {iteration}; no checkpoint from before that is left, so \
         nothing in this folder can be relied on from there on: start the run anew with another --out"
    )]
    Tainted {
        /// Which actor computed what.
        what: String,
        /// The first iteration that may have trained on wrong results.
        iteration: u32,
    },
    /// The commander could not be built.
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
        "{} continues with the configuration of its checkpoints, but {} (in its config.toml, a configuration file or an \
         option); leave that out: only keys of [run] other than run.seed may change, or begin a new run from its weights \
         with --from {}",
        .0.display(), .1, .0.display()
    )]
    OtherConfiguration(PathBuf, String),
    /// A budget that is spent already.
    #[error(
        "run.max_steps: the run has trained {done} steps, so its budget cannot be lowered to {requested}; give {done} or more"
    )]
    Budget {
        /// As it was requested.
        requested: u64,
        /// Joint steps trained on.
        done: u64,
    },
    /// The run cannot begin from the weights of another one.
    #[error("--from {}: {}", .0.display(), .1)]
    Parent(PathBuf, String),
    /// The configuration names weights to begin from, and nothing says where they are.
    #[error(
        "run.initial_weights: the run begins from the weights {0}; name their run with --from RUN, or remove the key"
    )]
    NoParent(String),
    /// The run folder was removed or replaced while the run went on.
    #[error(
        "{}: the run folder was removed, moved or replaced while the run went on, and is not back; what was trained since its last checkpoint is lost",
        .0.display()
    )]
    Gone(PathBuf),
    /// The configuration could not be serialised.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A replay buffer that does not fit into memory.
    #[error(
        "qmix.buffer_episodes: {episodes} episodes take {}, and {} are available: lower it to {fit}",
        magex_runtime::limits::size(*.needed), magex_runtime::limits::size(*.available)
    )]
    Buffer {
        /// As it was requested.
        episodes: usize,
        /// Bytes that they take.
        needed: u64,
        /// Bytes that this process can get.
        available: u64,
        /// Episodes that take half of that.
        fit: u64,
    },
    /// The training threads could not be started.
    #[error("training threads cannot be started ({}); {}", .0, magex_runtime::limits::threads())]
    Threads(String),
}

impl TrainError {
    /// Whether the configuration or the command line is at fault, not the run.
    pub fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::OtherConfiguration(..)
                | Self::Budget { .. }
                | Self::Parent(..)
                | Self::Buffer { .. }
                | Self::NoParent(_)
                | Self::Config(_)
                | Self::Threads(_)
        )
    }
}

impl TrainError {
    /// Whether a file of the run folder cannot be written, or the folder is gone.
    pub fn is_output(&self) -> bool {
        matches!(self, Self::File(_) | Self::Gone(_) | Self::Checkpoint(CheckpointError::File { .. }))
    }

    /// What the system says, if a file of the run folder cannot be used.
    pub fn io(&self) -> Option<&std::io::Error> {
        match self {
            Self::File(error) => Some(&error.error),
            _ => None,
        }
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
