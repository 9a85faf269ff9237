//! magex-actor
pub mod rollout;
pub mod cache;
mod crew;
pub mod goals;
mod link;
pub mod run;
mod weights_feed;
pub mod worker;
pub mod cli;
pub mod policy;
