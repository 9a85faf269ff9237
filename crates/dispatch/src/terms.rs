//! The words of a fleet beside distances: what a pair costs, and which pairs are possible.
//!
//! A pair costs `weight · time ^ power` with `time = offset + d / speed + wait / 2`. An agent that is there before `earliest` waits; a
//! second of waiting counts as half a second of driving, so that of two agents that must wait the nearer one goes. A pair whose
//! agent comes after `due` is impossible, as is one with a goal that is not open.

use magex_assign::POWERS;
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use std::ops::RangeInclusive;

/// Speeds, units per second.
pub(crate) const SPEEDS: RangeInclusive<f64> = 1e-12..=1e12;
/// Durations in seconds, and loads.
pub(crate) const DURATIONS: RangeInclusive<f64> = 0.0..=1e12;
/// Times on a client's clock, seconds.
pub(crate) const TIMES: RangeInclusive<f64> = -1e12..=1e12;
/// Weights of goals.
pub(crate) const WEIGHTS: RangeInclusive<f64> = 1e-6..=1e6;
/// What a second of waiting counts as, in seconds of driving.
const WAITING: f64 = 0.5;

/// What the costs of a team are made of. An empty list stands for the neutral value of every member.
#[derive(Debug, Clone, PartialEq)]
pub struct Terms {
    /// Exponent.
    pub power: f64,
    /// `[N]` units per second; 1.
    pub speeds: Vec<f64>,
    /// `[N]` how long each agent is busy, with its load; 0.
    pub offsets: Vec<f64>,
    /// `[G]` priority; 1.
    pub weights: Vec<f64>,
    /// `[G]` agents that the goal takes; 1.
    pub capacities: Vec<u32>,
    /// `[G]` when the goal can be begun; 0.
    pub earliest: Vec<f64>,
    /// `[G]` when the goal must be begun at the latest; +∞.
    pub due: Vec<f64>,
    /// `[G]` the goal waits for another one.
    pub closed: Vec<bool>,
    /// (agent, goal) pairs that are decided.
    pub pinned: Vec<(u32, u32)>,
}

impl Default for Terms {
    fn default() -> Self {
        let (none, power) = (Vec::new(), 1.0);
        Self {
            power,
            speeds: none.clone(),
            offsets: none.clone(),
            weights: none.clone(),
            capacities: Vec::new(),
            earliest: none.clone(),
            due: none,
            closed: Vec::new(),
            pinned: Vec::new(),
        }
    }
}

/// When an agent is at a goal, and what that counts as.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Visit {
    /// When it begins there.
    pub(crate) arrival: f64,
    /// The base of the power.
    pub(crate) time: f64,
    /// It comes after the goal's due time.
    pub(crate) late: bool,
}

impl Terms {
    /// Whether distances are the costs.
    pub fn plain(&self) -> bool {
        self.power == 1.0 && !self.timed() && self.weights.is_empty() && !self.limits()
    }

    /// Whether arrivals are more than distances.
    pub fn timed(&self) -> bool {
        !(self.speeds.is_empty() && self.offsets.is_empty() && self.earliest.is_empty() && self.due.is_empty())
    }

    /// Whether goals take more than one agent, or pairs are impossible or decided.
    fn limits(&self) -> bool {
        !self.capacities.is_empty() || !self.pinned.is_empty() || self.forbids()
    }

    /// Whether a pair may be impossible.
    pub(crate) fn forbids(&self) -> bool {
        !self.due.is_empty() || self.closed.contains(&true) || !self.pinned.is_empty()
    }

    /// Whether goals differ in weight: then it matters which of them are left.
    pub(crate) fn weighted(&self) -> bool {
        self.weights.iter().any(|weight| Some(weight) != self.weights.first())
    }

    /// An agent's visit of a goal at distance `d`.
    pub(crate) fn visit(&self, agent: usize, goal: usize, d: f64) -> Visit {
        let drive = match self.speeds.get(agent) {
            Some(speed) => d / speed,
            None => d,
        };
        let there = match self.offsets.get(agent) {
            Some(offset) => offset + drive,
            None => drive,
        };
        let late = self.due.get(goal).is_some_and(|due| there.max(self.earliest_of(goal)) > *due);
        match self.earliest.get(goal) {
            Some(&earliest) if there < earliest => {
                Visit { arrival: earliest, time: there + WAITING * (earliest - there), late }
            }
            _ => Visit { arrival: there, time: there, late },
        }
    }

