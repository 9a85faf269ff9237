//! What an update changes about the members and pairs of a mission, before it is planned.

use super::members::{Side, forget, merge, most_pairs};
use super::{Mission, MissionLimits, Names, Taken, pair};
use crate::AssignError;
use crate::terms::{DURATIONS, ROUTING};
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use std::collections::{HashMap, HashSet};

impl Mission {
    /// Forgets members that finished long ago, as if they had been removed.
    pub(super) fn forget(&mut self) {
        let (agents, goals) = (forget(&mut self.assignment.agents), forget(&mut self.assignment.goals));
        self.forget_pairs(&agents, &goals);
    }

    /// Drops what is said about members that are no longer there.
    pub(super) fn forget_pairs(&mut self, agents: &HashSet<String>, goals: &HashSet<String>) {
        if agents.is_empty() && goals.is_empty() {
            return;
        }
        let stays = |(agent, goal): &Names| !agents.contains(agent) && !goals.contains(goal);
        self.forbidden.retain(stays);
        self.pinned.retain(stays);
        self.overrides.retain(|names, _| stays(names));
        for names in self.assignment.goals.iter_mut().filter_map(|goal| goal.after.as_mut()) {
            names.goal_ids.retain(|id| !goals.contains(id));
        }
    }

    pub(super) fn upsert(
        &mut self,
        agents: Vec<v1::Member>,
        goals: Vec<v1::Member>,
        overrides: &[v1::PairCost],
        limits: &MissionLimits,
    ) -> Result<(), AssignError> {
        let first = |members: &[v1::Member]| members.iter().map(|member| member.position.len()).find(|&len| len > 0);
        let a = &mut self.assignment;
        let dims = first(&a.agents).or(first(&a.goals)).or(first(&agents)).or(first(&goals)).unwrap_or(2);
        let pairs = || overrides.iter().filter_map(|item| item.pair.as_ref());
        let priced: [HashSet<String>; 2] =
            [pairs().map(|pair| pair.agent_id.clone()).collect(), pairs().map(|pair| pair.goal_id.clone()).collect()];
        merge(Side::Agents, &mut a.agents, agents, dims, &priced[0], limits)?;
        merge(Side::Goals, &mut a.goals, goals, dims, &priced[1], limits)?;
        Ok(())
    }

    pub(super) fn remove(&mut self, agents: &[String], goals: &[String]) -> Result<Taken, AssignError> {
        let a = &mut self.assignment;
        for (field, members, ids) in [("remove_agents", &mut a.agents, agents), ("remove_goals", &mut a.goals, goals)] {
            let mut left: HashSet<&str> = members.iter().map(|member| member.id.as_str()).collect();
            if let Some(k) = ids.iter().position(|id| !left.remove(id.as_str())) {
                return Err(AssignError::invalid(format!("{field}[{k}]"), "no member has this name"));
            }
            let ids: HashSet<&str> = ids.iter().map(String::as_str).collect();
            members.retain(|member| !ids.contains(member.id.as_str()));
        }
        let set = |ids: &[String]| ids.iter().cloned().collect::<HashSet<String>>();
        let taken = Taken { agents: set(agents), goals: set(goals), ..Taken::default() };
        self.forget_pairs(&taken.agents, &taken.goals);
        Ok(taken)
    }

    /// Agents whose goal has been finished have done one more.
    pub(super) fn count_loads(&mut self, finished_before: &HashSet<String>) {
        let a = &mut self.assignment;
        let now = finished(&a.goals);
        let done =
            a.pairs.iter().filter(|pair| now.contains(&pair.goal_id) && !finished_before.contains(&pair.goal_id));
        let by: HashSet<&str> = done.map(|pair| pair.agent_id.as_str()).collect();
        for agent in a.agents.iter_mut().filter(|agent| by.contains(agent.id.as_str())) {
            agent.load = Some((agent.load.unwrap_or(0.0) + 1.0).min(*DURATIONS.end()));
        }
    }

    /// Forbids the pairs of agents that give their goals back.
    pub(super) fn forfeit(&mut self, agents: &[String]) -> Result<HashSet<String>, AssignError> {
        let known = |members: &[v1::Member], id: &str| members.iter().any(|member| member.id == id);
        for (k, id) in agents.iter().enumerate() {
            let pair = self.assignment.pairs.iter().find(|pair| pair.agent_id == *id);
            let pair =
                pair.ok_or_else(|| AssignError::invalid(format!("forfeit[{k}]"), "no agent of this name has a goal"))?;
            let names = (pair.agent_id.clone(), pair.goal_id.clone());
            self.pinned.remove(&names);
            if known(&self.assignment.agents, &names.0) && known(&self.assignment.goals, &names.1) {
                self.forbidden.insert(names);
            }
        }
        Ok(agents.iter().cloned().collect())
    }

    /// Pins must not contradict each other, nor forbidden pairs; those of finished members are dropped.
    pub(super) fn check_pins(
        &mut self,
        [forbid, pin]: [&str; 2],
        forbidden: &[Names],
        pins: &[Names],
    ) -> Result<(), ConvertError> {
        let place = |list: &[Names], names: &Names, field: &str| {
            list.iter().position(|own| own == names).map(|k| format!("{field}[{k}]"))
        };
        let field = |names: &Names| {
            place(pins, names, pin).or_else(|| place(forbidden, names, forbid)).unwrap_or_else(|| "pinned".to_owned())
        };
        let capacities: HashMap<&str, u32> =
            self.assignment.goals.iter().map(|goal| (goal.id.as_str(), goal.capacity.unwrap_or(1))).collect();
        let (mut goal_of, mut taken) = (HashMap::new(), HashMap::new());
        for names @ (agent, goal) in &self.pinned {
            let infinite = self.overrides.get(names) == Some(&f64::INFINITY);
            ConvertError::ensure(!self.forbidden.contains(names) && !infinite, || {
                (
                    field(names),
                    format!("the pair of {agent} and {goal} is pinned and forbidden; leave out one of the two"),
                )
            })?;
            if let Some(other) = goal_of.insert(agent, goal) {
                let newer = if pins.contains(names) { names.clone() } else { (agent.clone(), other.clone()) };
                let problem = format!("{agent} is pinned to {other} and to {goal}; {ROUTING}, or unpin the first pair");
                return Err(ConvertError::new(field(&newer), problem));
            }
            let places = taken.entry(goal).or_insert(0u32);
            *places += 1;
            let capacity = capacities.get(goal.as_str()).copied().unwrap_or(1);
            ConvertError::ensure(*places <= capacity, || {
                (field(names), format!("{places} agents are pinned to {goal}, which takes {capacity}"))
            })?;
        }
        let done: [HashSet<String>; 2] = [finished(&self.assignment.agents), finished(&self.assignment.goals)];
        self.pinned.retain(|(agent, goal)| !done[0].contains(agent) && !done[1].contains(goal));
        self.assignment.pinned = self.pinned.iter().map(pair).collect();
        Ok(())
    }

    pub(super) fn check_size(&self, limits: &MissionLimits) -> Result<(), AssignError> {
        let most = most_pairs(limits);
        for (field, count) in [("forbidden", self.forbidden.len()), ("cost_overrides", self.overrides.len())] {
            ConvertError::ensure(count <= most, || (field, format!("{count} pairs exceed the limit of {most}")))?;
        }
        Ok(())
    }
}

/// Names of finished members.
pub(super) fn finished(members: &[v1::Member]) -> HashSet<String> {
    let done = members.iter().filter(|member| member.state() == v1::MemberState::Finished);
    done.map(|member| member.id.clone()).collect()
}
