//! The active members of a mission as a problem, and what their pairs cost now.

use super::{Mission, MissionLimits};
use crate::UNASSIGNED;
use crate::problem::Problem;
use crate::terms::{Terms, check_capacities};
use magex_assign::{distance, powered};
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use std::collections::HashMap;

/// The active members, with their places in the mission.
pub(super) struct Team {
    pub(super) problem: Problem,
    pub(super) agents: Vec<usize>,
    pub(super) goals: Vec<usize>,
}

impl Team {
    /// The team of a mission; `None` if a side is empty.
    pub(super) fn of(mission: &Mission, limits: &MissionLimits) -> Result<Option<Self>, ConvertError> {
        let a = &mission.assignment;
        let active = |members: &[v1::Member]| -> Vec<usize> {
            (0..members.len()).filter(|&k| members[k].state() == v1::MemberState::Active).collect()
        };
        let (agents, goals) = (active(&a.agents), active(&a.goals));
        if agents.is_empty() || goals.is_empty() {
            return Ok(None);
        }
        let terms = terms(a, &agents, &goals);
        let path = |col: usize| format!("goals[{}].capacity", a.goals[goals[col]].id);
        check_capacities(&terms.capacities, agents.len(), limits.members, path)?;
        let rows: HashMap<&str, u32> = (0u32..).zip(&agents).map(|(row, &k)| (a.agents[k].id.as_str(), row)).collect();
        let cols: HashMap<&str, u32> = (0u32..).zip(&goals).map(|(col, &k)| (a.goals[k].id.as_str(), col)).collect();
        let find = |agent: &str, goal: &str| Some((*rows.get(agent)?, *cols.get(goal)?));
        let mut current = vec![UNASSIGNED; agents.len()];
        let mut free: Vec<u32> = (0..goals.len()).map(|col| terms.capacity(col)).collect();
        for (row, col) in a.pairs.iter().filter_map(|pair| find(&pair.agent_id, &pair.goal_id)) {
            // The goal may take fewer agents now.
            if free[col as usize] > 0 {
                free[col as usize] -= 1;
                current[row as usize] = col;
            }
        }
        let priced = mission.overrides.iter().filter_map(|((agent, goal), &cost)| {
            let (row, col) = find(agent, goal)?;
            Some((row, col, cost))
        });
        let mut problem = Problem {
            agent_count: agents.len(),
            goal_count: goals.len(),
            overrides: priced.collect(),
            forbidden: mission.forbidden.iter().filter_map(|(agent, goal)| find(agent, goal)).collect(),
            terms: Terms {
                pinned: mission.pinned.iter().filter_map(|(agent, goal)| find(agent, goal)).collect(),
                ..terms
            },
            current,
            switching_cost: a.switching_cost,
            scheduler: a.scheduler().into(),
            seed: a.revision,
            ..Problem::default()
        };
        let points = |members: &[v1::Member], places: &[usize]| -> Vec<f64> {
            places.iter().flat_map(|&k| members[k].position.iter().copied()).collect()
        };
        let everywhere =
            |members: &[v1::Member], places: &[usize]| places.iter().all(|&k| !members[k].position.is_empty());
        if everywhere(&a.agents, &agents) && everywhere(&a.goals, &goals) {
            problem.dims = a.agents[agents[0]].position.len();
            problem.agents = points(&a.agents, &agents);
            problem.goals = points(&a.goals, &goals);
        } else {
            let cost = |(row, col): (&usize, &usize)| apart(&a.agents[*row], &a.goals[*col]).unwrap_or(f64::INFINITY);
            let cells = agents.iter().flat_map(|row| goals.iter().map(move |col| (row, col)));
            problem.matrix = Some(cells.map(cost).collect());
        }
        problem.check_power()?;
        Ok(Some(Self { problem, agents, goals }))
    }

    /// What pairs of a mission cost now.
    pub(super) fn costs<'a>(&'a self, mission: &'a Mission) -> Costs<'a> {
        let a = &mission.assignment;
        let index = |members: &'a [v1::Member], places: &[usize]| -> HashMap<&'a str, usize> {
            places.iter().enumerate().map(|(row, &k)| (members[k].id.as_str(), row)).collect()
        };
        Costs { team: self, mission, rows: index(&a.agents, &self.agents), cols: index(&a.goals, &self.goals) }
    }
}

/// Distance of two members; `None` if one has no position.
fn apart(agent: &v1::Member, goal: &v1::Member) -> Option<f64> {
    (!agent.position.is_empty() && !goal.position.is_empty()).then(|| distance(&agent.position, &goal.position))
}

