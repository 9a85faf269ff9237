//! The scores of a system.

/// Why numbers are no scores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ScoresError {
    /// Nothing was scored.
    #[error("scores: no tasks; give at least one")]
    NoTasks,
    /// A task without runs.
    #[error("scores[{0}]: no runs; give at least one")]
    NoRuns(usize),
    /// A score that is no number.
    #[error("scores[{0}][{1}]: not a finite number")]
    NotFinite(usize, usize),
    /// Two systems can be compared on the same tasks only.
    #[error("scores: {0} tasks and {1} tasks; give both systems the same tasks")]
    OtherTasks(usize, usize),
}

/// Scores `[K tasks][R runs]`, all finite; tasks may differ in the number of their runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Scores(Vec<Vec<f64>>);

impl Scores {
    /// From the scores of every task's runs.
    ///
    /// # Errors
    /// No task, a task without runs, or a score that is not finite.
    pub fn new(tasks: Vec<Vec<f64>>) -> Result<Self, ScoresError> {
        if tasks.is_empty() {
            return Err(ScoresError::NoTasks);
        }
        for (task, runs) in tasks.iter().enumerate() {
            if runs.is_empty() {
                return Err(ScoresError::NoRuns(task));
            }
            if let Some(run) = runs.iter().position(|score| !score.is_finite()) {
                return Err(ScoresError::NotFinite(task, run));
            }
        }
        Ok(Self(tasks))
    }

    /// Every task's runs.
    pub fn tasks(&self) -> &[Vec<f64>] {
        &self.0
    }

    /// All scores, task by task: `[Σ R]`.
    pub fn flat(&self) -> impl Iterator<Item = f64> {
        self.0.iter().flatten().copied()
    }

    /// The smallest number of runs of a task: below 2 a bootstrap has nothing to resample.
    pub fn fewest_runs(&self) -> usize {
        self.0.iter().map(Vec::len).min().unwrap_or_default()
    }

    /// The same tasks with these runs, which are finite by construction.
    pub(crate) fn with_runs(tasks: Vec<Vec<f64>>) -> Self {
        Self(tasks)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_score_is_named() {
        assert_eq!(Scores::new(vec![]), Err(ScoresError::NoTasks));
        assert_eq!(Scores::new(vec![vec![1.0], vec![]]), Err(ScoresError::NoRuns(1)));
        let error = Scores::new(vec![vec![1.0], vec![0.5, f64::NAN]]).unwrap_err();
        assert_eq!(error.to_string(), "scores[1][1]: not a finite number");
        assert_eq!(Scores::new(vec![vec![1.0], vec![0.5, 2.0]]).unwrap().fewest_runs(), 1);
    }
}
