//! What users of dispatchers have asked for, each by the project and number of the thread in which it was asked, and how it is
//! said here (docs/how-do-i-say.md).

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_dispatch::answer::Planned;
use magex_dispatch::engine;
use magex_dispatch::mission::{FINISHED_KEPT, Mission, MissionLimits};
use magex_dispatch::{AssignError, Limits, Problem, answer};
use magex_proto::v1;
use magex_proto::v1::{ChangeReason, MemberState, UnassignedReason};

const LIMITS: MissionLimits = MissionLimits { members: 200, lifetime_ms: 60_000 };

fn planner(problem: &Problem) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

fn at(id: &str, x: f64) -> v1::Member {
    v1::Member { id: id.into(), position: vec![x, 0.0], ..Default::default() }
}

fn state(id: &str, state: MemberState) -> v1::Member {
    v1::Member { id: id.into(), state: state.into(), ..Default::default() }
}

fn pair(agent: &str, goal: &str) -> v1::PairRef {
    v1::PairRef { agent_id: agent.into(), goal_id: goal.into(), ..Default::default() }
}

fn mission(agents: Vec<v1::Member>, goals: Vec<v1::Member>) -> Mission {
    create(v1::CreateMissionRequest { agents, goals, ..Default::default() }).unwrap()
}

fn create(request: v1::CreateMissionRequest) -> Result<Mission, String> {
    let request = v1::CreateMissionRequest { mission_id: "m".into(), ..request };
    Mission::create(request, "me", "drawn", 1000, &LIMITS, &planner).map_err(|error| error.to_string())
}

fn change(mission: &Mission, request: v1::UpdateMissionRequest) -> Mission {
    mission.update(request, 2000, &LIMITS, &planner).unwrap()
}

fn refused(mission: &Mission, request: v1::UpdateMissionRequest) -> String {
    mission.update(request, 2000, &LIMITS, &planner).unwrap_err().to_string()
}

fn agents(mission: &Mission, agents: Vec<v1::Member>) -> Mission {
    change(mission, v1::UpdateMissionRequest { agents, ..Default::default() })
}

fn goals(mission: &Mission, goals: Vec<v1::Member>) -> Mission {
    change(mission, v1::UpdateMissionRequest { goals, ..Default::default() })
}

fn pairs(mission: &Mission) -> Vec<(&str, &str)> {
    mission.assignment.pairs.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect()
}

fn reasons(mission: &Mission) -> Vec<(&str, ChangeReason)> {
    mission.assignment.changes.iter().map(|c| (c.agent_id.as_str(), c.reason())).collect()
}

fn left(members: &[v1::Unassigned]) -> Vec<(&str, UnassignedReason)> {
    members.iter().map(|m| (m.id.as_str(), m.reason())).collect()
}

fn ask(team: v1::AssignRequest) -> v1::AssignResponse {
    let problem = Problem::read(team, 1, &Limits { members: 50, teams: 1 }).unwrap();
    answer::write(&problem, &engine::solve(&problem, problem.scheduler, &|| true).unwrap())
}

fn line(xs: &[f64]) -> Option<v1::Positions> {
    Some(v1::Positions { dims: 2, coordinates: xs.iter().flat_map(|x| [*x, 0.0]).collect(), ..Default::default() })
}

fn chosen(answer: &v1::AssignResponse) -> Vec<(u32, u32)> {
    answer.pairs.iter().map(|p| (p.agent_index, p.goal_index)).collect()
}

fn by_index(agent_index: u32, goal_index: u32) -> v1::PairRef {
    v1::PairRef { agent_index, goal_index, ..Default::default() }
}

#[test]
fn vroom_191_the_last_vehicle_counts() {
    // The least sum is 0 + 10, the earliest end 6.
    let costs = Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![0.0, 6.0, 6.0, 10.0] });
    let scheduler = v1::AssignmentMethod::Makespan.into();
    let answer = ask(v1::AssignRequest { costs, scheduler, ..Default::default() });
    assert_eq!((chosen(&answer), answer.largest_cost), (vec![(0, 1), (1, 0)], 6.0));
}

#[test]
fn vroom_466_finish_everything_as_soon_as_possible() {
    // The same end, and below it the least sum of squares: no agent is late for nothing.
    let costs = Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![0.0, 6.0, 6.0, 10.0] });
    let answer = ask(v1::AssignRequest { costs, power: Some(2.0), ..Default::default() });
    assert_eq!((chosen(&answer), answer.cost), (vec![(0, 1), (1, 0)], 72.0));
}

