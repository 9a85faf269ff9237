//! What an iteration waited for: its actors, its learner, or the network between them.
//!
//! The learner's own time is measured. The time of collecting is split by what the shards spent theirs on: an actor says
//! how long it held each shard and how much of that it waited for weights; what is left of the time between lease and
//! result is the way there and back. Times end here: nothing that is trained on knows them.

use serde::Serialize;

/// What an iteration waited for most.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum BoundBy {
    /// The actors (and the commander that they ask): more of them would help.
    #[default]
    Actor,
    /// The learner: more training threads or cheaper updates would help.
    Learner,
    /// The network: neither would help.
    Network,
}

impl BoundBy {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Actor, Self::Learner, Self::Network];

    /// Its name in files, logs and metrics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Actor => "actor",
            Self::Learner => "learner",
            Self::Network => "network",
        }
    }
}

/// Where the time of the shards of one plan went. Sums over shards that were done side by side: no spans of a clock.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Collected {
    /// Held by actors, seconds: waiting and computing.
    pub held_s: f64,
    /// Of these rolling out.
    pub rollout_s: f64,
    /// Of these waiting for the commander.
    pub goals_wait_s: f64,
    /// Of these waiting for the weights.
    pub weights_wait_s: f64,
    /// Between lease and result, and not held by the actor: on the way.
    pub transfer_s: f64,
    /// When nobody held a lease, seconds of the clock.
    pub idle_s: f64,
}

/// An iteration's verdict, with the numbers that it rests on.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Bound {
    /// The largest of the three below.
    pub by: BoundBy,
    /// Seconds of the iteration that the actors took.
    pub actor_s: f64,
    /// Seconds that the learner took.
    pub learner_s: f64,
    /// Seconds that the network took.
    pub network_s: f64,
    /// Of the actors' seconds: nobody held a lease.
    pub idle_s: f64,
    /// Sum over shards: rolling out.
    pub rollout_s: f64,
    /// Sum over shards: waiting for the commander.
    pub goals_wait_s: f64,
    /// Sum over shards: waiting for the weights.
    pub weights_wait_s: f64,
    /// Sum over shards: leases and results on their way.
    pub transfer_s: f64,
}

/// Judges an iteration that took `learner_s` seconds of the learner's own and `collect_s` seconds of waiting for results.
/// Without `collected` there is no network: everything happened in one process.
pub fn judge(learner_s: f64, collect_s: f64, collected: Option<&Collected>) -> Bound {
    let all = collected.copied().unwrap_or_default();
    let idle_s = all.idle_s.clamp(0.0, collect_s.max(0.0));
    // Weights that are not there yet are on their way.
    let (computing, on_the_way) = ((all.held_s - all.weights_wait_s).max(0.0), all.transfer_s + all.weights_wait_s);
    let share = if on_the_way > 0.0 { on_the_way / (computing + on_the_way) } else { 0.0 };
    let network_s = (collect_s - idle_s).max(0.0) * share;
    let actor_s = (collect_s - network_s).max(0.0);
    let parts = [(BoundBy::Actor, actor_s), (BoundBy::Learner, learner_s), (BoundBy::Network, network_s)];
    // Of equals the first.
    let by = parts.iter().rev().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(BoundBy::Actor, |part| part.0);
    let Collected { rollout_s, goals_wait_s, weights_wait_s, transfer_s, .. } = all;
    Bound { by, actor_s, learner_s, network_s, idle_s, rollout_s, goals_wait_s, weights_wait_s, transfer_s }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn collected(held_s: f64, weights_wait_s: f64, transfer_s: f64, idle_s: f64) -> Collected {
        Collected { held_s, weights_wait_s, transfer_s, idle_s, ..Collected::default() }
    }

    fn check(bound: Bound, by: BoundBy, [actor, learner, network]: [f64; 3]) {
        let close = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(bound.by == by, "{bound:?}");
        assert!(
            close(bound.actor_s, actor) && close(bound.learner_s, learner) && close(bound.network_s, network),
            "{bound:?}"
        );
    }

    #[test]
    fn the_verdict_follows_the_largest_part() {
        // Two actors side by side: 8 s of shard time in 4 s.
        check(judge(1.0, 4.0, Some(&collected(6.0, 0.0, 2.0, 0.0))), BoundBy::Actor, [3.0, 1.0, 1.0]);
        check(judge(5.0, 4.0, Some(&collected(6.0, 0.0, 2.0, 0.0))), BoundBy::Learner, [3.0, 5.0, 1.0]);
        check(judge(1.0, 4.0, Some(&collected(1.0, 0.0, 3.0, 0.0))), BoundBy::Network, [1.0, 1.0, 3.0]);
    }

    #[test]
    fn waiting_for_weights_is_the_network_and_a_lack_of_actors_is_the_actors() {
        check(judge(0.5, 4.0, Some(&collected(4.0, 3.0, 0.0, 0.0))), BoundBy::Network, [1.0, 0.5, 3.0]);
        check(judge(0.5, 4.0, Some(&collected(0.5, 0.0, 0.5, 3.0))), BoundBy::Actor, [3.5, 0.5, 0.5]);
    }

    #[test]
    fn without_a_network_there_is_none_and_nothing_at_all_is_no_nan() {
        check(judge(1.0, 2.0, None), BoundBy::Actor, [2.0, 1.0, 0.0]);
        check(judge(3.0, 2.0, None), BoundBy::Learner, [2.0, 3.0, 0.0]);
        check(judge(0.0, 0.0, Some(&Collected::default())), BoundBy::Actor, [0.0; 3]);
        // An actor whose clock says nonsense.
        check(judge(0.0, 1.0, Some(&collected(0.0, 9.0, 1.0, 7.0))), BoundBy::Actor, [1.0, 0.0, 0.0]);
    }
}
