//! The life of missions: why goals change, what survives, and what is rejected.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_dispatch::answer::Planned;
use magex_dispatch::disk::{Disk, DiskError};
use magex_dispatch::engine;
use magex_dispatch::mission::{Mission, MissionLimits};
use magex_dispatch::missions::{Bounds, KeepError, Missions};
use magex_dispatch::{AssignError, Problem};
use magex_proto::v1;
use magex_proto::v1::{ChangeReason, MemberState, UnassignedReason};
use proptest::prelude::*;

const LIMITS: MissionLimits = MissionLimits { members: 20, lifetime_ms: 60_000 };

fn planner(problem: &Problem) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

fn member(id: &str, position: &[f64]) -> v1::Member {
    v1::Member { id: id.into(), position: position.to_vec(), ..Default::default() }
}

fn state(id: &str, state: MemberState) -> v1::Member {
    v1::Member { id: id.into(), state: state.into(), ..Default::default() }
}

fn pair(agent: &str, goal: &str) -> v1::PairRef {
    v1::PairRef { agent_id: agent.into(), goal_id: goal.into(), ..Default::default() }
}

/// Two agents on a line, each with a goal one unit away.
fn request(switching_cost: f64) -> v1::CreateMissionRequest {
    v1::CreateMissionRequest {
        mission_id: "m".into(),
        agents: vec![member("a", &[0.0, 0.0]), member("b", &[10.0, 0.0])],
        goals: vec![member("x", &[0.0, 1.0]), member("y", &[10.0, 1.0])],
        switching_cost,
        ..Default::default()
    }
}

fn start(switching_cost: f64) -> Mission {
    Mission::create(request(switching_cost), "me", "drawn", 1000, &LIMITS, &planner).unwrap()
}

fn change(mission: &Mission, request: v1::UpdateMissionRequest) -> Mission {
    mission.update(request, 2000, &LIMITS, &planner).unwrap()
}

fn goals(mission: &Mission) -> Vec<(&str, &str)> {
    mission.assignment.pairs.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect()
}

fn reasons(mission: &Mission) -> Vec<(&str, ChangeReason)> {
    mission.assignment.changes.iter().map(|c| (c.agent_id.as_str(), c.reason())).collect()
}

#[test]
fn a_mission_begins_with_all_agents_assigned() {
    let mission = start(0.5);
    let a = &mission.assignment;
    assert_eq!(goals(&mission), [("a", "x"), ("b", "y")]);
    assert_eq!(reasons(&mission), [("a", ChangeReason::Assigned), ("b", ChangeReason::Assigned)]);
    assert_eq!((a.revision, a.cost, a.gap, a.owner.as_str()), (1, 2.0, Some(0.0), "me"));
    assert_eq!((a.created_ms, a.updated_ms, a.expires_ms), (1000, 1000, 61_000));
}

#[test]
fn agents_keep_their_goals_unless_leaving_them_is_worth_it() {
    // Crossing over saves 1 + 1 - 0.6 = just below, or above, twice the switching cost.
    let cross = |switching_cost: f64| {
        let moved = vec![member("a", &[5.2, 1.0]), member("b", &[4.8, 1.0])];
        change(&start(switching_cost), v1::UpdateMissionRequest { agents: moved, ..Default::default() })
    };
    // Staying costs 5.2 + 5.2, crossing 4.8 + 4.8.
    let kept = cross(0.5);
    assert_eq!(goals(&kept), [("a", "x"), ("b", "y")]);
    assert!(kept.assignment.changes.is_empty());
    assert!((kept.assignment.cost - 10.4).abs() < 1e-5);
    assert!((kept.assignment.exact_cost.unwrap() - 9.6).abs() < 1e-5);
    assert!(kept.assignment.gap.unwrap() > 0.08);
    let crossed = cross(0.3);
    assert_eq!(goals(&crossed), [("a", "y"), ("b", "x")]);
    assert_eq!(reasons(&crossed), [("a", ChangeReason::Switched), ("b", ChangeReason::Switched)]);
    assert!((crossed.assignment.saving.unwrap() - 0.8).abs() < 1e-5);
    assert!((crossed.assignment.changes[0].gain.unwrap() - 0.4).abs() < 1e-5);
    assert!(
        crossed.assignment.changes[0].explanation.contains("fall by 0.8000, more than 2 x the switching cost of 0.3")
    );
}

