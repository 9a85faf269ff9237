//! magex-actor
pub mod cache;
pub mod cli;
mod crew;
mod gauges;
pub mod goals;
mod link;
pub mod policy;
pub mod rollout;
pub mod run;
mod weights_feed;
pub mod worker;
