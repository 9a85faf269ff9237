//! Exit codes, as in sysexits.h, and the outcome of a command.

use crate::process::ensure_environment;
use std::process::ExitCode;

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

/// Runs the body of a service's command with the arguments of this process, in the environment that it needs: usage errors exit
/// with [`USAGE`], failures are printed to standard error and exit with their code. `main` calls this before anything else.
pub fn run<P: clap::Parser>(body: impl FnOnce(P) -> Result<u8, Failure>) -> ExitCode {
    if let Err(error) = ensure_environment() {
        return report(Err(Failure::new(INTERNAL, error)));
    }
    let arguments = match P::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            // Help and version are no errors. A closed terminal does not matter.
            let _ = error.print();
            return ExitCode::from(if error.use_stderr() { USAGE } else { OK });
        }
    };
    report(body(arguments))
}

/// The exit code of a result; a failure is printed to standard error.
#[allow(clippy::print_stderr, reason = "the one place that prints why a command failed")]
fn report(result: Result<u8, Failure>) -> ExitCode {
    match result {
        Ok(code) => ExitCode::from(code),
        Err(failure) => {
            eprintln!("error: {failure}");
            ExitCode::from(failure.code)
        }
    }
}
