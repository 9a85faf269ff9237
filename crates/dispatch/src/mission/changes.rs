//! Why goals changed: the reason, the gain, and a sentence.

use super::team::Team;
use super::{Mission, Taken};
use magex_proto::v1;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// An agent whose goal changed, and what the team gains.
struct Exchange<'a> {
    agent: &'a str,
    from: Option<&'a str>,
    to: Option<&'a str>,
    saving: Option<f64>,
    /// Agents of the team that leave a goal which they could have kept, or that another agent got.
    switches: u32,
    switching_cost: f64,
}

impl Exchange<'_> {
    fn sentence(&self, reason: v1::ChangeReason) -> String {
        let Self { agent, from, to, saving, switches, switching_cost } = *self;
        let (from, then) =
            (from.unwrap_or_default(), to.map_or_else(|| "it has no goal now".into(), |to| format!("it gets {to}")));
        match reason {
            v1::ChangeReason::Assigned => format!("{agent} had no goal and gets {}", to.unwrap_or_default()),
            v1::ChangeReason::Switched => {
                let to = to.unwrap_or_default();
                // An agent that leaves at the same time for another reason pays nothing, but is not told apart here.
                match saving.filter(|saving| *saving > switching_cost * f64::from(switches)) {
                    Some(saving) => format!(
                        "{agent} switches from {from} to {to}: the costs of the team fall by {saving:.4}, more than {switches} x \
                     the switching cost of {switching_cost}"
                    ),
                    None => format!(
                        "{agent} switches from {from} to {to}: with other changes of the team that is worth more than the \
                     switching cost of {switching_cost}"
                    ),
                }
            }
            v1::ChangeReason::AgentFailed => format!("{agent} failed and loses {from}"),
            v1::ChangeReason::AgentFinished => format!("{agent} finished and loses {from}"),
            v1::ChangeReason::AgentRemoved => format!("{agent} was removed and loses {from}"),
            v1::ChangeReason::GoalFailed => format!("{from}, the goal of {agent}, failed; {then}"),
            v1::ChangeReason::GoalFinished => format!("{from}, the goal of {agent}, is finished; {then}"),
            v1::ChangeReason::GoalRemoved => format!("{from}, the goal of {agent}, was removed; {then}"),
            v1::ChangeReason::PairForbidden => format!("the pair of {agent} and {from} is forbidden now; {then}"),
            v1::ChangeReason::Displaced => {
                format!("another agent gets {from}, the goal of {agent}, at a lower cost of the team; {then}")
            }
            v1::ChangeReason::Forfeited => format!("{agent} gives {from} back; {then}"),
            v1::ChangeReason::Pinned => {
                format!("{agent} leaves {from}, because a pair with one of the two is pinned; {then}")
            }
            v1::ChangeReason::TooLate => format!("{agent} can no longer be at {from} in time; {then}"),
            v1::ChangeReason::NotOpen => format!("{from}, the goal of {agent}, waits for another goal; {then}"),
            v1::ChangeReason::Unspecified => String::new(),
        }
    }
}

impl Mission {
    /// Fills in the changes against `before`, with their reasons.
    pub(super) fn explain(&mut self, before: &[v1::Pair], taken: &Taken, team: Option<&Team>, switches: u32) {
        let a = &self.assignment;
        let (agents, goals) = (by_id(&a.agents), by_id(&a.goals));
        let costs = team.map(|team| team.costs(self));
        let cost = |agent: &str, goal: &str| costs.as_ref()?.of(agent, goal);
        let old: BTreeMap<&str, &str> = before.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect();
        let new: BTreeMap<&str, &str> = a.pairs.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect();
        let kept: Option<f64> = old.iter().map(|(agent, goal)| cost(agent, goal)).sum();
        let same_size = old.len() == new.len() && !old.is_empty();
        let left_over = |goals: &BTreeMap<&str, &str>| {
            costs.as_ref().map_or(0.0, |costs| costs.unserved(goals.values(), a.unserved_cost, new.values()))
        };
        let saving = kept.filter(|_| same_size).map(|kept| kept + left_over(&old) - a.cost);
        let all: BTreeSet<&str> = old.keys().chain(new.keys()).copied().collect();
        let mut changes = Vec::new();
        for agent in all {
            let (from, to) = (old.get(agent).copied(), new.get(agent).copied());
            if from == to {
                continue;
            }
            let state = |members: &HashMap<&str, &v1::Member>, id: &str| members.get(id).map(|member| member.state());
            let pinned = |goal: &str| self.pinned.iter().any(|(a, g)| (a == agent) != (g == goal));
            let reason = match (from, state(&agents, agent)) {
                (None, _) => v1::ChangeReason::Assigned,
                (_, None) => v1::ChangeReason::AgentRemoved,
                _ if taken.agents.contains(agent) => v1::ChangeReason::AgentRemoved,
                (_, Some(v1::MemberState::Failed)) => v1::ChangeReason::AgentFailed,
                (_, Some(v1::MemberState::Finished)) => v1::ChangeReason::AgentFinished,
                (Some(goal), _) => match state(&goals, goal) {
                    None => v1::ChangeReason::GoalRemoved,
                    _ if taken.goals.contains(goal) => v1::ChangeReason::GoalRemoved,
                    Some(v1::MemberState::Failed) => v1::ChangeReason::GoalFailed,
                    Some(v1::MemberState::Finished) => v1::ChangeReason::GoalFinished,
                    _ if taken.forfeits.contains(agent) => v1::ChangeReason::Forfeited,
                    _ if self.forbidden.contains(&(agent.to_owned(), goal.to_owned())) => {
                        v1::ChangeReason::PairForbidden
                    }
                    _ if costs.as_ref().is_some_and(|costs| costs.closed(goal)) => v1::ChangeReason::NotOpen,
                    _ if costs.as_ref().is_some_and(|costs| costs.late(agent, goal)) => v1::ChangeReason::TooLate,
                    _ if pinned(goal) => v1::ChangeReason::Pinned,
                    _ if to.is_none() => v1::ChangeReason::Displaced,
                    _ => v1::ChangeReason::Switched,
                },
            };
            let gain = from.zip(to).and_then(|(from, to)| Some(cost(agent, from)? - cost(agent, to)?));
            let exchange = Exchange { agent, from, to, saving, switches, switching_cost: a.switching_cost };
            changes.push(v1::Change {
                agent_id: agent.to_owned(),
                from_goal_id: from.unwrap_or_default().to_owned(),
                to_goal_id: to.unwrap_or_default().to_owned(),
                reason: reason.into(),
                gain,
                explanation: exchange.sentence(reason),
            });
        }
        (self.assignment.changes, self.assignment.saving) = (changes, saving);
    }
}

fn by_id(members: &[v1::Member]) -> HashMap<&str, &v1::Member> {
    members.iter().map(|member| (member.id.as_str(), member)).collect()
}
