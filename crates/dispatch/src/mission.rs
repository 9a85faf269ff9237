//! A mission: a persistent team. Its agents and goals are added, move, fail, finish and are removed; every change re-plans the
//! mission and reports each changed assignment with its reason.

mod changes;
mod members;

use crate::answer::Planned;
use crate::clock::Now;
use crate::problem::{Problem, pairs, priced_pairs, switching_cost};
use crate::{AssignError, UNASSIGNED};
use changes::sentence;
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;
use members::{MemberNames, check_id, check_lengths, check_record, lifetime, merge, most_pairs, sticky_scheduler};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

/// Longest title, bytes.
const LONGEST_TITLE: usize = 256;
/// Bytes of a pair without its names.
const PAIR: usize = 24;
/// Prefix of the names of training episodes.
pub const TRAINING_PREFIX: &str = "training.";

/// Limits of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MissionLimits {
    /// Agents, and goals, of a mission.
    pub members: usize,
    /// Lifetime without an update, milliseconds.
    pub lifetime_ms: i64,
}

/// Solves a problem with the available methods.
pub type Planner<'a> = dyn Fn(&Problem) -> Result<Planned, AssignError> + 'a;

/// Names of an agent and of a goal.
type Names = (String, String);

/// Names of the agents and of the goals that an update removed.
type Removed = [Vec<String>; 2];

/// A mission and its current assignment.
#[derive(Debug, Clone, PartialEq)]
pub struct Mission {
    /// The part that clients see.
    pub assignment: v1::Assignment,
    forbidden: BTreeSet<Names>,
    overrides: BTreeMap<Names, f64>,
    lifetime_ms: i64,
    /// When it expires, on the clock of missions.
    deadline_ms: i64,
}

/// The record on disk.
#[derive(Clone, PartialEq, prost::Message)]
struct Record {
    #[prost(message, optional, tag = "1")]
    assignment: Option<v1::Assignment>,
    #[prost(message, repeated, tag = "2")]
    forbidden: Vec<v1::PairRef>,
    #[prost(message, repeated, tag = "3")]
    overrides: Vec<v1::PairCost>,
    #[prost(int64, tag = "4")]
    lifetime_ms: i64,
    #[prost(int64, optional, tag = "5")]
    deadline_ms: Option<i64>,
}

impl Mission {
    /// Its size on the wire, bytes.
    pub fn bytes(&self) -> usize {
        let pairs = self.forbidden.iter().chain(self.overrides.keys());
        magex_proto::encoded_len(&self.assignment)
            + pairs.map(|(agent, goal)| agent.len() + goal.len() + PAIR).sum::<usize>()
    }

    /// Number of agents, and of goals.
    pub fn size(&self) -> (usize, usize) {
        (self.assignment.agents.len(), self.assignment.goals.len())
    }

    /// Creates and plans a mission. `drawn_id` is its name if the request has none.
    /// An error names the first invalid field, or is the planner's.
    pub fn create(
        request: v1::CreateMissionRequest,
        owner: &str,
        drawn_id: &str,
        now: impl Into<Now>,
        limits: &MissionLimits,
        planner: &Planner<'_>,
    ) -> Result<Self, AssignError> {
        let now = now.into();
        let id = if request.mission_id.is_empty() { drawn_id.to_owned() } else { request.mission_id };
        check_id(&id)?;
        ConvertError::ensure(request.title.len() <= LONGEST_TITLE, || {
            ("title", format!("{} bytes exceed the limit of {LONGEST_TITLE}", request.title.len()))
        })?;
        let kind = sticky_scheduler(request.scheduler)?.unwrap_or(AssignmentMethod::Exact);
        let empty = Self {
            assignment: v1::Assignment {
                mission_id: id,
                title: request.title,
                source: v1::MissionSource::Client.into(),
                owner: owner.to_owned(),
                scheduler: v1::AssignmentMethod::from(kind).into(),
                switching_cost: switching_cost(request.switching_cost)?,
                created_ms: now.day_ms,
                ..Default::default()
            },
            forbidden: BTreeSet::new(),
            overrides: BTreeMap::new(),
            lifetime_ms: lifetime(request.lifetime_seconds, limits)?,
            deadline_ms: 0,
        };
        let content = v1::UpdateMissionRequest {
            agents: request.agents,
            goals: request.goals,
            forbid: request.forbidden,
            cost_overrides: request.cost_overrides,
            ..Default::default()
        };
        empty.change("forbidden", content, now, limits, planner)
    }