#[test]
fn vroom_1314_work_is_balanced() {
    // ada is nearer, but has done more.
    let team = |balance| v1::AssignRequest {
        agents: line(&[1.0, 2.0]),
        goals: line(&[0.0]),
        agent_loads: vec![5.0, 1.0],
        balance,
        ..Default::default()
    };
    assert_eq!(chosen(&ask(team(0.0))), [(0, 0)]);
    assert_eq!(chosen(&ask(team(0.5))), [(1, 0)]);
    // A mission counts what its agents finish.
    let agents = vec![at("ada", 1.0), at("bob", 2.0)];
    let request = v1::CreateMissionRequest { agents, goals: vec![at("x", 0.0)], balance: 3.0, ..Default::default() };
    let done = goals(&create(request).unwrap(), vec![state("x", MemberState::Finished), at("y", 0.0)]);
    assert_eq!((pairs(&done), done.assignment.agents[0].load), (vec![("bob", "y")], Some(1.0)));
}

#[test]
fn vroom_800_steps_that_have_begun_are_kept() {
    let start = mission(vec![at("ada", 0.0)], vec![at("x", 5.0)]);
    let pinned = change(&start, v1::UpdateMissionRequest { pin: vec![pair("ada", "x")], ..Default::default() });
    let nearer = goals(&pinned, vec![at("y", 0.1)]);
    assert_eq!(
        (pairs(&nearer), left(&nearer.assignment.goals_without_agent)),
        (vec![("ada", "x")], vec![("y", UnassignedReason::Outnumbered)])
    );
    let free = change(&nearer, v1::UpdateMissionRequest { unpin: vec![pair("ada", "x")], ..Default::default() });
    assert_eq!(pairs(&free), [("ada", "y")]);
    let wrong =
        v1::UpdateMissionRequest { pin: vec![pair("ada", "y")], forbid: vec![pair("ada", "y")], ..Default::default() };
    assert!(refused(&free, wrong).starts_with("pin[0]: the pair of ada and y is pinned and forbidden"));
    let wrong = v1::UpdateMissionRequest { pin: vec![pair("ada", "y"), pair("ada", "x")], ..Default::default() };
    let text = refused(&free, wrong);
    assert!(text.starts_with("pin[") && text.contains("routing problem"), "{text}");
}

#[test]
fn rmf_task_127_the_idle_robot_goes() {
    // ada is nearer, but busy for another ten seconds; both drive half a metre per second.
    let answer = ask(v1::AssignRequest {
        agents: line(&[1.0, 4.0]),
        goals: line(&[0.0]),
        agent_speeds: vec![0.5, 0.5],
        agent_offsets: vec![10.0, 0.0],
        ..Default::default()
    });
    assert_eq!((chosen(&answer), answer.last_arrival), (vec![(1, 0)], Some(8.0)));
}

#[test]
fn rmf_task_34_a_goal_opens_when_another_is_finished() {
    let after = |id: &str, x: f64, first: &str| {
        let after = Some(v1::GoalNames { goal_ids: vec![first.to_owned()] });
        v1::Member { after, ..at(id, x) }
    };
    let start = mission(vec![at("ada", 0.0), at("bob", 1.0)], vec![at("load", 0.0), after("unload", 1.0, "load")]);
    assert_eq!(pairs(&start), [("ada", "load")]);
    assert_eq!(left(&start.assignment.goals_without_agent), [("unload", UnassignedReason::NotOpen)]);
    let done = goals(&start, vec![state("load", MemberState::Finished)]);
    assert_eq!(pairs(&done), [("bob", "unload")]);
    let circle = v1::UpdateMissionRequest { goals: vec![after("load", 0.0, "unload")], ..Default::default() };
    assert!(refused(&start, circle).starts_with("after: a circle"));
    let unknown = v1::UpdateMissionRequest { goals: vec![after("z", 0.0, "nothing")], ..Default::default() };
    assert!(refused(&start, unknown).starts_with("goals[z].after.goal_ids[0]: no goal has this name"));
}

#[test]
fn rmf_ros2_55_a_finished_task_plans_the_next_one() {
    let start = mission(vec![at("ada", 0.0)], vec![at("x", 1.0), at("y", 2.0)]);
    let next = goals(&start, vec![state("x", MemberState::Finished)]);
    assert_eq!((pairs(&next), reasons(&next)), (vec![("ada", "y")], vec![("ada", ChangeReason::GoalFinished)]));
}