/// The terms of the active members, at the mission's time.
fn terms(a: &v1::Assignment, agents: &[usize], goals: &[usize]) -> Terms {
    /// A list of all values, or none if no member has one.
    fn each<T: Copy>(values: impl Iterator<Item = Option<T>> + Clone, neutral: T) -> Vec<T> {
        if values.clone().all(|value| value.is_none()) {
            Vec::new()
        } else {
            values.map(|v| v.unwrap_or(neutral)).collect()
        }
    }
    let agents = agents.iter().map(|&k| &a.agents[k]);
    let goals = goals.iter().map(|&k| &a.goals[k]);
    let offset = |agent: &v1::Member| {
        let busy = agent.busy_until.map_or(0.0, |until| (until - a.time).max(0.0));
        let loaded = a.balance * agent.load.unwrap_or(0.0);
        (busy > 0.0 || loaded > 0.0).then_some(busy + loaded)
    };
    let waits: HashMap<&str, bool> =
        a.goals.iter().map(|goal| (goal.id.as_str(), goal.state() != v1::MemberState::Finished)).collect();
    let closed = |goal: &v1::Member| {
        let mut first = goal.after.iter().flat_map(|names| &names.goal_ids);
        first.any(|id| waits.get(id.as_str()).copied().unwrap_or(false)).then_some(true)
    };
    Terms {
        power: a.power,
        speeds: each(agents.clone().map(|agent| agent.speed), 1.0),
        offsets: each(agents.map(offset), 0.0),
        weights: each(goals.clone().map(|goal| goal.weight), 1.0),
        capacities: each(goals.clone().map(|goal| goal.capacity), 1),
        earliest: each(goals.clone().map(|goal| goal.earliest.map(|at| (at - a.time).max(0.0))), 0.0),
        due: each(goals.clone().map(|goal| goal.due.map(|at| at - a.time)), f64::INFINITY),
        closed: each(goals.map(closed), false),
        pinned: Vec::new(),
    }
}

/// Costs of pairs by name.
pub(super) struct Costs<'a> {
    team: &'a Team,
    mission: &'a Mission,
    rows: HashMap<&'a str, usize>,
    cols: HashMap<&'a str, usize>,
}

impl Costs<'_> {
    /// Row, column and what stands for the distance; `None` if the pair is forbidden or a member does not take part.
    fn base(&self, agent: &str, goal: &str) -> Option<(usize, usize, f64)> {
        let (row, col) = (*self.rows.get(agent)?, *self.cols.get(goal)?);
        let names = (agent.to_owned(), goal.to_owned());
        if self.mission.forbidden.contains(&names) {
            return None;
        }
        let a = &self.mission.assignment;
        let given = self.mission.overrides.get(&names).copied();
        let base = given.or_else(|| apart(&a.agents[self.team.agents[row]], &a.goals[self.team.goals[col]]))?;
        (base < f64::INFINITY).then_some((row, col, base))
    }

    /// Present cost; `None` if the pair is impossible.
    pub(super) fn of(&self, agent: &str, goal: &str) -> Option<f64> {
        let (row, col, base) = self.base(agent, goal)?;
        let terms = &self.team.problem.terms;
        let visit = terms.visit(row, col, base);
        (!visit.late && terms.open(col)).then(|| terms.weight(col) * powered(visit.time, terms.power))
    }

    /// Whether the goal waits for another one.
    pub(super) fn closed(&self, goal: &str) -> bool {
        self.cols.get(goal).is_some_and(|&col| !self.team.problem.terms.open(col))
    }

    /// Whether the agent comes after the goal's due time.
    pub(super) fn late(&self, agent: &str, goal: &str) -> bool {
        self.base(agent, goal).is_some_and(|(row, col, base)| self.team.problem.terms.visit(row, col, base).late)
    }

    /// What the places cost that are free beside `goals`, if those beside `planned` cost `unserved`.
    pub(super) fn unserved<'g>(
        &self,
        goals: impl Iterator<Item = &'g &'g str>,
        unserved: f64,
        planned: impl Iterator<Item = &'g &'g str>,
    ) -> f64 {
        if unserved == 0.0 {
            return 0.0;
        }
        let problem = &self.team.problem;
        let terms = &problem.terms;
        let places = |goal: usize| f64::from(terms.capacity(goal).min(problem.agent_count as u32));
        let all: f64 = (0..problem.goal_count).map(|goal| places(goal) * terms.weight(goal)).sum();
        let weight = |goal: &&str| self.cols.get(*goal).map_or(0.0, |&col| terms.weight(col));
        let free = all - planned.map(weight).sum::<f64>();
        unserved * (all - goals.map(weight).sum::<f64>()) / free
    }
}