#[test]
fn equal_alternatives_change_nothing_even_when_switching_is_free() {
    let moved = vec![member("a", &[5.0, 1.0]), member("b", &[5.0, 1.0])];
    let mission = change(&start(0.0), v1::UpdateMissionRequest { agents: moved, ..Default::default() });
    assert!(mission.assignment.changes.is_empty());
}

#[test]
fn failures_ends_and_removals_are_told_apart() {
    let mission = start(0.0);
    let one = |request: v1::UpdateMissionRequest| {
        let next = change(&mission, request);
        assert_eq!(next.assignment.revision, 2);
        (reasons(&next).iter().map(|&(a, r)| (a.to_owned(), r)).collect::<Vec<_>>(), next)
    };
    let agents = |s| v1::UpdateMissionRequest { agents: vec![state("a", s)], ..Default::default() };
    let goals_ = |s| v1::UpdateMissionRequest { goals: vec![state("x", s)], ..Default::default() };
    // The other agent is far away: it keeps its own goal.
    let (changed, next) = one(agents(MemberState::Failed));
    assert_eq!(changed, [("a".to_owned(), ChangeReason::AgentFailed)]);
    assert_eq!(next.assignment.agents_without_goal[0].reason(), UnassignedReason::Inactive);
    assert_eq!(next.assignment.goals_without_agent[0].reason(), UnassignedReason::Outnumbered);
    assert_eq!(one(agents(MemberState::Finished)).0, [("a".to_owned(), ChangeReason::AgentFinished)]);
    assert_eq!(one(goals_(MemberState::Failed)).0, [("a".to_owned(), ChangeReason::GoalFailed)]);
    assert_eq!(one(goals_(MemberState::Finished)).0, [("a".to_owned(), ChangeReason::GoalFinished)]);
    let removed = v1::UpdateMissionRequest { remove_agents: vec!["a".into()], ..Default::default() };
    assert_eq!(one(removed).0, [("a".to_owned(), ChangeReason::AgentRemoved)]);
    let removed = v1::UpdateMissionRequest { remove_goals: vec!["x".into()], ..Default::default() };
    assert_eq!(one(removed).0, [("a".to_owned(), ChangeReason::GoalRemoved)]);
    let banned = v1::UpdateMissionRequest { forbid: vec![pair("a", "x")], ..Default::default() };
    let (changed, next) = one(banned);
    // As many agents as possible have a goal: they exchange theirs.
    assert_eq!(changed, [("a".to_owned(), ChangeReason::PairForbidden), ("b".to_owned(), ChangeReason::Switched)]);
    let again = change(&next, v1::UpdateMissionRequest { allow: vec![pair("a", "x")], ..Default::default() });
    assert_eq!(goals(&again), [("a", "x"), ("b", "y")]);
}

#[test]
fn a_goal_that_appears_is_taken_and_an_empty_mission_waits() {
    let empty = v1::CreateMissionRequest { agents: vec![member("a", &[0.0, 0.0, 0.0])], ..Default::default() };
    let mission = Mission::create(empty, "me", "drawn", 0, &LIMITS, &planner).unwrap();
    assert_eq!((mission.id(), mission.assignment.pairs.len()), ("drawn", 0));
    assert_eq!(mission.assignment.agents_without_goal[0].reason(), UnassignedReason::Outnumbered);
    let goal = vec![member("x", &[3.0, 4.0, 0.0])];
    let mission = change(&mission, v1::UpdateMissionRequest { goals: goal, ..Default::default() });
    assert_eq!((goals(&mission), mission.assignment.cost), (vec![("a", "x")], 5.0));
}

