//! Statistics over training runs: what a result says when it rests on few seeds.
//!
//! | module | content |
//! |---|---|
//! | [`scores`] | the scores of a system: for every task, those of its runs |
//! | [`aggregate`] | interquartile mean, mean, median, optimality gap, standard deviation |
//! | [`distribution`] | performance profiles and the probability of improvement |
//! | [`bootstrap`] | intervals by the stratified percentile bootstrap |
//! | [`curves`] | the mean of several learning curves, with a band |
//!
//! Names and formulas are those of "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (Agarwal et al.,
//! 2021); point estimates agree with its package rliable 1.2.0 to 1e-12 (`testdata/`). The intervals are our own: the same
//! scheme, drawn from keyed streams, so that a table is the same on every machine.

pub mod aggregate;
pub mod bootstrap;
pub mod curves;
pub mod distribution;
pub mod scores;

pub use bootstrap::Interval;
pub use scores::{Scores, ScoresError};
