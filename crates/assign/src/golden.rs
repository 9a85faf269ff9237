//! Checks the exact solver against recorded problems (`format` = `assignment-golden-1`): each holds a cost matrix or
//! agent and goal points, the optimal cost, one optimal matching and whether it is the only one.

use crate::{Solver, cost_of};
use serde_json::{Map, Value};
use thiserror::Error;

/// Name of the recording's format.
pub const FORMAT: &str = "assignment-golden-1";
/// Largest relative error of a cost.
pub const TOLERANCE: f64 = 1e-9;

/// Why a recording could not be used. The message names the field.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{field}: {reason}")]
pub struct MalformedRecording {
    /// Where, for example `cases[3].matrix[7]`.
    pub field: String,
    /// What is wrong there.
    pub reason: String,
}

/// One recorded problem on which the solver was wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Mismatch {
    /// Name of the problem.
    pub name: String,
    /// What differs.
    pub reason: String,
}

/// What a recording says about the solver.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// Problems compared.
    pub problems: usize,
    /// Problems whose matching was compared too, because it is the only optimal one.
    pub matchings: usize,
    /// Largest relative error of a cost.
    pub worst: f64,
    /// Name of the problem with the largest error; the first one if all are exact.
    pub worst_problem: String,
    /// Every problem beyond the tolerance, with a wrong matching, or refused by the solver.
    pub mismatches: Vec<Mismatch>,
}

impl Report {
    /// True if every problem agrees.
    pub fn passed(&self) -> bool {
        self.problems > 0 && self.mismatches.is_empty()
    }
}

/// Solves every problem of a recording and compares costs (relative [`TOLERANCE`]) and, where the optimum is unique,
/// matchings.
///
/// # Errors
/// Text that is not JSON, another format, no cases, and any field that is missing, of the wrong kind, not finite or
/// inconsistent with its neighbours.
pub fn verify_assignment(text: &str) -> Result<Report, MalformedRecording> {
    let value: Value = serde_json::from_str(text).map_err(|error| malformed("file", format!("not JSON: {error}")))?;
    verify_value(&value)
}

/// [`verify_assignment`] on JSON that is already parsed.
///
/// # Errors
/// As [`verify_assignment`].
pub fn verify_value(value: &Value) -> Result<Report, MalformedRecording> {
    let root = value.as_object().ok_or_else(|| malformed("file", "an object was expected"))?;
    match root.get("format").and_then(Value::as_str) {
        Some(FORMAT) => {}
        Some(other) => return Err(malformed("format", format!("'{other}' is not '{FORMAT}'"))),
        None => return Err(malformed("format", "missing or not a text")),
    }
    let cases = root.get("cases").and_then(Value::as_array);
    let cases = cases.filter(|cases| !cases.is_empty()).ok_or_else(|| malformed("cases", "missing or empty"))?;
    let mut solver = Solver::default();
    let mut report = Report::default();
    for (index, case) in cases.iter().enumerate() {
        compare(&Case::parse(case, &format!("cases[{index}]"))?, &mut solver, &mut report);
    }
    Ok(report)
}

fn compare(case: &Case, solver: &mut Solver, report: &mut Report) {
    report.problems += 1;
    let mut fail = |reason: String| report.mismatches.push(Mismatch { name: case.name.clone(), reason });
    let answer = match solver.solve(&case.cost, case.rows, case.cols) {
        Ok(answer) => answer,
        Err(error) => return fail(format!("the solver refused it: {error}")),
    };
    // The matching is judged by the matrix, not by the sum the solver claims.
    let found = cost_of(&case.cost, case.cols, &answer.col_of_row);
    let scale = if case.expected == 0.0 {
        case.cost.iter().fold(0.0f64, |largest, cost| largest.max(cost.abs()))
    } else {
        case.expected.abs()
    };
    let difference = (found - case.expected).abs().max((answer.cost - case.expected).abs());
    let error = if difference == 0.0 { 0.0 } else { difference / scale };
    if error.is_nan() || error > TOLERANCE {
        fail(format!("cost {found} differs from {} by {error:.1e} (limit {TOLERANCE:.0e})", case.expected));
    }
    if case.unique {
        report.matchings += 1;
        if answer.col_of_row != case.col_of_row {
            let place = answer.col_of_row.iter().zip(&case.col_of_row).position(|(a, b)| a != b).unwrap_or_default();
            let reason = format!("row {place} has another column than the only optimal matching");
            report.mismatches.push(Mismatch { name: case.name.clone(), reason });
        }
    }
    if report.problems == 1 || error > report.worst {
        report.worst = error;
        report.worst_problem.clone_from(&case.name);
    }
}

/// A problem as recorded.
struct Case {
    name: String,
    rows: usize,
    cols: usize,
    /// `[rows, cols]`
    cost: Vec<f64>,
    /// `[rows]`
    col_of_row: Vec<u32>,
    expected: f64,
    unique: bool,
}

