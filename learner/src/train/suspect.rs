//! Results that an update refuses.

use magex_nets::commander::CommanderError;
use magex_nets::params::ParamError;

/// A result that the weights which it names do not give: its numbers were made elsewhere, or changed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field}: differs by {error:e} from what the weights give, where {limit:e} is allowed")]
pub struct Suspect {
    /// Which of the iteration's trajectories.
    pub trajectory: usize,
    /// Which numbers of it.
    pub field: &'static str,
    /// Largest difference.
    pub error: f64,
    /// Largest difference that is allowed.
    pub limit: f64,
}

/// Why an update failed. What is learned may have changed by then.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    /// A trajectory is not what it says.
    #[error(transparent)]
    Suspect(#[from] Suspect),
    /// The executor's networks could not be updated.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The commander could not be updated.
    #[error(transparent)]
    Commander(#[from] CommanderError),
}

impl From<candle_core::Error> for UpdateError {
    fn from(error: candle_core::Error) -> Self {
        Self::Weights(error.into())
    }
}

/// Largest difference between the log-probabilities of an actor or commander and those that the learner recomputes. They have the
/// same bits where both run the same operations; across batch shapes and processors single precision leaves less than this.
pub const LOG_PROB_TOLERANCE: f64 = 1e-4;
