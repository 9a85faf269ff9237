//! Goal assignment for external clients (transport-independent).
//!
//! A request is parsed and checked ([`problem`], its words by [`terms`]), priced ([`costs`]), solved ([`engine`]), and answered
//! ([`answer`]). A mission ([`mission`]) is a
//! persistent team: it is re-planned on every change, with a switching cost that favours current assignments. [`missions`] stores
//! missions, bounded in number and age ([`clock`]), in a file ([`disk`]). Missions are wire types on purpose: a mission's assignment is the
//! message that clients receive and the record that is stored.
//!
//! For every input the answer is a valid matching or an error that names the field.

pub mod answer;
pub mod clock;
pub mod costs;
pub mod disk;
pub mod engine;
mod lists;
pub mod mission;
pub mod missions;
pub mod problem;
pub mod terms;

pub use magex_assign::{AssignError, UNASSIGNED};
pub use problem::{Limits, Problem};
