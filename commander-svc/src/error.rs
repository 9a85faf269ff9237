//! Errors of calls, and the one place that turns them into statuses.

use crate::scheduler::SchedulerError;
use magex_dispatch::AssignError;
use magex_dispatch::missions::KeepError;
use magex_proto::convert::ConvertError;
use magex_runtime::net::in_flight::stopping;
use magex_runtime::status;
use std::time::Duration;
use tonic::Status;

/// Retry delay at the limit of missions.
const FULL: Duration = Duration::from_secs(10);
/// Retry delay after a failed write: longer than the pause before the file is opened again.
const NO_DISK: Duration = Duration::from_secs(2);

/// Why a call failed.
pub(crate) trait CallError {
    /// The status that the client gets.
    fn status(self) -> Status;
}

/// The status of an error.
pub(crate) fn to_status(error: impl CallError) -> Status {
    error.status()
}

impl CallError for ConvertError {
    fn status(self) -> Status {
        status::invalid_argument(self.field, self.problem)
    }
}

impl CallError for AssignError {
    fn status(self) -> Status {
        match self {
            Self::Invalid(error) => error.status(),
            Self::Interrupted => too_late(),
        }
    }
}

impl CallError for SchedulerError {
    fn status(self) -> Status {
        match self {
            Self::Invalid(error) => error.status(),
            Self::Interrupted => Status::deadline_exceeded("the call ended before the shard was answered"),
            Self::Unsupported(reason) => status::failed_precondition(reason),
            Self::Load(problem) | Self::Compute(problem) => Status::internal(problem),
        }
    }
}

impl CallError for KeepError {
    fn status(self) -> Status {
        let text = self.to_string();
        match self {
            Self::Exists(_) => Status::already_exists(text),
            Self::Missing(_) => Status::not_found(text),
            Self::Full(_) => status::resource_exhausted(text, FULL),
            Self::Changed { .. } => Status::aborted(text),
            Self::Closed => stopping(),
            Self::Disk(_) => {
                tracing::error!(error = text, "missions cannot be written");
                status::unavailable(text, NO_DISK)
            }
        }
    }
}

/// The status of a call without an answer at its deadline.
pub(crate) fn too_late() -> Status {
    Status::deadline_exceeded("no answer before the deadline; allow more time, or request the greedy scheduler")
}
