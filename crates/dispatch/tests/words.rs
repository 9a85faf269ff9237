//! Every word of a fleet against the formula of the documentation and all possible plans.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_assign::powered;
use magex_core::rng::{Key, Purpose, Stream};
use magex_dispatch::engine;
use magex_dispatch::{Limits, Problem, UNASSIGNED, answer};
use magex_proto::goals::AssignmentMethod;
use magex_proto::v1;

const LIMITS: Limits = Limits { members: 40, teams: 3 };

/// The words of a request that a case may use.
const WORDS: [&str; 13] = [
    "power",
    "speeds",
    "offsets",
    "loads",
    "weights",
    "capacities",
    "earliest",
    "due",
    "precedence",
    "pinned",
    "forbidden",
    "costs",
    "sparse",
];

fn by_index(agent_index: u32, goal_index: u32) -> v1::PairRef {
    v1::PairRef { agent_index, goal_index, ..Default::default() }
}

/// A random team of up to 5 agents and goals that uses some words.
fn team(words: &[&str], stream: &mut Stream) -> v1::AssignRequest {
    let (n, g) = (1 + stream.below(5) as usize, 1 + stream.below(4) as usize);
    let has = |word: &str| words.contains(&word);
    let each = |count: usize, draw: &mut dyn FnMut() -> f64| (0..count).map(|_| draw()).collect::<Vec<f64>>();
    let mut draw = |low: f64, high: f64| stream.range(low, high);
    let points = |values: Vec<f64>| Some(v1::Positions { dims: 2, coordinates: values, ..Default::default() });
    let mut team = v1::AssignRequest::default();
    if has("costs") {
        let values = each(n * g, &mut || draw(0.0, 10.0));
        team.costs = Some(v1::CostMatrix { agents: n as u32, goals: g as u32, values });
    } else if !has("sparse") {
        team.agents = points(each(2 * n, &mut || draw(0.0, 10.0)));
        team.goals = points(each(2 * g, &mut || draw(0.0, 10.0)));
    }
    if has("power") {
        team.power = Some([1.0, 1.5, 2.0, 3.5, 4.0][(draw(0.0, 5.0) as usize).min(4)]);
    }
    if has("speeds") {
        team.agent_speeds = each(n, &mut || draw(0.2, 3.0));
    }
    if has("offsets") {
        team.agent_offsets = each(n, &mut || draw(0.0, 8.0));
    }
    if has("loads") {
        team.agent_loads = each(n, &mut || draw(0.0, 4.0));
        team.balance = draw(0.0, 3.0);
    }
    if has("weights") {
        team.goal_weights = each(g, &mut || draw(0.1, 9.0));
    }
    if has("earliest") {
        team.goal_earliest = each(g, &mut || draw(0.0, 12.0));
    }
    if has("due") {
        team.goal_due = each(g, &mut || draw(1.0, 14.0));
        let earliest = team.goal_earliest.clone();
        team.goal_due.iter_mut().zip(earliest).for_each(|(due, earliest)| *due = due.max(earliest));
    }
    if has("sparse") {
        let cells: Vec<(u32, u32)> = (0..n as u32).flat_map(|a| (0..g as u32).map(move |b| (a, b))).collect();
        let chosen: Vec<(u32, u32)> = cells.into_iter().filter(|_| draw(0.0, 1.0) < 0.6).collect();
        let values = each(chosen.len(), &mut || draw(0.0, 10.0));
        let (agent_indices, goal_indices) = chosen.into_iter().unzip();
        team.sparse_costs =
            Some(v1::SparseCosts { agents: n as u32, goals: g as u32, agent_indices, goal_indices, values });
    }
    if has("capacities") {
        team.goal_capacities = (0..g).map(|_| 1 + draw(0.0, 3.0) as u32).collect();
    }
    if has("precedence") && g > 1 {
        let goal_index = (draw(0.0, g as f64) as u32).min(g as u32 - 1);
        let after_index = (goal_index + 1) % g as u32;
        team.precedence = vec![v1::Precedence { goal_index, after_index, ..Default::default() }];
    }
    let any = |draw: &mut dyn FnMut(f64, f64) -> f64| {
        by_index((draw(0.0, n as f64) as u32).min(n as u32 - 1), (draw(0.0, g as f64) as u32).min(g as u32 - 1))
    };
    if has("forbidden") {
        team.forbidden = (0..3).map(|_| any(&mut draw)).collect();
    }
    if has("pinned") {
        team.pinned = vec![any(&mut draw)];
    }
    team
}

