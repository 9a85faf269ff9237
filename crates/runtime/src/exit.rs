//! Exit codes, as in sysexits.h, and the outcome of a command.

/// Success.
pub const OK: u8 = 0;
/// The work failed.
pub const FAILURE: u8 = 1;
/// Wrong usage or configuration: nothing was started.
pub const USAGE: u8 = 64;
/// A required service is unavailable.
pub const UNAVAILABLE: u8 = 69;
/// An internal error.
pub const INTERNAL: u8 = 70;
/// An output cannot be created.
pub const CANNOT_CREATE: u8 = 73;
/// Stopped before the end; resuming continues.
pub const TEMPORARY: u8 = 75;
/// Interrupted twice.
pub const INTERRUPTED: u8 = 130;

/// Why a command failed, and its exit code.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// Exit code.
    pub code: u8,
    /// The message for the user.
    pub message: String,
}

impl Failure {
    /// A failure with its exit code.
    pub fn new(code: u8, message: impl ToString) -> Self {
        Self { code, message: message.to_string() }
    }

    /// Wrong usage or configuration.
    pub fn usage(message: impl ToString) -> Self {
        Self::new(USAGE, message)
    }
}
