//! Whatever the request, the answer is a valid matching or an error with the path of a field.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_dispatch::engine::{self, Plan};
use magex_dispatch::{AssignError, Limits, Problem, UNASSIGNED, answer};
use magex_proto::goals::AssignmentMethod;
use magex_proto::{arrays, v1};
use proptest::prelude::*;
use proptest::strategy::Union;

const KINDS: [AssignmentMethod; 4] =
    [AssignmentMethod::Exact, AssignmentMethod::Makespan, AssignmentMethod::Greedy, AssignmentMethod::Random];

fn limits() -> Limits {
    Limits { members: 12, teams: 3 }
}

fn positions(dims: u32, coordinates: &[f64]) -> Option<v1::Positions> {
    Some(v1::Positions { dims, coordinates: coordinates.to_vec(), ..Default::default() })
}

fn team(agents: &[f64], goals: &[f64]) -> v1::AssignRequest {
    v1::AssignRequest { agents: positions(2, agents), goals: positions(2, goals), ..Default::default() }
}

fn read(message: v1::AssignRequest) -> Problem {
    Problem::read(message, 1, &limits()).unwrap()
}

fn solve(problem: &Problem, kind: AssignmentMethod) -> Plan {
    engine::solve(problem, kind, &|| true).unwrap()
}

fn by_index(agent_index: u32, goal_index: u32) -> v1::PairRef {
    v1::PairRef { agent_index, goal_index, ..Default::default() }
}

#[test]
fn both_forms_of_positions_are_read_alike() {
    let plain = team(&[0.0, 0.0, 1.0, 0.0], &[1.0, 1.0]);
    let mut packed = plain.clone();
    packed.agents =
        Some(v1::Positions { array: Some(arrays::from_f32(&[2, 2], &[0.0, 0.0, 1.0, 0.0])), ..Default::default() });
    assert_eq!(read(plain), read(packed));
}

#[test]
fn a_matrix_alone_makes_a_team_and_single_costs_and_bans_change_it() {
    let costs = v1::CostMatrix { agents: 2, goals: 2, values: vec![1.0, 5.0, 1.5, 2.0] };
    let ids = |side: &str| vec![format!("{side}0"), format!("{side}1")];
    let plain = v1::AssignRequest {
        costs: Some(costs),
        agent_ids: ids("a"),
        goal_ids: ids("g"),
        scheduler: v1::AssignmentMethod::Exact.into(),
        ..Default::default()
    };
    let ask = |message: &v1::AssignRequest, kind| {
        let problem = read(message.clone());
        answer::write(&problem, &solve(&problem, kind))
    };
    let response = ask(&plain, AssignmentMethod::Exact);
    assert_eq!((response.cost, response.largest_cost, response.gap), (3.0, 2.0, Some(0.0)));
    assert_eq!((response.pairs[0].goal_id.as_str(), response.pairs[0].distance), ("g0", 0.0));

    let named = v1::PairRef { agent_id: "a0".into(), goal_id: "g1".into(), ..Default::default() };
    let cheap =
        v1::AssignRequest { cost_overrides: vec![v1::PairCost { pair: Some(named), cost: -2.0 }], ..plain.clone() };
    assert_eq!(ask(&cheap, AssignmentMethod::Exact).cost, -0.5);

    let banned = v1::AssignRequest { forbidden: vec![by_index(0, 0), by_index(0, 1)], ..plain.clone() };
    for kind in KINDS {
        let response = ask(&banned, kind);
        assert_eq!(response.unassigned_agents, [0]);
        assert_eq!(response.agents_without_goal[0].reason(), v1::UnassignedReason::Forbidden, "{kind:?}");
        assert_eq!(response.goals_without_agent[0].reason(), v1::UnassignedReason::Conflict, "{kind:?}");
        assert_eq!(response.agents_without_goal[0].id, "a0");
    }
}

#[test]
fn unassigned_agents_have_a_reason() {
    let problem = read(team(&[0.0, 0.0, 5.0, 0.0, 1.0, 0.0], &[1.0, 0.5, 0.0, 0.5]));
    for kind in KINDS {
        let response = answer::write(&problem, &solve(&problem, kind));
        assert_eq!(response.agents_without_goal.len(), 1);
        assert_eq!(response.agents_without_goal[0].reason(), v1::UnassignedReason::Outnumbered);
        assert!(response.goals_without_agent.is_empty());
    }
    let response = answer::write(&problem, &solve(&problem, AssignmentMethod::Exact));
    assert_eq!(response.unassigned_agents, [1]);
}

