//! Who goes where, for outside clients, without a network: a request is read and checked ([`problem`]), solved
//! ([`engine`]), and answered ([`answer`]); a mission ([`mission`]) is a team that stays, planned again with every change
//! and reluctant to send anybody elsewhere; [`missions`] keeps them, bounded in number and age, on disk ([`disk`]).
//!
//! Whatever the input, the answer is a valid matching or an error that names the field.

pub mod answer;
pub mod disk;
pub mod engine;
pub mod mission;
pub mod missions;
pub mod problem;
pub mod view;

pub use magex_assign::UNASSIGNED;
pub use problem::{Limits, Problem};

/// Why there is no assignment.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DispatchError {
    /// The request makes no sense; names the field.
    #[error(transparent)]
    Invalid(#[from] magex_proto::convert::ConvertError),
    /// Nobody wants the answer any more, or its time is over.
    #[error("given up before the answer was found")]
    Interrupted,
}

impl DispatchError {
    /// A problem with a field.
    pub fn invalid(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Invalid(magex_proto::convert::ConvertError::new(field, problem))
    }
}
