//! The solvers against exact rational arithmetic: every matching of small problems is visited, and its cost is summed without
//! rounding. The quick part runs in every test; the long one is named in .ci/long.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

#[path = "exact/problems.rs"]
mod problems;

use magex_assign::{BottleneckSolver, Solver, Switching, UNASSIGNED};
use magex_core::rng::{Key, Purpose};
use num_bigint::BigInt;
use num_rational::BigRational;
use problems::{KINDS, Small, draw};
use std::cmp::Ordering;

/// What is minimised, in this order.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Score {
    /// Pairs that are missing.
    missing: usize,
    /// Empty, or the largest cost.
    largest: Vec<BigInt>,
    /// Summed cost + switching cost × switches.
    cost: BigInt,
    switches: usize,
    col_of_row: Vec<u32>,
}

/// A problem in whole numbers of the same unit.
struct Whole {
    rows: usize,
    cols: usize,
    cost: Vec<Option<BigInt>>,
    current: Vec<u32>,
    switching: BigInt,
    bottleneck: bool,
}

impl Whole {
    fn of(problem: &Small, bottleneck: bool) -> Self {
        let exact = |value: f64| BigRational::from_float(value).unwrap();
        let every = || problem.cost.iter().copied().filter(|c| c.is_finite()).chain([problem.switching]).map(exact);
        // The denominators are powers of two.
        let unit = every().map(|value| value.denom().clone()).max().unwrap();
        let whole = |value: f64| (exact(value) * unit.clone()).to_integer();
        Self {
            rows: problem.rows,
            cols: problem.cols,
            cost: problem.cost.iter().map(|&c| c.is_finite().then(|| whole(c))).collect(),
            current: problem.current.clone(),
            switching: whole(problem.switching),
            bottleneck,
        }
    }

    fn best(&self) -> Score {
        let mut best = None;
        let start = Score {
            missing: self.rows.min(self.cols),
            largest: Vec::new(),
            cost: BigInt::default(),
            switches: 0,
            col_of_row: Vec::new(),
        };
        self.visit(start, &mut best);
        best.unwrap()
    }

    /// Gives the next row every column that is free, and none.
    fn visit(&self, score: Score, best: &mut Option<Score>) {
        let row = score.col_of_row.len();
        if row == self.rows {
            if best.as_ref().is_none_or(|best| score < *best) {
                *best = Some(score);
            }
            return;
        }
        let current = self.current.get(row).copied().unwrap_or(UNASSIGNED);
        for col in (0..self.cols as u32).chain([UNASSIGNED]) {
            let mut next = score.clone();
            let leaves = current != UNASSIGNED && current != col;
            if leaves {
                next.cost += &self.switching;
                next.switches += 1;
            }
            if col != UNASSIGNED {
                let Some(cost) = &self.cost[row * self.cols + col as usize] else { continue };
                if next.col_of_row.contains(&col) {
                    continue;
                }
                next.missing -= 1;
                next.cost += cost;
                if self.bottleneck {
                    let own = if leaves { cost + &self.switching } else { cost.clone() };
                    let largest = next.largest.pop().filter(|largest| *largest > own).unwrap_or(own);
                    next.largest.push(largest);
                }
            }
            next.col_of_row.push(col);
            self.visit(next, best);
        }
    }
}

fn check(problem: &Small, solver: &mut Solver, bottleneck: &mut BottleneckSolver) {
    let Small { rows, cols, cost, current, switching } = problem;
    let switching = Switching { current, cost: *switching };
    let answer = solver.solve_switching(cost, *rows, *cols, &switching, &|| true).unwrap();
    let best = Whole::of(problem, false).best();
    assert_eq!(answer.col_of_row, best.col_of_row, "{problem:?}");
    if current.is_empty() && cost.iter().all(|c| c.is_finite()) {
        assert_eq!(solver.solve(cost, *rows, *cols).unwrap(), answer, "{problem:?}");
    }
    let answer = bottleneck.solve_switching(cost, *rows, *cols, &switching, &|| true).unwrap();
    assert_eq!(answer.col_of_row, Whole::of(problem, true).best().col_of_row, "makespan of {problem:?}");
}

fn check_many(first: u32, count: u32) {
    let (mut solver, mut bottleneck) = (Solver::default(), BottleneckSolver::default());
    for index in first..first + count {
        let mut chance = Key::new(23, Purpose::Bench, &[index]).stream();
        let problem = draw(&mut chance, KINDS[index as usize % KINDS.len()]);
        check(&problem, &mut solver, &mut bottleneck);
    }
}

#[test]
fn small_problems_have_the_lowest_of_the_exact_optima() {
    check_many(0, if cfg!(debug_assertions) { 1200 } else { 6000 });
}

#[test]
#[ignore = "minutes; .ci/long runs it"]
fn a_hundred_thousand_small_problems_have_the_lowest_of_the_exact_optima() {
    check_many(0, 100_000);
}

#[test]
fn the_oracle_knows_the_order_of_what_is_minimised() {
    let problem = Small { rows: 2, cols: 2, cost: vec![0.0, 1.0, 0.0, 3.0], current: vec![0, 1], switching: 1.0 };
    // Keeping costs 3, and so does exchanging: 1 and two switches.
    let best = Whole::of(&problem, false).best();
    assert_eq!((best.col_of_row, best.switches), (vec![0, 1], 0));
    assert_eq!(Whole::of(&Small { switching: 0.5, ..problem.clone() }, false).best().col_of_row, [1, 0]);
    assert_eq!(best.cost.cmp(&BigInt::from(3)), Ordering::Equal);
}