#[test]
fn wrong_fields_are_named() {
    let created = |change: fn(&mut v1::CreateMissionRequest), words: &str| {
        let mut message = request(0.0);
        change(&mut message);
        let error = Mission::create(message, "me", "d", 0, &LIMITS, &planner).unwrap_err().to_string();
        assert!(error.starts_with(words), "{error} instead of {words}");
    };
    created(|m| m.mission_id = "a b".into(), "mission_id: use 1 to 128");
    created(|m| m.mission_id = "training.x".into(), "mission_id: use 1 to 128");
    created(|m| m.title = "x".repeat(300), "title: 300 bytes");
    created(|m| m.agents[1].id = "a".into(), "agents[1].id: duplicate name");
    created(|m| m.agents[1].id.clear(), "agents[1].id: 0 bytes");
    created(|m| m.agents[1].position.clear(), "agents[1].position: 0 coordinates");
    created(|m| m.goals[0].position = vec![0.0; 3], "goals[0].position: 3 coordinates, but other members have 2");
    created(|m| m.goals[0].position[1] = f64::NAN, "goals[0].position[1]: NaN");
    created(|m| m.goals[0].state = 9, "goals[0].state: 9");
    created(|m| m.scheduler = v1::AssignmentMethod::Random.into(), "scheduler: random is not allowed");
    created(|m| m.switching_cost = f64::INFINITY, "switching_cost: inf");
    created(|m| m.lifetime_seconds = Some(61.0), "lifetime_seconds: 61");
    created(|m| m.forbidden = vec![pair("a", "z")], "forbidden[0].goal_id: no member");
    created(|m| m.forbidden = vec![v1::PairRef::default()], "forbidden[0].agent_id: missing; pairs of a mission");
    created(
        |m| m.agents = (0..21).map(|k| member(&k.to_string(), &[0.0, 0.0])).collect(),
        "agents: a mission has at most 20 agents that are not finished",
    );
    created(|m| m.forbidden = vec![pair("a", "z"); 201], "forbidden: 201 entries exceed the limit of 200");
    let mission = start(0.0);
    let updated = |request: v1::UpdateMissionRequest, words: &str| {
        let error = mission.update(request, 0, &LIMITS, &planner).unwrap_err().to_string();
        assert!(error.starts_with(words), "{error} instead of {words}");
    };
    let wrong = v1::UpdateMissionRequest { remove_goals: vec!["z".into()], ..Default::default() };
    updated(wrong, "remove_goals[0]: no member");
    let wrong = v1::UpdateMissionRequest { remove_agents: vec!["a".into(), "a".into()], ..Default::default() };
    updated(wrong, "remove_agents[1]: no member");
    let wrong = v1::UpdateMissionRequest { allow: vec![pair("a", "z"); 201], ..Default::default() };
    updated(wrong, "allow: 201 entries exceed the limit of 200");
    let wrong = v1::UpdateMissionRequest { agents: vec![state("new", MemberState::Active)], ..Default::default() };
    updated(wrong, "agents[0].position: 0 coordinates");
}

#[test]
fn missions_are_bounded_in_number_and_age() {
    let bounds = Bounds { total: 3, per_owner: 2, each: LIMITS, ..Bounds::default() };
    let missions = Missions::open(None, bounds).unwrap();
    let make = |id: &str, owner: &str, now: i64| {
        let request = v1::CreateMissionRequest { mission_id: id.into(), ..request(0.0) };
        missions.insert(Mission::create(request, owner, "", now, &LIMITS, &planner).unwrap())
    };
    make("1", "me", 0).unwrap();
    assert!(matches!(make("1", "me", 0), Err(KeepError::Exists(_))));
    make("2", "me", 1000).unwrap();
    assert!(
        matches!(make("3", "me", 0), Err(KeepError::Full(text)) if text.contains("the client is at its limit of 2"))
    );
    make("3", "you", 0).unwrap();
    assert!(
        matches!(make("4", "them", 0), Err(KeepError::Full(text)) if text.contains("the service is at its limit of 3"))
    );
    let old: Vec<String> = missions.expire(60_500).unwrap().iter().map(|m| m.id().to_owned()).collect();
    assert_eq!(old, ["1", "3"]);
    assert!(missions.get("1").is_none() && missions.get("2").is_some());
    let first = missions.get("2").unwrap();
    let next = change(&first, v1::UpdateMissionRequest::default());
    assert_eq!(missions.replace(next.clone(), 1).unwrap().assignment.revision, 2);
    assert!(matches!(missions.replace(next, 1), Err(KeepError::Changed { found: 2, .. })));
    missions.remove("2", |_| true).unwrap();
    assert!(matches!(missions.remove("2", |_| true), Err(KeepError::Missing(_))));
}

