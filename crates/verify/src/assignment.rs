//! Agreement of the exact solver with recorded problems (`format` = `assignment-golden-1`): each holds a cost matrix or
//! agent and goal points, the optimal cost, one optimal matching and whether it is the only one.

use crate::reader::Field;
use crate::report::{Report, worse};
use magex_assign::{Solver, UNASSIGNED, cost_of};
use magex_core::error::FieldError;

#[cfg(test)]
mod tests;

pub(crate) const FORMAT: &str = "assignment-golden-1";
const TOLERANCE: f64 = 1e-9;
/// Most rows, columns and problems of a recording.
const MOST: usize = 100_001;

/// Solves every problem of a recording and compares costs (relative [`TOLERANCE`]) and, where the optimum is unique,
/// matchings. A problem beyond the tolerance, with a wrong matching, or rejected by the solver is a mismatch that names it.
pub(crate) fn verify(root: &Field<'_>) -> Result<Report, FieldError> {
    let cases = root.get("cases")?;
    let mut solver = Solver::default();
    let mut report = Report::default();
    let (mut problems, mut unique, mut worst) = (0, 0, 0.0);
    for case in cases.items(MOST)? {
        let case = Case::read(&case)?;
        problems += 1;
        unique += usize::from(case.unique);
        worst = worse(worst, compare(&case, &mut solver, &mut report.mismatches));
    }
    if problems == 0 {
        return Err(cases.wrong("is empty"));
    }
    report.content = format!("{problems} problems, {unique} with one optimum");
    report.limited("relative cost", worst, TOLERANCE);
    Ok(report)
}

/// The relative error of the cost.
fn compare(case: &Case, solver: &mut Solver, mismatches: &mut Vec<String>) -> f64 {
    let mut fail = |reason: String| mismatches.push(format!("{}: {reason}", case.name));
    let answer = match solver.solve(&case.cost, case.rows, case.cols) {
        Ok(answer) => answer,
        Err(error) => {
            fail(format!("the solver rejected it: {error}"));
            return 0.0;
        }
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
    if case.unique && answer.col_of_row != case.col_of_row {
        let place = answer.col_of_row.iter().zip(&case.col_of_row).position(|(a, b)| a != b).unwrap_or_default();
        fail(format!("row {place} has another column than the only optimal matching"));
    }
    error
}

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
    fn read(case: &Field<'_>) -> Result<Self, FieldError> {
        let (rows, cols) = (case.get("rows")?.count(MOST)?, case.get("cols")?.count(MOST)?);
        let cost = match (case.optional("matrix")?, case.optional("agents")?, case.optional("goals")?) {
            (Some(matrix), None, None) => matrix.each(rows * cols, Field::number)?,
            (None, Some(agents), Some(goals)) => {
                euclidean(&agents.each(rows, Field::array)?, &goals.each(cols, Field::array)?)
            }
            _ => {
                let field = format!("{}.matrix", case.path());
                return Err(FieldError::new(field, "either matrix or both agents and goals are needed"));
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

fn matching(case: &Field<'_>, rows: usize, cols: usize) -> Result<Vec<u32>, FieldError> {
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