#[test]
fn a_team_without_agents_or_without_goals_is_answered_and_the_others_are_left_over() {
    let (two, none) = ([0.0, 0.0, 1.0, 0.0], [0.0; 0]);
    let packed = |rows: usize, dims: usize| {
        let values = vec![0.5; rows * dims];
        Some(v1::Positions { array: Some(arrays::from_f64(&[rows, dims], &values)), ..Default::default() })
    };
    let costs = |agents, goals| v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents, goals, values: vec![] }),
        ..Default::default()
    };
    let named = v1::AssignRequest { agent_ids: vec!["a".into(), "b".into()], ..team(&two, &none) };
    let forms = [
        (team(&two, &none), 2, 0),
        (team(&none, &two), 0, 2),
        (team(&none, &none), 0, 0),
        // The dimensions of no points do not count.
        (v1::AssignRequest { goals: positions(0, &[]), ..team(&two, &none) }, 2, 0),
        (v1::AssignRequest { agents: positions(0, &[]), goals: positions(0, &[]), ..Default::default() }, 0, 0),
        (v1::AssignRequest { agents: positions(3, &[]), ..team(&none, &two) }, 0, 2),
        (v1::AssignRequest { agents: packed(3, 2), goals: packed(0, 2), ..Default::default() }, 3, 0),
        (v1::AssignRequest { agents: packed(0, 0), goals: packed(1, 3), ..Default::default() }, 0, 1),
        (costs(2, 0), 2, 0),
        (costs(0, 3), 0, 3),
        (costs(0, 0), 0, 0),
        (v1::AssignRequest { agents: positions(2, &two), goals: positions(2, &none), ..costs(2, 0) }, 2, 0),
        (named, 2, 0),
    ];
    for (message, agents, goals) in forms {
        let problem = read(message.clone());
        for kind in [&KINDS[..], &[AssignmentMethod::Learned]].concat() {
            let response = answer::write(&problem, &solve(&problem, kind));
            assert!(response.pairs.is_empty() && response.gap == Some(0.0), "{message:?}");
            assert_eq!((response.cost, response.exact_cost, response.largest_cost), (0.0, Some(0.0), 0.0));
            let left = [response.unassigned_agents.len(), response.unassigned_goals.len()];
            assert_eq!(left, [agents, goals], "{message:?}");
            let idle = response.agents_without_goal.iter().chain(&response.goals_without_agent);
            assert!(idle.clone().all(|member| member.reason() == v1::UnassignedReason::Outnumbered));
            assert_eq!(idle.count(), agents + goals);
        }
        assert!(engine::not_for_learned(&problem).is_some(), "a model is not asked");
    }
}

#[test]
fn makespan_minimises_the_longest_way() {
    // The cheapest sum sends one agent far: 0 + 10; the shortest longest way is 6 + 6.
    let costs = v1::CostMatrix { agents: 2, goals: 2, values: vec![0.0, 6.0, 6.0, 10.0] };
    let problem = read(v1::AssignRequest { costs: Some(costs), ..Default::default() });
    assert_eq!(solve(&problem, AssignmentMethod::Exact).goal_of, [0, 1]);
    let plan = solve(&problem, AssignmentMethod::Makespan);
    assert_eq!((plan.goal_of, plan.cost, plan.exact_cost), (vec![1, 0], 12.0, Some(10.0)));
}

