//! Writes a plan as a response.

use crate::UNASSIGNED;
use crate::costs::{Obstacle, PairTerms};
use crate::engine::Plan;
use crate::problem::Problem;
use magex_assign::compensated_sum;
use magex_proto::v1;

/// A plan and its origin.
#[derive(Debug, Clone, PartialEq)]
pub struct Planned {
    /// The plan.
    pub plan: Plan,
    /// Why another method than the requested one answered; empty otherwise.
    pub fallback_reason: String,
    /// Weights that answered: version, SHA-256, run.
    pub weights: Option<(u32, String, String)>,
}

impl Planned {
    /// Writes the response. The caller adds the time.
    pub fn respond(self, problem: &Problem) -> v1::AssignResponse {
        let fallback_reason = self.fallback_reason;
        let (version, sha256, run_id) = self.weights.unwrap_or_default();
        v1::AssignResponse { fallback_reason, version, sha256, run_id, ..write(problem, &self.plan) }
    }
}

/// Writes the response without the weights and the reason of a fallback.
pub fn write(problem: &Problem, plan: &Plan) -> v1::AssignResponse {
    let (n, g) = (problem.agent_count, problem.goal_count);
    let mut response = v1::AssignResponse {
        pairs: Vec::with_capacity(n.min(g)),
        cost: plan.cost,
        exact_cost: plan.exact_cost,
        gap: gap(plan.cost, plan.exact_cost),
        scheduler: v1::AssignmentMethod::from(plan.scheduler).into(),
        unserved_cost: plan.unserved_cost,
        ..Default::default()
    };
    let timed = problem.terms.timed();
    // Without words of their own, costs are distances.
    let plain = problem.terms.plain() && problem.matrix.is_none() && problem.overrides.is_empty();
    let mut free = vec![true; g];
    let mut largest: Option<f64> = None;
    for (agent, &goal) in plan.goal_of.iter().enumerate() {
        if goal == UNASSIGNED {
            response.unassigned_agents.push(agent as u32);
            continue;
        }
        free[goal as usize] = false;
        let PairTerms { cost, arrival } = plan.pairs[agent];
        largest = Some(largest.map_or(cost, |top| top.max(cost)));
        let distance = if plain { cost } else { problem.distance(agent, goal as usize) };
        let arrival = timed.then_some(arrival);
        response.last_arrival = response.last_arrival.map_or(arrival, |last| arrival.map(|arrival| arrival.max(last)));
        response.pairs.push(v1::Pair {
            agent_index: agent as u32,
            goal_index: goal,
            agent_id: name(&problem.agent_ids, agent),
            goal_id: name(&problem.goal_ids, goal as usize),
            distance,
            probability: plan.probabilities.as_ref().and_then(|p| p.get(agent).copied().flatten()),
            cost,
            arrival,
        });
    }
    response.largest_cost = largest.unwrap_or(0.0);
    response.distance =
        if plain { plan.cost } else { compensated_sum(response.pairs.iter().map(|pair| pair.distance)) };
    response.unassigned_goals.extend((0..g as u32).filter(|&goal| free[goal as usize]));
    let [agents, goals] = &plan.obstacles;
    let places = problem.place_count();
    response.agents_without_goal = reasons(&response.unassigned_agents, &problem.agent_ids, agents, n > places);
    response.goals_without_agent = reasons(&response.unassigned_goals, &problem.goal_ids, goals, places > n);
    let left = |(now, then): (&u32, &u32)| *then != UNASSIGNED && now != then;
    response.switches = plan.goal_of.iter().zip(&problem.current).filter(|pair| left(*pair)).count() as u32;
    response
}

/// cost / exact − 1; `None` where it is undefined.
fn gap(cost: f64, exact: Option<f64>) -> Option<f64> {
    let exact = exact?;
    if exact > 0.0 {
        // The sums are rounded in different orders.
        return Some((cost / exact - 1.0).max(0.0));
    }
    (cost <= exact).then_some(0.0)
}

fn name(ids: &[String], index: usize) -> String {
    ids.get(index).cloned().unwrap_or_default()
}

fn reasons(left: &[u32], ids: &[String], obstacles: &[Option<Obstacle>], outnumbered: bool) -> Vec<v1::Unassigned> {
    let reason = |index: &u32| match obstacles.get(*index as usize).copied().flatten() {
        Some(Obstacle::Forbidden) => v1::UnassignedReason::Forbidden,
        Some(Obstacle::Late) => v1::UnassignedReason::TooLate,
        Some(Obstacle::NotOpen) => v1::UnassignedReason::NotOpen,
        None if outnumbered => v1::UnassignedReason::Outnumbered,
        None => v1::UnassignedReason::Conflict,
    };
    left.iter()
        .map(|index| v1::Unassigned { index: *index, id: name(ids, *index as usize), reason: reason(index).into() })
        .collect()
}