    fn earliest_of(&self, goal: usize) -> f64 {
        self.earliest.get(goal).copied().unwrap_or(f64::NEG_INFINITY)
    }

    /// Priority of a goal.
    pub(crate) fn weight(&self, goal: usize) -> f64 {
        self.weights.get(goal).copied().unwrap_or(1.0)
    }

    /// Agents that a goal takes.
    pub(crate) fn capacity(&self, goal: usize) -> u32 {
        self.capacities.get(goal).copied().unwrap_or(1)
    }

    /// Whether a goal is open.
    pub(crate) fn open(&self, goal: usize) -> bool {
        !self.closed.get(goal).is_some_and(|closed| *closed)
    }
}

/// A number in a range, which the error names.
pub(crate) fn within(
    value: f64,
    range: &RangeInclusive<f64>,
    field: impl FnOnce() -> String,
) -> Result<f64, ConvertError> {
    ConvertError::ensure(range.contains(&value), || {
        let shown = |bound: f64| {
            if (1e-3..1e4).contains(&bound) || bound == 0.0 { format!("{bound}") } else { format!("{bound:e}") }
        };
        (field(), format!("{value} is not a number from {} to {}", shown(*range.start()), shown(*range.end())))
    })?;
    Ok(value)
}

/// The exponent; 1 unless it is set.
pub(crate) fn power(value: Option<f64>) -> Result<f64, ConvertError> {
    within(value.unwrap_or(1.0), &POWERS, || "power".to_owned())
}

/// A due time: a duration, or +∞.
pub(crate) fn due(value: f64, field: impl FnOnce() -> String) -> Result<f64, ConvertError> {
    if value == f64::INFINITY { Ok(value) } else { within(value, &DURATIONS, field) }
}

/// Checks that no goal waits for itself: `after` are (goal, the one before it). The error names the goals of a circle.
pub(crate) fn no_circle(
    goals: usize,
    after: &[(u32, u32)],
    name: impl Fn(u32) -> String,
    field: &str,
) -> Result<(), ConvertError> {
    let mut before = vec![Vec::new(); goals];
    after.iter().for_each(|&(goal, first)| before[goal as usize].push(first));
    // 0: not seen, 1: on the path, 2: done.
    let mut seen = vec![0u8; goals];
    for start in 0..goals as u32 {
        let mut path = vec![(start, 0)];
        while let Some((goal, next)) = path.pop() {
            if next == 0 {
                if seen[goal as usize] == 2 {
                    continue;
                }
                seen[goal as usize] = 1;
            }
            match before[goal as usize].get(next) {
                Some(&first) => {
                    path.push((goal, next + 1));
                    if seen[first as usize] == 1 {
                        let from = path.iter().position(|&(other, _)| other == first).unwrap_or_default();
                        let mut circle: Vec<String> = path[from..].iter().map(|&(goal, _)| name(goal)).collect();
                        circle.truncate(8);
                        circle.push(name(first));
                        return Err(ConvertError::new(
                            field,
                            format!("a circle, in which no goal can be the first: {}", circle.join(" waits for ")),
                        ));
                    }
                    path.push((first, 0));
                }
                None => seen[goal as usize] = 2,
            }
        }
    }
    Ok(())
}

/// What an agent with several goals is told.
pub(crate) const ROUTING: &str = "an agent has one goal at a time; several goals in a row for one agent are a routing problem \
    (vehicle routing), which this service does not solve: give the next goal when the first is finished";

/// Checks the pinned pairs by themselves: an agent once, a goal as often as it takes agents.
pub(crate) fn check_pinned(
    pinned: &[(u32, u32)],
    terms: &Terms,
    field: impl Fn(usize) -> String,
) -> Result<(), ConvertError> {
    let mut agents = std::collections::HashSet::new();
    let mut places: std::collections::HashMap<u32, u32> = std::collections::HashMap::new();
    for (k, &(agent, goal)) in pinned.iter().enumerate() {
        ConvertError::ensure(agents.insert(agent), || (field(k), format!("its agent is pinned twice; {ROUTING}")))?;
        let taken = places.entry(goal).or_default();
        *taken += 1;
        let capacity = terms.capacity(goal as usize);
        ConvertError::ensure(*taken <= capacity, || {
            (field(k), format!("{taken} agents are pinned to its goal, which takes {capacity}"))
        })?;
        ConvertError::ensure(terms.open(goal as usize), || {
            (field(k), "its goal waits for another one; leave out the pin or the precedence")
        })?;
    }
    Ok(())
}

