//! Networks of MAGE-X on candle: features, layers with hand-written gradients, the action executor and its ablations,
//! the goal commander, and parameter I/O. No tokio, no clock, no thread.

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index several arrays by one counter; iterators hide which elements meet"
)]

pub mod commander;
pub mod distribution;
pub mod executor;
pub mod features;
mod matmul;
pub mod ops;
pub mod params;
mod simd;

pub use matmul::Activation;
