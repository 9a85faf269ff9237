//! The learner: it leases shards to actors, trains on what they return, publishes weights and keeps the run folder.
//!
//! | module | content |
//! |---|---|
//! | [`trainer`] | the training loop: publish, plan, collect, evaluate, update, record, checkpoint |
//! | [`train`] | the algorithms: MAPPO for the executor, PPO for the goal commander |
//! | [`serve`] | the gRPC service: sessions, the ledger of leases, validation of results, the weights board |
//! | [`report`] | the observers of a run: metrics.jsonl, summary.json, TensorBoard, the bottleneck of an iteration |
//! | [`collector`] | the seam between the training loop and the actors |
//! | [`run_events`], [`run_identity`] | what a run reports, and how it is identified |
//! | [`checkpoint`] | what a resume needs |
//! | [`run_folder`], [`run_lock`] | beginning and continuing a run in a folder, and the lock that keeps other processes out |
//! | [`run_start`] | what may change when a run continues, and a run that begins from the weights of another |
//! | [`cli`] | the command line of `magex-learner` |

pub mod checkpoint;
pub mod cli;
pub mod collector;
#[cfg(test)]
mod fixtures;
pub mod origin;
pub mod report;
pub mod run_events;
pub mod run_folder;
pub mod run_identity;
pub mod run_lock;
pub mod run_start;
pub mod serve;
pub mod train;
pub mod trainer;
