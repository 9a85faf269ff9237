//! Distances between points, and powers of them.

use crate::{AssignError, Result, check_shape, invalid_size};

/// Largest magnitude of a coordinate: squares of differences stay finite.
pub const LARGEST_COORDINATE: f64 = 1e100;

/// Exponents that [`powered`] takes.
pub const POWERS: std::ops::RangeInclusive<f64> = 1.0..=16.0;

/// Euclidean distance of two points, in double precision.
pub fn distance<T: Copy + Into<f64>>(a: &[T], b: &[T]) -> f64 {
    square(a, b).sqrt()
}

fn square<T: Copy + Into<f64>>(a: &[T], b: &[T]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| (a.into() - b.into()) * (a.into() - b.into())).sum()
}

/// value^power for value ≥ 0. 1, 1.5 and 2 are square roots and products; every other power is libm's, the same bits on every
/// machine.
#[inline]
pub fn powered(value: f64, power: f64) -> f64 {
    if power == 1.0 {
        value
    } else if power == 1.5 {
        value * value.sqrt()
    } else if power == 2.0 {
        value * value
    } else {
        libm::pow(value, power)
    }
}

/// The cost distance^power of a pair whose squared distance is `square`. For the power 2 this is `square` itself, without the
/// rounding of a root.
#[inline]
pub fn powered_square(square: f64, power: f64) -> f64 {
    if power == 2.0 { square } else { powered(square.sqrt(), power) }
}

/// Summed distance of an assignment, in double precision: agents `[N, dims]`, goals `[G, dims]`, `goal_of` `[N]` the goal of each
/// agent. An agent without a goal ([`crate::UNASSIGNED`]) costs nothing.
pub fn cost_of_points<T: Copy + Into<f64>>(agents: &[T], goals: &[T], dims: usize, goal_of: &[u32]) -> f64 {
    let mut total = 0.0;
    for (agent, &goal) in agents.chunks_exact(dims).zip(goal_of) {
        let start = goal as usize * dims;
        if let Some(goal) = goals.get(start..start + dims) {
            total += distance(agent, goal);
        }
    }
    total
}

/// Checks agents `[rows, dims]` and goals `[cols, dims]`: neither empty nor ragged, every coordinate finite and up to
/// [`LARGEST_COORDINATE`]. Returns (rows, cols).
pub(crate) fn check_points<T: Copy + Into<f64>>(agents: &[T], goals: &[T], dims: usize) -> Result<(usize, usize)> {
    if dims == 0 {
        return Err(AssignError::invalid("dims", "0 is out of range; use at least 1"));
    }
    for (field, points) in [("agents", agents), ("goals", goals)] {
        if !points.len().is_multiple_of(dims) {
            return Err(invalid_size(field, points.len(), points.len().div_ceil(dims) * dims));
        }
        // False for NaN.
        let usable = |x: &T| (*x).into().abs() <= LARGEST_COORDINATE;
        if let Some(place) = points.iter().position(|x| !usable(x)) {
            let (path, value) = (format!("{field}[{}][{}]", place / dims, place % dims), points[place].into());
            let problem = if value.is_finite() { "is beyond 1e100" } else { "is not finite" };
            return Err(AssignError::invalid(path, format!("{value} {problem}")));
        }
    }
    let (rows, cols) = (agents.len() / dims, goals.len() / dims);
    check_shape(rows, cols)?;
    Ok((rows, cols))
}

pub(crate) fn check_power(power: f64) -> Result<()> {
    if POWERS.contains(&power) {
        return Ok(());
    }
    Err(AssignError::invalid("power", format!("{power} is not a number from 1 to 16")))
}

/// Distances `[rows, cols]` in f64 between agents `[rows, dims]` and goals `[cols, dims]`; returns (rows, cols).
/// Fails for empty or ragged arrays and coordinates that are not finite or beyond [`LARGEST_COORDINATE`].
pub fn distances_into<T: Copy + Into<f64>>(
    agents: &[T],
    goals: &[T],
    dims: usize,
    cost: &mut Vec<f64>,
) -> Result<(usize, usize)> {
    costs_into(agents, goals, dims, 1.0, cost)
}

/// Costs distance^power `[rows, cols]`. Fails as [`distances_into`], for a power outside [`POWERS`], and where a cost is beyond
/// [`crate::LARGEST_COST`].
pub fn costs_into<T: Copy + Into<f64>>(
    agents: &[T],
    goals: &[T],
    dims: usize,
    power: f64,
    cost: &mut Vec<f64>,
) -> Result<(usize, usize)> {
    check_power(power)?;
    let (rows, cols) = check_points(agents, goals, dims)?;
    cost.clear();
    cost.reserve(rows * cols);
    for agent in agents.chunks_exact(dims) {
        if let &[x, y] = agent {
            let (x, y) = (x.into(), y.into());
            cost.extend(goals.as_chunks::<2>().0.iter().map(|&[gx, gy]| {
                let (dx, dy) = (x - gx.into(), y - gy.into());
                dx * dx + dy * dy
            }));
        } else {
            cost.extend(goals.chunks_exact(dims).map(|goal| square(agent, goal)));
        }
    }
    if power == 1.0 {
        cost.iter_mut().for_each(|cost| *cost = cost.sqrt());
    } else if power != 2.0 {
        cost.iter_mut().for_each(|cost| *cost = powered_square(*cost, power));
    }
    if power > 2.0 {
        // Only high powers of far points leave the range: (√D · 2e100)^power.
        if let Some(place) = cost.iter().position(|cost| *cost > crate::LARGEST_COST) {
            let problem = format!("the distance to goals[{}] to the power of {power} is beyond 1e300", place % cols);
            return Err(AssignError::invalid(format!("agents[{}]", place / cols), problem));
        }
    }
    Ok((rows, cols))
}
