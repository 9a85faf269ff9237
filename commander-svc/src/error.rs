//! Errors of calls, and the one place that turns them into statuses.

use crate::scheduler::SchedulerError;
use magex_dispatch::DispatchError;
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
#[derive(Debug, thiserror::Error)]
pub(crate) enum CallError {
    /// A field of the request is invalid.
    #[error(transparent)]
    Field(#[from] ConvertError),
    /// A team or a mission was not solved.
    #[error(transparent)]
    Dispatch(#[from] DispatchError),
    /// A shard was not answered.
    #[error(transparent)]
    Scheduler(#[from] SchedulerError),
    /// A mission was not stored.
    #[error(transparent)]
    Missions(#[from] KeepError),
}

impl From<CallError> for Status {
    fn from(error: CallError) -> Self {
        let text = error.to_string();
        match error {
            CallError::Field(error)
            | CallError::Dispatch(DispatchError::Invalid(error))
            | CallError::Scheduler(SchedulerError::Invalid(error)) => {
                status::invalid_argument(error.field, error.problem)
            }
            CallError::Dispatch(DispatchError::Interrupted) => too_late(),
            CallError::Scheduler(error) => match error {
                SchedulerError::Interrupted => Self::deadline_exceeded("the call ended before the shard was answered"),
                SchedulerError::Unsupported(reason) => status::failed_precondition(reason),
                _ => Self::internal(text),
            },
            CallError::Missions(error) => match error {
                KeepError::Exists(_) => Self::already_exists(text),
                KeepError::Missing(_) => Self::not_found(text),
                KeepError::Full(_) => status::resource_exhausted(text, FULL),
                KeepError::Changed { .. } => Self::aborted(text),
                KeepError::Closed => stopping(),
                KeepError::Disk(_) => {
                    tracing::error!(error = text, "missions cannot be written");
                    status::unavailable(text, NO_DISK)
                }
            },
        }
    }
}

/// The status of an error.
pub(crate) fn to_status(error: impl Into<CallError>) -> Status {
    error.into().into()
}

/// The status of a call without an answer at its deadline.
pub(crate) fn too_late() -> Status {
    Status::deadline_exceeded("no answer before the deadline; allow more time, or request the greedy scheduler")
}
