//! Parses and checks a request for one team.

use magex_assign::{UNASSIGNED, distance, distances_into};
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
#[derive(Debug, Clone, PartialEq)]
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
    /// Parses a request. `seed` is the seed of a request without one.
    ///
    /// # Errors
    /// The first invalid field, by its path.
    pub fn read(message: v1::AssignRequest, seed: u64, limits: &Limits) -> Result<Self, ConvertError> {
        let scheduler = scheduler("scheduler", message.scheduler)?.unwrap_or_default();
        let mode = match v1::Mode::try_from(message.mode) {
            Ok(v1::Mode::Sampled) => Mode::Sampled,
            Ok(v1::Mode::Greedy | v1::Mode::Unspecified) => Mode::Greedy,
            Err(_) => {
                return Err(ConvertError::new(
                    "mode",
                    format!("{} is not a mode; use sampled or greedy", message.mode),
                ));
            }
        };
        let positions = match (message.agents, message.goals) {
            (None, None) if message.costs.is_some() => None,
            (agents, goals) => Some((points("agents", agents, limits)?, points("goals", goals, limits)?)),
        };
        if let Some(((_, agents), (_, goals))) = &positions
            && agents != goals
        {
            return Err(ConvertError::new("goals", format!("{goals} dimensions, the agents have {agents}")));
        }
        let dims = positions.as_ref().map_or(0, |(agents, _)| agents.1);
        let counts = positions.as_ref().map(|((agents, d), (goals, _))| (agents.len() / d, goals.len() / d));
        let (matrix, (agent_count, goal_count)) = match (message.costs, counts) {
            (Some(costs), counts) => {
                let (values, shape) = matrix(costs, counts, limits)?;
                (Some(values), shape)
            }
            (None, Some(counts)) => (None, counts),
            (None, None) => return Err(ConvertError::missing("agents")),
        };
        let (agents, goals) = positions.map_or_else(Default::default, |((agents, _), (goals, _))| (agents, goals));
        let agent_index = index("agent_ids", &message.agent_ids, agent_count)?;
        let goal_index = index("goal_ids", &message.goal_ids, goal_count)?;
        let sides = Sides { agents: (&agent_index, agent_count), goals: (&goal_index, goal_count) };
        let mut overrides = Vec::with_capacity(message.cost_overrides.len());
        for (k, item) in message.cost_overrides.iter().enumerate() {
            let path = || format!("cost_overrides[{k}]");
            let pair = item.pair.as_ref().ok_or_else(|| ConvertError::missing(format!("{}.pair", path())))?;
            let (agent, goal) = sides.resolve(pair).map_err(|e| e.within(&format!("{}.pair", path())))?;
            overrides.push((agent, goal, finite_cost(item.cost, || format!("{}.cost", path()))?));
        }
        let mut forbidden = Vec::with_capacity(message.forbidden.len());
        for (k, pair) in message.forbidden.iter().enumerate() {
            forbidden.push(sides.resolve(pair).map_err(|e| e.within(&format!("forbidden[{k}]")))?);
        }
        let current = current(&message.current, &sides)?;
        Ok(Self {
            agent_count,
            goal_count,
            dims,
            agents,
            goals,
            matrix,
            overrides,
            forbidden,
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
    pub fn costs_into(&self, costs: &mut Vec<f64>) -> Result<(), ConvertError> {
        match &self.matrix {
            Some(matrix) => {
                costs.clear();
                costs.extend_from_slice(matrix);
            }
            None => {
                distances_into(&self.agents, &self.goals, self.dims, costs)
                    .map_err(|error| ConvertError::new("agents", error.to_string()))?;
            }
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
pub(crate) fn scheduler(field: &str, value: i32) -> Result<Option<AssignmentMethod>, ConvertError> {
    match v1::AssignmentMethod::try_from(value) {
        Ok(v1::AssignmentMethod::Unspecified) => Ok(None),
        Ok(kind) => Ok(Some(kind.into())),
        Err(_) => Err(ConvertError::new(
            field,
            format!("{value} is not a method; use learned, exact, makespan, greedy or random"),
        )),
    }
}

pub(crate) fn switching_cost(value: f64) -> Result<f64, ConvertError> {
    if (0.0..=LARGEST_COST).contains(&value) {
        return Ok(value);
    }
    Err(ConvertError::new("switching_cost", format!("{value} is not a number from 0 to {LARGEST_COST:e}")))
}

pub(crate) fn finite_cost(value: f64, field: impl FnOnce() -> String) -> Result<f64, ConvertError> {
    // False for NaN.
    if value.abs() <= LARGEST_COST {
        return Ok(value);
    }
    Err(ConvertError::new(field(), format!("{value} is not a finite number up to {LARGEST_COST:e}")))
}

fn deadline(seconds: f64) -> Result<Duration, ConvertError> {
    if seconds > 0.0 && seconds <= LONGEST_DEADLINE {
        return Ok(Duration::from_secs_f64(seconds));
    }
    let problem = format!("{seconds} is not a number of seconds above 0 and up to {LONGEST_DEADLINE}");
    Err(ConvertError::new("deadline_seconds", problem))
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
    if !(2..=3).contains(&dims) {
        return Err(ConvertError::new(format!("{field}.dims"), format!("{dims} is not 2 or 3")));
    }
    if values.is_empty() || !values.len().is_multiple_of(dims) {
        let problem = format!("{} numbers do not make points of {dims} coordinates", values.len());
        return Err(ConvertError::new(format!("{field}.coordinates"), problem));
    }
    if values.len() / dims > limits.members {
        let problem = format!("{} points exceed the limit of {}", values.len() / dims, limits.members);
        return Err(ConvertError::new(field, problem));
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(place) => {
            let path = format!("{field}.coordinates[{place}]");
            Err(ConvertError::new(path, format!("{} is not finite", values[place])))
        }
        None => Ok((values, dims)),
    }
}

/// Checks a cost matrix against the number of positions, if there are any.
fn matrix(
    costs: v1::CostMatrix,
    counts: Option<(usize, usize)>,
    limits: &Limits,
) -> Result<(Vec<f64>, (usize, usize)), ConvertError> {
    let shape = (costs.agents as usize, costs.goals as usize);
    for (field, found, points) in
        [("costs.agents", shape.0, counts.map(|c| c.0)), ("costs.goals", shape.1, counts.map(|c| c.1))]
    {
        if found == 0 || found > limits.members {
            return Err(ConvertError::new(field, format!("{found} is not in 1..{}", limits.members)));
        }
        if let Some(points) = points.filter(|&points| points != found) {
            return Err(ConvertError::new(field, format!("{found}, but there are {points} positions")));
        }
    }
    if costs.values.len() != shape.0 * shape.1 {
        let problem = format!("{} numbers do not fill {} x {}", costs.values.len(), shape.0, shape.1);
        return Err(ConvertError::new("costs.values", problem));
    }
    if let Some(place) = costs.values.iter().position(|value| value.is_nan() || value.abs() > LARGEST_COST) {
        finite_cost(costs.values[place], || format!("costs.values[{place}]"))?;
    }
    Ok((costs.values, shape))
}

/// Index of every name. There must be as many names as members, or none, and all different.
fn index<'a>(field: &str, ids: &'a [String], count: usize) -> Result<HashMap<&'a str, u32>, ConvertError> {
    let mut places = HashMap::new();
    if ids.is_empty() {
        return Ok(places);
    }
    if ids.len() != count {
        let problem = format!("{} names for {count} members; give one each or none", ids.len());
        return Err(ConvertError::new(field, problem));
    }
    places.reserve(count);
    for (k, id) in ids.iter().enumerate() {
        if id.is_empty() || id.len() > LONGEST_ID {
            let problem = format!("{} bytes; a name has 1 to {LONGEST_ID}", id.len());
            return Err(ConvertError::new(format!("{field}[{k}]"), problem));
        }
        if let Some(first) = places.insert(id.as_str(), k as u32) {
            return Err(ConvertError::new(format!("{field}[{k}]"), format!("the same name as {field}[{first}]")));
        }
    }
    Ok(places)
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

fn current(pairs: &[v1::PairRef], sides: &Sides<'_>) -> Result<Vec<u32>, ConvertError> {
    if pairs.is_empty() {
        return Ok(Vec::new());
    }
    let mut goal_of = vec![UNASSIGNED; sides.agents.1];
    let mut taken = vec![false; sides.goals.1];
    for (k, pair) in pairs.iter().enumerate() {
        let (agent, goal) = sides.resolve(pair).map_err(|e| e.within(&format!("current[{k}]")))?;
        if goal_of[agent as usize] != UNASSIGNED || std::mem::replace(&mut taken[goal as usize], true) {
            return Err(ConvertError::new(format!("current[{k}]"), "its agent or its goal is in another pair too"));
        }
        goal_of[agent as usize] = goal;
    }
    Ok(goal_of)
}