#[test]
fn a_mission_that_is_no_longer_the_one_that_was_looked_at_stays() {
    let missions = Missions::open(None, Bounds::default()).unwrap();
    let make = |owner: &str| Mission::create(request(0.0), owner, "", 1000, &LIMITS, &planner).unwrap();
    let mine = missions.insert(make("me")).unwrap();
    // Between read and write another client takes the name, at the same revision, in the same millisecond.
    let next = change(&mine, v1::UpdateMissionRequest::default());
    missions.remove("m", |_| true).unwrap();
    let theirs = missions.insert(make("them")).unwrap();
    let mine = |mission: &Mission| mission.assignment.owner == "me";
    let absent = missions.remove("missing", mine).unwrap_err().to_string().replace("missing", "m");
    assert_eq!(missions.remove("m", mine).unwrap_err().to_string(), absent);
    assert_eq!(missions.replace(next, 1).unwrap_err().to_string(), absent);
    assert_eq!(missions.get("m").unwrap(), theirs);
    missions.remove("m", |mission| mission.assignment.owner == "them").unwrap();
}

#[test]
fn missions_are_bounded_in_bytes() {
    let make = |id: &str| {
        let request = v1::CreateMissionRequest { mission_id: id.into(), ..request(0.0) };
        Mission::create(request, "me", "", 0, &LIMITS, &planner).unwrap()
    };
    let bytes = 2 * make("1").bytes();
    let missions = Missions::open(None, Bounds { bytes, ..Bounds::default() }).unwrap();
    missions.insert(make("1")).unwrap();
    let second = missions.insert(make("2")).unwrap();
    assert!(matches!(missions.insert(make("3")), Err(KeepError::Full(text)) if text.contains("bytes")));
    let agents = (0..15).map(|k| member(&format!("another-{k}"), &[1.0, 2.0])).collect();
    let more = v1::UpdateMissionRequest { agents, ..Default::default() };
    assert!(matches!(missions.replace(change(&second, more), 1), Err(KeepError::Full(_))));
    let less = change(&second, v1::UpdateMissionRequest { remove_agents: vec!["b".into()], ..Default::default() });
    assert!(less.bytes() < second.bytes());
    missions.replace(less, 1).unwrap();
    missions.remove("1", |_| true).unwrap();
    missions.insert(make("3")).unwrap();
}

#[test]
fn missions_survive_on_disk_and_the_file_has_one_owner() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missions.redb");
    let kept = {
        let missions = Missions::open(Some(Disk::open(&path).unwrap()), Bounds::default()).unwrap();
        assert!(matches!(Disk::open(&path), Err(DiskError::InUse)));
        let priced = v1::PairCost { pair: Some(pair("a", "y")), cost: 0.25 };
        let forbidden = vec![pair("b", "y")];
        let full = v1::CreateMissionRequest { cost_overrides: vec![priced], forbidden, ..request(0.125) };
        missions.insert(Mission::create(full, "me", "", 5, &LIMITS, &planner).unwrap()).unwrap();
        let gone = v1::CreateMissionRequest { mission_id: "gone".into(), ..request(0.0) };
        missions.insert(Mission::create(gone, "me", "", 5, &LIMITS, &planner).unwrap()).unwrap();
        missions.remove("gone", |_| true).unwrap();
        missions.get("m").unwrap()
    };
    assert_eq!(goals(&kept), [("a", "y"), ("b", "x")]);
    let missions = Missions::open(Some(Disk::open(&path).unwrap()), Bounds::default()).unwrap();
    assert_eq!(missions.get("m").unwrap(), kept);
    assert!(missions.get("gone").is_none());
    // It goes on where it was: the ban and the price still count.
    let next = change(&missions.get("m").unwrap(), v1::UpdateMissionRequest::default());
    assert!(next.assignment.changes.is_empty());
    assert_eq!(next.assignment.cost, kept.assignment.cost);
}

