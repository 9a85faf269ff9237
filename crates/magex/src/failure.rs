//! Errors that carry the exit code of the process.

use crate::options::CommonOptions;
use crate::output::fatal;
use crate::usage::FromEnvironment;
use magex_core::config::ConfigError;
use magex_learner::trainer::TrainError;
use magex_runtime::exit::{self, Failure};
use std::fmt;
use std::process::ExitCode;

/// Wrong usage or configuration: nothing was started.
pub fn usage(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::USAGE, message)
}

/// An output cannot be created.
pub fn cannot_create(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::CANNOT_CREATE, message)
}

/// A required service cannot be reached.
pub fn unavailable(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::UNAVAILABLE, message)
}

/// Ends the process with `code`.
pub fn coded(code: u8, message: impl fmt::Display) -> anyhow::Error {
    anyhow::Error::new(Failure::new(code, message))
}

/// The exit code of a command; reports its error.
pub fn exit_code(result: anyhow::Result<u8>, options: &CommonOptions, variables: &FromEnvironment) -> ExitCode {
    ExitCode::from(result.unwrap_or_else(|error| {
        let code = code_of(&error);
        fatal(&variables.named(&format!("{error:#}")), code, options.json);
        code
    }))
}

/// The exit code of an error.
pub(crate) fn code_of(error: &anyhow::Error) -> u8 {
    if let Some(failure) = error.downcast_ref::<Failure>() {
        return failure.code;
    }
    if error.downcast_ref::<ConfigError>().is_some() {
        return exit::USAGE;
    }
    match error.downcast_ref::<TrainError>() {
        Some(error) if error.is_usage() => exit::USAGE,
        Some(TrainError::Gone(_)) => exit::CANNOT_CREATE,
        _ => exit::FAILURE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context as _;

    #[test]
    fn the_code_survives_context() {
        let error = Err::<(), _>(usage("agents: 0 is too few")).context("reading the configuration").unwrap_err();
        assert_eq!(code_of(&error), exit::USAGE);
        assert_eq!(format!("{error:#}"), "reading the configuration: agents: 0 is too few");
        assert_eq!(code_of(&anyhow::anyhow!("broken")), exit::FAILURE);
        assert_eq!(code_of(&ConfigError("x".into()).into()), exit::USAGE);
    }
}
