//! The live page of a run: one HTML file without outside assets, and the JSON that it asks for.
//!
//! Training never waits for a viewer. The training thread leaves what is new in [`LivePage`]; whoever looks takes copies of
//! it. Memory is bounded, and so is the number of requests answered at once.

mod curve;
mod routes;
pub mod scene;
mod state;

pub use state::{LivePage, Phase, RunEnd, RunInfo};

#[cfg(test)]
mod tests;
