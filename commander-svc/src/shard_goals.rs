//! The goals of one shard: a pure function of the request and the weights.

use magex_assign::random::random;
use magex_assign::{GoOn, cost_of_points, exact_points};
use magex_core::keys::{episode_keys, random_goals};
use magex_nets::commander::{Commander, CommanderError, Team};
use magex_proto::goals::{GoalReply, GoalRequest};

/// Assigns the goals of every stage of every episode of a shard. Random choices are keyed by (seed, shard, episode).
/// `random_assignment_fraction` of the training episodes get a random matching, whatever the scheduler.
/// `go_on` is called before every team.
pub fn answer(
    commander: &Commander,
    random_assignment_fraction: f32,
    request: &GoalRequest,
    go_on: GoOn<'_>,
) -> Result<GoalReply, CommanderError> {
    let (n, g, d, k) = (request.agent_count, request.goal_count, request.dims, request.stages);
    let b = request.shard.episodes as usize;
    if n == 0 || d == 0 || k == 0 || request.agents.len() != b * k * n * d || request.goals.len() != b * k * g * d {
        return Err(CommanderError::Instance(format!(
            "agents, goals: {} and {} numbers do not make {b} times {k} teams of {n} agents and {g} goals in {d} dimensions",
            request.agents.len(),
            request.goals.len()
        )));
    }
    let mut reply = GoalReply {
        goals: Vec::with_capacity(b * k * n),
        log_probs: Vec::with_capacity(b * k),
        costs: Vec::with_capacity(b * k),
        exact_costs: Vec::with_capacity(b * k),
    };
    for e in 0..b {
        let mut stream = episode_keys(request.seed, &request.shard, e as u32).commander.stream();
        let mut shuffled = random_goals(request.seed, &request.shard, e as u32, random_assignment_fraction);
        for stage in e * k..(e + 1) * k {
            if !go_on() {
                return Err(CommanderError::Interrupted);
            }
            let team = Team {
                agents: &request.agents[stage * n * d..(stage + 1) * n * d],
                goals: &request.goals[stage * g * d..(stage + 1) * g * d],
                dims: d,
            };
            let (goals, log_prob) = match &mut shuffled {
                Some(stream) => (random(n, g, stream)?, 0.0),
                None => {
                    let decision = commander.assign(&team, request.shard.mode, &mut stream)?;
                    (decision.goals, decision.log_prob)
                }
            };
            reply.costs.push(cost_of_points(team.agents, team.goals, d, &goals) as f32);
            reply.exact_costs.push(exact_points(team.agents, team.goals, d)?.1 as f32);
            reply.log_probs.push(log_prob);
            reply.goals.extend(goals);
        }
    }
    Ok(reply)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use magex_core::config::CommanderPolicy;
    use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};

    #[test]
    fn a_shard_without_agents_dimensions_or_stages_is_rejected() {
        let shard = Shard {
            kind: ShardKind::Train,
            iteration: Iteration(0),
            index: 0,
            episodes: 1,
            first_episode: 0,
            version: WeightsVersion(0),
            mode: Mode::Greedy,
            eval_set: 0,
            record: false,
        };
        let (agents, goals) = (vec![0.0, 0.0], vec![1.0, 0.0]);
        let (stages, agent_count, goal_count, dims) = (1, 1, 1, 2);
        let good = GoalRequest { shard, seed: 1, stages, agent_count, goal_count, dims, agents, goals };
        let commander = Commander::classical(CommanderPolicy::Exact).unwrap();
        assert_eq!(answer(&commander, 0.0, &good, &|| true).unwrap().goals, [0]);
        assert!(matches!(answer(&commander, 0.0, &good, &|| false), Err(CommanderError::Interrupted)));
        let empty = GoalRequest { agents: Vec::new(), goals: Vec::new(), ..good };
        for request in [
            GoalRequest { stages: 0, ..empty.clone() },
            GoalRequest { agent_count: 0, goal_count: 0, ..empty.clone() },
            GoalRequest { dims: 0, ..empty },
        ] {
            let refused = answer(&commander, 0.0, &request, &|| true);
            assert!(matches!(refused, Err(CommanderError::Instance(_))), "{refused:?}");
        }
    }
}
