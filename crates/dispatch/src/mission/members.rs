//! Checks the members and settings of a mission in requests and records.

use super::{MissionLimits, Names, TRAINING_PREFIX};
use crate::problem::{LONGEST_ID, check_name, coordinates, pair_cost, scheduler, single_precision, switching_cost};
use crate::terms::{DURATIONS, SPEEDS, TIMES, WEIGHTS, no_circle, power, within};
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::ops::RangeInclusive;

/// Maximum number of forbidden pairs, of cost overrides, and of entries of a list in a request.
pub(super) fn most_pairs(limits: &MissionLimits) -> usize {
    limits.members.saturating_mul(10)
}

/// Rejects oversized lists before they are processed.
pub(super) fn check_lengths(limits: &MissionLimits, lists: &[(&str, usize)]) -> Result<(), ConvertError> {
    let most = most_pairs(limits);
    for &(field, count) in lists {
        ConvertError::ensure(count <= most, || {
            (field, format!("{count} entries exceed the limit of {most}; send fewer at a time"))
        })?;
    }
    Ok(())
}

/// The names of a mission's members.
pub(super) struct MemberNames<'a> {
    agents: HashSet<&'a str>,
    goals: HashSet<&'a str>,
}

impl<'a> MemberNames<'a> {
    pub(super) fn of(assignment: &'a v1::Assignment) -> Self {
        let ids = |members: &'a [v1::Member]| members.iter().map(|member| member.id.as_str()).collect();
        Self { agents: ids(&assignment.agents), goals: ids(&assignment.goals) }
    }

    /// Resolves a pair by name: indices change when members are removed.
    pub(super) fn names(&self, pair: &v1::PairRef) -> Result<Names, ConvertError> {
        let sides = [("agent_id", &self.agents, &pair.agent_id), ("goal_id", &self.goals, &pair.goal_id)];
        for (field, members, id) in sides {
            ConvertError::ensure(!id.is_empty(), || {
                (field, "missing; pairs of a mission are named by id, not by index")
            })?;
            ConvertError::ensure(members.contains(id.as_str()), || (field, "no member has this name"))?;
        }
        Ok((pair.agent_id.clone(), pair.goal_id.clone()))
    }
}

/// Finished members that are kept on each side: of earlier ones, the first in the list are forgotten.
pub const FINISHED_KEPT: usize = 100;

/// Forgets finished members beyond [`FINISHED_KEPT`]. Returns their names.
pub(super) fn forget(members: &mut Vec<v1::Member>) -> HashSet<String> {
    let finished = |member: &v1::Member| member.state() == v1::MemberState::Finished;
    let mut surplus = members.iter().filter(|member| finished(member)).count().saturating_sub(FINISHED_KEPT);
    let mut forgotten = HashSet::new();
    if surplus > 0 {
        members.retain(|member| {
            let goes = surplus > 0 && finished(member);
            if goes {
                surplus -= 1;
                forgotten.insert(member.id.clone());
            }
            !goes
        });
    }
    forgotten
}

/// A side of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Agents,
    Goals,
}

impl Side {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Agents => "agents",
            Self::Goals => "goals",
        }
    }
}

