//! Timings of the exact solver on uniform instances.

pub(crate) mod limits;

use crate::stats::quantile;
use magex_assign::{AssignError, Solver, distances_into};
use magex_core::rng::{Key, Purpose};
use std::hint::black_box;
use std::time::Instant;

/// n agents and n goals, uniform in the unit square: (agents `[n, 2]`, goals `[n, 2]`). The same `index` gives the same
/// points on every machine.
pub(crate) fn uniform_points(n: usize, index: u32) -> (Vec<f32>, Vec<f32>) {
    let mut stream = Key::new(0, Purpose::Bench, &[n as u32, index]).stream();
    let agents = (0..2 * n).map(|_| stream.uniform32()).collect();
    let goals = (0..2 * n).map(|_| stream.uniform32()).collect();
    (agents, goals)
}

/// Distances `[n, n]` between agents and goals `[n, 2]`.
pub(crate) fn distances(agents: &[f32], goals: &[f32]) -> Result<Vec<f64>, AssignError> {
    let mut cost = Vec::new();
    distances_into(agents, goals, 2, &mut cost)?;
    Ok(cost)
}

/// Median microseconds of an exact solve of an n × n Euclidean cost matrix over `instances` instances.
///
/// # Errors
/// n = 0.
pub(crate) fn time_exact(n: usize, instances: u32) -> Result<f64, AssignError> {
    let mut solver = Solver::default();
    let mut times = Vec::with_capacity(instances as usize);
    for index in 0..instances {
        let (agents, goals) = uniform_points(n, index);
        let cost = distances(&agents, &goals)?;
        if index == 0 {
            solver.solve(&cost, n, n)?; // The first call allocates.
        }
        let start = Instant::now();
        black_box(solver.solve(black_box(&cost), n, n)?);
        times.push(start.elapsed().as_secs_f64() * 1e6);
    }
    Ok(quantile(&mut times, 0.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timings_are_positive_and_empty_instances_are_rejected() {
        assert!(time_exact(10, 3).unwrap() > 0.0);
        assert!(time_exact(0, 1).is_err());
    }
}
