//! Numbers that stand for all runs and tasks of a system.

use crate::scores::Scores;

/// Interquartile mean, IQM: the mean of what is left of all runs × tasks after the lowest and the highest ⌊n/4⌋ numbers are cut
/// off. Below four numbers nothing is cut and it is the mean.
pub fn iqm(scores: &Scores) -> f64 {
    let mut all: Vec<f64> = scores.flat().collect();
    all.sort_unstable_by(f64::total_cmp);
    let cut = all.len() / 4;
    average(&all[cut..all.len() - cut])
}

/// Mean of the tasks' means.
pub fn mean(scores: &Scores) -> f64 {
    average(&task_means(scores))
}

/// Median of the tasks' means.
pub fn median(scores: &Scores) -> f64 {
    let mut means = task_means(scores);
    means.sort_unstable_by(f64::total_cmp);
    let half = means.len() / 2;
    if means.len().is_multiple_of(2) { (means[half - 1] + means[half]) / 2.0 } else { means[half] }
}

/// How far the scores fall short of `target` on average; a score above it counts as `target`.
pub fn optimality_gap(scores: &Scores, target: f64) -> f64 {
    let reached: Vec<f64> = scores.flat().map(|score| score.min(target)).collect();
    target - average(&reached)
}

/// Mean of numbers `[n]`; NaN without any.
pub fn average(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Sample standard deviation of numbers `[n]`, with n − 1 in the denominator. `None` below two numbers.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = average(values);
    let squares: f64 = values.iter().map(|value| (value - mean) * (value - mean)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

fn task_means(scores: &Scores) -> Vec<f64> {
    scores.tasks().iter().map(|runs| average(runs)).collect()
}