    /// Computes and plans the next revision. An error names the first invalid field, or is the planner's.
    pub fn update(
        &self,
        request: v1::UpdateMissionRequest,
        now: impl Into<Now>,
        limits: &MissionLimits,
        planner: &Planner<'_>,
    ) -> Result<Self, AssignError> {
        self.clone().change("forbid", request, now.into(), limits, planner)
    }

    /// Applies a request, in which `forbid` is the name of the list of pairs to forbid, and plans.
    fn change(
        mut self,
        forbid: &str,
        request: v1::UpdateMissionRequest,
        now: Now,
        limits: &MissionLimits,
        planner: &Planner<'_>,
    ) -> Result<Self, AssignError> {
        check_lengths(
            limits,
            &[
                ("agents", request.agents.len()),
                ("goals", request.goals.len()),
                ("remove_agents", request.remove_agents.len()),
                ("remove_goals", request.remove_goals.len()),
                (forbid, request.forbid.len()),
                ("allow", request.allow.len()),
                ("cost_overrides", request.cost_overrides.len()),
                ("clear_cost_overrides", request.clear_cost_overrides.len()),
            ],
        )?;
        let removed = [request.remove_agents, request.remove_goals];
        self.remove(&removed)?;
        self.upsert(request.agents, request.goals, limits)?;
        let known = MemberNames::of(&self.assignment);
        let names = |pair: &v1::PairRef| known.names(pair);
        self.forbidden.extend(pairs(forbid, &request.forbid, names)?);
        for allowed in pairs("allow", &request.allow, names)? {
            self.forbidden.remove(&allowed);
        }
        self.overrides.extend(priced_pairs("cost_overrides", &request.cost_overrides, names)?);
        for cleared in pairs("clear_cost_overrides", &request.clear_cost_overrides, names)? {
            self.overrides.remove(&cleared);
        }
        if let Some(cost) = request.switching_cost {
            self.assignment.switching_cost = switching_cost(cost)?;
        }
        if let Some(kind) = sticky_scheduler(request.scheduler)? {
            self.assignment.scheduler = v1::AssignmentMethod::from(kind).into();
        }
        self.check_size(limits)?;
        self.plan(&removed, now, planner)?;
        Ok(self)
    }

    /// Its name.
    pub fn id(&self) -> &str {
        &self.assignment.mission_id
    }

    /// Whether it has expired.
    pub fn expired(&self, now: &Now) -> bool {
        self.deadline_ms <= now.clock_ms
    }

    /// What a client sees now: the time of day at which it will expire follows a clock that was set.
    pub fn shown(&self, now: &Now) -> v1::Assignment {
        v1::Assignment { expires_ms: now.day_of(self.deadline_ms), ..self.assignment.clone() }
    }

    /// Encodes the record on disk.
    pub fn encode(&self) -> Vec<u8> {
        let pair = |(agent, goal): &Names| v1::PairRef {
            agent_id: agent.clone(),
            goal_id: goal.clone(),
            ..Default::default()
        };
        let priced = |(names, &cost): (&Names, &f64)| v1::PairCost { pair: Some(pair(names)), cost };
        let record = Record {
            assignment: Some(self.assignment.clone()),
            forbidden: self.forbidden.iter().map(pair).collect(),
            overrides: self.overrides.iter().map(priced).collect(),
            lifetime_ms: self.lifetime_ms,
            deadline_ms: Some(self.deadline_ms),
        };
        prost::Message::encode_to_vec(&record)
    }

