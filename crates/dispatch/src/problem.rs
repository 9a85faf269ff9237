//! Parses and checks a request for one team.

use magex_assign::{AssignError, UNASSIGNED, distance, distances_into};
use magex_core::ids::Mode;
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::{arrays, v1};
use std::collections::HashMap;
use std::time::Duration;

/// Largest magnitude of a client's cost, so that sums and penalties stay finite.
pub const LARGEST_COST: f64 = 1e100;

/// Longest name of an agent or a goal, bytes.
pub const LONGEST_ID: usize = 128;

/// Longest deadline of a request, seconds.
pub const LONGEST_DEADLINE: f64 = 3600.0;

/// Limits of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Agents, and goals, of a team.
    pub members: usize,
    /// Teams of a call.
    pub teams: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { members: 5000, teams: 1000 }
    }
}

/// The assignment problem of one team. All values are finite and in range.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Problem {
    /// N.
    pub agent_count: usize,
    /// G.
    pub goal_count: usize,
    /// D; 0 without positions.
    pub dims: usize,
    /// `[N, D]` world units; empty without positions.
    pub agents: Vec<f32>,
    /// `[G, D]` world units; empty without positions.
    pub goals: Vec<f32>,
    /// `[N]` names, or none.
    pub agent_ids: Vec<String>,
    /// `[G]` names, or none.
    pub goal_ids: Vec<String>,
    /// `[N, G]` costs that replace the distances.
    pub matrix: Option<Vec<f64>>,
    /// (agent, goal, cost) of single pairs; a later entry replaces an earlier one.
    pub overrides: Vec<(u32, u32, f64)>,
    /// Forbidden (agent, goal) pairs.
    pub forbidden: Vec<(u32, u32)>,
    /// `[N]` current goal of each agent, or [`UNASSIGNED`]; empty without current pairs.
    pub current: Vec<u32>,
    /// Cost of an agent leaving its current goal.
    pub switching_cost: f64,
    /// Requested method.
    pub scheduler: AssignmentMethod,
    /// How the learned method chooses.
    pub mode: Mode,
    /// Key of the random choices.
    pub seed: u64,
    /// Deadline, from the arrival of the request.
    pub deadline: Option<Duration>,
}

impl Problem {
    /// The problem of these positions (`[N, dims]` and `[G, dims]`, world units), without names, costs and current pairs.
    pub fn of_points(agents: Vec<f32>, goals: Vec<f32>, dims: usize) -> Self {
        Self {
            agent_count: agents.len() / dims.max(1),
            goal_count: goals.len() / dims.max(1),
            dims,
            agents,
            goals,
            ..Self::default()
        }
    }

    /// Parses a request. `seed` is the seed of a request without one. An error names the first invalid field by its path.
    pub fn read(message: v1::AssignRequest, seed: u64, limits: &Limits) -> Result<Self, ConvertError> {
        let scheduler = scheduler(message.scheduler)?.unwrap_or_default();
        let mode = match v1::Mode::try_from(message.mode) {
            Ok(v1::Mode::Sampled) => Mode::Sampled,
            Ok(v1::Mode::Greedy | v1::Mode::Unspecified) => Mode::Greedy,
            Err(_) => {
                let problem = format!("{} is not a mode; use sampled or greedy", message.mode);
                return Err(ConvertError::new("mode", problem));
            }
        };
        let positions = match (message.agents, message.goals) {
            (None, None) if message.costs.is_some() => None,
            (agents, goals) => Some((points("agents", agents, limits)?, points("goals", goals, limits)?)),
        };
        let has_positions = positions.is_some();
        let ((agents, agent_dims), (goals, goal_dims)) = positions.unwrap_or_default();
        // The dimensions of no points mean nothing.
        let dims = if agents.is_empty() { goal_dims } else { agent_dims };
        ConvertError::ensure(dims == goal_dims || goals.is_empty(), || {
            ("goals", format!("{goal_dims} dimensions, the agents have {dims}"))
        })?;
        let counts = has_positions.then(|| (agents.len() / dims.max(1), goals.len() / dims.max(1)));
        let (matrix, (agent_count, goal_count)) = match (message.costs, counts) {
            (Some(costs), counts) => {
                let shape = check_matrix(&costs, counts, limits)?;
                (Some(costs.values), shape)
            }
            (None, Some(counts)) => (None, counts),
            (None, None) => return Err(ConvertError::missing("agents")),
        };
        let agent_index = index("agent_ids", &message.agent_ids, agent_count)?;
        let goal_index = index("goal_ids", &message.goal_ids, goal_count)?;
        let sides = Sides { agents: (&agent_index, agent_count), goals: (&goal_index, goal_count) };
        let resolve = |pair: &v1::PairRef| sides.resolve(pair);
        let overrides = priced_pairs("cost_overrides", &message.cost_overrides, resolve)?;
        let current = current(&message.current, &sides)?;
        Ok(Self {
            agent_count,
            goal_count,
            dims,
            agents,
            goals,
            matrix,
            overrides: overrides.into_iter().map(|((agent, goal), cost)| (agent, goal, cost)).collect(),
            forbidden: pairs("forbidden", &message.forbidden, resolve)?,
            current,
            switching_cost: switching_cost(message.switching_cost)?,
            scheduler,
            mode,
            seed: message.seed.unwrap_or(seed),
            deadline: message.deadline_seconds.map(deadline).transpose()?,
            agent_ids: message.agent_ids,
            goal_ids: message.goal_ids,
        })
    }

