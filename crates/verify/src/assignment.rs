//! Agreement of the exact solver with recorded problems (`format` = `assignment-golden-1`): each holds a cost matrix or
//! agent and goal points, the optimal cost, one optimal matching and whether it is the only one.

use crate::error::RecordingError;
use crate::reader::Field;
use magex_assign::{Solver, UNASSIGNED, cost_of};

#[cfg(test)]
mod tests;

/// Name of the recording's format.
pub const FORMAT: &str = "assignment-golden-1";
/// Largest relative error of a cost.
pub const TOLERANCE: f64 = 1e-9;
/// Most rows, columns and problems of a recording.
const MOST: usize = 100_001;

/// What a recording says about the solver.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AssignmentReport {
    /// Problems compared.
    pub problems: usize,
    /// Problems whose matching was compared too, because it is the only optimal one.
    pub matchings: usize,
    /// Largest relative error of a cost.
    pub worst: f64,
    /// Every problem beyond the tolerance, with a wrong matching, or rejected by the solver: its name and the reason.
    pub mismatches: Vec<String>,
}

impl AssignmentReport {
    /// True if every problem agrees.
    pub fn agrees(&self) -> bool {
        self.problems > 0 && self.mismatches.is_empty()
    }
}

/// Solves every problem of a recording and compares costs (relative [`TOLERANCE`]) and, where the optimum is unique,
/// matchings.
///
/// # Errors
/// Text that is not JSON, another format, no cases, and any field that is missing, of the wrong kind, not finite or
/// inconsistent with its neighbours.
pub fn verify_assignment(text: &str) -> Result<AssignmentReport, RecordingError> {
    let value: serde_json::Value = serde_json::from_str(text)?;
    let root = Field::root(&value);
    let format = root.get("format")?.text()?;
    if format != FORMAT {
        return Err(RecordingError::Format { found: format.to_owned(), expected: FORMAT });
    }
    let cases = root.get("cases")?;
    let mut solver = Solver::default();
    let mut report = AssignmentReport::default();
    for case in cases.items(MOST)? {
        compare(&Case::read(&case)?, &mut solver, &mut report);
    }
    if report.problems == 0 { Err(cases.wrong("is empty")) } else { Ok(report) }
}

fn compare(case: &Case, solver: &mut Solver, report: &mut AssignmentReport) {
    report.problems += 1;
    let mut fail = |reason: String| report.mismatches.push(format!("{}: {reason}", case.name));
    let answer = match solver.solve(&case.cost, case.rows, case.cols) {
        Ok(answer) => answer,
        Err(error) => return fail(format!("the solver rejected it: {error}")),
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
            fail(format!("row {place} has another column than the only optimal matching"));
        }
    }
    report.worst = crate::check::worse(report.worst, error);
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
    fn read(case: &Field<'_>) -> Result<Self, RecordingError> {
        let size = |name: &str| {
            let field = case.get(name)?;
            match field.index(MOST)? {
                0 => Err(field.wrong("must be at least 1")),
                size => Ok(size),
            }
        };
        let (rows, cols) = (size("rows")?, size("cols")?);
        let cost = match (case.optional("matrix")?, case.optional("agents")?, case.optional("goals")?) {
            (Some(matrix), None, None) => matrix.each(rows * cols, Field::number)?,
            (None, Some(agents), Some(goals)) => euclidean(&agents.points(rows)?, &goals.points(cols)?),
            _ => {
                let field = format!("{}.matrix", case.path());
                return Err(RecordingError::Field {
                    field,
                    problem: "either matrix or both agents and goals are needed".into(),
                });
            }
        };
        Ok(Self {
            name: case.optional("name")?.map_or(Ok(case.path()), |name| name.text())?.to_owned(),
            rows,
            cols,
            cost,
            col_of_row: matching(case, rows, cols)?,
            expected: case.get("cost")?.number()?,
            unique: case.optional("unique")?.map_or(Ok(false), |unique| unique.flag())?,
        })
    }
}

fn matching(case: &Field<'_>, rows: usize, cols: usize) -> Result<Vec<u32>, RecordingError> {
    let pairs = rows.min(cols);
    let row_ind = case.get("row_ind")?.each(pairs, |row| row.index(rows))?;
    let col_ind = case.get("col_ind")?;
    let (mut col_of_row, mut taken) = (vec![UNASSIGNED; rows], vec![false; cols]);
    for (row, field) in row_ind.into_iter().zip(col_ind.list(pairs)?) {
        let col = field.index(cols)?;
        if col_of_row[row] != UNASSIGNED || std::mem::replace(&mut taken[col], true) {
            return Err(field.wrong("a row or column occurs twice"));
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