impl Case {
    fn parse(value: &Value, place: &str) -> Result<Self, MalformedRecording> {
        let fields = value.as_object().ok_or_else(|| malformed(place, "an object was expected"))?;
        let at = |name: &str| format!("{place}.{name}");
        let size = |name: &str| match fields.get(name).and_then(Value::as_u64) {
            Some(size @ 1..=100_000) => Ok(size as usize),
            _ => Err(malformed(at(name), "a whole number from 1 to 100000 was expected")),
        };
        let (rows, cols) = (size("rows")?, size("cols")?);
        let cost = match (fields.get("matrix"), fields.get("agents"), fields.get("goals")) {
            (Some(matrix), None, None) => numbers(matrix, &at("matrix"), rows * cols)?,
            (None, Some(agents), Some(goals)) => {
                euclidean(&points(agents, &at("agents"), rows)?, &points(goals, &at("goals"), cols)?)
            }
            _ => return Err(malformed(at("matrix"), "either matrix or both agents and goals are needed")),
        };
        let unique = match fields.get("unique") {
            Some(Value::Bool(unique)) => *unique,
            Some(Value::Null) | None => false,
            Some(_) => return Err(malformed(at("unique"), "true, false or null was expected")),
        };
        Ok(Self {
            name: fields.get("name").and_then(Value::as_str).unwrap_or(place).to_owned(),
            rows,
            cols,
            cost,
            col_of_row: matching(fields, place, rows, cols)?,
            expected: number(fields.get("cost"), &at("cost"))?,
            unique,
        })
    }
}

fn matching(
    fields: &Map<String, Value>,
    place: &str,
    rows: usize,
    cols: usize,
) -> Result<Vec<u32>, MalformedRecording> {
    let indices = |name: &str, bound: usize| -> Result<Vec<usize>, MalformedRecording> {
        let field = format!("{place}.{name}");
        let list =
            fields.get(name).and_then(Value::as_array).ok_or_else(|| malformed(&field, "a list was expected"))?;
        if list.len() != rows.min(cols) {
            return Err(malformed(&field, format!("{} entries, {} pairs are needed", list.len(), rows.min(cols))));
        }
        let index = |(k, value): (usize, &Value)| match value.as_u64() {
            Some(index) if (index as usize) < bound => Ok(index as usize),
            _ => Err(malformed(format!("{field}[{k}]"), format!("{value} is not an index below {bound}"))),
        };
        list.iter().enumerate().map(index).collect()
    };
    let mut col_of_row = vec![crate::UNASSIGNED; rows];
    let mut taken = vec![false; cols];
    for (k, (row, col)) in indices("row_ind", rows)?.into_iter().zip(indices("col_ind", cols)?).enumerate() {
        if col_of_row[row] != crate::UNASSIGNED || std::mem::replace(&mut taken[col], true) {
            return Err(malformed(format!("{place}.col_ind[{k}]"), "a row or column occurs twice"));
        }
        col_of_row[row] = col as u32;
    }
    Ok(col_of_row)
}

fn euclidean(agents: &[[f64; 2]], goals: &[[f64; 2]]) -> Vec<f64> {
    let distance = |agent: &[f64; 2], goal: &[f64; 2]| {
        let (dx, dy) = (agent[0] - goal[0], agent[1] - goal[1]);
        (dx * dx + dy * dy).sqrt()
    };
    agents.iter().flat_map(|agent| goals.iter().map(move |goal| distance(agent, goal))).collect()
}

fn points(value: &Value, field: &str, count: usize) -> Result<Vec<[f64; 2]>, MalformedRecording> {
    let list = value.as_array().ok_or_else(|| malformed(field, "a list of points was expected"))?;
    if list.len() != count {
        return Err(malformed(field, format!("{} points, {count} are needed", list.len())));
    }
    let point = |(k, value): (usize, &Value)| {
        let coordinates = numbers(value, &format!("{field}[{k}]"), 2)?;
        Ok([coordinates[0], coordinates[1]])
    };
    list.iter().enumerate().map(point).collect()
}

fn numbers(value: &Value, field: &str, count: usize) -> Result<Vec<f64>, MalformedRecording> {
    let list = value.as_array().ok_or_else(|| malformed(field, "a list of numbers was expected"))?;
    if list.len() != count {
        return Err(malformed(field, format!("{} numbers, {count} are needed", list.len())));
    }
    let entry = |(k, value): (usize, &Value)| match value.as_f64() {
        Some(number) if number.is_finite() => Ok(number),
        _ => Err(malformed(format!("{field}[{k}]"), format!("{value} is not a finite number"))),
    };
    list.iter().enumerate().map(entry).collect()
}

fn number(value: Option<&Value>, field: &str) -> Result<f64, MalformedRecording> {
    let number = value.and_then(Value::as_f64).filter(|number| number.is_finite());
    number.ok_or_else(|| malformed(field, "a finite number was expected"))
}

fn malformed(field: impl Into<String>, reason: impl Into<String>) -> MalformedRecording {
    MalformedRecording { field: field.into(), reason: reason.into() }
}