/// The formula of the documentation, written down once more.
struct Formula<'a> {
    team: &'a v1::AssignRequest,
    agents: usize,
    goals: usize,
}

impl Formula<'_> {
    fn base(&self, agent: usize, goal: usize) -> f64 {
        let pair = by_index(agent as u32, goal as u32);
        if self.team.forbidden.contains(&pair) {
            return f64::INFINITY;
        }
        if let Some(sparse) = &self.team.sparse_costs {
            let at = (0..sparse.values.len())
                .rfind(|&k| sparse.agent_indices[k] == agent as u32 && sparse.goal_indices[k] == goal as u32);
            return at.map_or(f64::INFINITY, |k| sparse.values[k]);
        }
        match &self.team.costs {
            Some(costs) => costs.values[agent * self.goals + goal],
            None => {
                let at = |side: &Option<v1::Positions>, k: usize| {
                    let c = &side.as_ref().unwrap().coordinates;
                    (c[2 * k], c[2 * k + 1])
                };
                let ((ax, ay), (gx, gy)) = (at(&self.team.agents, agent), at(&self.team.goals, goal));
                ((ax - gx) * (ax - gx) + (ay - gy) * (ay - gy)).sqrt()
            }
        }
    }

    /// The parenthesis, or +∞ for an impossible pair.
    fn time(&self, agent: usize, goal: usize) -> f64 {
        let t = self.team;
        let of = |list: &[f64], k: usize, neutral: f64| list.get(k).copied().unwrap_or(neutral);
        let there = of(&t.agent_offsets, agent, 0.0)
            + t.balance * of(&t.agent_loads, agent, 0.0)
            + self.base(agent, goal) / of(&t.agent_speeds, agent, 1.0);
        let wait = (of(&t.goal_earliest, goal, 0.0) - there).max(0.0);
        let closed = t.precedence.iter().any(|order| order.goal_index == goal as u32);
        let late = there + wait > of(&t.goal_due, goal, f64::INFINITY);
        if closed || late { f64::INFINITY } else { there + wait / 2.0 }
    }

    fn capacity(&self, goal: usize) -> usize {
        self.team.goal_capacities.get(goal).map_or(1, |&k| k as usize)
    }

    fn weight(&self, goal: usize) -> f64 {
        self.team.goal_weights.get(goal).copied().unwrap_or(1.0)
    }

    /// Pairs, largest time to the power, and summed cost with what is left over; `None` for an impossible plan.
    fn score(&self, goal_of: &[u32], times: &[f64], unserved: f64) -> Option<(usize, f64, f64)> {
        let power = self.team.power.unwrap_or(1.0);
        let (mut pairs, mut largest, mut sum) = (0, 0.0f64, 0.0);
        let mut free: Vec<usize> = (0..self.goals).map(|goal| self.capacity(goal).min(self.agents)).collect();
        for (agent, &goal) in goal_of.iter().enumerate() {
            let pin = self.team.pinned.iter().find(|pin| pin.agent_index == agent as u32);
            if goal == UNASSIGNED {
                continue;
            }
            let time = times[agent * self.goals + goal as usize];
            if time == f64::INFINITY || pin.is_some_and(|pin| pin.goal_index != goal) {
                return None;
            }
            pairs += 1;
            free[goal as usize] = free[goal as usize].checked_sub(1)?;
            largest = largest.max(powered(time, power));
            sum += self.weight(goal as usize) * powered(time, power);
        }
        // The places of pinned agents are theirs, whether they can come or not.
        for pin in &self.team.pinned {
            if goal_of[pin.agent_index as usize] != pin.goal_index && free[pin.goal_index as usize] == 0 {
                return None;
            }
        }
        let left: f64 = (0..self.goals).map(|goal| free[goal] as f64 * self.weight(goal)).sum();
        Some((pairs, largest, sum + unserved * left))
    }
}

