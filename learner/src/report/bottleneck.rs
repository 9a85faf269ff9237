//! The bottleneck of an iteration: its actors, its learner, or the network between them.
//!
//! The learner's own time is measured. The time of collecting is attributed by the time of the shards: an actor reports how
//! long it held each shard and how much of that it waited for weights; the rest of the time between lease and result is
//! transfer. No number of the run depends on these times.

use serde::Serialize;

/// The stage of an iteration that time is attributed to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// The actors and their commander: more actors would help.
    #[default]
    Actor,
    /// The learner: more training threads or cheaper updates would help.
    Learner,
    /// The network: neither more actors nor a faster learner would help.
    Network,
}

impl Stage {
    /// All stages.
    pub const ALL: [Self; 3] = [Self::Actor, Self::Learner, Self::Network];

    /// Name in files, logs and metrics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Actor => "actor",
            Self::Learner => "learner",
            Self::Network => "network",
        }
    }
}

/// Where the time of the shards of one plan went, seconds. Sums over concurrent shards, so they may exceed the wall time.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct CollectTiming {
    /// Wall time without a lease outstanding; counts as the actors'.
    pub idle_s: f64,
    /// Held by actors: waiting and computing.
    #[serde(skip)]
    pub held_s: f64,
    /// Of these rolling out.
    pub rollout_s: f64,
    /// Of these waiting for the commander.
    pub goals_wait_s: f64,
    /// Of these waiting for the weights.
    pub weights_wait_s: f64,
    /// Between lease and result and not held by the actor: in transfer.
    pub transfer_s: f64,
}

/// The bottleneck of an iteration, with the numbers behind it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Bottleneck {
    /// The stage with the largest of the three times below.
    pub stage: Stage,
    /// Seconds of the iteration attributed to the actors.
    pub actor_s: f64,
    /// Seconds attributed to the learner.
    pub learner_s: f64,
    /// Seconds attributed to the network.
    pub network_s: f64,
    /// Where the time of the shards went; zeros without a network.
    #[serde(flatten)]
    pub shards: CollectTiming,
}

/// Attributes an iteration of `learner_s` seconds of the learner's own and `collect_s` seconds of waiting for results.
/// Without `timing` there is no network: everything ran in one process.
pub fn attribute(learner_s: f64, collect_s: f64, timing: Option<&CollectTiming>) -> Bottleneck {
    let mut shards = timing.copied().unwrap_or_default();
    shards.idle_s = shards.idle_s.clamp(0.0, collect_s.max(0.0));
    // Waiting for weights counts as transfer: they are under way.
    let computing = (shards.held_s - shards.weights_wait_s).max(0.0);
    let transfer = shards.transfer_s + shards.weights_wait_s;
    let share = if transfer > 0.0 { transfer / (computing + transfer) } else { 0.0 };
    let network_s = (collect_s - shards.idle_s).max(0.0) * share;
    let actor_s = (collect_s - network_s).max(0.0);
    let parts = [(Stage::Actor, actor_s), (Stage::Learner, learner_s), (Stage::Network, network_s)];
    // Ties go to the first stage.
    let stage = parts.iter().rev().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(Stage::Actor, |part| part.0);
    Bottleneck { stage, actor_s, learner_s, network_s, shards }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn collected(held_s: f64, weights_wait_s: f64, transfer_s: f64, idle_s: f64) -> CollectTiming {
        CollectTiming { held_s, weights_wait_s, transfer_s, idle_s, ..CollectTiming::default() }
    }

    fn check(found: Bottleneck, stage: Stage, [actor, learner, network]: [f64; 3]) {
        let close = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(found.stage == stage, "{found:?}");
        assert!(
            close(found.actor_s, actor) && close(found.learner_s, learner) && close(found.network_s, network),
            "{found:?}"
        );
    }

    #[test]
    fn the_bottleneck_is_the_stage_with_the_largest_time() {
        // Two actors side by side: 8 s of shard time in 4 s.
        check(attribute(1.0, 4.0, Some(&collected(6.0, 0.0, 2.0, 0.0))), Stage::Actor, [3.0, 1.0, 1.0]);
        check(attribute(5.0, 4.0, Some(&collected(6.0, 0.0, 2.0, 0.0))), Stage::Learner, [3.0, 5.0, 1.0]);
        check(attribute(1.0, 4.0, Some(&collected(1.0, 0.0, 3.0, 0.0))), Stage::Network, [1.0, 1.0, 3.0]);
    }

    #[test]
    fn waiting_for_weights_counts_as_network_and_idle_time_as_actors() {
        check(attribute(0.5, 4.0, Some(&collected(4.0, 3.0, 0.0, 0.0))), Stage::Network, [1.0, 0.5, 3.0]);
        check(attribute(0.5, 4.0, Some(&collected(0.5, 0.0, 0.5, 3.0))), Stage::Actor, [3.5, 0.5, 0.5]);
    }

    #[test]
    fn one_process_has_no_network_time_and_zero_times_give_no_nan() {
        check(attribute(1.0, 2.0, None), Stage::Actor, [2.0, 1.0, 0.0]);
        check(attribute(3.0, 2.0, None), Stage::Learner, [2.0, 3.0, 0.0]);
        check(attribute(0.0, 0.0, Some(&CollectTiming::default())), Stage::Actor, [0.0; 3]);
        // An actor with a wrong clock.
        check(attribute(0.0, 1.0, Some(&collected(0.0, 9.0, 1.0, 7.0))), Stage::Actor, [1.0, 0.0, 0.0]);
    }
}
