//! An agent keeps its goal unless leaving it saves more than the switching cost, whatever the method.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_dispatch::answer::Planned;
use magex_dispatch::engine::{self, Plan};
use magex_dispatch::mission::{Mission, MissionLimits};
use magex_dispatch::{AssignError, Limits, Problem, UNASSIGNED, answer};
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;
use magex_proto::v1::ChangeReason;
use proptest::prelude::*;

const LIMITS: MissionLimits = MissionLimits { members: 20, lifetime_ms: 60_000 };

fn matrix(agents: usize, values: &[f64], current: &[(u32, u32)], switching_cost: f64) -> Problem {
    let (agents, goals) = (agents as u32, (values.len() / agents) as u32);
    let pair = |&(agent_index, goal_index): &(u32, u32)| v1::PairRef { agent_index, goal_index, ..Default::default() };
    let message = v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents, goals, values: values.to_vec() }),
        current: current.iter().map(pair).collect(),
        switching_cost,
        ..Default::default()
    };
    Problem::read(message, 1, &Limits::default()).unwrap()
}

fn exact(problem: &Problem) -> Vec<u32> {
    engine::solve(problem, AssignmentMethod::Exact, &|| true).unwrap().goal_of
}

fn adopt(problem: &Problem, wish: &[u32]) -> Plan {
    let goals = wish.iter().map(|&goal| (goal != UNASSIGNED).then_some(goal)).collect();
    engine::adopt(problem, goals, Some(vec![0.5; wish.len()]), &|| true).unwrap()
}

#[test]
fn what_one_far_pair_costs_says_nothing_about_the_others() {
    let current = [(0, 0), (1, 1), (2, 2)];
    for far in [1e9, 1e15, 1e100] {
        // Crossing saves 0.8 for two switches.
        let costs = [5.2, 4.8, far, 4.8, 5.2, 7.0, far, 7.0, 1.0];
        assert_eq!(exact(&matrix(3, &costs, &current, 0.3)), [1, 0, 2], "{far:e}");
        assert_eq!(exact(&matrix(3, &costs, &current, 0.5)), [0, 1, 2], "{far:e}");
        // The same where the far pair is in force and cannot be left.
        let costs = [5.2, 4.8, far, 4.8, 5.2, far, far, far, far];
        assert_eq!(exact(&matrix(3, &costs, &current, 0.3)), [1, 0, 2], "{far:e}");
        // Ties change nothing, among zeros either.
        let costs = [0.0, 0.0, far, 0.0, 0.0, far, 3.0, 3.0, 3.0];
        for kept in [[(0, 0), (1, 1), (2, 2)], [(0, 1), (1, 0), (2, 2)]] {
            let goal_of = exact(&matrix(3, &costs, &kept, 0.0));
            assert_eq!(goal_of, kept.map(|(_, goal)| goal), "{far:e}");
        }
    }
}

#[test]
fn nothing_but_zeros_changes_nothing() {
    for kept in [[(0, 0), (1, 1)], [(0, 1), (1, 0)]] {
        assert_eq!(exact(&matrix(2, &[0.0; 4], &kept, 0.0)), kept.map(|(_, goal)| goal));
    }
}

fn member(id: &str, x: f64) -> v1::Member {
    v1::Member { id: id.into(), position: vec![x, 0.0], ..Default::default() }
}

