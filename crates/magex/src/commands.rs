//! One file per command.

pub(crate) mod act;
pub(crate) mod assign;
pub(crate) mod bench;
pub(crate) mod check_environment;
pub(crate) mod compare;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod health;
pub(crate) mod replay;
pub(crate) mod reproduce;
pub(crate) mod roles;
pub(crate) mod trace;
pub(crate) mod train;
pub(crate) mod train_commander;
pub(crate) mod verify;
