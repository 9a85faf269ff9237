//! What the distribution of the scores says beyond one number.

use crate::aggregate::average;
use crate::scores::{Scores, ScoresError};

/// Performance profile: for every threshold τ the share of all runs × tasks whose score is strictly above it; `[T]` for `[T]`
/// thresholds.
pub fn performance_profile(scores: &Scores, thresholds: &[f64]) -> Vec<f64> {
    let count = scores.flat().count() as f64;
    let above = |tau: f64| scores.flat().filter(|&score| score > tau).count() as f64 / count;
    thresholds.iter().map(|&tau| above(tau)).collect()
}

/// Probability of improvement: how likely a run of `x` beats a run of `y` on the same task, averaged over the tasks. A tie counts
/// as one half (the Mann–Whitney statistic).
///
/// # Errors
/// The systems have different numbers of tasks.
pub fn probability_of_improvement(x: &Scores, y: &Scores) -> Result<f64, ScoresError> {
    let (own, other) = (x.tasks().len(), y.tasks().len());
    if own != other {
        return Err(ScoresError::OtherTasks(own, other));
    }
    let of_task = |(x, y): (&Vec<f64>, &Vec<f64>)| {
        let wins = |&x: &f64| y.iter().map(|&y| if x > y { 1.0 } else { half_if(x == y) }).sum::<f64>();
        x.iter().map(wins).sum::<f64>() / (x.len() * y.len()) as f64
    };
    Ok(average(&x.tasks().iter().zip(y.tasks()).map(of_task).collect::<Vec<_>>()))
}

fn half_if(tie: bool) -> f64 {
    if tie { 0.5 } else { 0.0 }
}