fn every_plan(n: usize, g: usize, chosen: &mut Vec<u32>, visit: &mut impl FnMut(&[u32])) {
    if chosen.len() == n {
        return visit(chosen);
    }
    for goal in (0..g as u32).chain([UNASSIGNED]) {
        chosen.push(goal);
        every_plan(n, g, chosen, visit);
        chosen.pop();
    }
}

fn close(one: f64, other: f64) -> bool {
    (one - other).abs() <= 1e-9 * one.abs().max(other.abs()).max(1.0)
}

/// Whether the answers of `exact` and `makespan` are the best of all plans. False if the team is contradictory.
fn check(team: &v1::AssignRequest) -> bool {
    let Ok(problem) = Problem::read(team.clone(), 1, &LIMITS) else { return false };
    let (n, g) = (problem.agent_count, problem.goal_count);
    let formula = Formula { team, agents: n, goals: g };
    let times: Vec<f64> = (0..n * g).map(|cell| formula.time(cell / g, cell % g)).collect();
    let longest = times.iter().copied().filter(|time| *time < f64::INFINITY).fold(0.0, f64::max);
    let differ = team.goal_weights.iter().any(|weight| *weight != team.goal_weights[0]);
    let unserved = if differ { powered(2.0 * longest, team.power.unwrap_or(1.0)) } else { 0.0 };
    let mut plans = Vec::new();
    every_plan(n, g, &mut Vec::new(), &mut |goal_of| plans.extend(formula.score(goal_of, &times, unserved)));
    let most = plans.iter().map(|(pairs, ..)| *pairs).max().unwrap();
    let least = |plans: &[(usize, f64, f64)]| plans.iter().map(|(.., sum)| *sum).fold(f64::INFINITY, f64::min);
    plans.retain(|(pairs, ..)| *pairs == most);
    let cheapest = least(&plans);

    let plan = engine::solve(&problem, AssignmentMethod::Exact, &|| true).unwrap();
    let (pairs, _, sum) = formula.score(&plan.goal_of, &times, unserved).unwrap();
    assert!(pairs == most && close(sum, cheapest), "{pairs} of {most} pairs, {sum} for {cheapest}: {team:?}");
    let response = answer::write(&problem, &plan);
    assert!(close(response.cost, sum) && response.gap == Some(0.0), "{} is not {sum}: {team:?}", response.cost);

    let shortest = plans.iter().map(|(_, largest, _)| *largest).fold(f64::INFINITY, f64::min);
    let within: Vec<_> = plans.iter().copied().filter(|(_, largest, _)| *largest <= shortest * (1.0 + 1e-9)).collect();
    let plan = engine::solve(&problem, AssignmentMethod::Makespan, &|| true).unwrap();
    let (pairs, largest, sum) = formula.score(&plan.goal_of, &times, unserved).unwrap();
    assert!(pairs == most && close(largest, shortest), "makespan {largest} for {shortest}: {team:?}");
    assert!(close(sum, least(&within)), "makespan, then {sum} for {}: {team:?}", least(&within));
    true
}

#[test]
fn each_word_alone_is_the_formula() {
    for (k, word) in (0u32..).zip(WORDS) {
        let mut stream = Key::new(7, Purpose::Instances, &[1, k]).stream();
        let checked = (0..150).filter(|_| check(&team(&[word], &mut stream))).count();
        assert!(checked > 100, "{word}: {checked} cases");
    }
}

