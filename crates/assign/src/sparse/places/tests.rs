use super::Shares;
use super::{Counted, Market, OwnCosts, Points, Problem, solve};
use crate::sparse::costs::Metric;
use crate::sparse::growing::Growing;
use crate::sparse::points::{Limit, PointProblem, check, matrix, solve_sparse};
use crate::sparse::threshold::bottleneck_sparse;
use crate::{BottleneckSolver, Solver, Switching, UNASSIGNED};
use magex_core::rng::{Key, Purpose, Stream};

/// Points `[count, dims]` on a grid, 0 with either sign.
fn on_a_grid(chance: &mut Stream, count: usize, dims: usize, side: u32) -> Vec<f64> {
    let mut coordinate = || match chance.below(2 * side) {
        0 => -0.0,
        drawn => f64::from(drawn / 2),
    };
    (0..count * dims).map(|_| coordinate()).collect()
}

/// As few or as many as `most` agents and goals that share some places; some with costs of their own or in force.
struct Drawn {
    points: [Vec<f64>; 2],
    dims: usize,
    power: f64,
    costs: Vec<(u32, u32, f64)>,
    current: Vec<u32>,
    switching: f64,
}

impl Drawn {
    fn new(chance: &mut Stream, most: u32) -> Self {
        let (rows, cols) = (1 + chance.below(most) as usize, 1 + chance.below(most) as usize);
        let cols = if chance.below(2) == 0 { rows } else { cols };
        let dims = 1 + chance.below(3) as usize;
        let side = 2 + chance.below(2 + most / 20);
        // One side may have no two points at the same place.
        let alone = chance.below(4);
        let points = [(rows, 0), (cols, 1)].map(|(count, which)| {
            let mut points = on_a_grid(chance, count, dims, side);
            if alone == which {
                points.iter_mut().for_each(|x| *x += chance.uniform());
            }
            points
        });
        let mut drawn = Self {
            points,
            dims,
            power: [1.0, 2.0, 1.5, 3.0][chance.below(4) as usize],
            costs: Vec::new(),
            current: Vec::new(),
            switching: f64::from(chance.below(3)) * 0.5,
        };
        if chance.below(3) == 0 {
            for _ in 0..chance.below(rows as u32 + 1) {
                let cost = if chance.below(3) == 0 { f64::from(chance.below(5)) - 1.0 } else { f64::INFINITY };
                drawn.costs.push((chance.below(rows as u32), chance.below(cols as u32), cost));
            }
        }
        if chance.below(3) == 0 {
            let order = chance.permutation(cols);
            let goal = |row: usize| order.get(row).copied().filter(|_| row % 4 == 1).unwrap_or(UNASSIGNED);
            drawn.current = (0..rows).map(goal).collect();
        }
        drawn
    }

    fn problem(&self) -> PointProblem<'_, f64> {
        PointProblem {
            power: self.power,
            costs: &self.costs,
            switching: Switching { current: &self.current, cost: self.switching },
            ..PointProblem::new(&self.points[0], &self.points[1], self.dims)
        }
    }
}

fn compare(first: u32, count: u32, most: u32) {
    let (mut solver, mut bottleneck) = (Solver::default(), BottleneckSolver::default());
    for index in first..first + count {
        let drawn = Drawn::new(&mut Key::new(30, Purpose::Bench, &[index]).stream(), most);
        let problem = drawn.problem();
        let (rows, cols) = check(&problem).unwrap();
        let cost = matrix(&problem).unwrap();
        let expected = solver.solve_switching(&cost, rows, cols, &problem.switching, &|| true).unwrap();
        let found = solve_sparse(&problem, rows, cols, Limit::NONE, &|| true).unwrap();
        assert_eq!(found, expected, "sum {index}: {rows} by {cols}");
        let problem = PointProblem { switching: Switching { cost: 0.0, ..problem.switching }, ..problem };
        let expected = bottleneck.solve_switching(&cost, rows, cols, &problem.switching, &|| true).unwrap();
        let found = bottleneck_sparse(&problem, rows, cols, &|| true).unwrap();
        assert_eq!(found, expected, "bottleneck {index}: {rows} by {cols}");
    }
}

#[test]
fn points_that_share_places_have_the_answers_of_the_matrix() {
    let times = if cfg!(debug_assertions) { 1 } else { 5 };
    compare(0, 800 * times, 8);
    compare(10_000, 100 * times, 60);
    compare(20_000, 4 * times, 300);
}