    /// N · G.
    pub fn cells(&self) -> usize {
        self.agent_count * self.goal_count
    }

    /// Costs `[N, G]`: the matrix or the distances, then single costs, then +∞ for forbidden pairs.
    pub fn costs_into(&self, costs: &mut Vec<f64>) -> Result<(), AssignError> {
        match &self.matrix {
            Some(matrix) => costs.clone_from(matrix),
            None => drop(distances_into(&self.agents, &self.goals, self.dims, costs)?),
        }
        for &(agent, goal, cost) in &self.overrides {
            costs[agent as usize * self.goal_count + goal as usize] = cost;
        }
        for &(agent, goal) in &self.forbidden {
            costs[agent as usize * self.goal_count + goal as usize] = f64::INFINITY;
        }
        Ok(())
    }

    /// Distance of a pair in double precision, world units; 0 without positions.
    pub fn distance(&self, agent: usize, goal: usize) -> f64 {
        let d = self.dims;
        let (a, g) = (self.agents.get(agent * d..(agent + 1) * d), self.goals.get(goal * d..(goal + 1) * d));
        distance(a.unwrap_or_default(), g.unwrap_or_default())
    }
}

/// A known method; `None` if unspecified.
pub(crate) fn scheduler(value: i32) -> Result<Option<AssignmentMethod>, ConvertError> {
    match v1::AssignmentMethod::try_from(value) {
        Ok(v1::AssignmentMethod::Unspecified) => Ok(None),
        Ok(kind) => Ok(Some(kind.into())),
        Err(_) => {
            let problem = format!("{value} is not a method; use learned, exact, makespan, greedy or random");
            Err(ConvertError::new("scheduler", problem))
        }
    }
}

pub(crate) fn switching_cost(value: f64) -> Result<f64, ConvertError> {
    let ok = (0.0..=LARGEST_COST).contains(&value);
    ConvertError::ensure(ok, || ("switching_cost", format!("{value} is not a number from 0 to {LARGEST_COST:e}")))?;
    Ok(value)
}

pub(crate) fn finite_cost(value: f64, field: impl FnOnce() -> String) -> Result<f64, ConvertError> {
    // False for NaN.
    let ok = value.abs() <= LARGEST_COST;
    ConvertError::ensure(ok, || (field(), format!("{value} is not a finite number up to {LARGEST_COST:e}")))?;
    Ok(value)
}

fn deadline(seconds: f64) -> Result<Duration, ConvertError> {
    ConvertError::ensure(seconds > 0.0 && seconds <= LONGEST_DEADLINE, || {
        let problem = format!("{seconds} is not a number of seconds above 0 and up to {LONGEST_DEADLINE}");
        ("deadline_seconds", problem)
    })?;
    Ok(Duration::from_secs_f64(seconds))
}

fn points(field: &str, positions: Option<v1::Positions>, limits: &Limits) -> Result<(Vec<f32>, usize), ConvertError> {
    let positions = positions.ok_or_else(|| ConvertError::missing(field))?;
    let (values, dims) = match positions.array {
        Some(array) => {
            let path = format!("{field}.array");
            let shape = arrays::shape_of(&path, Some(&array), 2)?;
            (arrays::to_f32(&path, Some(array), &shape)?, shape[1])
        }
        None => (positions.coordinates, positions.dims as usize),
    };
    // An empty side is a normal request: there may be nothing to do, or no agent left.
    let known = (2..=3).contains(&dims) || (dims == 0 && values.is_empty());
    ConvertError::ensure(known, || (format!("{field}.dims"), format!("{dims} is not 2 or 3")))?;
    ConvertError::ensure(values.is_empty() || values.len().is_multiple_of(dims), || {
        let problem = format!("{} numbers do not make points of {dims} coordinates", values.len());
        (format!("{field}.coordinates"), problem)
    })?;
    let count = values.len() / dims.max(1);
    ConvertError::ensure(count <= limits.members, || {
        (field, format!("{count} points exceed the limit of {}", limits.members))
    })?;
    Ok((arrays::finite(&format!("{field}.coordinates"), values)?, dims))
}