    /// Decodes a record on disk. It must be that of a valid mission.
    pub fn decode(bytes: &[u8]) -> Result<Self, ConvertError> {
        let record: Record =
            prost::Message::decode(bytes).map_err(|error| ConvertError::new("mission", error.to_string()))?;
        let names = |pair: v1::PairRef| (pair.agent_id, pair.goal_id);
        let assignment = record.assignment.ok_or_else(|| ConvertError::missing("mission"))?;
        check_record(&assignment, &record.overrides)?;
        // A record of a version whose lifetimes ran on the time of day.
        let deadline_ms = record.deadline_ms.unwrap_or(assignment.expires_ms);
        let overrides = record.overrides.into_iter();
        Ok(Self {
            assignment,
            forbidden: record.forbidden.into_iter().map(names).collect(),
            overrides: overrides.filter_map(|item| Some((names(item.pair?), item.cost))).collect(),
            lifetime_ms: record.lifetime_ms,
            deadline_ms,
        })
    }

    fn upsert(
        &mut self,
        agents: Vec<v1::Member>,
        goals: Vec<v1::Member>,
        limits: &MissionLimits,
    ) -> Result<(), AssignError> {
        let first = |members: &[v1::Member]| members.iter().map(|member| member.position.len()).find(|&len| len > 0);
        let a = &mut self.assignment;
        let dims = first(&a.agents).or(first(&a.goals)).or(first(&agents)).or(first(&goals)).unwrap_or(2);
        merge("agents", &mut a.agents, agents, dims, limits)?;
        merge("goals", &mut a.goals, goals, dims, limits)?;
        Ok(())
    }

    fn remove(&mut self, [agents, goals]: &Removed) -> Result<(), AssignError> {
        let a = &mut self.assignment;
        for (field, members, ids) in [("remove_agents", &mut a.agents, agents), ("remove_goals", &mut a.goals, goals)] {
            let mut left: HashSet<&str> = members.iter().map(|member| member.id.as_str()).collect();
            if let Some(k) = ids.iter().position(|id| !left.remove(id.as_str())) {
                return Err(AssignError::invalid(format!("{field}[{k}]"), "no member has this name"));
            }
            let ids: HashSet<&str> = ids.iter().map(String::as_str).collect();
            members.retain(|member| !ids.contains(member.id.as_str()));
        }
        let (agents, goals): (HashSet<&String>, HashSet<&String>) = (agents.iter().collect(), goals.iter().collect());
        self.forbidden.retain(|(agent, goal)| !agents.contains(agent) && !goals.contains(goal));
        self.overrides.retain(|(agent, goal), _| !agents.contains(agent) && !goals.contains(goal));
        Ok(())
    }

    fn check_size(&self, limits: &MissionLimits) -> Result<(), AssignError> {
        let most = most_pairs(limits);
        for (field, count) in [("forbidden", self.forbidden.len()), ("cost_overrides", self.overrides.len())] {
            ConvertError::ensure(count <= most, || (field, format!("{count} pairs exceed the limit of {most}")))?;
        }
        Ok(())
    }

