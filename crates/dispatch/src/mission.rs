//! A mission: a persistent team. Its agents and goals are added, move, fail, finish and are removed; every change re-plans the
//! mission and reports each changed assignment with its reason.

mod changes;
mod edits;
mod members;
mod team;

use crate::AssignError;
use crate::answer::Planned;
use crate::clock::Now;
use crate::problem::{Problem, pairs, priced_pairs, switching_cost};
use crate::terms::{self, DURATIONS, TIMES, within};
use edits::finished;
use magex_assign::distance;
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;
use members::{MemberNames, check_id, check_lengths, check_order, check_record, lifetime, sticky_scheduler};
use std::collections::{BTreeMap, BTreeSet, HashSet};
use team::Team;

pub use members::FINISHED_KEPT;

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

/// What an update took out by name: agents and goals that it removed, and agents that forfeited their goals.
#[derive(Debug, Default)]
struct Taken {
    agents: HashSet<String>,
    goals: HashSet<String>,
    forfeits: HashSet<String>,
}

/// A mission and its current assignment.
#[derive(Debug, Clone, PartialEq)]
pub struct Mission {
    /// The part that clients see.
    pub assignment: v1::Assignment,
    forbidden: BTreeSet<Names>,
    overrides: BTreeMap<Names, f64>,
    pinned: BTreeSet<Names>,
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
    #[prost(int64, tag = "5")]
    deadline_ms: i64,
}

impl Mission {
    /// Its size on the wire, bytes.
    pub fn bytes(&self) -> usize {
        let pairs = self.forbidden.iter().chain(self.overrides.keys()).chain(&self.pinned);
        magex_proto::encoded_len(&self.assignment)
            + pairs.map(|(agent, goal)| agent.len() + goal.len() + PAIR).sum::<usize>()
    }

