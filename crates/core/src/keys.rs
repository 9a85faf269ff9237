//! Which stream serves which episode of which shard: one place, used by actors (to roll out), commander (to sample
//! goals) and learner (to replay the graph's noise).

use crate::ids::{Shard, ShardKind};
use crate::rng::{Key, Purpose, Stream};

/// Streams of one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeKeys {
    /// Spawn positions.
    pub spawn: Key,
    /// Executor actions.
    pub action: Key,
    /// Gumbel noise of the executor's graph.
    pub graph: Key,
    /// Goal sampling.
    pub commander: Key,
    /// Randomness of a controller without weights.
    pub controller: Key,
}

/// Keys of the b-th episode of a shard. Evaluation episodes are named by their set and index alone, so that a set does
/// not depend on how it was cut into shards, nor on the iteration.
pub fn episode_keys(seed: u64, shard: &Shard, b: u32) -> EpisodeKeys {
    use Purpose::{Action, Commander, EvalAction, EvalCommander, EvalGraph, EvalSpawn, Graph, Spawn};
    let (set, purposes) = match shard.kind {
        ShardKind::Train => (shard.iteration.0, [Spawn, Action, Graph, Commander]),
        ShardKind::Eval => (shard.eval_set, [EvalSpawn, EvalAction, EvalGraph, EvalCommander]),
    };
    let [spawn, action, graph, commander] =
        purposes.map(|purpose| Key::new(seed, purpose, &[set, shard.first_episode + b]));
    let kind = u32::from(shard.kind == ShardKind::Eval);
    let controller = Key::new(seed, Purpose::Controller, &[set, shard.first_episode + b, kind]);
    EpisodeKeys { spawn, action, graph, commander, controller }
}

/// Whether the b-th episode of a shard gets a random matching instead of the scheduler's, which happens to a given share
/// of the training episodes and to no evaluation: the stream to draw it from, if so.
pub fn random_goals(seed: u64, shard: &Shard, b: u32, share: f32) -> Option<Stream> {
    if shard.kind == ShardKind::Eval || share <= 0.0 {
        return None;
    }
    let mut stream = Key::new(seed, Purpose::RandomGoals, &[shard.iteration.0, shard.first_episode + b]).stream();
    (stream.uniform32() < share).then_some(stream)
}
