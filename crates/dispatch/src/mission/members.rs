//! Checks the members and settings of a mission in requests and records.

use super::{MissionLimits, Names, TRAINING_PREFIX};
use crate::problem::{LONGEST_ID, check_name, finite_cost, scheduler, switching_cost};
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use magex_proto::{arrays, v1};
use std::collections::{BTreeSet, HashMap, HashSet};

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

/// Adds new members and updates existing ones.
pub(super) fn merge(
    field: &str,
    members: &mut Vec<v1::Member>,
    updates: Vec<v1::Member>,
    dims: usize,
    limits: &MissionLimits,
) -> Result<(), ConvertError> {
    let mut places: HashMap<String, usize> = members.iter().enumerate().map(|(k, m)| (m.id.clone(), k)).collect();
    let mut seen = BTreeSet::new();
    for (k, update) in updates.into_iter().enumerate() {
        let path = |part: &str| format!("{field}[{k}].{part}");
        check_name(&update.id, || path("id"))?;
        ConvertError::ensure(seen.insert(update.id.clone()), || (path("id"), "duplicate name"))?;
        let state = v1::MemberState::try_from(update.state).map_err(|_| {
            let problem = format!("{} is not a state; use active, failed or finished", update.state);
            ConvertError::new(path("state"), problem)
        })?;
        let position = arrays::finite(&path("position"), update.position)?;
        let (known, count) = (places.get(&update.id).copied(), position.len());
        if known.is_none() || count > 0 {
            ConvertError::ensure((2..=3).contains(&count), || {
                (path("position"), format!("{count} coordinates; give 2 or 3"))
            })?;
            ConvertError::ensure(count == dims, || {
                (path("position"), format!("{count} coordinates, but other members have {dims}"))
            })?;
        }
        match known {
            Some(place) => {
                let member = &mut members[place];
                if count > 0 {
                    member.position = position;
                }
                if state != v1::MemberState::Unspecified {
                    member.state = state.into();
                }
            }
            None => {
                let most = limits.members;
                ConvertError::ensure(members.len() < most, || {
                    (path("id"), format!("a mission has at most {most} {field}"))
                })?;
                let state = if state == v1::MemberState::Unspecified { v1::MemberState::Active } else { state };
                places.insert(update.id.clone(), members.len());
                members.push(v1::Member { id: update.id, position, state: state.into() });
            }
        }
    }
    Ok(())
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
    let dims = a.agents.iter().chain(&a.goals).map(|member| member.position.len()).next().unwrap_or(2);
    for (field, members) in [("agents", &a.agents), ("goals", &a.goals)] {
        let mut seen = HashSet::new();
        for (k, member) in members.iter().enumerate() {
            if member.id.is_empty() || !seen.insert(member.id.as_str()) {
                return wrong(format!("{field}[{k}].id"), "empty or duplicate name");
            }
            let position = &member.position;
            if position.len() != dims || !(2..=3).contains(&dims) || position.iter().any(|x| !x.is_finite()) {
                let problem = "coordinates are not finite, or their number differs from other members";
                return wrong(format!("{field}[{k}].position"), problem);
            }
            if !v1::MemberState::try_from(member.state).is_ok_and(|state| state != v1::MemberState::Unspecified) {
                return wrong(format!("{field}[{k}].state"), "unknown");
            }
        }
    }
    let (mut agents, mut goals) = (HashSet::new(), HashSet::new());
    for (k, pair) in a.pairs.iter().enumerate() {
        if !agents.insert(pair.agent_id.as_str()) || !goals.insert(pair.goal_id.as_str()) {
            return wrong(format!("pairs[{k}]"), "its agent or goal is in another pair");
        }
    }
    for (k, item) in overrides.iter().enumerate() {
        finite_cost(item.cost, || format!("cost_overrides[{k}].cost"))?;
    }
    Ok(())
}