#[test]
fn wrong_fields_are_named() {
    let check = |change: fn(&mut v1::AssignRequest), words: &str| {
        let mut message = team(&[0.0, 0.0, 2.0, 2.0], &[1.0, 1.0]);
        change(&mut message);
        let error = Problem::read(message, 1, &limits()).unwrap_err().to_string();
        assert!(error.starts_with(words), "{error} instead of {words}");
    };
    check(|m| m.agents = None, "agents: missing");
    check(|m| (m.agents, m.goals) = (None, None), "agents: missing");
    check(|m| m.goals = None, "goals: missing");
    check(|m| m.goals = positions(0, &[1.0]), "goals.dims: 0");
    check(|m| m.goals = positions(2, &[1.0]), "goals.coordinates: 1 numbers");
    check(
        |m| m.agents = Some(v1::Positions { dims: 2, single_coordinates: vec![1.0, 2.0], ..Default::default() }),
        "agents.single_coordinates: coordinates in single precision",
    );
    check(|m| m.goals = positions(4, &[1.0; 4]), "goals.dims: 4");
    check(|m| m.goals = positions(3, &[1.0; 3]), "goals: 3 dimensions, the agents have 2");
    check(|m| m.goals = positions(2, &[0.0; 26]), "goals: 13 points exceed the limit of 12");
    check(|m| m.agents = positions(2, &[1.0, f64::NAN]), "agents.coordinates[1]: NaN");
    check(|m| m.agents = positions(2, &[f64::INFINITY, 0.0]), "agents.coordinates[0]: inf");
    check(|m| m.agent_ids = vec!["a".into()], "agent_ids: 1 names for 2");
    check(|m| m.agent_ids = vec!["a".into(), "a".into()], "agent_ids[1]: the same name as agent_ids[0]");
    check(|m| m.goal_ids = vec![String::new()], "goal_ids[0]: 0 bytes");
    check(|m| m.scheduler = 99, "scheduler: 99 is not a method");
    check(|m| m.mode = -1, "mode: -1 is not a mode");
    check(|m| m.switching_cost = f64::NAN, "switching_cost: NaN");
    check(|m| m.switching_cost = -1.0, "switching_cost: -1");
    check(|m| m.deadline_seconds = Some(0.0), "deadline_seconds: 0");
    check(|m| m.deadline_seconds = Some(f64::NAN), "deadline_seconds: NaN");
    check(|m| m.forbidden = vec![by_index(2, 0)], "forbidden[0].agent_index: 2 is not below 2");
    check(|m| m.current = vec![by_index(0, 0), by_index(1, 0)], "current[1]: its agent or its goal");
    check(
        |m| m.forbidden = vec![v1::PairRef { agent_id: "x".into(), ..Default::default() }],
        "forbidden[0].agent_id: no member",
    );
    check(|m| m.cost_overrides = vec![v1::PairCost { pair: None, cost: 1.0 }], "cost_overrides[0].pair: missing");
    check(
        |m| m.cost_overrides = vec![v1::PairCost { pair: Some(by_index(0, 0)), cost: f64::NEG_INFINITY }],
        "cost_overrides[0].cost: -inf",
    );
    let matrix = |agents, goals, values: &[f64]| Some(v1::CostMatrix { agents, goals, values: values.to_vec() });
    let check = |costs: Option<v1::CostMatrix>, words: &str| {
        let error = Problem::read(v1::AssignRequest { costs, ..team(&[0.0, 0.0], &[1.0, 1.0]) }, 1, &limits());
        let error = error.unwrap_err().to_string();
        assert!(error.starts_with(words), "{error} instead of {words}");
    };
    check(matrix(2, 1, &[1.0, 1.0]), "costs.agents: 2, but there are 1");
    check(matrix(0, 1, &[]), "costs.agents: 0, but there are 1");
    check(matrix(1, u32::MAX, &[]), "costs.goals: 4294967295");
    check(matrix(1, 1, &[]), "costs.values: 0 numbers");
    check(matrix(1, 1, &[1e101]), "costs.values[0]: 1e101 is not a cost; use a number up to 1e100");
    check(matrix(1, 1, &[f64::NAN]), "costs.values[0]: NaN");
    check(matrix(1, 1, &[f64::NEG_INFINITY]), "costs.values[0]: -inf");
}

#[test]
fn a_model_that_gives_nonsense_is_found_out() {
    let problem = read(v1::AssignRequest {
        forbidden: vec![by_index(0, 1)],
        ..team(&[0.0, 0.0, 1.0, 0.0], &[1.0, 0.5, 0.0, 0.5])
    });
    let adopt = |goals: &[Option<u32>], p: Option<Vec<f32>>| engine::adopt(&problem, goals.to_vec(), p, &|| true);
    for wrong in [vec![Some(0), Some(0)], vec![Some(0), None], vec![Some(0), Some(2)], vec![Some(0)]] {
        assert!(adopt(&wrong, None).is_err(), "{wrong:?}");
    }
    assert!(adopt(&[Some(1), Some(0)], None).unwrap_err().contains("forbidden pair"));
    assert!(adopt(&[Some(0), Some(1)], Some(vec![0.5, f32::NAN])).unwrap_err().contains("probability"));
    let plan = adopt(&[Some(0), Some(1)], Some(vec![0.5, 1.0])).unwrap();
    assert_eq!((plan.scheduler, plan.exact_cost.is_some()), (AssignmentMethod::Learned, true));
}