    /// Number of agents, and of places at goals.
    pub fn size(&self) -> (usize, usize) {
        (self.assignment.agents.len(), places(&self.assignment.goals))
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
                power: terms::power(request.power)?,
                balance: within(request.balance, &DURATIONS, || "balance".to_owned())?,
                time: within(request.time, &TIMES, || "time".to_owned())?,
                created_ms: now.day_ms,
                ..Default::default()
            },
            forbidden: BTreeSet::new(),
            overrides: BTreeMap::new(),
            pinned: BTreeSet::new(),
            lifetime_ms: lifetime(request.lifetime_seconds, limits)?,
            deadline_ms: 0,
        };
        let content = v1::UpdateMissionRequest {
            agents: request.agents,
            goals: request.goals,
            forbid: request.forbidden,
            pin: request.pinned,
            cost_overrides: request.cost_overrides,
            ..Default::default()
        };
        empty.change(["forbidden", "pinned"], content, now, limits, planner)
    }

    /// Computes and plans the next revision. An error names the first invalid field, or is the planner's.
    pub fn update(
        &self,
        request: v1::UpdateMissionRequest,
        now: impl Into<Now>,
        limits: &MissionLimits,
        planner: &Planner<'_>,
    ) -> Result<Self, AssignError> {
        self.clone().change(["forbid", "pin"], request, now.into(), limits, planner)
    }

    /// Applies a request, in which `forbid` and `pin` are the names of the lists of pairs to forbid and to pin, and plans.
    fn change(
        mut self,
        [forbid, pin]: [&str; 2],
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
                (pin, request.pin.len()),
                ("unpin", request.unpin.len()),
                ("forfeit", request.forfeit.len()),
            ],
        )?;
        self.forget();
        let mut taken = self.remove(&request.remove_agents, &request.remove_goals)?;
        let finished_before = finished(&self.assignment.goals);
        self.upsert(request.agents, request.goals, &request.cost_overrides, limits)?;
        self.count_loads(&finished_before);
        check_order(&self.assignment.goals)?;
        let known = MemberNames::of(&self.assignment);
        let names = |pair: &v1::PairRef| known.names(pair);
        let (forbidden, pins) = (pairs(forbid, &request.forbid, names)?, pairs(pin, &request.pin, names)?);
        self.forbidden.extend(forbidden.iter().cloned());
        for allowed in pairs("allow", &request.allow, names)? {
            self.forbidden.remove(&allowed);
        }
        self.overrides.extend(priced_pairs("cost_overrides", &request.cost_overrides, names)?);
        for cleared in pairs("clear_cost_overrides", &request.clear_cost_overrides, names)? {
            self.overrides.remove(&cleared);
        }
        for unpinned in pairs("unpin", &request.unpin, names)? {
            self.pinned.remove(&unpinned);
        }
        self.pinned.extend(pins.iter().cloned());
        taken.forfeits = self.forfeit(&request.forfeit)?;
        self.check_pins([forbid, pin], &forbidden, &pins)?;
        let a = &mut self.assignment;
        if let Some(cost) = request.switching_cost {
            a.switching_cost = switching_cost(cost)?;
        }
        if let Some(power) = request.power {
            a.power = terms::power(Some(power))?;
        }
        if let Some(balance) = request.balance {
            a.balance = within(balance, &DURATIONS, || "balance".to_owned())?;
        }
        if let Some(time) = request.time {
            let before = a.time;
            ConvertError::ensure(time >= before, || {
                ("time", format!("{time} is before the time of the mission, {before}; it never goes back"))
            })?;
            a.time = within(time, &TIMES, || "time".to_owned())?;
        }
        if let Some(kind) = sticky_scheduler(request.scheduler)? {
            a.scheduler = v1::AssignmentMethod::from(kind).into();
        }
        self.check_size(limits)?;
        self.plan(&taken, now, limits, planner)?;
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
        let priced = |(names, &cost): (&Names, &f64)| v1::PairCost { pair: Some(pair(names)), cost };
        let record = Record {
            assignment: Some(self.assignment.clone()),
            forbidden: self.forbidden.iter().map(pair).collect(),
            overrides: self.overrides.iter().map(priced).collect(),
            lifetime_ms: self.lifetime_ms,
            deadline_ms: self.deadline_ms,
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
        let overrides = record.overrides.into_iter();
        Ok(Self {
            pinned: assignment.pinned.iter().cloned().map(names).collect(),
            assignment,
            forbidden: record.forbidden.into_iter().map(names).collect(),
            overrides: overrides.filter_map(|item| Some((names(item.pair?), item.cost))).collect(),
            lifetime_ms: record.lifetime_ms,
            deadline_ms: record.deadline_ms,
        })
    }

    fn plan(
        &mut self,
        taken: &Taken,
        now: Now,
        limits: &MissionLimits,
        planner: &Planner<'_>,
    ) -> Result<(), AssignError> {
        let before = self.assignment.pairs.clone();
        let team = Team::of(self, limits)?;
        let solved = match &team {
            Some(team) => Some((planner(&team.problem)?.respond(&team.problem), &team.agents, &team.goals)),
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
                    let (from, to) = (&a.agents[agent].position, &a.goals[goal].position);
                    // The team of members of which some have no position is known to the planner by costs.
                    if !from.is_empty() && !to.is_empty() {
                        pair.distance = distance(from, to);
                    }
                }
                response.distance = response.pairs.iter().map(|pair| pair.distance).sum();
                let placed = |left: &[v1::Unassigned], places: &[usize]| -> BTreeMap<usize, i32> {
                    left.iter().map(|member| (places[member.index as usize], member.reason)).collect()
                };
                let (agents, goals) =
                    (placed(&response.agents_without_goal, agents), placed(&response.goals_without_agent, goals));
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
        (a.distance, a.last_arrival, a.unserved_cost) =
            (response.distance, response.last_arrival, response.unserved_cost);
        a.fallback_reason = response.fallback_reason;
        (a.version, a.sha256, a.run_id) = (response.version, response.sha256, response.run_id);
        let (agents, goals) = reasons.unzip();
        a.agents_without_goal = idle(&a.agents, agents.as_ref());
        a.goals_without_agent = idle(&a.goals, goals.as_ref());
        self.explain(&before, taken, team.as_ref(), response.switches);
        Ok(())
    }
}

fn pair((agent, goal): &Names) -> v1::PairRef {
    v1::PairRef { agent_id: agent.clone(), goal_id: goal.clone(), ..Default::default() }
}

/// Agents that goals take together.
pub fn places(goals: &[v1::Member]) -> usize {
    goals.iter().map(|goal| goal.capacity.unwrap_or(1) as usize).fold(0, usize::saturating_add)
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