#[test]
fn words_together_are_the_formula() {
    let mut checked = 0;
    for k in 0..1500 {
        let mut stream = Key::new(7, Purpose::Instances, &[2, k]).stream();
        let words: Vec<&str> = WORDS.into_iter().filter(|_| stream.below(3) == 0).collect();
        checked += usize::from(check(&team(&words, &mut stream)));
    }
    assert!(checked > 1000, "{checked} cases");
}

#[test]
fn switching_costs_are_in_the_unit_after_the_power() {
    // Staying costs 3² + 3², crossing 2² + 2²: it saves 10 and costs twice the switching cost.
    let team = |switching_cost| v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![3.0, 2.0, 2.0, 3.0] }),
        current: vec![by_index(0, 0), by_index(1, 1)],
        power: Some(2.0),
        switching_cost,
        ..Default::default()
    };
    let goals = |switching_cost| {
        let problem = Problem::read(team(switching_cost), 1, &LIMITS).unwrap();
        engine::solve(&problem, AssignmentMethod::Exact, &|| true).unwrap().goal_of
    };
    assert_eq!((goals(4.9), goals(5.1)), (vec![1, 0], vec![0, 1]));
}

#[test]
fn wrong_words_and_contradictions_are_named() {
    let check = |change: fn(&mut v1::AssignRequest), words: &str| {
        let points =
            |values: &[f64]| Some(v1::Positions { dims: 2, coordinates: values.to_vec(), ..Default::default() });
        let mut team = v1::AssignRequest {
            agents: points(&[0.0, 0.0, 2.0, 2.0]),
            goals: points(&[1.0, 1.0, 3.0, 1.0]),
            ..Default::default()
        };
        change(&mut team);
        let error = Problem::read(team, 1, &LIMITS).unwrap_err().to_string();
        assert!(error.starts_with(words), "{error} instead of {words}");
    };
    check(|m| m.power = Some(0.5), "power: 0.5 is not a number from 1 to 16");
    check(|m| m.power = Some(f64::NAN), "power: NaN is not a number");
    check(|m| m.agent_speeds = vec![1.0], "agent_speeds: 1 numbers for 2 members");
    check(|m| m.agent_speeds = vec![1.0, 0.0], "agent_speeds[1]: 0 is not a number from 1e-12");
    check(|m| m.agent_offsets = vec![-1.0, 0.0], "agent_offsets[0]: -1 is not");
    check(|m| m.balance = 1.0, "balance: agent_loads are missing");
    check(|m| m.goal_weights = vec![1.0, f64::INFINITY], "goal_weights[1]: inf is not");
    check(|m| m.goal_capacities = vec![1, 0], "goal_capacities[1]: 0 agents");
    check(
        |m| (m.goal_earliest, m.goal_due) = (vec![5.0, 0.0], vec![4.0, 1.0]),
        "goal_due[0]: 4 is before goal_earliest[0]",
    );
    check(
        |m| {
            let after = |goal_index, after_index| v1::Precedence { goal_index, after_index, ..Default::default() };
            m.precedence = vec![after(0, 1), after(1, 0)];
        },
        "precedence: a circle, in which no goal can be the first: goal 0 waits for goal 1 waits for goal 0",
    );
    check(
        |m| (m.pinned, m.forbidden) = (vec![by_index(0, 1)], vec![by_index(0, 1)]),
        "pinned[0]: the pair is forbidden, too",
    );
    check(
        |m| m.pinned = vec![by_index(0, 1), by_index(0, 0)],
        "pinned[1]: its agent is pinned twice; an agent has one goal",
    );
    check(
        |m| m.pinned = vec![by_index(0, 1), by_index(1, 1)],
        "pinned[1]: 2 agents are pinned to its goal, which takes 1",
    );
    check(
        |m| {
            m.pinned = vec![by_index(0, 1)];
            m.precedence = vec![v1::Precedence { goal_index: 1, after_index: 0, ..Default::default() }];
        },
        "pinned[0]: its goal waits for another one",
    );
    check(
        |m| {
            m.costs = Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![1.0, -1.0, 1.0, 1.0] });
            m.power = Some(2.0);
        },
        "costs.values[1]: -1 is negative, which a power above 1",
    );
    check(
        |m| {
            m.agents.as_mut().unwrap().coordinates[0] = 1e30;
            m.power = Some(16.0);
        },
        "power: a pair may take 1e30",
    );
    check(
        |m| {
            m.sparse_costs = Some(v1::SparseCosts { agents: 2, goals: 2, ..Default::default() });
            m.costs = Some(v1::CostMatrix { agents: 2, goals: 2, values: vec![1.0; 4] });
        },
        "sparse_costs: costs are given, too",
    );
    let sparse = |agent_indices: Vec<u32>, goal_indices: Vec<u32>, values: Vec<f64>| {
        let sparse = v1::SparseCosts { agents: 2, goals: 2, agent_indices, goal_indices, values };
        let team = v1::AssignRequest { sparse_costs: Some(sparse), ..Default::default() };
        Problem::read(team, 1, &LIMITS).map(drop).map_err(|error| error.to_string())
    };
    assert_eq!(sparse(vec![0, 1], vec![1, 0], vec![1.0, f64::INFINITY]), Ok(()));
    assert!(
        sparse(vec![0], vec![1, 0], vec![1.0]).unwrap_err().starts_with("sparse_costs.goal_indices: 2 indices for 1")
    );
    assert!(
        sparse(vec![2], vec![0], vec![1.0]).unwrap_err().starts_with("sparse_costs.agent_indices[0]: 2 is not below 2")
    );
    assert!(sparse(vec![0], vec![0], vec![f64::NAN]).unwrap_err().starts_with("sparse_costs.values[0]: NaN"));
}