#[test]
fn planning_stops_when_its_caller_is_gone() {
    let coordinates: Vec<f64> = (0..24).map(|k| ((k * 37) % 23) as f64).collect();
    let problem = read(team(&coordinates, &coordinates[2..]));
    let stopped = engine::solve(&problem, AssignmentMethod::Makespan, &|| false);
    assert_eq!(stopped, Err(AssignError::Interrupted));
    // An answer that is there stays, without its distance to the best.
    let values = (0..144).map(|k| f64::from((k / 12 + 1) * (k % 12 + 1))).collect();
    let costs = Some(v1::CostMatrix { agents: 12, goals: 12, values });
    let problem = read(v1::AssignRequest { costs, ..Default::default() });
    let greedy = engine::solve(&problem, AssignmentMethod::Greedy, &|| false).unwrap();
    assert_eq!(greedy.exact_cost, None);
    assert_eq!(greedy.goal_of, solve(&problem, AssignmentMethod::Greedy).goal_of);
    assert!(solve(&problem, AssignmentMethod::Greedy).exact_cost.is_some());
}

/// Every way to give each agent one of the goals or none, as goal_of.
fn every_plan(n: usize, g: usize, chosen: &mut Vec<u32>, visit: &mut impl FnMut(&[u32])) {
    if chosen.len() == n {
        return visit(chosen);
    }
    for goal in (0..g as u32).chain([UNASSIGNED]) {
        if goal == UNASSIGNED || !chosen.contains(&goal) {
            chosen.push(goal);
            every_plan(n, g, chosen, visit);
            chosen.pop();
        }
    }
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        20 => -10.0f64..10.0,
        4 => (-2i8..3).prop_map(f64::from),
        1 => any::<f64>(),
        1 => Just(f64::NAN),
    ]
}

