//! Members and settings of a mission, as requests bring them.

use super::{MissionLimits, Names, TRAINING_PREFIX};
use crate::DispatchError;
use crate::problem::{LONGEST_ID, scheduler};
use magex_proto::convert::ConvertError;
use magex_proto::goals::SchedulerKind;
use magex_proto::v1;
use std::collections::{BTreeSet, HashMap, HashSet};

/// Most pairs that a mission forbids, or prices, and longest list in a request.
pub(super) fn most_pairs(limits: &MissionLimits) -> usize {
    limits.members.saturating_mul(10)
}

/// Refuses lists that nobody needs before anything goes through them.
pub(super) fn check_lengths(limits: &MissionLimits, lists: &[(&str, usize)]) -> Result<(), DispatchError> {
    let most = most_pairs(limits);
    match lists.iter().find(|(_, count)| *count > most) {
        Some((field, count)) => {
            Err(DispatchError::invalid(*field, format!("{count} entries are more than {most}; send fewer at a time")))
        }
        None => Ok(()),
    }
}

/// The names of a mission's members.
pub(super) struct Known<'a> {
    agents: HashSet<&'a str>,
    goals: HashSet<&'a str>,
}

impl<'a> Known<'a> {
    pub(super) fn of(assignment: &'a v1::Assignment) -> Self {
        let ids = |members: &'a [v1::Member]| members.iter().map(|member| member.id.as_str()).collect();
        Self { agents: ids(&assignment.agents), goals: ids(&assignment.goals) }
    }

    /// A mission's members come and go: only names mean anything.
    pub(super) fn names(&self, pair: &v1::PairRef) -> Result<Names, ConvertError> {
        let known = |field: &str, members: &HashSet<&str>, id: &str| match members.contains(id) {
            true => Ok(()),
            false if id.is_empty() => Err(ConvertError::new(field, "missing; missions name pairs by id, not by index")),
            false => Err(ConvertError::new(field, "no member has this name")),
        };
        known("agent_id", &self.agents, &pair.agent_id)?;
        known("goal_id", &self.goals, &pair.goal_id)?;
        Ok((pair.agent_id.clone(), pair.goal_id.clone()))
    }
}

/// Adds new members, and changes those that are there.
pub(super) fn merge(
    field: &str,
    members: &mut Vec<v1::Member>,
    updates: Vec<v1::Member>,
    dims: usize,
    limits: &MissionLimits,
) -> Result<(), DispatchError> {
    let mut places: HashMap<String, usize> = members.iter().enumerate().map(|(k, m)| (m.id.clone(), k)).collect();
    let mut seen = BTreeSet::new();
    for (k, update) in updates.into_iter().enumerate() {
        let wrong = |part: &str, problem: String| Err(DispatchError::invalid(format!("{field}[{k}].{part}"), problem));
        if update.id.is_empty() || update.id.len() > LONGEST_ID {
            return wrong("id", format!("{} bytes; a name has 1 to {LONGEST_ID}", update.id.len()));
        }
        if !seen.insert(update.id.clone()) {
            return wrong("id", "the same name occurs before".to_owned());
        }
        let Ok(state) = v1::MemberState::try_from(update.state) else {
            return wrong("state", format!("{} is unknown", update.state));
        };
        if let Some(axis) = update.position.iter().position(|x| !x.is_finite()) {
            return wrong(&format!("position[{axis}]"), format!("{} is not finite", update.position[axis]));
        }
        let known = places.get(&update.id).copied();
        if !(known.is_some() && update.position.is_empty()) {
            if !(2..=3).contains(&update.position.len()) {
                return wrong("position", format!("{} coordinates are not 2 or 3", update.position.len()));
            }
            if update.position.len() != dims {
                return wrong("position", format!("{} coordinates, others have {dims}", update.position.len()));
            }
        }
        match known {
            Some(place) => {
                let member = &mut members[place];
                if !update.position.is_empty() {
                    member.position = update.position;
                }
                if state != v1::MemberState::Unspecified {
                    member.state = state.into();
                }
            }
            None => {
                if members.len() >= limits.members {
                    return wrong("id", format!("a mission has at most {} {field}", limits.members));
                }
                let state = if state == v1::MemberState::Unspecified { v1::MemberState::Active } else { state };
                places.insert(update.id.clone(), members.len());
                members.push(v1::Member { state: state.into(), ..update });
            }
        }
    }
    Ok(())
}

pub(super) fn sticky_scheduler(value: i32) -> Result<Option<SchedulerKind>, DispatchError> {
    let kind = scheduler("scheduler", value)?;
    if kind == Some(SchedulerKind::Random) {
        return Err(DispatchError::invalid(
            "scheduler",
            "a mission cannot be random; use exact, makespan, greedy or learned",
        ));
    }
    Ok(kind)
}

pub(super) fn check_id(id: &str) -> Result<(), DispatchError> {
    let fits = id.len() <= LONGEST_ID && id.bytes().all(|b| b.is_ascii_alphanumeric() || b"._-".contains(&b));
    if fits && !id.is_empty() && !id.starts_with(TRAINING_PREFIX) {
        return Ok(());
    }
    let problem =
        format!("a name has up to {LONGEST_ID} of A-Z a-z 0-9 . _ - and does not begin with '{TRAINING_PREFIX}'");
    Err(DispatchError::invalid("mission_id", problem))
}

pub(super) fn lifetime(seconds: Option<f64>, limits: &MissionLimits) -> Result<i64, DispatchError> {
    let Some(seconds) = seconds else { return Ok(limits.lifetime_ms) };
    let most = limits.lifetime_ms as f64 / 1e3;
    if seconds > 0.0 && seconds <= most {
        return Ok(((seconds * 1e3) as i64).max(1));
    }
    Err(DispatchError::invalid("lifetime_seconds", format!("{seconds} is not above 0 and up to {most}")))
}
