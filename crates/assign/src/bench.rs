//! Timings of the solvers on uniform instances, for the command line and for comparisons between machines.
//!
//! The clock decides nothing but the number that is reported.

use crate::duals::{Schedule, sinkhorn_duals};
use crate::{AssignError, Solver, distances};
use magex_core::rng::{Key, Purpose};
use std::hint::black_box;
use std::time::Instant;

/// n agents and n goals, uniform in the unit square: (agents `[n, 2]`, goals `[n, 2]`). The same `index` gives the same
/// points on every machine.
pub fn uniform_points(n: usize, index: u32) -> (Vec<f32>, Vec<f32>) {
    let mut stream = Key::new(0, Purpose::Bench, &[n as u32, index]).stream();
    let agents = (0..2 * n).map(|_| stream.uniform32()).collect();
    let goals = (0..2 * n).map(|_| stream.uniform32()).collect();
    (agents, goals)
}

/// Median microseconds of an exact solve of an n × n Euclidean cost matrix over `instances` instances.
///
/// # Errors
/// n = 0 and `instances` = 0.
pub fn time_exact(n: usize, instances: usize) -> Result<f64, AssignError> {
    let mut solver = Solver::default();
    median_microseconds(n, instances, |cost| solver.solve(cost, n, n).map(|answer| drop(black_box(answer))))
}

/// Median microseconds of [`sinkhorn_duals`] on the same instances.
///
/// # Errors
/// As [`time_exact`], and a schedule out of range.
pub fn time_duals(n: usize, instances: usize, schedule: &Schedule) -> Result<f64, AssignError> {
    let mut narrow = Vec::new();
    median_microseconds(n, instances, |cost| {
        narrow.clear();
        narrow.extend(cost.iter().map(|&c| c as f32));
        sinkhorn_duals(&narrow, n, n, schedule).map(|answer| drop(black_box(answer)))
    })
}

fn median_microseconds(
    n: usize,
    instances: usize,
    mut solve: impl FnMut(&[f64]) -> Result<(), AssignError>,
) -> Result<f64, AssignError> {
    if instances == 0 {
        return Err(AssignError::Parameter { field: "instances", value: 0.0, remedy: "use at least 1" });
    }
    let mut times = Vec::with_capacity(instances);
    for index in 0..instances as u32 {
        let (agents, goals) = uniform_points(n, index);
        let cost = distances(&agents, &goals, 2)?;
        if index == 0 {
            solve(&cost)?; // The first call allocates.
        }
        let start = Instant::now();
        solve(black_box(&cost))?;
        times.push(start.elapsed().as_secs_f64() * 1e6);
    }
    times.sort_unstable_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}
