//! The actor: it leases shards from the learner, rolls them out with the published weights and returns the results.
//!
//! | module | content |
//! |---|---|
//! | [`run`] | the actor's loop: connect, work, reconnect, until shutdown or the end of the run |
//! | `session` | one connection to the learner: leases in, results out |
//! | `rollout_pool` | the rollout threads of one run |
//! | [`pulse`] | whether a rollout thread still moves |
//! | [`worker`] | the seam between the pool and the rollout, and the worker of production |
//! | [`rollout`] | the rollout of one shard: a pure function of shard, seed, task, weights and goals |
//! | [`environment`] | environments of other people: processes that are called over gRPC |
//! | [`goal_client`] | the goals of a shard, from the commander service |
//! | `weights_cache` | the stream of weights, and the two latest versions |
//! | `metrics` | the actor's Prometheus metrics |
//! | [`cli`] | the command line of `magex-actor` |

pub mod cli;
pub mod environment;
pub mod goal_client;
mod metrics;
pub mod pulse;
pub mod rollout;
mod rollout_pool;
pub mod run;
mod session;
mod weights_cache;
pub mod worker;
