//! The `magex` command as a library.
//!
//! | module | content |
//! |---|---|
//! | [`cli`], `commands` | the command line: one file per command |
//! | [`options`], [`settings`], [`usage`], [`output`], [`failure`] | what every command shares: options, configuration, refusals, printing, exit codes |
//! | [`local`], `evaluate`, `planning_clock` | rollouts in this process, for training and for evaluation |
//! | [`supervise`] | training with learner, commander and actors as child processes |
//! | `training`, `runs` | one training run in its folder; runs as they are compared |
//! | `reproduce` | the paper's tables, trained and measured anew |
//! | [`folder`], `artifacts` | run folders, and the pictures in them |

pub mod cli;
mod external;
pub mod failure;
pub mod folder;
pub mod local;
pub mod options;
pub mod output;
pub mod settings;
pub mod supervise;
pub mod usage;

mod artifacts;
mod commands;
mod evaluate;
mod logging;
mod parallel;
mod parent_watch;
mod planning_clock;
mod progress;
mod reproduce;
mod runs;
mod synthetic;
mod training;
