//! Errors that know the exit code they end the process with.

use magex_core::config::ConfigError;
use magex_learner::trainer::TrainError;
use magex_runtime::exit::{self, Failure};
use std::fmt;

/// Wrong usage or configuration: nothing was started.
pub(crate) fn usage(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::USAGE, message)
}

/// An output cannot be created.
pub(crate) fn cannot_create(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::CANNOT_CREATE, message)
}

/// A service that is needed cannot be used.
pub(crate) fn unavailable(message: impl fmt::Display) -> anyhow::Error {
    coded(exit::UNAVAILABLE, message)
}

/// Ends the process with `code`.
pub(crate) fn coded(code: u8, message: impl fmt::Display) -> anyhow::Error {
    anyhow::Error::new(Failure::new(code, message))
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
        assert_eq!(code_of(&ConfigError::Syntax("x".into()).into()), exit::USAGE);
    }
}