/// Adds new members and updates existing ones. `priced` are the names on this side whose pairs are given costs.
pub(super) fn merge(
    side: Side,
    members: &mut Vec<v1::Member>,
    updates: Vec<v1::Member>,
    dims: usize,
    priced: &HashSet<String>,
    limits: &MissionLimits,
) -> Result<(), ConvertError> {
    let field = side.name();
    let mut places: HashMap<String, usize> = members.iter().enumerate().map(|(k, m)| (m.id.clone(), k)).collect();
    let mut seen = BTreeSet::new();
    for (k, update) in updates.into_iter().enumerate() {
        let path = |part: &str| format!("{field}[{k}].{part}");
        check_name(&update.id, || path("id"))?;
        ConvertError::ensure(seen.insert(update.id.clone()), || (path("id"), "duplicate name"))?;
        v1::MemberState::try_from(update.state).map_err(|_| {
            let problem = format!("{} is not a state; use active, failed or finished", update.state);
            ConvertError::new(path("state"), problem)
        })?;
        single_precision(&update.single_position, || path("single_position"))?;
        coordinates(&update.position, |place| format!("{field}[{k}].position[{place}]"))?;
        let count = update.position.len();
        // A name that is not known and has no position is a slip, unless its pairs have costs.
        let placed = count > 0 || places.contains_key(&update.id) || priced.contains(&update.id);
        ConvertError::ensure(placed && (count == 0 || (2..=3).contains(&count)), || {
            (path("position"), format!("{count} coordinates; give 2 or 3, or the costs of its pairs in cost_overrides"))
        })?;
        ConvertError::ensure(count == 0 || count == dims, || {
            (path("position"), format!("{count} coordinates, but other members have {dims}"))
        })?;
        let place = *places.entry(update.id.clone()).or_insert_with(|| {
            members.push(v1::Member {
                id: update.id.clone(),
                state: v1::MemberState::Active.into(),
                ..Default::default()
            });
            members.len() - 1
        });
        let member = &mut members[place];
        if count > 0 {
            member.position = update.position;
        }
        if update.state != i32::from(v1::MemberState::Unspecified) {
            member.state = update.state;
        }
        member.speed = update.speed.or(member.speed);
        member.busy_until = update.busy_until.or(member.busy_until);
        member.load = update.load.or(member.load);
        member.weight = update.weight.or(member.weight);
        member.capacity = update.capacity.or(member.capacity);
        member.earliest = update.earliest.or(member.earliest);
        member.due = update.due.or(member.due);
        member.after = update.after.or_else(|| member.after.take());
        check_terms(side, member, path)?;
    }
    let (most, kept) = (limits.members, |member: &&v1::Member| member.state() != v1::MemberState::Finished);
    let count = members.iter().filter(kept).count();
    ConvertError::ensure(count <= most && members.len() <= 2 * most + FINISHED_KEPT, || {
        (
            field,
            format!(
                "a mission has at most {most} {field} that are not finished; finish some, or name them in remove_{field}"
            ),
        )
    })
}

/// Checks the terms of a member by the rules of requests.
pub(super) fn check_terms(side: Side, member: &v1::Member, path: impl Fn(&str) -> String) -> Result<(), ConvertError> {
    let own = [
        ("speed", member.speed.is_some()),
        ("busy_until", member.busy_until.is_some()),
        ("load", member.load.is_some()),
    ];
    let others = [
        ("weight", member.weight.is_some()),
        ("capacity", member.capacity.is_some()),
        ("earliest", member.earliest.is_some()),
        ("due", member.due.is_some()),
        ("after", member.after.is_some()),
    ];
    let (foreign, owner) = match side {
        Side::Agents => (&others[..], "goals"),
        Side::Goals => (&own[..], "agents"),
    };
    if let Some((name, _)) = foreign.iter().find(|(_, set)| *set) {
        return Err(ConvertError::new(path(name), format!("only {owner} have it")));
    }
    let check = |value: Option<f64>, range: &RangeInclusive<f64>, name: &str| match value {
        Some(value) => within(value, range, || path(name)).map(drop),
        None => Ok(()),
    };
    check(member.speed, &SPEEDS, "speed")?;
    check(member.busy_until, &TIMES, "busy_until")?;
    check(member.load, &DURATIONS, "load")?;
    check(member.weight, &WEIGHTS, "weight")?;
    check(member.earliest, &TIMES, "earliest")?;
    check(member.due.filter(|due| *due != f64::INFINITY), &TIMES, "due")?;
    ConvertError::ensure(member.capacity != Some(0), || (path("capacity"), "0 agents; leave the goal out"))?;
    let (earliest, due) = (member.earliest.unwrap_or(f64::NEG_INFINITY), member.due.unwrap_or(f64::INFINITY));
    ConvertError::ensure(earliest <= due, || (path("due"), format!("{due} is before earliest, which is {earliest}")))
}

/// Checks what goals wait for: known goals, and no circle.
pub(super) fn check_order(goals: &[v1::Member]) -> Result<(), ConvertError> {
    if goals.iter().all(|goal| goal.after.is_none()) {
        return Ok(());
    }
    let places: HashMap<&str, u32> = (0u32..).zip(goals).map(|(k, goal)| (goal.id.as_str(), k)).collect();
    let mut after = Vec::new();
    for (k, goal) in (0u32..).zip(goals) {
        for (place, first) in goal.after.iter().flat_map(|names| &names.goal_ids).enumerate() {
            let found = places.get(first.as_str()).ok_or_else(|| {
                let field = format!("goals[{}].after.goal_ids[{place}]", goal.id);
                ConvertError::new(field, "no goal has this name; one that was finished long ago need not be named")
            })?;
            after.push((k, *found));
        }
    }
    no_circle(goals.len(), &after, |goal| format!("'{}'", goals[goal as usize].id), "after")
}