#[test]
fn rmf_ros2_119_a_robot_forfeits_its_task() {
    let start = mission(vec![at("ada", 0.0), at("bob", 9.0)], vec![at("x", 1.0)]);
    let given = change(&start, v1::UpdateMissionRequest { forfeit: vec!["ada".into()], ..Default::default() });
    assert_eq!(pairs(&given), [("bob", "x")]);
    assert_eq!(reasons(&given), [("ada", ChangeReason::Forfeited), ("bob", ChangeReason::Assigned)]);
    assert_eq!(left(&given.assignment.agents_without_goal), [("ada", UnassignedReason::Forbidden)]);
    let text = refused(&given, v1::UpdateMissionRequest { forfeit: vec!["ada".into()], ..Default::default() });
    assert!(text.starts_with("forfeit[0]: no agent of this name has a goal"), "{text}");
    let again = change(&given, v1::UpdateMissionRequest { allow: vec![pair("ada", "x")], ..Default::default() });
    assert_eq!(pairs(&again), [("ada", "x")]);
}

#[test]
fn rmf_ros2_461_and_rmf_demos_343_charging_and_parking_take_time() {
    let charging = v1::Member { busy_until: Some(160.0), speed: Some(1.0), ..at("ada", 0.0) };
    let request = v1::CreateMissionRequest {
        agents: vec![charging, v1::Member { speed: Some(1.0), ..at("bob", 50.0) }],
        goals: vec![at("x", 1.0)],
        time: 100.0,
        ..Default::default()
    };
    let start = create(request).unwrap();
    assert_eq!((pairs(&start), start.assignment.last_arrival), (vec![("bob", "x")], Some(49.0)));
    // Half a minute later less of it is left.
    let later = change(&start, v1::UpdateMissionRequest { time: Some(130.0), ..Default::default() });
    assert_eq!(pairs(&later), [("ada", "x")]);
    let back = v1::UpdateMissionRequest { time: Some(120.0), ..Default::default() };
    assert!(refused(&later, back).starts_with("time: 120 is before the time of the mission, 130"));
}

#[test]
fn rmf_demos_302_seven_tasks_at_once() {
    let tasks = (0..7).map(|k| at(&format!("task{k}"), f64::from(k))).collect();
    let start = mission(vec![at("ada", 0.0), at("bob", 6.0)], tasks);
    assert_eq!(pairs(&start), [("ada", "task0"), ("bob", "task6")]);
    assert_eq!(start.assignment.goals_without_agent.len(), 5);
}

#[test]
fn cuopt_1117_every_vehicle_is_used() {
    // Two goals at one place: one after the other would save a vehicle, but both go.
    let answer = ask(v1::AssignRequest { agents: line(&[0.0, 90.0]), goals: line(&[1.0, 1.0]), ..Default::default() });
    assert_eq!(answer.pairs.len(), 2);
}

#[test]
fn vda5050_511_an_order_fails() {
    let start = mission(vec![at("ada", 0.0)], vec![at("x", 1.0), at("y", 2.0)]);
    let next = goals(&start, vec![state("x", MemberState::Failed)]);
    assert_eq!((pairs(&next), reasons(&next)), (vec![("ada", "y")], vec![("ada", ChangeReason::GoalFailed)]));
}

#[test]
fn rmf_ros2_16_a_robot_fails_and_comes_back() {
    let start = mission(vec![at("ada", 0.0), at("bob", 9.0)], vec![at("x", 1.0)]);
    let failed = agents(&start, vec![state("ada", MemberState::Failed)]);
    assert_eq!(pairs(&failed), [("bob", "x")]);
    assert_eq!(pairs(&agents(&failed, vec![state("ada", MemberState::Active)])), [("ada", "x")]);
}

#[test]
fn rmf_core_318_what_a_pair_costs_is_told() {
    // 2 · (3 + 4 / 2)^2
    let answer = ask(v1::AssignRequest {
        agents: line(&[0.0]),
        goals: line(&[4.0]),
        agent_speeds: vec![2.0],
        agent_offsets: vec![3.0],
        goal_weights: vec![2.0],
        power: Some(2.0),
        ..Default::default()
    });
    let pair = &answer.pairs[0];
    assert_eq!((pair.cost, pair.arrival, pair.distance, answer.distance), (50.0, Some(5.0), 4.0, 4.0));
}

