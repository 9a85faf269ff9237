//! The services over real sockets in one process, with fakes for what computes: leases, results, weights, goals,
//! and everything that goes wrong between them.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests")]

mod commander;
mod elastic;
mod handshake;
mod results;
mod sandbox;
mod speed;
mod stopping;
mod weights;
