//! The `magex` command as a library: everything in one process ([`local`]), the checks and pictures it makes
//! ([`verify`], [`replay`], [`curve`]), and the command line itself ([`cli`]).

pub mod cli;
pub mod curve;
pub mod local;
pub mod replay;
pub mod verify;

mod artifacts;
mod commands;
mod evaluate;
mod failure;
mod folder;
mod logging;
mod output;
mod progress;
mod settings;
mod supervise;
mod synthetic;