#[test]
fn or_tools_4573_due_times_hold_with_the_shortest_end() {
    // Without due times agent 0 would take goal 0.
    let team = |goal_due| v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![5.0, 1.0, 1.0, 5.0] }),
        goal_due,
        scheduler: v1::AssignmentMethod::Makespan.into(),
        ..Default::default()
    };
    assert_eq!(chosen(&ask(team(vec![]))), [(0, 1), (1, 0)]);
    let answer = ask(team(vec![0.5, 1.0]));
    assert_eq!(chosen(&answer), [(0, 1)]);
    assert_eq!(answer.goals_without_agent[0].reason(), UnassignedReason::TooLate);
    assert_eq!(answer.agents_without_goal[0].reason(), UnassignedReason::TooLate);
}

#[test]
fn a_goal_that_can_no_longer_be_made_is_told_and_not_served_late() {
    let due = v1::Member { due: Some(10.0), ..at("x", 5.0) };
    let start = mission(vec![at("ada", 0.0)], vec![due]);
    assert_eq!(pairs(&start), [("ada", "x")]);
    let later = change(&start, v1::UpdateMissionRequest { time: Some(6.0), ..Default::default() });
    assert_eq!((pairs(&later), reasons(&later)), (vec![], vec![("ada", ChangeReason::TooLate)]));
    assert_eq!(left(&later.assignment.goals_without_agent), [("x", UnassignedReason::TooLate)]);
}

#[test]
fn a_goal_of_high_priority_is_served_first_and_from_nearer() {
    let team = |goal_weights| v1::AssignRequest {
        agents: line(&[0.0]),
        goals: line(&[1.0, 2.0]),
        goal_weights,
        ..Default::default()
    };
    assert_eq!(chosen(&ask(team(vec![]))), [(0, 0)]);
    let answer = ask(team(vec![1.0, 5.0]));
    // 5 · 2, and goal 0 waits: 1 · 2 · 2.
    assert_eq!((chosen(&answer), answer.cost, answer.unserved_cost), (vec![(0, 1)], 14.0, 4.0));
}

#[test]
fn a_goal_takes_several_agents() {
    let answer = ask(v1::AssignRequest {
        agents: line(&[0.0, 1.0, 2.0, 9.0]),
        goals: line(&[0.0, 9.0]),
        goal_capacities: vec![2, 1],
        current: vec![by_index(0, 0), by_index(1, 0)],
        ..Default::default()
    });
    assert_eq!((chosen(&answer), answer.switches), (vec![(0, 0), (1, 0), (3, 1)], 0));
    let both = v1::Member { capacity: Some(2), ..at("lift", 0.0) };
    assert_eq!(pairs(&mission(vec![at("ada", 0.0), at("bob", 1.0)], vec![both])), [("ada", "lift"), ("bob", "lift")]);
}

#[test]
fn walls_are_costs_also_in_a_mission_without_positions() {
    let nowhere = |id: &str| v1::Member { id: id.into(), ..Default::default() };
    let priced = |agent: &str, goal: &str, cost| v1::PairCost { pair: Some(pair(agent, goal)), cost };
    let request = |cost_overrides| v1::CreateMissionRequest {
        agents: vec![nowhere("ada"), nowhere("bob")],
        goals: vec![nowhere("x"), nowhere("y")],
        cost_overrides,
        ..Default::default()
    };
    let costs = vec![
        priced("ada", "x", 1.0),
        priced("bob", "x", 2.0),
        priced("bob", "y", f64::INFINITY),
        priced("ada", "y", 9.0),
    ];
    let start = create(request(costs)).unwrap();
    assert_eq!((pairs(&start), start.assignment.cost), (vec![("ada", "y"), ("bob", "x")], 11.0));
    let text = create(request(vec![])).unwrap_err();
    assert!(text.starts_with("agents[0].position: 0 coordinates"), "{text}");
}

#[test]
fn finished_members_are_forgotten_and_a_mission_goes_on_for_ever() {
    let robots = (0..20).map(|k| at(&format!("r{k}"), f64::from(k))).collect();
    let batch = |round: u32| (0..20).map(|k| at(&format!("g{}", 20 * round + k), f64::from(k))).collect::<Vec<_>>();
    let mut now = mission(robots, batch(0));
    let mut sizes = Vec::new();
    for round in 1..60 {
        let done = now.assignment.pairs.iter().map(|pair| state(&pair.goal_id, MemberState::Finished));
        now = goals(&now, done.chain(batch(round)).collect());
        assert_eq!(now.assignment.pairs.len(), 20);
        sizes.push(now.encode().len());
    }
    assert!(now.assignment.goals.len() <= FINISHED_KEPT + 40, "{}", now.assignment.goals.len());
    assert!(sizes[58] < sizes[20] + sizes[20] / 10, "{sizes:?}");
    assert!(!now.assignment.goals.iter().any(|goal| goal.id == "g0"), "the first ones are forgotten");
}
