//! The exact solvers as functions of arrays. They run without the interpreter's lock, and Ctrl-C ends them.

use crate::arrays::{array, entries, refused};
use magex_assign::{
    AllowedPairs, AssignError, Assignment, BottleneckSolver, PointProblem, Solver, Switching, bottleneck_points, pairs,
    powered_square, solve_pairs, solve_points,
};
use magex_core::error::FieldError;
use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use std::cell::RefCell;
use std::time::{Duration, Instant};

/// How often a solver asks for Ctrl-C.
const ASK: Duration = Duration::from_millis(100);

/// Rows and columns of the pairs, rows ascending, and what the objective makes of their costs.
type Answer<'py> = (Bound<'py, PyArrayDyn<i64>>, Bound<'py, PyArrayDyn<i64>>, f64);

/// Assigns agents [N, D] to goals [G, D] (float64) by distance^power.
#[pyfunction]
pub(crate) fn assign_points<'py>(
    py: Python<'py>,
    agents: PyReadonlyArrayDyn<'py, f64>,
    goals: PyReadonlyArrayDyn<'py, f64>,
    objective: &str,
    power: f64,
) -> PyResult<Answer<'py>> {
    let bottleneck = is_bottleneck(objective)?;
    let dims = matrix_shape("agents_xy", agents.shape(), "[agents, coordinates]")?[1];
    if matrix_shape("goals_xy", goals.shape(), "[goals, coordinates]")?[1] != dims {
        let problem = format!("has {} coordinates per point, agents_xy has {dims}; they must agree", goals.shape()[1]);
        return Err(refused(FieldError::new("goals_xy", problem)));
    }
    let (agents, goals) = (entries("agents_xy", &agents)?, entries("goals_xy", &goals)?);
    let problem = PointProblem { power, ..PointProblem::new(agents, goals, dims) };
    let cost = |row: usize, col: usize| {
        let points = agents[row * dims..(row + 1) * dims].iter().zip(&goals[col * dims..(col + 1) * dims]);
        powered_square(points.map(|(a, b)| (a - b) * (a - b)).sum(), power)
    };
    solve(
        py,
        &[("agents", "agents_xy"), ("goals", "goals_xy"), ("cost", "agents_xy, goals_xy")],
        bottleneck,
        cost,
        |go_on| {
            if bottleneck { bottleneck_points(&problem, go_on) } else { solve_points(&problem, go_on) }
        },
    )
}

/// Assigns rows to columns of a matrix [rows, cols] (float64), in which +inf forbids a pair.
#[pyfunction]
pub(crate) fn assign_costs<'py>(
    py: Python<'py>,
    costs: PyReadonlyArrayDyn<'py, f64>,
    objective: &str,
) -> PyResult<Answer<'py>> {
    let bottleneck = is_bottleneck(objective)?;
    let [rows, cols] = matrix_shape("matrix", costs.shape(), "[rows, columns]")?;
    let costs = entries("matrix", &costs)?;
    solve(
        py,
        &[("cost", "matrix")],
        bottleneck,
        |row, col| costs[row * cols + col],
        |go_on| {
            if bottleneck {
                BottleneckSolver::default().solve_switching(costs, rows, cols, &Switching::default(), go_on)
            } else {
                Solver::default().solve_allowed(costs, rows, cols, go_on)
            }
        },
    )
}

