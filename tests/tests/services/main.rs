//! The services over real sockets in one process, with fakes for what computes: leases, results, weights, goals,
//! and everything that goes wrong between them.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests")]

mod bounds;
mod certificates;
mod clients;
mod commander;
mod elastic;
mod floods;
mod handshake;
mod hostile;
mod missions;
mod results;
mod sandbox;
mod security;
mod stopping;
mod swaps;
mod weights;
mod wire;
