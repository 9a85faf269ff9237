//! An episode of a training run as a read-only mission.

use crate::engine::pairs;
use crate::mission::TRAINING_PREFIX;
use magex_assign::distance;
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;

/// An episode and its assignment.
#[derive(Debug, Clone, Copy)]
pub struct Episode<'a> {
    /// Its run.
    pub run_id: &'a str,
    /// `train-<iteration>` or `eval-<set>`.
    pub part: &'a str,
    /// Index of the episode.
    pub index: u32,
    /// D.
    pub dims: usize,
    /// `[N, D]` world units.
    pub agents: &'a [f32],
    /// `[G, D]` world units.
    pub goals: &'a [f32],
    /// `[N]` goal of each agent.
    pub goal_of: &'a [u32],
    /// Method that answered.
    pub scheduler: AssignmentMethod,
    /// Weights that answered.
    pub version: u32,
    /// Their SHA-256.
    pub sha256: &'a str,
    /// Summed distance of the answer.
    pub cost: f64,
    /// Smallest possible summed distance.
    pub exact_cost: f64,
    /// When it was answered, milliseconds since 1970.
    pub at_ms: i64,
    /// Until when it is shown, milliseconds since 1970.
    pub expires_ms: i64,
}

impl Episode<'_> {
    /// Name of the mission.
    pub fn mission_id(&self) -> String {
        format!("{TRAINING_PREFIX}{}.{}.{}", self.run_id, self.part, self.index)
    }

    /// As clients see it.
    pub fn assignment(&self) -> v1::Assignment {
        let member = |side: &str| {
            let side = side.to_owned();
            move |(k, position): (usize, &[f32])| v1::Member {
                id: format!("{side}-{k}"),
                position: position.to_vec(),
                state: v1::MemberState::Active.into(),
            }
        };
        let d = self.dims.max(1);
        let members = |points: &[f32], side: &str| -> Vec<v1::Member> {
            points.chunks_exact(d).enumerate().map(member(side)).collect()
        };
        let (agents, goals) = (members(self.agents, "agent"), members(self.goals, "goal"));
        let possible = pairs(self.goal_of).filter(|&(agent, goal)| agent < agents.len() && goal < goals.len());
        let pairs: Vec<v1::Pair> = possible
            .map(|(agent, goal)| {
                let distance = distance(&agents[agent].position, &goals[goal].position);
                v1::Pair {
                    agent_index: agent as u32,
                    goal_index: goal as u32,
                    agent_id: agents[agent].id.clone(),
                    goal_id: goals[goal].id.clone(),
                    distance,
                    probability: None,
                    cost: distance,
                }
            })
            .collect();
        let left = |members: &[v1::Member], paired: Vec<u32>| -> Vec<v1::Unassigned> {
            let free = members.iter().enumerate().filter(|(k, _)| !paired.contains(&(*k as u32)));
            let reason = v1::UnassignedReason::Outnumbered.into();
            free.map(|(k, m)| v1::Unassigned { index: k as u32, id: m.id.clone(), reason }).collect()
        };
        let scheduler = v1::AssignmentMethod::from(self.scheduler).into();
        v1::Assignment {
            mission_id: self.mission_id(),
            title: format!("{} episode {} of run {}", self.part, self.index, self.run_id),
            source: v1::MissionSource::Training.into(),
            revision: 1,
            agents_without_goal: left(&agents, pairs.iter().map(|p| p.agent_index).collect()),
            goals_without_agent: left(&goals, pairs.iter().map(|p| p.goal_index).collect()),
            largest_cost: pairs.iter().map(|p| p.cost).fold(0.0, f64::max),
            agents,
            goals,
            pairs,
            cost: self.cost,
            exact_cost: Some(self.exact_cost),
            gap: crate::answer::gap(self.cost, Some(self.exact_cost)),
            scheduler,
            answered_by: scheduler,
            version: self.version,
            sha256: self.sha256.to_owned(),
            run_id: self.run_id.to_owned(),
            created_ms: self.at_ms,
            updated_ms: self.at_ms,
            expires_ms: self.expires_ms,
            ..Default::default()
        }
    }
}