/// Checks a cost matrix against the number of positions, if there are any. Returns its shape.
fn check_matrix(
    costs: &v1::CostMatrix,
    counts: Option<(usize, usize)>,
    limits: &Limits,
) -> Result<(usize, usize), ConvertError> {
    let (agents, goals) = (costs.agents as usize, costs.goals as usize);
    let (agent_points, goal_points) = counts.unzip();
    for (field, found, points) in [("costs.agents", agents, agent_points), ("costs.goals", goals, goal_points)] {
        ConvertError::ensure(found <= limits.members, || {
            (field, format!("{found} exceed the limit of {}", limits.members))
        })?;
        if let Some(points) = points.filter(|&points| points != found) {
            return Err(ConvertError::new(field, format!("{found}, but there are {points} positions")));
        }
    }
    ConvertError::ensure(costs.values.len() == agents * goals, || {
        ("costs.values", format!("{} numbers do not fill {agents} x {goals}", costs.values.len()))
    })?;
    if let Some(place) = costs.values.iter().position(|value| value.is_nan() || value.abs() > LARGEST_COST) {
        finite_cost(costs.values[place], || format!("costs.values[{place}]"))?;
    }
    Ok((agents, goals))
}

/// Checks the length of a member's name.
pub(crate) fn check_name(id: &str, field: impl FnOnce() -> String) -> Result<(), ConvertError> {
    let ok = (1..=LONGEST_ID).contains(&id.len());
    ConvertError::ensure(ok, || (field(), format!("{} bytes; a name has 1 to {LONGEST_ID}", id.len())))
}

/// Index of every name. There must be as many names as members, or none, and all different.
fn index<'a>(field: &str, ids: &'a [String], count: usize) -> Result<HashMap<&'a str, u32>, ConvertError> {
    let mut places = HashMap::new();
    if ids.is_empty() {
        return Ok(places);
    }
    ConvertError::ensure(ids.len() == count, || {
        (field, format!("{} names for {count} members; give one each or none", ids.len()))
    })?;
    places.reserve(count);
    for (k, id) in ids.iter().enumerate() {
        check_name(id, || format!("{field}[{k}]"))?;
        if let Some(first) = places.insert(id.as_str(), k as u32) {
            return Err(ConvertError::new(format!("{field}[{k}]"), format!("the same name as {field}[{first}]")));
        }
    }
    Ok(places)
}

/// Pairs, each resolved to its members.
pub(crate) fn pairs<T>(
    field: &str,
    pairs: &[v1::PairRef],
    resolve: impl Fn(&v1::PairRef) -> Result<T, ConvertError>,
) -> Result<Vec<T>, ConvertError> {
    let read = |(k, pair)| resolve(pair).map_err(|error| error.within(&format!("{field}[{k}]")));
    pairs.iter().enumerate().map(read).collect()
}

/// Pairs with their costs, each resolved to its members.
pub(crate) fn priced_pairs<T>(
    field: &str,
    items: &[v1::PairCost],
    resolve: impl Fn(&v1::PairRef) -> Result<T, ConvertError>,
) -> Result<Vec<(T, f64)>, ConvertError> {
    let read = |(k, item): (usize, &v1::PairCost)| {
        let path = || format!("{field}[{k}].pair");
        let pair = item.pair.as_ref().ok_or_else(|| ConvertError::missing(path()))?;
        let members = resolve(pair).map_err(|error| error.within(&path()))?;
        Ok((members, finite_cost(item.cost, || format!("{field}[{k}].cost"))?))
    };
    items.iter().enumerate().map(read).collect()
}

/// Names and sizes of both sides.
struct Sides<'a> {
    agents: (&'a HashMap<&'a str, u32>, usize),
    goals: (&'a HashMap<&'a str, u32>, usize),
}

impl Sides<'_> {
    fn resolve(&self, pair: &v1::PairRef) -> Result<(u32, u32), ConvertError> {
        let one = |side: &(&HashMap<&str, u32>, usize), id: &str, index: u32, names: [&str; 2]| match id {
            "" if (index as usize) < side.1 => Ok(index),
            "" => Err(ConvertError::new(names[1], format!("{index} is not below {}", side.1))),
            id => side.0.get(id).copied().ok_or_else(|| ConvertError::new(names[0], "no member has this name")),
        };
        let agent = one(&self.agents, &pair.agent_id, pair.agent_index, ["agent_id", "agent_index"])?;
        let goal = one(&self.goals, &pair.goal_id, pair.goal_index, ["goal_id", "goal_index"])?;
        Ok((agent, goal))
    }
}

fn current(current: &[v1::PairRef], sides: &Sides<'_>) -> Result<Vec<u32>, ConvertError> {
    if current.is_empty() {
        return Ok(Vec::new());
    }
    let mut goal_of = vec![UNASSIGNED; sides.agents.1];
    let mut taken = vec![false; sides.goals.1];
    for (k, (agent, goal)) in pairs("current", current, |pair| sides.resolve(pair))?.into_iter().enumerate() {
        if goal_of[agent as usize] != UNASSIGNED || std::mem::replace(&mut taken[goal as usize], true) {
            return Err(ConvertError::new(format!("current[{k}]"), "its agent or its goal is in another pair too"));
        }
        goal_of[agent as usize] = goal;
    }
    Ok(goal_of)
}
