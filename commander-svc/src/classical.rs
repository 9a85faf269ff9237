//! The schedulers that need no training, for the episodes of a shard.

use crate::scheduler::{AssignError, GoalReply, GoalRequest, SchedulerKind};
use magex_assign::{Solver, bottleneck, cost_of, distances, greedy, random::random};
use magex_core::keys::episode_keys;
use magex_core::rng::Stream;

impl From<magex_assign::AssignError> for AssignError {
    fn from(error: magex_assign::AssignError) -> Self {
        let text = error.to_string();
        match text.split_once(": ") {
            Some((field, problem)) => Self::invalid(field, problem),
            None => Self::Failed(text),
        }
    }
}

/// A matching and what it costs.
#[derive(Debug, Clone, PartialEq)]
struct Answer {
    goals: Vec<u32>,
    cost: f64,
    exact_cost: f64,
}

/// Answers for one team with distances `[rows, cols]`. Learned counts as exact: it is what stands in for it.
fn answer(
    kind: SchedulerKind,
    solver: &mut Solver,
    costs: &[f64],
    (rows, cols): (usize, usize),
    stream: &mut Stream,
) -> Result<Answer, AssignError> {
    let exact = solver.solve(costs, rows, cols)?;
    let exact_cost = exact.cost;
    let goals = match kind {
        SchedulerKind::Exact | SchedulerKind::Learned => exact.col_of_row,
        SchedulerKind::Makespan => bottleneck(costs, rows, cols)?.assignment.col_of_row,
        SchedulerKind::Greedy => greedy(costs, rows, cols)?.col_of_row,
        SchedulerKind::Random => random(rows, cols, stream)?,
    };
    let cost = cost_of(costs, cols, &goals);
    Ok(Answer { goals, cost, exact_cost })
}

/// Goals for the episodes of a shard.
pub(crate) fn assign_batch(request: &GoalRequest, go_on: &dyn Fn() -> bool) -> Result<GoalReply, AssignError> {
    let (n, g, d, k) = (request.agent_count, request.goal_count, request.dims, request.stages);
    if g < n {
        return Err(AssignError::invalid("goals", format!("{g} goals are not enough for {n} agents")));
    }
    if n == 0 || d == 0 || k == 0 {
        return Err(AssignError::invalid("agents", format!("{k} stages of {n} agents in {d} dimensions make no team")));
    }
    let mut solver = Solver::default();
    let mut reply = GoalReply { goals: Vec::new(), log_probs: Vec::new(), costs: Vec::new(), exact_costs: Vec::new() };
    let teams = request.agents.chunks_exact(n * d).zip(request.goals.chunks_exact(g * d));
    let mut stream = episode_keys(request.seed, &request.shard, 0).commander.stream();
    for (index, (agents, goals)) in teams.enumerate() {
        if !go_on() {
            return Err(AssignError::Interrupted);
        }
        if index % k == 0 {
            stream = episode_keys(request.seed, &request.shard, (index / k) as u32).commander.stream();
        }
        let costs = distances(agents, goals, d)?;
        let answer = answer(request.scheduler, &mut solver, &costs, (n, g), &mut stream)?;
        reply.goals.extend(answer.goals);
        reply.log_probs.push(0.0);
        reply.costs.push(answer.cost as f32);
        reply.exact_costs.push(answer.exact_cost as f32);
    }
    Ok(reply)
}