    /// The problem of the active members, with their indices as rows and columns; `None` if a side is empty.
    fn problem(&self) -> Option<(Problem, Vec<usize>, Vec<usize>)> {
        let a = &self.assignment;
        let active = |members: &[v1::Member]| -> Vec<usize> {
            (0..members.len()).filter(|&k| members[k].state() == v1::MemberState::Active).collect()
        };
        let (agents, goals) = (active(&a.agents), active(&a.goals));
        if agents.is_empty() || goals.is_empty() {
            return None;
        }
        let points = |members: &[v1::Member], places: &[usize]| -> Vec<f32> {
            places.iter().flat_map(|&k| members[k].position.iter().copied()).collect()
        };
        let rows: HashMap<&str, u32> = (0u32..).zip(&agents).map(|(row, &k)| (a.agents[k].id.as_str(), row)).collect();
        let cols: HashMap<&str, u32> = (0u32..).zip(&goals).map(|(col, &k)| (a.goals[k].id.as_str(), col)).collect();
        let find = |agent: &str, goal: &str| Some((*rows.get(agent)?, *cols.get(goal)?));
        let mut current = vec![UNASSIGNED; agents.len()];
        for (row, col) in a.pairs.iter().filter_map(|pair| find(&pair.agent_id, &pair.goal_id)) {
            current[row as usize] = col;
        }
        let priced = self.overrides.iter().filter_map(|((agent, goal), &cost)| {
            let (row, col) = find(agent, goal)?;
            Some((row, col, cost))
        });
        let dims = a.agents[agents[0]].position.len();
        let problem = Problem {
            overrides: priced.collect(),
            forbidden: self.forbidden.iter().filter_map(|(agent, goal)| find(agent, goal)).collect(),
            current,
            switching_cost: a.switching_cost,
            scheduler: a.scheduler().into(),
            seed: a.revision,
            ..Problem::of_points(points(&a.agents, &agents), points(&a.goals, &goals), dims)
        };
        Some((problem, agents, goals))
    }

    fn plan(&mut self, removed: &Removed, now: Now, planner: &Planner<'_>) -> Result<(), AssignError> {
        let before = self.assignment.pairs.clone();
        let solved = match self.problem() {
            Some((problem, agents, goals)) => Some((planner(&problem)?.respond(&problem), agents, goals)),
            None => None,
        };
        let a = &mut self.assignment;
        a.revision += 1;
        // The order of revisions is seen in their times, whatever the time of day does.
        a.updated_ms = now.day_ms.max(a.updated_ms).max(a.created_ms);
        self.deadline_ms = now.clock_ms.saturating_add(self.lifetime_ms);
        a.expires_ms = now.day_of(self.deadline_ms);
        let mut reasons = None;
        let response = match solved {
            Some((mut response, agents, goals)) => {
                for pair in &mut response.pairs {
                    let (agent, goal) = (agents[pair.agent_index as usize], goals[pair.goal_index as usize]);
                    (pair.agent_index, pair.goal_index) = (agent as u32, goal as u32);
                    (pair.agent_id, pair.goal_id) = (a.agents[agent].id.clone(), a.goals[goal].id.clone());
                }
                let placed = |left: &[v1::Unassigned], places: &[usize]| -> BTreeMap<usize, i32> {
                    left.iter().map(|member| (places[member.index as usize], member.reason)).collect()
                };
                let (agents, goals) =
                    (placed(&response.agents_without_goal, &agents), placed(&response.goals_without_agent, &goals));
                reasons = Some((agents, goals));
                response
            }
            None => {
                let (exact_cost, scheduler) = (Some(0.0), a.scheduler);
                v1::AssignResponse { exact_cost, gap: exact_cost, scheduler, ..Default::default() }
            }
        };
        (a.pairs, a.cost, a.largest_cost) = (response.pairs, response.cost, response.largest_cost);
        (a.exact_cost, a.gap, a.answered_by) = (response.exact_cost, response.gap, response.scheduler);
        a.fallback_reason = response.fallback_reason;
        (a.version, a.sha256, a.run_id) = (response.version, response.sha256, response.run_id);
        let (agents, goals) = reasons.unzip();
        a.agents_without_goal = idle(&a.agents, agents.as_ref());
        a.goals_without_agent = idle(&a.goals, goals.as_ref());
        self.explain(&before, removed);
        Ok(())
    }

    /// Present cost of a pair; `None` if it is not allowed.
    fn cost_of(&self, agent: &v1::Member, goal: &v1::Member) -> Option<f64> {
        let names = (agent.id.clone(), goal.id.clone());
        let active = |member: &v1::Member| member.state() == v1::MemberState::Active;
        if !active(agent) || !active(goal) || self.forbidden.contains(&names) {
            return None;
        }
        let distance = || magex_assign::distance(&agent.position, &goal.position);
        Some(self.overrides.get(&names).copied().unwrap_or_else(distance))
    }