/// A model that sends agent k to goal k + 1.
fn restless(problem: &Problem) -> Result<Planned, AssignError> {
    let (n, g) = (problem.agent_count as u32, problem.goal_count as u32);
    let goals = (0..n).map(|k| (k < g).then_some((k + 1) % g)).collect();
    let plan = engine::adopt(problem, goals, None, &|| true).unwrap();
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

#[test]
fn an_agent_that_joins_a_learned_mission_moves_no_other_agent() {
    let create = v1::CreateMissionRequest {
        mission_id: "m".into(),
        agents: vec![member("a", 0.0), member("b", 1.0)],
        goals: vec![member("x", 0.0), member("y", 1.0)],
        scheduler: v1::AssignmentMethod::Learned.into(),
        switching_cost: 5.0,
        ..Default::default()
    };
    let goals = |mission: &Mission| -> Vec<(String, String)> {
        mission.assignment.pairs.iter().map(|pair| (pair.agent_id.clone(), pair.goal_id.clone())).collect()
    };
    let both = [("a".to_owned(), "y".to_owned()), ("b".to_owned(), "x".to_owned())];
    let first = Mission::create(create, "me", "", 0, &LIMITS, &restless).unwrap();
    assert_eq!(goals(&first), both);
    // The model would move all three; neither has been asked to be moved.
    let third = v1::UpdateMissionRequest {
        agents: vec![member("c", 2.0)],
        goals: vec![member("z", 2.0)],
        ..Default::default()
    };
    let joined = first.update(third, 1, &LIMITS, &restless).unwrap();
    assert_eq!(goals(&joined)[..2], both);
    let [change] = &joined.assignment.changes[..] else { panic!("{:?}", joined.assignment.changes) };
    assert_eq!((change.agent_id.as_str(), change.to_goal_id.as_str()), ("c", "z"));
    assert_eq!(change.reason(), ChangeReason::Assigned);
    // A fourth agent without a goal displaces no other.
    let fourth = v1::UpdateMissionRequest { agents: vec![member("0", 1.0)], ..Default::default() };
    let crowded = joined.update(fourth, 2, &LIMITS, &restless).unwrap();
    assert!(crowded.assignment.changes.is_empty(), "{:?}", crowded.assignment.changes);
    // Where the exchange is worth it, it happens, and says so.
    let cheap = v1::UpdateMissionRequest { switching_cost: Some(0.5), ..Default::default() };
    let swapped = first.update(cheap, 3, &LIMITS, &|problem| {
        let plan = engine::adopt(problem, vec![Some(0), Some(1)], None, &|| true).unwrap();
        Ok(Planned { plan, fallback_reason: String::new(), weights: None })
    });
    let changes = swapped.unwrap().assignment.changes;
    assert_eq!(changes.len(), 2);
    assert!(changes[0].explanation.contains("fall by 2.0000, more than 2 x the switching cost of 0.5"), "{changes:?}");
}

#[test]
fn of_two_exchanges_that_a_model_wants_the_one_that_is_worth_it_happens() {
    // 0 and 1 exchange for 0.2, 2 and 3 for 8; 4 had nothing, and its goal is kept by 0.
    let costs = [
        1.0, 0.9, 9.0, 9.0, 9.0, //
        0.9, 1.0, 9.0, 9.0, 9.0, //
        9.0, 9.0, 5.0, 1.0, 9.0, //
        9.0, 9.0, 1.0, 5.0, 9.0, //
        9.0, 9.0, 9.0, 9.0, 2.0,
    ];
    let current = [(0, 0), (1, 1), (2, 2), (3, 3)];
    let problem = matrix(5, &costs, &current, 1.0);
    let plan = adopt(&problem, &[1, 0, 3, 2, 4]);
    assert_eq!(plan.goal_of, [0, 1, 3, 2, 4]);
    assert_eq!((plan.cost, plan.scheduler), (6.0, AssignmentMethod::Learned));
    // What the model did not choose has no probability of its.
    assert_eq!(plan.probabilities, Some(vec![None, None, Some(0.5), Some(0.5), Some(0.5)]));
    let response = answer::write(&problem, &plan);
    assert_eq!((response.switches, response.pairs[0].probability, response.pairs[4].probability), (2, None, Some(0.5)));
}

#[test]
fn more_pairs_are_worth_any_switch() {
    // Agent 1 can only go where agent 0 is.
    let inf = v1::PairRef { agent_index: 1, goal_index: 1, ..Default::default() };
    let message = v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![1.0, 1.0, 1.0, 1.0] }),
        forbidden: vec![inf],
        current: vec![v1::PairRef::default()],
        switching_cost: 1e6,
        ..Default::default()
    };
    let problem = Problem::read(message, 1, &Limits::default()).unwrap();
    assert_eq!(adopt(&problem, &[1, 0]).goal_of, [1, 0]);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(500) })]

    #[test]
    fn a_model_is_followed_only_where_it_pays(
        n in 1usize..7, g in 1usize..7, numbers in prop::collection::vec(0.0f64..10.0, 36), had in 0usize..6,
        wanted in Just([0u32, 1, 2, 3, 4, 5]).prop_shuffle(), held in Just([0u32, 1, 2, 3, 4, 5]).prop_shuffle(),
        switching_cost in 0.0f64..6.0
    ) {
        let current: Vec<(u32, u32)> = (0..n as u32).zip(held.into_iter().filter(|&goal| (goal as usize) < g)).take(had).collect();
        let problem = matrix(n, &numbers[..n * g], &current, switching_cost);
        let mut wish: Vec<u32> = wanted.into_iter().filter(|&goal| (goal as usize) < g).collect();
        wish.resize(wish.len().max(n), UNASSIGNED);
        wish.truncate(n);
        let plan = adopt(&problem, &wish);
        let (pairs, goals): (usize, std::collections::BTreeSet<u32>) = {
            let some = plan.goal_of.iter().filter(|&&goal| goal != UNASSIGNED);
            (some.clone().count(), some.copied().collect())
        };
        prop_assert_eq!((pairs, goals.len()), (n.min(g), n.min(g)), "a full matching");
        let had = |agent: usize| problem.current.get(agent).copied().unwrap_or(UNASSIGNED);
        let score = |goal_of: &[u32]| -> f64 {
            let costs = goal_of.iter().enumerate().filter(|(_, goal)| **goal != UNASSIGNED);
            let left = (0..n).filter(|&agent| had(agent) != UNASSIGNED && had(agent) != goal_of[agent]).count();
            costs.map(|(agent, goal)| numbers[agent * g + *goal as usize]).sum::<f64>() + switching_cost * left as f64
        };
        prop_assert!(score(&plan.goal_of) <= score(&wish) + 1e-6, "never worse than the wish");
        prop_assert!(score(&plan.goal_of) >= score(&exact(&problem)) - 1e-6, "nor better than the exact answer");
        let dear = Problem { switching_cost: 1e9, ..problem.clone() };
        let kept = adopt(&dear, &wish).goal_of;
        prop_assert!(current.iter().all(|&(agent, goal)| kept[agent as usize] == goal), "{:?}", kept);
        prop_assert!(score(&plan.goal_of) <= score(&kept) + 1e-6, "never worse than keeping everything");
    }
}

