//! What a run needs of the machine: memory for its replay buffer, and threads.

use super::TrainError;
use crate::train::replay::Replay;
use magex_core::config::RunConfig;

/// Refuses a replay buffer that will not fit into memory when it is full: hours later, the run would be killed.
pub(super) fn check_buffer(config: &RunConfig) -> Result<(), TrainError> {
    if !config.run.algorithm.off_policy() {
        return Ok(());
    }
    let (episodes, needed) = (config.qmix.buffer_episodes, Replay::bytes(config));
    match magex_runtime::limits::available_memory() {
        Some(available) if available < needed => {
            let fit = (available / 2 / Replay::episode_bytes(config)).max(1);
            Err(TrainError::Buffer { episodes, needed, available, fit })
        }
        _ => Ok(()),
    }
}

/// Training threads: as many as can be started, up to `most`. Their number changes no number of the run.
pub(super) fn pool(most: usize) -> Result<rayon::ThreadPool, TrainError> {
    let build = |threads| {
        let builder = rayon::ThreadPoolBuilder::new().num_threads(threads).stack_size(64 << 20);
        builder.thread_name(|i| format!("magex-train-{i}")).build()
    };
    let mut threads = most;
    loop {
        match build(threads) {
            Err(error) if threads > 1 => {
                threads /= 2;
                tracing::warn!(%error, threads, "not all training threads can be started; trying with fewer");
            }
            built => return built.map_err(|error| TrainError::Threads(error.to_string())),
        }
    }
}
