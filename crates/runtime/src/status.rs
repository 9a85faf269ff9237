//! Statuses with details, shared by the services.

use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

/// INVALID_ARGUMENT with the field, also as a google.rpc.BadRequest detail.
pub fn invalid_argument(field: impl Into<String>, problem: impl Into<String>) -> Status {
    let (field, problem) = (field.into(), problem.into());
    let message = format!("{field}: {problem}");
    Status::with_error_details(Code::InvalidArgument, message, ErrorDetails::with_bad_request_violation(field, problem))
}

/// FAILED_PRECONDITION: retrying does not help until client or server is changed.
pub fn failed_precondition(message: impl Into<String>) -> Status {
    Status::failed_precondition(message)
}

/// RESOURCE_EXHAUSTED with a retry delay.
pub fn resource_exhausted(message: impl Into<String>, retry: Duration) -> Status {
    Status::with_error_details(Code::ResourceExhausted, message, ErrorDetails::with_retry_info(Some(retry)))
}

/// UNAVAILABLE with a retry delay.
pub fn unavailable(message: impl Into<String>, retry: Duration) -> Status {
    Status::with_error_details(Code::Unavailable, message, ErrorDetails::with_retry_info(Some(retry)))
}

/// The retry delay of a status.
pub fn retry_delay(status: &Status) -> Option<Duration> {
    status.get_details_retry_info().and_then(|info| info.retry_delay)
}

/// Whether a retry may succeed, also after a broken connection (tonic's status has a source) or a damaged message.
pub fn is_transient(status: &Status) -> bool {
    let own = std::error::Error::source(status).is_some();
    own || matches!(
        status.code(),
        Code::Unavailable
            | Code::DataLoss
            | Code::DeadlineExceeded
            | Code::Cancelled
            | Code::Unknown
            | Code::ResourceExhausted
            | Code::Aborted
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn details_are_part_of_the_status() {
        let status = invalid_argument("agents.array", "missing");
        assert_eq!(status.message(), "agents.array: missing");
        let details = status.get_details_bad_request().unwrap();
        assert_eq!(details.field_violations[0].field, "agents.array");
        let status = unavailable("no weights yet", Duration::from_millis(500));
        assert_eq!(retry_delay(&status), Some(Duration::from_millis(500)));
        assert!(is_transient(&status) && !is_transient(&invalid_argument("x", "y")));
    }
}