#[test]
fn break_even_changes_nothing_and_ties_go_to_the_lowest_index() {
    let makespan = |problem: &Problem| engine::solve(problem, AssignmentMethod::Makespan, &|| true).unwrap().goal_of;
    let kept = [
        matrix(1, &[1.0, 2.0], &[(0, 1)], 1.0),
        matrix(1, &[2.0, 1.0], &[(0, 0)], 1.0),
        matrix(2, &[0.0, 1.0, 0.0, 3.0], &[(0, 0), (1, 1)], 1.0),
        matrix(2, &[2.0, 1.0, 1.0, 2.0], &[(0, 0), (1, 1)], 1.0),
        // The doubles of 0.3 and 0.1 + 0.2 differ, and it is the doubles that count: 0.3 - 0.1 < 0.2.
        matrix(1, &[0.3, 0.1], &[(0, 0)], 0.2),
    ];
    for problem in &kept {
        assert_eq!(exact(problem), problem.current, "{problem:?}");
    }
    // The largest costs are 2 and 1 + 1.
    assert_eq!(makespan(&kept[3]), kept[3].current);
    for ones in [matrix(2, &[1.0; 4], &[], 0.0), matrix(3, &[1.0; 9], &[], 0.0), matrix(3, &[1.0; 15], &[], 0.0)] {
        let diagonal: Vec<u32> = (0..ones.agent_count as u32).collect();
        assert_eq!((exact(&ones), makespan(&ones)), (diagonal.clone(), diagonal));
    }
    // A pair of 1e16 that cannot be avoided leaves the others their digits.
    assert_eq!(exact(&matrix(2, &[1e16, 1e16, 0.9071, 0.9363], &[], 0.0)), [1, 0]);
    assert_eq!(exact(&matrix(3, &[1e50, 1e50, 1e50, 1.0, 2.0, 9.0, 1.0, 4.0, 3.0], &[], 0.0)), [2, 1, 0]);
}