/// Something that happens to a mission.
#[derive(Debug, Clone)]
struct Event {
    agents: Vec<(u8, i8, i8, i32)>,
    goals: Vec<(u8, i8, i8, i32)>,
    gone: (Option<u8>, Option<u8>),
    forbid: Option<(u8, u8)>,
}

fn event() -> impl Strategy<Value = Event> {
    let one = || (0u8..6, any::<i8>(), any::<i8>(), 0i32..4);
    let some = move || prop::collection::vec(one(), 0..3);
    let name = || prop::option::weighted(0.2, 0u8..6);
    (some(), some(), (name(), name()), prop::option::weighted(0.2, (0u8..6, 0u8..6)))
        .prop_map(|(agents, goals, gone, forbid)| Event { agents, goals, gone, forbid })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]

    #[test]
    fn whatever_happens_the_assignment_is_valid_and_the_changes_lead_to_it(
        events in prop::collection::vec(event(), 1..8), switching_cost in 0.0f64..50.0
    ) {
        let empty = v1::CreateMissionRequest { mission_id: "m".into(), switching_cost, ..Default::default() };
        let mut mission = Mission::create(empty, "me", "", 0, &LIMITS, &planner).unwrap();
        for event in events {
            let members = |side: &str, list: &[(u8, i8, i8, i32)]| -> Vec<v1::Member> {
                list.iter()
                    .map(|&(k, x, y, state)| v1::Member {
                        id: format!("{side}{k}"), position: vec![f64::from(x), f64::from(y)], state, ..Default::default()
                    })
                    .collect()
            };
            let name = |side: &str, k: Option<u8>| k.map(|k| format!("{side}{k}")).into_iter().collect();
            let request = v1::UpdateMissionRequest {
                agents: members("a", &event.agents),
                goals: members("g", &event.goals),
                remove_agents: name("a", event.gone.0),
                remove_goals: name("g", event.gone.1),
                forbid: event.forbid.map(|(a, g)| pair(&format!("a{a}"), &format!("g{g}"))).into_iter().collect(),
                ..Default::default()
            };
            let next = match mission.update(request, 1, &LIMITS, &planner) {
                Ok(next) => next,
                Err(AssignError::Invalid(error)) => {
                    prop_assert!(error.field.contains('['), "{error}");
                    continue;
                }
                Err(other) => panic!("{other}"),
            };
            let a = &next.assignment;
            let active = |members: &[v1::Member]| members.iter().filter(|m| m.state() == MemberState::Active).count();
            prop_assert_eq!(a.pairs.len() + a.agents_without_goal.len(), a.agents.len());
            prop_assert_eq!(a.pairs.len() + a.goals_without_agent.len(), a.goals.len());
            prop_assert!(a.pairs.len() <= active(&a.agents).min(active(&a.goals)));
            for p in &a.pairs {
                prop_assert_eq!(a.agents[p.agent_index as usize].state(), MemberState::Active);
                prop_assert_eq!(a.goals[p.goal_index as usize].state(), MemberState::Active);
                prop_assert_eq!(&a.agents[p.agent_index as usize].id, &p.agent_id);
            }
            // Old pairs with the changes applied are the new pairs.
            let mut pairs: std::collections::BTreeMap<String, String> =
                mission.assignment.pairs.iter().map(|p| (p.agent_id.clone(), p.goal_id.clone())).collect();
            for c in &a.changes {
                prop_assert_eq!(pairs.remove(&c.agent_id).unwrap_or_default(), c.from_goal_id.clone());
                prop_assert!(c.reason() != ChangeReason::Unspecified && !c.explanation.is_empty());
                if !c.to_goal_id.is_empty() {
                    pairs.insert(c.agent_id.clone(), c.to_goal_id.clone());
                }
            }
            let new = a.pairs.iter().map(|p| (p.agent_id.clone(), p.goal_id.clone())).collect();
            prop_assert_eq!(pairs, new);
            prop_assert_eq!(Mission::decode(&next.encode()).unwrap(), next.clone());
            mission = next;
        }
    }
}
