//! Requests and missions, up to the answer.

use magex_dispatch::answer::Planned;
use magex_dispatch::mission::{Mission, MissionLimits};
use magex_dispatch::{AssignError, Limits, Problem, answer, engine};
use magex_proto::v1::{AssignRequest, AssignResponse, CreateMissionRequest, UpdateMissionRequest};
use prost::Message as _;

const LIMITS: MissionLimits = MissionLimits { members: 16, lifetime_ms: 1000 };

fn planner(problem: &Problem) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

/// A request: a valid matching, or an error that names a field.
pub fn assign(bytes: &[u8]) {
    let Ok(message) = AssignRequest::decode(bytes) else { return };
    let problem = match Problem::read(message, 1, &Limits { members: 64, teams: 1 }) {
        Ok(problem) => problem,
        Err(error) => return assert!(!error.field.is_empty() && !error.problem.is_empty()),
    };
    let plan = match engine::solve(&problem, problem.scheduler, &|| true) {
        Ok(plan) => plan,
        Err(error) => panic!("a problem that was read was refused: {error}"),
    };
    let response = answer::write(&problem, &plan);
    check_matching(&response, problem.agent_count, &problem.terms.capacities, problem.goal_count);
    let banned = response.pairs.iter().find(|pair| problem.forbidden.contains(&(pair.agent_index, pair.goal_index)));
    assert!(banned.is_none(), "{banned:?} is forbidden");
}

/// Every agent is in one pair or left over, every goal has as many agents as it takes or fewer, and every number is one.
pub fn check_matching(response: &AssignResponse, agents: usize, capacities: &[u32], goals: usize) {
    let mut agent_free = vec![true; agents];
    let mut places: Vec<u32> = (0..goals).map(|goal| capacities.get(goal).copied().unwrap_or(1)).collect();
    let mut served = vec![false; goals];
    for pair in &response.pairs {
        let goal = pair.goal_index as usize;
        assert!(std::mem::take(&mut agent_free[pair.agent_index as usize]), "an agent has two goals");
        assert!(places[goal] > 0, "a goal has more agents than it takes");
        (places[goal], served[goal]) = (places[goal] - 1, true);
        assert!(pair.cost.is_finite() && pair.distance.is_finite() && pair.arrival.is_none_or(f64::is_finite));
    }
    assert_eq!(response.pairs.len() + response.agents_without_goal.len(), agents);
    let served = served.into_iter().filter(|served| *served).count();
    assert_eq!(served + response.goals_without_agent.len(), goals);
    assert!(response.cost.is_finite() && response.gap.is_none_or(f64::is_finite));
}

/// A mission, and updates, parted by their length in one byte: it stays valid, and its record can be read back.
pub fn mission(bytes: &[u8]) {
    let mut rest = bytes;
    let mut next = || {
        let (&length, tail) = rest.split_first()?;
        let (part, after) = tail.split_at_checked(usize::from(length)).unwrap_or((tail, &[]));
        rest = after;
        Some(part)
    };
    let Some(Ok(request)) = next().map(CreateMissionRequest::decode) else { return };
    let mut mission = match Mission::create(request, "me", "drawn", 0, &LIMITS, &planner) {
        Ok(mission) => mission,
        Err(error) => return check_refusal(&error),
    };
    check_mission(&mission);
    while let Some(part) = next() {
        let Ok(request) = UpdateMissionRequest::decode(part) else { continue };
        match mission.update(request, 1, &LIMITS, &planner) {
            Ok(updated) => mission = updated,
            Err(error) => check_refusal(&error),
        }
        check_mission(&mission);
    }
}

fn check_mission(mission: &Mission) {
    let a = &mission.assignment;
    assert_eq!(a.pairs.len() + a.agents_without_goal.len(), a.agents.len());
    let record = mission.encode();
    match Mission::decode(&record) {
        Ok(read) => assert_eq!(read.encode(), record),
        Err(error) => panic!("a record cannot be read back: {error}"),
    }
}

fn check_refusal(error: &AssignError) {
    match error {
        AssignError::Invalid(error) => assert!(!error.field.is_empty() && !error.problem.is_empty()),
        AssignError::Interrupted => panic!("it was not interrupted"),
    }
}

/// A record on disk, whatever it holds, and the next update of that mission.
pub fn record(bytes: &[u8]) {
    let Ok(mission) = Mission::decode(bytes) else { return };
    assert!(Mission::decode(&mission.encode()).is_ok());
    if let Err(error) = mission.update(UpdateMissionRequest::default(), 1, &LIMITS, &planner) {
        check_refusal(&error);
    }
}