#[test]
fn positions_keep_their_digits() {
    let points =
        |dims: u32, points: &[&[f64]]| Some(v1::Positions { dims, coordinates: points.concat(), ..Default::default() });
    let solve = |dims: u32, agents: &[&[f64]], goals: &[&[f64]]| {
        let team = v1::AssignRequest { agents: points(dims, agents), goals: points(dims, goals), ..Default::default() };
        let problem = Problem::read(team, 1, &LIMITS).unwrap();
        let plan = engine::solve(&problem, problem.scheduler, &|| true).unwrap();
        (plan.goal_of.clone(), answer::write(&problem, &plan))
    };
    // UTM metres: three robots 0.2 m apart, and goals a few centimetres away.
    let (x, y) = (388_096.0, 9_348_996.0);
    let at = |y: f64| [x, y];
    let (goals, answer) =
        solve(2, &[&at(y), &at(y + 0.2), &at(y + 0.4)], &[&at(y + 0.41), &at(y + 0.19), &at(y + 0.02)]);
    assert_eq!(goals, [2, 1, 0]);
    assert!((answer.cost - 0.04).abs() < 1e-8 && answer.gap == Some(0.0), "{answer:?}");
    let (_, answer) = solve(2, &[&[500_000.25, 4_649_776.75]], &[&[500_000.25, 4_649_777.0]]);
    assert_eq!((answer.cost, answer.distance), (0.25, 0.25));
    // Earth-centred metres, degrees, and steps of 1e-3 at 1e9.
    let (_, answer) = solve(3, &[&[3_782_970.1, 902_154.92, 5_038_375.59]], &[&[3_782_970.1, 902_155.92, 5_038_375.6]]);
    assert!((answer.cost - 1.00005).abs() < 1e-8, "{}", answer.cost);
    let (goals, _) = solve(2, &[&[52.000_004, 13.0], &[52.000_000, 13.0]], &[&[52.000_001, 13.0], &[52.000_005, 13.0]]);
    assert_eq!(goals, [1, 0]);
    let (goals, answer) = solve(2, &[&[1e9, 0.0], &[1e9 + 2e-3, 0.0]], &[&[1e9 + 3e-3, 0.0], &[1e9 + 1e-3, 0.0]]);
    assert_eq!(goals, [1, 0]);
    assert!((answer.cost - 2e-3).abs() < 1e-6, "{}", answer.cost);
}
