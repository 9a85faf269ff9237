//! The shards of an iteration.

use magex_core::config::RunConfig;
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};

const EVAL_SHARD_EPISODES: u32 = 16;
/// Evaluation set while training.
pub const EVAL_SET_TRAINING: u32 = 1;
/// Evaluation set that closes a run: other spawns than any set before.
pub const EVAL_SET_FINAL: u32 = 2;

/// Limit of the episodes of any shard of a run.
pub fn max_shard_episodes(config: &RunConfig) -> u32 {
    (config.collect.episodes_per_iteration / config.collect.shards_per_iteration).max(EVAL_SHARD_EPISODES)
}

pub(super) fn training(config: &RunConfig, iteration: u32) -> impl Iterator<Item = Shard> + use<> {
    let shards = config.collect.shards_per_iteration;
    let episodes = config.collect.episodes_per_iteration / shards;
    (0..shards).map(move |index| Shard {
        kind: ShardKind::Train,
        iteration: Iteration(iteration),
        index,
        episodes,
        first_episode: index * episodes,
        version: WeightsVersion(iteration),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    })
}

/// The shards of an evaluation of the present version. `record` asks for a recording of the first episode.
pub(super) fn evaluation(
    iteration: u32,
    set: u32,
    episodes: u32,
    mode: Mode,
    record: bool,
) -> impl Iterator<Item = Shard> + use<> {
    let shards = episodes.div_ceil(EVAL_SHARD_EPISODES);
    // The two final evaluations share spawns; their shards need different names.
    let offset = if mode == Mode::Sampled { shards } else { 0 };
    (0..shards).map(move |index| Shard {
        kind: ShardKind::Eval,
        iteration: Iteration(iteration),
        index: index + offset,
        episodes: EVAL_SHARD_EPISODES.min(episodes - index * EVAL_SHARD_EPISODES),
        first_episode: index * EVAL_SHARD_EPISODES,
        version: WeightsVersion(iteration),
        mode,
        eval_set: set,
        record: record && index == 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_shard_of_a_run_exceeds_the_limit_that_the_service_accepts() {
        let mut config = RunConfig::default();
        for (episodes, shards) in [(64, 4), (8, 4), (1000, 10)] {
            (config.collect.episodes_per_iteration, config.collect.shards_per_iteration) = (episodes, shards);
            let evaluation = evaluation(3, EVAL_SET_FINAL, 100, Mode::Sampled, true);
            let largest = training(&config, 3).chain(evaluation).map(|shard| shard.episodes).max();
            assert_eq!(largest, Some(max_shard_episodes(&config)));
        }
    }
}
