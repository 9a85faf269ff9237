//! "Learning Graph-Enhanced Commander-Executor for Multi-Agent Navigation" (Yang et al., AAMAS 2023), section by section: each
//! equation, line of Algorithm 1, task and table of the appendix is a test. Where this product deviates from the paper on
//! purpose the test says so, and why.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod appendix;
mod experiments;
mod method;
mod support;