pub(super) fn sticky_scheduler(value: i32) -> Result<Option<AssignmentMethod>, ConvertError> {
    let kind = scheduler(value)?;
    ConvertError::ensure(kind != Some(AssignmentMethod::Random), || {
        ("scheduler", "random is not allowed for a mission; use exact, makespan, greedy or learned")
    })?;
    Ok(kind)
}

pub(super) fn check_id(id: &str) -> Result<(), ConvertError> {
    let fits = id.len() <= LONGEST_ID && id.bytes().all(|b| b.is_ascii_alphanumeric() || b"._-".contains(&b));
    ConvertError::ensure(fits && !id.is_empty() && !id.starts_with(TRAINING_PREFIX), || {
        let form =
            format!("use 1 to {LONGEST_ID} characters of A-Z a-z 0-9 . _ -, not starting with '{TRAINING_PREFIX}'");
        ("mission_id", form)
    })
}

pub(super) fn lifetime(seconds: Option<f64>, limits: &MissionLimits) -> Result<i64, ConvertError> {
    let Some(seconds) = seconds else { return Ok(limits.lifetime_ms) };
    let most = limits.lifetime_ms as f64 / 1e3;
    ConvertError::ensure(seconds > 0.0 && seconds <= most, || {
        ("lifetime_seconds", format!("{seconds} is outside 0..={most}; give a positive number"))
    })?;
    Ok(((seconds * 1e3) as i64).max(1))
}

/// Checks a record by the rules of requests, on which updates rely.
pub(super) fn check_record(a: &v1::Assignment, overrides: &[v1::PairCost]) -> Result<(), ConvertError> {
    let wrong = |field: String, problem: &str| Err(ConvertError::new(field, problem.to_owned()));
    check_id(&a.mission_id)?;
    sticky_scheduler(a.scheduler)?;
    switching_cost(a.switching_cost)?;
    if a.revision == u64::MAX {
        return wrong("revision".to_owned(), "u64::MAX cannot be incremented");
    }
    power(Some(a.power))?;
    within(a.balance, &DURATIONS, || "balance".to_owned())?;
    within(a.time, &TIMES, || "time".to_owned())?;
    let dims = a.agents.iter().chain(&a.goals).map(|member| member.position.len()).find(|&len| len > 0).unwrap_or(2);
    for (side, members) in [(Side::Agents, &a.agents), (Side::Goals, &a.goals)] {
        let (field, mut seen) = (side.name(), HashSet::new());
        for (k, member) in members.iter().enumerate() {
            if member.id.is_empty() || !seen.insert(member.id.as_str()) {
                return wrong(format!("{field}[{k}].id"), "empty or duplicate name");
            }
            let position = &member.position;
            if !position.is_empty() && (position.len() != dims || !(2..=3).contains(&dims)) {
                let problem = "the number of coordinates differs from other members";
                return wrong(format!("{field}[{k}].position"), problem);
            }
            coordinates(position, |place| format!("{field}[{k}].position[{place}]"))?;
            if !v1::MemberState::try_from(member.state).is_ok_and(|state| state != v1::MemberState::Unspecified) {
                return wrong(format!("{field}[{k}].state"), "unknown");
            }
            check_terms(side, member, |part| format!("{field}[{k}].{part}"))?;
        }
    }
    check_order(&a.goals)?;
    let capacities: HashMap<&str, u32> =
        a.goals.iter().map(|goal| (goal.id.as_str(), goal.capacity.unwrap_or(1))).collect();
    let (mut agents, mut goals) = (HashSet::new(), HashMap::new());
    for (k, pair) in a.pairs.iter().enumerate() {
        let taken = goals.entry(pair.goal_id.as_str()).or_insert(0u32);
        *taken += 1;
        if !agents.insert(pair.agent_id.as_str())
            || *taken > capacities.get(pair.goal_id.as_str()).copied().unwrap_or(1)
        {
            return wrong(format!("pairs[{k}]"), "its agent or goal is in another pair");
        }
    }
    for (k, item) in overrides.iter().enumerate() {
        pair_cost(item.cost, || format!("cost_overrides[{k}].cost"))?;
    }
    Ok(())
}