/// Of squares of distances between points of a grid, whose sums are not rounded, by visiting every matching.
fn lowest_best(agents: &[[f64; 2]], goals: &[[f64; 2]]) -> Vec<u32> {
    fn visit(agents: &[[f64; 2]], goals: &[[f64; 2]], chosen: &mut Vec<u32>, sum: f64, best: &mut (f64, Vec<u32>)) {
        let row = chosen.len();
        let missing = chosen.iter().filter(|goal| **goal == UNASSIGNED).count();
        if missing > agents.len().saturating_sub(goals.len()) || sum > best.0 {
            return;
        }
        if row == agents.len() {
            if sum < best.0 || *chosen < best.1 {
                *best = (sum, chosen.clone());
            }
            return;
        }
        for goal in (0..goals.len() as u32).chain([UNASSIGNED]) {
            let cost = goals
                .get(goal as usize)
                .map_or(0.0, |to| (agents[row][0] - to[0]).powi(2) + (agents[row][1] - to[1]).powi(2));
            if goal == UNASSIGNED || !chosen.contains(&goal) {
                chosen.push(goal);
                visit(agents, goals, chosen, sum + cost, best);
                chosen.pop();
            }
        }
    }
    let mut best = (f64::INFINITY, Vec::new());
    visit(agents, goals, &mut Vec::new(), 0.0, &mut best);
    best.1
}

#[test]
fn points_that_share_places_have_the_lowest_of_all_best_matchings() {
    let metric = Metric { power: 2.0, limit: f64::INFINITY };
    let mut counted = 0;
    for index in 0..if cfg!(debug_assertions) { 1500 } else { 6000 } {
        let mut chance = Key::new(31, Purpose::Bench, &[index]).stream();
        let [agents, goals] = [(); 2].map(|()| {
            let count = 1 + chance.below(7) as usize;
            on_a_grid(&mut chance, count, 2, 2).as_chunks::<2>().0.to_vec()
        });
        let turned = agents.len() > goals.len();
        let (short, long) = if turned { (&goals, &agents) } else { (&agents, &goals) };
        let own = &OwnCosts::default();
        let problem = Problem { short, long, metric, own, largest_cost: 2.0, sink: None, turned };
        if let Some(goal_of) = solve(&problem, &|| true).unwrap() {
            counted += 1;
            assert_eq!(goal_of, lowest_best(&agents, &goals), "{index}: {agents:?} {goals:?}");
        }
    }
    assert!(counted > 200, "{counted} had many points at the same places");
}

/// Pivots for each place, and looks of the bottleneck's rows for each point.
fn work(agents: &[[f64; 2]], goals: &[[f64; 2]], power: f64) -> [usize; 2] {
    let metric = Metric { power, limit: f64::INFINITY };
    let counted = Counted::new(agents, goals, &OwnCosts::default()).expect("many share a place");
    let mut shares = Shares::new(&counted, metric);
    shares.search(&|| true).unwrap();
    let Counted { short_at, long_at, own } = counted;
    let (source, order) = Points::new(&short_at.points, &long_at.points, metric, &own, 1e6, None);
    let supply = order.row_at.iter().map(|&place| short_at.members(place).len() as u64).collect();
    let demand = order.col_at.iter().map(|&place| long_at.members(place).len() as u64).collect();
    let mut market = Market { source, supply, demand, no_row: 0.0, no_col: 0.0, magnitude: 1e6 };
    let (simplex, _) = market.rounded(&|| true).unwrap().expect("a cheapest flow");
    let places = order.row_at.len() + order.col_at.len();
    [simplex.pivots / places, shares.seeker().looks / agents.len()]
}

#[test]
fn what_points_share_is_looked_at_once() {
    let mut chance = Key::new(32, Purpose::Bench, &[]).stream();
    let apart = |chance: &mut Stream, side: f64| -> Vec<[f64; 2]> {
        (0..4000).map(|_| [side * chance.uniform(), side * chance.uniform()]).collect()
    };
    let grid = |chance: &mut Stream, side| on_a_grid(chance, 4000, 2, side).as_chunks::<2>().0.to_vec();
    for power in [1.0, 2.0] {
        for sides in [[Some(20), Some(20)], [Some(5), Some(5)], [None, Some(5)], [None, Some(20)], [Some(20), None]] {
            let [agents, goals] = sides.map(|side| match side {
                Some(side) => grid(&mut chance, side),
                None => apart(&mut chance, f64::from(sides[0].or(sides[1]).unwrap_or(1))),
            });
            let [pivots, looks] = work(&agents, &goals, power);
            // 1 to 17, and 0 to 51.
            assert!(pivots <= 30 && looks <= 80, "power {power}, {sides:?}: {pivots} pivots, {looks} looks");
        }
    }
}
