//! Trained policies outside of training: acting on raw positions, traces of episodes, and exports. docs/policy.md is its reference.
//!
//! | module | content |
//! |---|---|
//! | [`acting`] | from positions, velocities and goals to actions, for any team size |
//! | [`memory`] | what a team carries between two calls, as opaque bytes |
//! | [`export`], [`onnx`], [`torch`], [`tensors`] | the policy as a file for other runtimes |
//! | [`trace`] | every step of an episode, for those that check a port |

pub mod acting;
pub mod export;
pub mod memory;
pub mod onnx;
pub mod tensors;
pub mod torch;
pub mod trace;
