//! Small problems of the kinds that solvers get wrong.

use magex_assign::UNASSIGNED;
use magex_core::rng::Stream;

/// At most 6 × 6.
#[derive(Debug, Clone)]
pub(crate) struct Small {
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    /// `[rows, cols]`; +∞ forbids a pair.
    pub(crate) cost: Vec<f64>,
    /// `[rows]` or empty.
    pub(crate) current: Vec<u32>,
    pub(crate) switching: f64,
}

/// How the costs of a problem look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Kind {
    Integers(u32),
    Tenths(u32),
    /// Some unit in the last place around 1.
    OneUlp,
    /// Ordinary ones, and rows or columns of very large ones that cannot be avoided.
    VeryLarge,
    /// A very large switching cost.
    LargeSwitching,
    /// 26 decades.
    Decades,
    Real,
    /// Distances between points of a small grid.
    Grid,
    /// Between points on a line.
    Line,
}

pub(crate) const KINDS: [Kind; 11] = [
    Kind::Integers(2),
    Kind::Integers(4),
    Kind::Integers(20),
    Kind::Tenths(12),
    Kind::OneUlp,
    Kind::VeryLarge,
    Kind::LargeSwitching,
    Kind::Decades,
    Kind::Real,
    Kind::Grid,
    Kind::Line,
];

/// The sizes are small enough to visit every matching, also those of fewer pairs.
pub(crate) fn draw(chance: &mut Stream, kind: Kind) -> Small {
    let side = |chance: &mut Stream| 1 + chance.below(6) as usize;
    let (rows, mut cols) = (side(chance), side(chance));
    if rows * cols > 25 && chance.below(20) != 0 {
        cols = 4;
    }
    let mut cost: Vec<f64> = match kind {
        Kind::Grid | Kind::Line => {
            let mut points = |count: usize| -> Vec<[f64; 2]> {
                let coordinate = |chance: &mut Stream| f64::from(chance.below(5)) * 0.3;
                (0..count)
                    .map(|_| [coordinate(chance), if kind == Kind::Grid { coordinate(chance) } else { 0.0 }])
                    .collect()
            };
            let (agents, goals) = (points(rows), points(cols));
            let distance = |a: &[f64; 2], g: &[f64; 2]| ((a[0] - g[0]).powi(2) + (a[1] - g[1]).powi(2)).sqrt();
            agents.iter().flat_map(|a| goals.iter().map(move |g| distance(a, g))).collect()
        }
        _ => (0..rows * cols).map(|_| entry(chance, kind)).collect(),
    };
    if kind == Kind::VeryLarge {
        let large = |chance: &mut Stream| [1e12, 1e16, 1e16, 1e20, 1e50, 1e100][chance.below(6) as usize];
        for _ in 0..1 + chance.below(2) {
            let value = large(chance);
            let exact = chance.below(2) == 0;
            let row = chance.below(rows as u32) as usize;
            for col in 0..cols {
                let own = &mut cost[row * cols + col];
                *own = if exact { value } else { value + *own };
            }
        }
        (0..rows * cols).for_each(|place| {
            if chance.below(8) == 0 {
                cost[place] = large(chance);
            }
        });
    }
    if chance.below(3) == 0 {
        let share = 1 + chance.below(6);
        cost.iter_mut().for_each(|cost| {
            if chance.below(8) < share {
                *cost = f64::INFINITY;
            }
        });
    }
    let mut problem = Small { rows, cols, cost, current: Vec::new(), switching: 0.0 };
    if chance.below(2) == 0 || kind == Kind::LargeSwitching {
        put_in_force(&mut problem, chance, kind);
    }
    problem
}

fn entry(chance: &mut Stream, kind: Kind) -> f64 {
    match kind {
        Kind::Integers(values) => f64::from(chance.below(values)) - f64::from(chance.below(2)),
        Kind::Tenths(values) => f64::from(chance.below(values)) / 10.0,
        Kind::OneUlp => 1.0 + f64::from(chance.below(4)) * f64::EPSILON,
        Kind::Decades => f64::from(1 + chance.below(9)) * 10f64.powi(chance.below(27) as i32 - 13),
        Kind::LargeSwitching if chance.below(2) == 0 => f64::from(chance.below(5)),
        _ => f64::from(chance.below(1_000_000)) / 1e6,
    }
}

/// Some pairs in force, and what it costs to leave them.
fn put_in_force(problem: &mut Small, chance: &mut Stream, kind: Kind) {
    let order = chance.permutation(problem.cols);
    problem.current = (0..problem.rows)
        .map(|row| order.get(row).copied().filter(|_| chance.below(4) != 0).unwrap_or(UNASSIGNED))
        .collect();
    let small = f64::from(chance.below(3));
    problem.switching = match kind {
        Kind::LargeSwitching => [1e9, 1e16, 1e20, 1e50][chance.below(4) as usize],
        Kind::Tenths(_) => f64::from(chance.below(8)) / 10.0,
        Kind::OneUlp => f64::from(chance.below(4)) * f64::EPSILON,
        Kind::Grid | Kind::Line => 0.3 * small,
        Kind::Real => small * 0.1,
        _ => small,
    };
}
