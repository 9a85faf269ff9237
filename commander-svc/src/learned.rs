//! Answers for the teams of one shard: a pure function of the request and the weights.

use magex_assign::exact_points;
use magex_core::keys::episode_keys;
use magex_nets::commander::{Commander, CommanderError, Team};
use magex_proto::goals::{GoalReply, GoalRequest};

/// Assigns the goals of every episode of a shard. What is random is keyed by (seed, shard, episode).
pub fn answer(commander: &Commander, request: &GoalRequest) -> Result<GoalReply, CommanderError> {
    let (n, g, d) = (request.agent_count, request.goal_count, request.dims);
    let b = request.shard.episodes as usize;
    if n == 0 || d == 0 || request.agents.len() != b * n * d || request.goals.len() != b * g * d {
        return Err(CommanderError::Instance(format!(
            "agents, goals: {} and {} numbers do not make {b} teams of {n} agents and {g} goals in {d} dimensions",
            request.agents.len(),
            request.goals.len()
        )));
    }
    let mut reply = GoalReply {
        goals: Vec::with_capacity(b * n),
        log_probs: Vec::with_capacity(b),
        costs: Vec::with_capacity(b),
        exact_costs: Vec::with_capacity(b),
    };
    for e in 0..b {
        let team = Team {
            agents: &request.agents[e * n * d..(e + 1) * n * d],
            goals: &request.goals[e * g * d..(e + 1) * g * d],
            dims: d,
        };
        let mut stream = episode_keys(request.seed, &request.shard, e as u32).commander.stream();
        let decision = commander.assign(&team, request.shard.mode, &mut stream)?;
        reply.costs.push(cost(&team, &decision.goals) as f32);
        reply.exact_costs.push(exact_points(team.agents, team.goals, d)?.1 as f32);
        reply.log_probs.push(decision.log_prob);
        reply.goals.extend(decision.goals);
    }
    Ok(reply)
}

/// Summed distance of an assignment in double precision; agents without a goal cost nothing.
pub fn cost(team: &Team<'_>, goals: &[u32]) -> f64 {
    let d = team.dims;
    let mut total = 0.0;
    for (agent, goal) in team.agents.chunks_exact(d).zip(goals) {
        if let Some(goal) = team.goals.chunks_exact(d).nth(*goal as usize) {
            total += agent.iter().zip(goal).map(|(a, g)| (f64::from(*a) - f64::from(*g)).powi(2)).sum::<f64>().sqrt();
        }
    }
    total
}
