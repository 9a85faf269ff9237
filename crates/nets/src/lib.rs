//! Networks of MAGE-X on candle, and what they see. No tokio, no clock, no thread.
//!
//! | module | content |
//! |---|---|
//! | [`features`] | from states to the numbers that networks see |
//! | [`executor`] | the action executor and its ablations: [`executor::Model`], [`executor::Policy`], [`executor::QNetwork`] |
//! | [`commander`] | the goal commander |
//! | [`distribution`] | categorical actions |
//! | [`ops`] | layers as custom operations with hand-written gradients |
//! | [`params`] | parameters: initialisation, order, weights files |
//! | [`weights_file`] | what a weights file says about itself |

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index several arrays by one counter; iterators hide which elements meet"
)]

pub mod commander;
pub mod distribution;
pub mod executor;
pub mod features;
pub mod ops;
pub mod params;
pub mod weights_file;