/// Assigns rows to columns by a list of allowed pairs (int64 [P], int64 [P], float64 [P]); every other pair is forbidden.
#[pyfunction]
pub(crate) fn assign_sparse<'py>(
    py: Python<'py>,
    rows: PyReadonlyArrayDyn<'py, i64>,
    cols: PyReadonlyArrayDyn<'py, i64>,
    costs: PyReadonlyArrayDyn<'py, f64>,
    shape: [usize; 2],
) -> PyResult<Answer<'py>> {
    let (rows, cols, costs) = (entries("rows", &rows)?, entries("cols", &cols)?, entries("costs", &costs)?);
    for (field, found) in [("cols", cols.len()), ("costs", costs.len())] {
        if found != rows.len() {
            let problem = format!("has {found} entries, rows has {}; they must agree", rows.len());
            return Err(refused(FieldError::new(field, problem)));
        }
    }
    let list = rows.iter().zip(cols).zip(costs).enumerate().map(|(k, ((&row, &col), &cost))| {
        let index = |field: &str, value: i64, below: usize| match usize::try_from(value) {
            Ok(index) if index < below => Ok(index as u32),
            _ => Err(FieldError::new(format!("{field}[{k}]"), format!("{value} is not from 0 to below {below}"))),
        };
        Ok((index("rows", row, shape[0])?, index("cols", col, shape[1])?, cost))
    });
    let list = list.collect::<Result<Vec<(u32, u32, f64)>, FieldError>>().map_err(refused)?;
    let problem = AllowedPairs { rows: shape[0], cols: shape[1], pairs: &list, switching: Switching::default() };
    // The cost is the sum, which the solver says.
    solve(py, &[("cost", "shape"), ("pairs", "costs")], false, |_, _| 0.0, |go_on| solve_pairs(&problem, go_on))
}

fn is_bottleneck(objective: &str) -> PyResult<bool> {
    match objective {
        "total" => Ok(false),
        "bottleneck" => Ok(true),
        _ => {
            let problem = format!("'{objective}' is not an objective; use total or bottleneck");
            Err(refused(FieldError::new("objective", problem)))
        }
    }
}

fn matrix_shape(field: &str, shape: &[usize], wanted: &str) -> PyResult<[usize; 2]> {
    let problem = format!("has {} axes; pass an array of shape {wanted}", shape.len());
    <[usize; 2]>::try_from(shape).map_err(|_| refused(FieldError::new(field, problem)))
}

/// A field of the solver by the name of the argument.
fn named(names: &[(&str, &str)], field: &str) -> String {
    let (name, index) = field.split_at(field.find('[').unwrap_or(field.len()));
    let argument = names.iter().find(|(solver, _)| *solver == name).map_or(name, |(_, argument)| argument);
    format!("{argument}{index}")
}

/// Runs a solver without the interpreter's lock. The cost of an answer is the sum, or with `bottleneck` the largest `cost` of a
/// pair (0 without pairs).
fn solve<'py>(
    py: Python<'py>,
    names: &[(&str, &str)],
    bottleneck: bool,
    cost: impl Fn(usize, usize) -> f64 + Sync,
    solver: impl FnOnce(&dyn Fn() -> bool) -> Result<Assignment, AssignError> + Send,
) -> PyResult<Answer<'py>> {
    let (answer, interrupt) = py.detach(|| {
        let state = RefCell::new((Instant::now(), None));
        let go_on = || {
            let (asked, interrupt) = &mut *state.borrow_mut();
            if interrupt.is_none() && asked.elapsed() >= ASK {
                *interrupt = Python::attach(|py| py.check_signals()).err();
                *asked = Instant::now();
            }
            interrupt.is_none()
        };
        let answer = solver(&go_on);
        (answer, state.into_inner().1)
    });
    if let Some(interrupt) = interrupt {
        return Err(interrupt);
    }
    let answer = answer.map_err(|error| match error {
        AssignError::Invalid(FieldError { field, problem }) => refused(FieldError::new(named(names, &field), problem)),
        AssignError::Interrupted => refused(FieldError::new("solver", error.to_string())),
    })?;
    let found: Vec<(usize, usize)> = pairs(&answer.col_of_row).collect();
    let value = if bottleneck {
        found
            .iter()
            .map(|&(row, col)| cost(row, col))
            .fold(None, |most: Option<f64>, cost| Some(most.map_or(cost, |most| most.max(cost))))
    } else {
        Some(answer.cost)
    };
    let (rows, cols) = found.iter().map(|&(row, col)| (row as i64, col as i64)).unzip();
    let shape = [found.len()];
    Ok((array(py, rows, &shape)?, array(py, cols, &shape)?, value.unwrap_or_default()))
}