fn side() -> impl Strategy<Value = Option<v1::Positions>> {
    let ok = (1usize..6).prop_flat_map(|n| prop::collection::vec(number(), 2 * n)).prop_map(|c| positions(2, &c));
    let odd = (0u32..5, prop::collection::vec(number(), 0..30)).prop_map(|(dims, c)| positions(dims, &c));
    let array = (prop::collection::vec(0u32..4, 0..3), prop::collection::vec(any::<u8>(), 0..40), 0i32..5).prop_map(
        |(shape, data, kind)| {
            let array = Some(v1::Array { r#type: kind, shape, data: data.into() });
            Some(v1::Positions { array, ..Default::default() })
        },
    );
    prop_oneof![12 => ok, 1 => odd, 1 => array, 1 => Just(None)]
}

fn reference() -> impl Strategy<Value = v1::PairRef> {
    let id = || prop_oneof![8 => Just(String::new()), 1 => Just("x".to_owned()), 1 => Just("a".to_owned())];
    (0u32..6, 0u32..6, id(), id()).prop_map(|(agent_index, goal_index, agent_id, goal_id)| v1::PairRef {
        agent_index,
        goal_index,
        agent_id,
        goal_id,
    })
}

fn few<T: std::fmt::Debug>(item: impl Strategy<Value = T>) -> impl Strategy<Value = Vec<T>> {
    prop::collection::vec(item, 0..3)
}

fn request() -> impl Strategy<Value = v1::AssignRequest> {
    let cost = prop_oneof![8 => -5.0f64..5.0, 1 => any::<f64>()].boxed();
    let priced =
        (prop::option::weighted(0.95, reference()), cost.clone()).prop_map(|(pair, cost)| v1::PairCost { pair, cost });
    let matrix = (1u32..5, 1u32..5).prop_flat_map(move |(agents, goals)| {
        let count = Union::new_weighted(vec![(9, Just((agents * goals) as usize).boxed()), (1, (0usize..20).boxed())]);
        let cost = cost.clone();
        count
            .prop_flat_map(move |count| prop::collection::vec(cost.clone(), count))
            .prop_map(move |values| v1::CostMatrix { agents, goals, values })
    });
    let ids = || prop_oneof![6 => Just(Vec::new()), 1 => prop::collection::vec("[ax]?", 0..4)];
    let switching = prop_oneof![6 => 0.0f64..3.0, 1 => any::<f64>()];
    let deadline = prop_oneof![6 => Just(None), 1 => any::<f64>().prop_map(Some)];
    (
        (side(), side(), ids(), ids()),
        (prop::option::weighted(0.2, matrix), few(priced), few(reference()), few(reference())),
        (switching, deadline, -1i32..7, -1i32..4),
    )
        .prop_map(|((agents, goals, agent_ids, goal_ids), (costs, cost_overrides, forbidden, current), rest)| {
            let (switching_cost, deadline_seconds, scheduler, mode) = rest;
            v1::AssignRequest {
                agents,
                goals,
                agent_ids,
                goal_ids,
                scheduler,
                mode,
                seed: None,
                costs,
                cost_overrides,
                forbidden,
                deadline_seconds,
                current,
                switching_cost,
                ..Default::default()
            }
        })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(2000) })]

    #[test]
    fn a_valid_matching_or_an_error_with_a_field_path(message in request(), seed in any::<u64>()) {
        let problem = match Problem::read(message, seed, &limits()) {
            Ok(problem) => problem,
            Err(error) => {
                let known = ["agents", "goals", "agent_ids", "goal_ids", "scheduler", "mode", "costs",
                    "cost_overrides", "forbidden", "current", "switching_cost", "deadline_seconds"];
                let first = error.field.split(['.', '[']).next().unwrap_or("");
                prop_assert!(known.contains(&first), "{error}");
                prop_assert!(!error.problem.is_empty());
                return Ok(());
            }
        };
        let (n, g) = (problem.agent_count, problem.goal_count);
        let mut costs = Vec::new();
        problem.costs_into(&mut costs);
        let allowed = |agent: usize, goal: usize| costs[agent * g + goal].is_finite();
        let mut most = 0;
        for kind in KINDS {
            let plan = solve(&problem, kind);
            let response = answer::write(&problem, &plan);
            let mut agents: Vec<u32> = response.pairs.iter().map(|p| p.agent_index).collect();
            let mut goals: Vec<u32> = response.pairs.iter().map(|p| p.goal_index).collect();
            prop_assert!(response.pairs.iter().all(|p| allowed(p.agent_index as usize, p.goal_index as usize)));
            prop_assert!(response.pairs.iter().all(|p| p.distance.is_finite() && p.cost.is_finite()));
            agents.extend(&response.unassigned_agents);
            goals.extend(&response.unassigned_goals);
            agents.sort_unstable();
            goals.sort_unstable();
            prop_assert_eq!(agents, (0..n as u32).collect::<Vec<_>>());
            prop_assert_eq!(goals, (0..g as u32).collect::<Vec<_>>());
            prop_assert_eq!(response.agents_without_goal.len(), response.unassigned_agents.len());
            prop_assert_eq!(response.goals_without_agent.len(), response.unassigned_goals.len());
            prop_assert!(response.gap.is_none_or(|gap| gap >= 0.0));
            match kind {
                AssignmentMethod::Exact => most = response.pairs.len(),
                AssignmentMethod::Greedy => prop_assert!(2 * response.pairs.len() >= most),
                _ => prop_assert_eq!(response.pairs.len(), most),
            }
            prop_assert_eq!(solve(&problem, kind), plan, "the same again");
        }
    }

    #[test]
    fn sticky_answers_are_exact_on_cost_plus_switches(
        n in 1usize..5, g in 1usize..5, numbers in prop::collection::vec(0.0f64..10.0, 16),
        bans in prop::collection::vec(any::<bool>(), 16), switching_cost in 0.0f64..4.0, rotation in 0u32..4
    ) {
        let values: Vec<f64> = numbers[..n * g].to_vec();
        let cells = (0..n as u32).flat_map(|a| (0..g as u32).map(move |b| (a, b)));
        let banned: Vec<(u32, u32)> =
            cells.filter(|&(a, b)| bans[a as usize * g + b as usize] && (a + b) % 3 == 0).collect();
        let current: Vec<v1::PairRef> =
            (0..n.min(g) as u32).map(|k| by_index(k, (k + rotation) % g as u32)).collect();
        let problem = read(v1::AssignRequest {
            costs: Some(v1::CostMatrix { agents: n as u32, goals: g as u32, values }),
            forbidden: banned.iter().map(|&(a, b)| by_index(a, b)).collect(),
            current,
            switching_cost,
            ..Default::default()
        });
        let mut costs = Vec::new();
        problem.costs_into(&mut costs);
        let score = |goal_of: &[u32]| {
            let mut pairs = 0usize;
            let mut sum = 0.0;
            for (agent, &goal) in goal_of.iter().enumerate() {
                if goal != UNASSIGNED {
                    pairs += 1;
                    sum += costs[agent * g + goal as usize];
                }
                if problem.current[agent] != UNASSIGNED && goal != problem.current[agent] {
                    sum += switching_cost;
                }
            }
            (pairs, sum)
        };
        let mut best = (0, f64::INFINITY);
        every_plan(n, g, &mut Vec::new(), &mut |goal_of| {
            let (pairs, sum) = score(goal_of);
            if sum.is_finite() && (pairs > best.0 || (pairs == best.0 && sum < best.1)) {
                best = (pairs, sum);
            }
        });
        let (pairs, sum) = score(&solve(&problem, AssignmentMethod::Exact).goal_of);
        prop_assert_eq!(pairs, best.0);
        prop_assert!((sum - best.1).abs() < 1e-6, "{} instead of {}", sum, best.1);
    }
}