    /// Fills in the changes against `before`, with their reasons.
    fn explain(&mut self, before: &[v1::Pair], [removed_agents, removed_goals]: &Removed) {
        let a = &self.assignment;
        let (agents, goals) = (by_id(&a.agents), by_id(&a.goals));
        let cost = |agent: &str, goal: &str| self.cost_of(agents.get(agent)?, goals.get(goal)?);
        let old: BTreeMap<&str, &str> = before.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect();
        let new: BTreeMap<&str, &str> = a.pairs.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect();
        let kept: Option<f64> = old.iter().map(|(agent, goal)| cost(agent, goal)).sum();
        let saving = kept.filter(|_| old.len() == new.len() && !old.is_empty()).map(|kept| kept - a.cost);
        let all: BTreeSet<&str> = old.keys().chain(new.keys()).copied().collect();
        let mut changes = Vec::new();
        for agent in all {
            let (from, to) = (old.get(agent).copied(), new.get(agent).copied());
            if from == to {
                continue;
            }
            let state = |members: &HashMap<&str, &v1::Member>, id: &str| members.get(id).map(|member| member.state());
            let gone = |removed: &[String], id: &str| removed.iter().any(|other| other == id);
            let reason = match (from, state(&agents, agent)) {
                (None, _) => v1::ChangeReason::Assigned,
                (_, None) => v1::ChangeReason::AgentRemoved,
                _ if gone(removed_agents, agent) => v1::ChangeReason::AgentRemoved,
                (_, Some(v1::MemberState::Failed)) => v1::ChangeReason::AgentFailed,
                (_, Some(v1::MemberState::Finished)) => v1::ChangeReason::AgentFinished,
                (Some(goal), _) => match state(&goals, goal) {
                    None => v1::ChangeReason::GoalRemoved,
                    _ if gone(removed_goals, goal) => v1::ChangeReason::GoalRemoved,
                    Some(v1::MemberState::Failed) => v1::ChangeReason::GoalFailed,
                    Some(v1::MemberState::Finished) => v1::ChangeReason::GoalFinished,
                    _ if self.forbidden.contains(&(agent.to_owned(), goal.to_owned())) => {
                        v1::ChangeReason::PairForbidden
                    }
                    _ if to.is_none() => v1::ChangeReason::Displaced,
                    _ => v1::ChangeReason::Switched,
                },
            };
            let gain = from.zip(to).and_then(|(from, to)| Some(cost(agent, from)? - cost(agent, to)?));
            changes.push(v1::Change {
                agent_id: agent.to_owned(),
                from_goal_id: from.unwrap_or_default().to_owned(),
                to_goal_id: to.unwrap_or_default().to_owned(),
                reason: reason.into(),
                gain,
                explanation: sentence(reason, agent, from, to, saving, a.switching_cost),
            });
        }
        (self.assignment.changes, self.assignment.saving) = (changes, saving);
    }
}

fn by_id(members: &[v1::Member]) -> HashMap<&str, &v1::Member> {
    members.iter().map(|member| (member.id.as_str(), member)).collect()
}

/// Members without a partner: inactive ones, and those that the plan left unassigned, with its `reasons`. Without a plan a side is
/// empty, so that the other one outnumbers it.
fn idle(members: &[v1::Member], reasons: Option<&BTreeMap<usize, i32>>) -> Vec<v1::Unassigned> {
    let idle = |(k, member): (usize, &v1::Member)| {
        let reason = match (member.state(), reasons) {
            (v1::MemberState::Active, Some(reasons)) => *reasons.get(&k)?,
            (v1::MemberState::Active, None) => v1::UnassignedReason::Outnumbered.into(),
            _ => v1::UnassignedReason::Inactive.into(),
        };
        Some(v1::Unassigned { index: k as u32, id: member.id.clone(), reason })
    };
    members.iter().enumerate().filter_map(idle).collect()
}
