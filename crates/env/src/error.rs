//! What a caller of the environment can get wrong.

use magex_core::error::FieldError;

/// Errors of an [`crate::Env`]. An error leaves the worlds untouched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnvError {
    /// The task does not validate; the text names the field and the remedy.
    #[error(transparent)]
    Task(#[from] FieldError),
    /// An array does not have the length its shape asks for.
    #[error("{field}: {found} entries, the shape asks for {expected}")]
    Length {
        /// Which array.
        field: &'static str,
        /// Entries given.
        found: usize,
        /// Entries needed.
        expected: usize,
    },
    /// An action does not exist.
    #[error("actions[{place}]: {action} is not an action; use 0 none, 1 +x, 2 -x, 3 +y, 4 -y")]
    Action {
        /// Flat index into `[B, N]`.
        place: usize,
        /// The value found there.
        action: u8,
    },
    /// An action component does not exist.
    #[error("actions[{place}]: {action} is not an action; use 0 forward, 1 stop, 2 backward")]
    AxisAction {
        /// Flat index into `[B, N, H]`.
        place: usize,
        /// The value found there.
        action: u8,
    },
    /// A goal names a landmark that does not exist.
    #[error("goals[{place}]: {goal} is not a landmark; use an index below {landmarks}")]
    Goal {
        /// Flat index into `[B, N, K]`.
        place: usize,
        /// The value found there.
        goal: u32,
        /// N.
        landmarks: usize,
    },
    /// A goal names a ball that does not exist.
    #[error("goals[{place}]: {goal} is not a ball; use an index below {balls}")]
    Ball {
        /// Flat index into `[B, N, 2]`.
        place: usize,
        /// The value found there.
        goal: u32,
        /// N.
        balls: usize,
    },
    /// A position, velocity or landmark is not a finite number.
    #[error("{field}[{place}]: {value} is not finite")]
    NotFinite {
        /// Which array.
        field: &'static str,
        /// Flat index into it.
        place: usize,
        /// The value found there.
        value: f32,
    },
    /// A step was asked for before the agents knew their goals.
    #[error("goals: not set; call set_goals before the first step")]
    GoalsNotSet,
    /// A step was asked for after the last one.
    #[error("step: the episode is over after {horizon} steps; start a new batch")]
    EpisodeOver {
        /// T.
        horizon: u32,
    },
}

/// `Ok` if an array has the length its shape asks for.
pub(crate) fn check_len(field: &'static str, found: usize, expected: usize) -> Result<(), EnvError> {
    if found == expected { Ok(()) } else { Err(EnvError::Length { field, found, expected }) }
}

/// `Ok` if every number is finite.
pub(crate) fn check_finite(field: &'static str, values: &[f32]) -> Result<(), EnvError> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(place) => Err(EnvError::NotFinite { field, place, value: values[place] }),
    }
}
