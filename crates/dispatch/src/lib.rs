//! Goal assignment for external clients (transport-independent).
//!
//! A request is parsed and checked ([`problem`]), solved ([`engine`]), and answered ([`answer`]). A mission ([`mission`]) is a
//! persistent team: it is re-planned on every change, with a switching cost that favours current assignments. [`missions`] stores
//! missions, bounded in number and age, in a file ([`disk`]). Missions are wire types on purpose: a mission's assignment is the
//! message that clients receive and the record that is stored.
//!
//! For every input the answer is a valid matching or an error that names the field.

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
    /// A field of the request is invalid.
    #[error(transparent)]
    Invalid(#[from] magex_proto::convert::ConvertError),
    /// The call ended or its deadline passed.
    #[error("interrupted before an answer was found")]
    Interrupted,
}

impl DispatchError {
    /// A problem with a field.
    pub fn invalid(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Invalid(magex_proto::convert::ConvertError::new(field, problem))
    }
}