/// Reads the terms of a request. `resolve` finds the members of a pair, `goal_of` a goal by index or name.
pub(crate) fn read(
    message: &mut v1::AssignRequest,
    (agents, goals): (usize, usize),
    members: usize,
    pinned: Vec<(u32, u32)>,
    goal_ids: &[String],
    goal_of: impl Fn(u32, &str, [&str; 2]) -> Result<u32, ConvertError>,
) -> Result<Terms, ConvertError> {
    let list = |field: &str, values: Vec<f64>, count: usize, range: &RangeInclusive<f64>| {
        one_each(field, values.len(), count)?;
        for (k, &value) in values.iter().enumerate() {
            within(value, range, || format!("{field}[{k}]"))?;
        }
        Ok::<_, ConvertError>(values)
    };
    let speeds = list("agent_speeds", std::mem::take(&mut message.agent_speeds), agents, &SPEEDS)?;
    let mut offsets = list("agent_offsets", std::mem::take(&mut message.agent_offsets), agents, &DURATIONS)?;
    let loads = list("agent_loads", std::mem::take(&mut message.agent_loads), agents, &DURATIONS)?;
    let balance = within(message.balance, &DURATIONS, || "balance".to_owned())?;
    ConvertError::ensure(balance == 0.0 || agents == 0 || !loads.is_empty(), || {
        ("balance", "agent_loads are missing, which it multiplies; give one each")
    })?;
    if balance > 0.0 && !loads.is_empty() {
        offsets.resize(agents, 0.0);
        offsets.iter_mut().zip(&loads).for_each(|(offset, load)| *offset += balance * load);
    }
    let weights = list("goal_weights", std::mem::take(&mut message.goal_weights), goals, &WEIGHTS)?;
    let earliest = list("goal_earliest", std::mem::take(&mut message.goal_earliest), goals, &DURATIONS)?;
    let due_times = std::mem::take(&mut message.goal_due);
    one_each("goal_due", due_times.len(), goals)?;
    for (k, &value) in due_times.iter().enumerate() {
        due(value, || format!("goal_due[{k}]"))?;
        if let Some(from) = earliest.get(k).filter(|from| **from > value) {
            let problem = format!("{value} is before goal_earliest[{k}], which is {from}");
            return Err(ConvertError::new(format!("goal_due[{k}]"), problem));
        }
    }
    let capacities = std::mem::take(&mut message.goal_capacities);
    one_each("goal_capacities", capacities.len(), goals)?;
    check_capacities(&capacities, agents, members, |k| format!("goal_capacities[{k}]"))?;
    let mut closed = Vec::new();
    let mut after = Vec::new();
    for (k, item) in message.precedence.iter().enumerate() {
        let within = |error: ConvertError| error.within(&format!("precedence[{k}]"));
        let goal = goal_of(item.goal_index, &item.goal_id, ["goal_id", "goal_index"]).map_err(within)?;
        let first = goal_of(item.after_index, &item.after_id, ["after_id", "after_index"]).map_err(within)?;
        closed.resize(goals, false);
        closed[goal as usize] = true;
        after.push((goal, first));
    }
    let name = |goal: u32| match goal_ids.get(goal as usize) {
        Some(id) => format!("'{id}'"),
        None => format!("goal {goal}"),
    };
    no_circle(goals, &after, name, "precedence")?;
    let power = power(message.power)?;
    let terms = Terms { power, speeds, offsets, weights, capacities, earliest, due: due_times, closed, pinned };
    check_pinned(&terms.pinned, &terms, |k| format!("pinned[{k}]"))?;
    Ok(terms)
}

/// Checks how many agents goals take; beyond the number of agents it does not matter.
pub(crate) fn check_capacities(
    capacities: &[u32],
    agents: usize,
    members: usize,
    field: impl Fn(usize) -> String,
) -> Result<(), ConvertError> {
    let mut places = 0usize;
    for (k, &capacity) in capacities.iter().enumerate() {
        ConvertError::ensure(capacity > 0, || (field(k), "0 agents; leave the goal out, or forbid its pairs"))?;
        places += (capacity as usize).min(agents.max(1));
        ConvertError::ensure(places <= members, || {
            (field(k), format!("the goals so far take {places} agents, more than the limit of {members} places"))
        })?;
    }
    Ok(())
}

fn one_each(field: &str, found: usize, count: usize) -> Result<(), ConvertError> {
    ConvertError::ensure(found == 0 || found == count, || {
        (field, format!("{found} numbers for {count} members; give one each or none"))
    })
}
