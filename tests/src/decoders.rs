//! Decoders that are fed untrusted bytes: requests, trajectories, weights, checkpoints, records of missions.
//!
//! Every target takes any bytes and panics where a promise breaks; that it returns at all is part of the promise. The
//! tests run them on damaged copies of good examples, `fuzz/` on what a coverage-guided fuzzer finds.

pub mod dispatch;
pub mod files;
pub mod mutate;
pub mod run_folder;
pub mod wire;
