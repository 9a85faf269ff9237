//! magex

pub mod curve;
pub mod replay;
pub mod verify;
pub mod local;
