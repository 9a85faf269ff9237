//! `magex-bench`: measures MAGE-X. See `magex-bench --help`.
//!
//! Benchmarks of whole runs and services start child processes of `magex`. So that these are always built from the same
//! sources, this executable contains `magex` and behaves like it when it is called by that name.

mod act;
mod assign;
mod cli;
mod cluster;
mod endless;
mod env;
mod fleet;
mod flood;
mod goals;
mod messages;
mod powers;
mod report;
mod runs;
mod soak;
mod solver;
mod stats;
mod tasks;
mod training;
mod update;
mod vitals;

use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    // Before anything else: this may replace the process.
    if let Err(error) = magex_runtime::process::ensure_environment() {
        return magex::cli::cannot_start(&error);
    }
    match std::env::args_os().next() {
        Some(name) if Path::new(&name).file_name().is_some_and(|name| name == "magex") => magex::cli::main(),
        _ => cli::main(),
    }
}
