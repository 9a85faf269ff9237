//! Parses and checks a request for one team.

use crate::terms::{self, Terms};
use magex_assign::powered;
use magex_assign::{LARGEST_COORDINATE, UNASSIGNED};
use magex_core::ids::Mode;
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::{arrays, v1};
use std::collections::{HashMap, HashSet};
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
    /// `[N, D]` in the unit of the client; empty without positions.
    pub agents: Vec<f64>,
    /// `[G, D]` in the same unit; empty without positions.
    pub goals: Vec<f64>,
    /// `[N]` names, or none.
    pub agent_ids: Vec<String>,
    /// `[G]` names, or none.
    pub goal_ids: Vec<String>,
    /// `[N, G]` costs that replace the distances; +∞ forbids a pair.
    pub matrix: Option<Vec<f64>>,
    /// (agent, goal, cost) of single pairs; a later entry replaces an earlier one, and +∞ forbids the pair.
    pub overrides: Vec<(u32, u32, f64)>,
    /// Pairs without an override are forbidden.
    pub only_overrides: bool,
    /// What pairs cost beside their distances, and which are possible.
    pub terms: Terms,
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
    /// The problem of these positions (`[N, dims]` and `[G, dims]`), without names, costs and current pairs.
    pub fn of_points(agents: Vec<f64>, goals: Vec<f64>, dims: usize) -> Self {
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
    pub fn read(mut message: v1::AssignRequest, seed: u64, limits: &Limits) -> Result<Self, ConvertError> {
        let scheduler = scheduler(message.scheduler)?.unwrap_or(AssignmentMethod::Exact);
        let mode = match v1::Mode::try_from(message.mode) {
            Ok(v1::Mode::Sampled) => Mode::Sampled,
            Ok(v1::Mode::Greedy | v1::Mode::Unspecified) => Mode::Greedy,
            Err(_) => {
                let problem = format!("{} is not a mode; use sampled or greedy", message.mode);
                return Err(ConvertError::new("mode", problem));
            }
        };
        let (given, sparse) = (message.costs.take(), message.sparse_costs.take());
        ConvertError::ensure(given.is_none() || sparse.is_none(), || {
            ("sparse_costs", "costs are given, too; give one of the two")
        })?;
        let positions = match (message.agents.take(), message.goals.take()) {
            (None, None) if given.is_some() || sparse.is_some() => None,
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
        let only_overrides = sparse.is_some();
        let (mut matrix, mut overrides) = (None, Vec::new());
        let (agent_count, goal_count) = match (given, sparse, counts) {
            (Some(costs), _, counts) => {
                let shape = check_matrix(&costs, counts, limits)?;
                matrix = Some(costs.values);
                shape
            }
            (None, Some(sparse), counts) => {
                overrides = sparse_pairs(&sparse, counts, limits)?;
                (sparse.agents as usize, sparse.goals as usize)
            }
            (None, None, Some(counts)) => counts,
            (None, None, None) => return Err(ConvertError::missing("agents")),
        };
        let agent_ids = std::mem::take(&mut message.agent_ids);
        let goal_ids = std::mem::take(&mut message.goal_ids);
        let agent_index = index("agent_ids", &agent_ids, agent_count)?;
        let goal_index = index("goal_ids", &goal_ids, goal_count)?;
        let sides = Sides { agents: (&agent_index, agent_count), goals: (&goal_index, goal_count) };
        let resolve = |pair: &v1::PairRef| sides.resolve(pair);
        let priced = priced_pairs("cost_overrides", &message.cost_overrides, resolve)?;
        overrides.extend(priced.into_iter().map(|((agent, goal), cost)| (agent, goal, cost)));
        let forbidden = pairs("forbidden", &message.forbidden, resolve)?;
        let pinned = pairs("pinned", &message.pinned, resolve)?;
        let current = pairs("current", &message.current, resolve)?;
        let goal_of = |index: u32, id: &str, names: [&str; 2]| one(&sides.goals, id, index, names);
        let size = (agent_count, goal_count);
        let terms = terms::read(&mut message, size, limits.members, pinned, &goal_ids, goal_of)?;
        let problem = Self {
            agent_count,
            goal_count,
            dims,
            agents,
            goals,
            matrix,
            overrides,
            only_overrides,
            forbidden,
            current: current_goals(&current, agent_count, &terms)?,
            terms,
            switching_cost: switching_cost(message.switching_cost)?,
            scheduler,
            mode,
            seed: message.seed.unwrap_or(seed),
            deadline: message.deadline_seconds.map(deadline).transpose()?,
            agent_ids,
            goal_ids,
        };
        problem.check()?;
        problem.check_memory()?;
        Ok(problem)
    }

    /// Checks what several fields say together: pins against forbidden pairs, and costs against the power.
    pub(crate) fn check(&self) -> Result<(), ConvertError> {
        let forbidden: HashSet<&(u32, u32)> = match self.terms.pinned.is_empty() {
            true => HashSet::new(),
            false => self.forbidden.iter().collect(),
        };
        let mut goal_of = vec![UNASSIGNED; self.agent_count];
        self.terms.pinned.iter().for_each(|&(agent, goal)| goal_of[agent as usize] = goal);
        let base = if self.terms.pinned.is_empty() { Vec::new() } else { self.base_of(&goal_of) };
        for (k, pair) in self.terms.pinned.iter().enumerate() {
            ConvertError::ensure(!forbidden.contains(pair) && base[pair.0 as usize] < f64::INFINITY, || {
                (format!("pinned[{k}]"), "the pair is forbidden, too; leave out one of the two")
            })?;
        }
        self.check_power()
    }

    /// Costs above a power of 1 must not be negative, and what comes out must be a cost.
    pub(crate) fn check_power(&self) -> Result<(), ConvertError> {
        let terms = &self.terms;
        let negative = "is negative, which a power above 1 does not allow; add a constant to all costs, or use power 1";
        if terms.power != 1.0 {
            let matrix = self.matrix.iter().flatten();
            if let Some((k, cost)) = matrix.enumerate().find(|(_, cost)| **cost < 0.0) {
                return Err(ConvertError::new(format!("costs.values[{k}]"), format!("{cost} {negative}")));
            }
            if let Some((_, _, cost)) = self.overrides.iter().find(|(.., cost)| *cost < 0.0) {
                let field = if self.only_overrides { "sparse_costs.values" } else { "cost_overrides" };
                return Err(ConvertError::new(field, format!("{cost} {negative}")));
            }
        }
        if terms.power == 1.0 && terms.speeds.is_empty() && terms.weights.is_empty() {
            return Ok(());
        }
        let most =
            |values: &[f64]| values.iter().copied().filter(|x| *x < f64::INFINITY).fold(0.0f64, |a, b| a.max(b.abs()));
        let given = self.matrix.as_deref().map_or_else(|| self.longest(), most);
        let d = self
            .overrides
            .iter()
            .map(|(.., cost)| *cost)
            .filter(|x| *x < f64::INFINITY)
            .fold(given, |a, b| a.max(b.abs()));
        let slowest = terms.speeds.iter().copied().fold(1.0, f64::min);
        let time = most(&terms.offsets) + d / slowest + most(&terms.earliest);
        // Goals that are left over count twice the longest time.
        let cost = powered(2.0 * time, terms.power) * most(&terms.weights).max(1.0);
        ConvertError::ensure(cost <= LARGEST_COST, || {
            let problem = format!(
                "a pair may take {time:e} by distance, speed and offset; raised to {} and weighted that is beyond {LARGEST_COST:e}; \
                 use a smaller power, or a larger unit",
                terms.power
            );
            ("power", problem)
        })
    }

    /// A bound of the distances: the diagonal of the box around all positions.
    fn longest(&self) -> f64 {
        let d = self.dims;
        let side = |axis: usize| {
            let all = self.agents.iter().chain(&self.goals).skip(axis).step_by(d.max(1));
            let (low, high) = all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &x| (low.min(x), high.max(x)));
            if low < high { high - low } else { 0.0 }
        };
        (0..d).map(|axis| side(axis) * side(axis)).sum::<f64>().sqrt()
    }

    /// Whether some pair may be forbidden.
    pub fn forbids(&self) -> bool {
        let infinite = |cost: &f64| *cost == f64::INFINITY;
        self.only_overrides
            || self.terms.forbids()
            || !self.forbidden.is_empty()
            || self.overrides.iter().any(|(.., cost)| infinite(cost))
            || self.matrix.as_ref().is_some_and(|matrix| matrix.iter().any(infinite))
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

/// Checks the cost of a pair; +∞ forbids it.
pub(crate) fn pair_cost(value: f64, field: impl FnOnce() -> String) -> Result<f64, ConvertError> {
    ConvertError::ensure(usable(value), || {
        let problem = format!(
            "{value:e} is not a cost; use a number up to {LARGEST_COST:e} in magnitude, or +infinity to forbid the pair"
        );
        (field(), problem)
    })?;
    Ok(value)
}

/// False for NaN, −∞ and numbers beyond [`LARGEST_COST`].
fn usable(cost: f64) -> bool {
    cost.abs() <= LARGEST_COST || cost == f64::INFINITY
}

fn deadline(seconds: f64) -> Result<Duration, ConvertError> {
    ConvertError::ensure(seconds > 0.0 && seconds <= LONGEST_DEADLINE, || {
        let problem = format!("{seconds} is not a number of seconds above 0 and up to {LONGEST_DEADLINE}");
        ("deadline_seconds", problem)
    })?;
    Ok(Duration::from_secs_f64(seconds))
}

fn points(field: &str, positions: Option<v1::Positions>, limits: &Limits) -> Result<(Vec<f64>, usize), ConvertError> {
    let positions = positions.ok_or_else(|| ConvertError::missing(field))?;
    single_precision(&positions.single_coordinates, || format!("{field}.single_coordinates"))?;
    let (values, dims) = match positions.array {
        Some(array) => {
            let path = format!("{field}.array");
            let shape = arrays::shape_of(&path, Some(&array), 2)?;
            (arrays::to_f64(&path, Some(array), &shape)?, shape[1])
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
    coordinates(&values, |place| format!("{field}.coordinates[{place}]"))?;
    Ok((values, dims))
}

/// Refuses what a client of an earlier release sends in place of coordinates: without it the team would look empty.
pub(crate) fn single_precision(values: &[f32], path: impl Fn() -> String) -> Result<(), ConvertError> {
    ConvertError::ensure(values.is_empty(), || {
        let problem = "coordinates in single precision, as clients of 0.2.0 and before send them; generate the client's stubs anew \
                       from proto/: coordinates are double now";
        (path(), problem.to_owned())
    })
}

/// Checks coordinates; `path` is the field of each.
pub(crate) fn coordinates(values: &[f64], path: impl Fn(usize) -> String) -> Result<(), ConvertError> {
    let wrong = values.iter().position(|value| value.is_nan() || value.abs() > LARGEST_COORDINATE);
    let Some(place) = wrong else { return Ok(()) };
    let problem = format!("{} is not a finite number up to {LARGEST_COORDINATE:e} in magnitude", values[place]);
    Err(ConvertError::new(path(place), problem))
}

/// Checks a cost matrix against the number of positions, if there are any. Returns its shape.
fn check_matrix(
    costs: &v1::CostMatrix,
    counts: Option<(usize, usize)>,
    limits: &Limits,
) -> Result<(usize, usize), ConvertError> {
    let (agents, goals) = (costs.agents as usize, costs.goals as usize);
    check_counts("costs", (agents, goals), counts, limits)?;
    ConvertError::ensure(costs.values.len() == agents * goals, || {
        ("costs.values", format!("{} numbers do not fill {agents} x {goals}", costs.values.len()))
    })?;
    if let Some(place) = costs.values.iter().position(|&value| !usable(value)) {
        pair_cost(costs.values[place], || format!("costs.values[{place}]"))?;
    }
    Ok((agents, goals))
}

/// Checks numbers of members against the limit and the number of positions.
fn check_counts(
    field: &str,
    (agents, goals): (usize, usize),
    counts: Option<(usize, usize)>,
    limits: &Limits,
) -> Result<(), ConvertError> {
    let (agent_points, goal_points) = counts.unzip();
    for (side, found, points) in [("agents", agents, agent_points), ("goals", goals, goal_points)] {
        let path = || format!("{field}.{side}");
        ConvertError::ensure(found <= limits.members, || {
            (path(), format!("{found} exceed the limit of {}", limits.members))
        })?;
        if let Some(points) = points.filter(|&points| points != found) {
            return Err(ConvertError::new(path(), format!("{found}, but there are {points} positions")));
        }
    }
    Ok(())
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
        Ok((members, pair_cost(item.cost, || format!("{field}[{k}].cost"))?))
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
        let agent = one(&self.agents, &pair.agent_id, pair.agent_index, ["agent_id", "agent_index"])?;
        let goal = one(&self.goals, &pair.goal_id, pair.goal_index, ["goal_id", "goal_index"])?;
        Ok((agent, goal))
    }
}

/// A member by name, or by index without one; `names` are the two fields.
fn one(side: &(&HashMap<&str, u32>, usize), id: &str, index: u32, names: [&str; 2]) -> Result<u32, ConvertError> {
    match id {
        "" if (index as usize) < side.1 => Ok(index),
        "" => Err(ConvertError::new(names[1], format!("{index} is not below {}", side.1))),
        id => side.0.get(id).copied().ok_or_else(|| ConvertError::new(names[0], "no member has this name")),
    }
}

/// The current goal of each agent, `[N]`: an agent has one, and a goal as many agents as it takes.
fn current_goals(current: &[(u32, u32)], agents: usize, terms: &Terms) -> Result<Vec<u32>, ConvertError> {
    if current.is_empty() {
        return Ok(Vec::new());
    }
    let (mut goal_of, mut taken) = (vec![UNASSIGNED; agents], HashMap::new());
    for (k, &(agent, goal)) in current.iter().enumerate() {
        let places = taken.entry(goal).or_insert(0);
        *places += 1;
        if goal_of[agent as usize] != UNASSIGNED || *places > terms.capacity(goal as usize) {
            let problem = format!("its agent or its goal is in another pair too; {}", terms::ROUTING);
            return Err(ConvertError::new(format!("current[{k}]"), problem));
        }
        goal_of[agent as usize] = goal;
    }
    Ok(goal_of)
}

/// Checks sparse costs against the number of positions, if there are any. Returns the allowed pairs.
fn sparse_pairs(
    sparse: &v1::SparseCosts,
    counts: Option<(usize, usize)>,
    limits: &Limits,
) -> Result<Vec<(u32, u32, f64)>, ConvertError> {
    check_counts("sparse_costs", (sparse.agents as usize, sparse.goals as usize), counts, limits)?;
    let pairs = sparse.values.len();
    for (field, indices, below) in
        [("agent_indices", &sparse.agent_indices, sparse.agents), ("goal_indices", &sparse.goal_indices, sparse.goals)]
    {
        let path = format!("sparse_costs.{field}");
        let found = indices.len();
        ConvertError::ensure(found == pairs, || (path.as_str(), format!("{found} indices for {pairs} values")))?;
        if let Some(place) = indices.iter().position(|index| *index >= below) {
            let problem = format!("{} is not below {below}", indices[place]);
            return Err(ConvertError::new(format!("{path}[{place}]"), problem));
        }
    }
    let both = sparse.agent_indices.iter().zip(&sparse.goal_indices).zip(&sparse.values).enumerate();
    both.map(|(k, ((&agent, &goal), &cost))| {
        Ok((agent, goal, pair_cost(cost, || format!("sparse_costs.values[{k}]"))?))
    })
    .collect()
}
