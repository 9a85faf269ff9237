//! Intervals by the stratified percentile bootstrap: the runs of every task are drawn again with replacement, each task by
//! itself, and the statistic is computed of each such resample.
//!
//! A draw depends on the key, the resample, the system and the task alone, so an interval is the same on every machine and in any
//! order of computation. Its ends are percentiles of the resampled statistics with linear interpolation, as numpy's.

use crate::scores::Scores;
use magex_core::rng::{Key, Purpose};

/// Resamples of an interval, unless a caller has a reason for another number.
pub const RESAMPLES: u32 = 10_000;
/// Share of the resampled statistics that an interval holds.
pub const CONFIDENCE: f64 = 0.95;

/// An interval of a statistic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The 95 % interval of a statistic of one system. `None` if a task has a single run: nothing is known of its spread, and an
/// interval of width zero would claim the opposite.
pub fn interval(scores: &Scores, seed: u64, resamples: u32, statistic: impl Fn(&Scores) -> f64) -> Option<Interval> {
    let of = |resample: u32| statistic(&resampled(scores, seed, resample, 0));
    (scores.fewest_runs() > 1).then(|| percentiles((0..resamples.max(1)).map(of).collect()))
}

/// The 95 % interval of a statistic of two systems, whose runs are drawn independently. `None` if a task of either has a single
/// run.
pub fn interval_of_two(
    [x, y]: [&Scores; 2],
    seed: u64,
    resamples: u32,
    statistic: impl Fn(&Scores, &Scores) -> f64,
) -> Option<Interval> {
    let of = |k: u32| statistic(&resampled(x, seed, k, 0), &resampled(y, seed, k, 1));
    (x.fewest_runs().min(y.fewest_runs()) > 1).then(|| percentiles((0..resamples.max(1)).map(of).collect()))
}

/// One resample: as many runs of each task as it has, drawn with replacement.
fn resampled(scores: &Scores, seed: u64, resample: u32, system: u32) -> Scores {
    let draw = |(task, runs): (usize, &Vec<f64>)| {
        let mut stream = Key::new(seed, Purpose::Bootstrap, &[resample, system, task as u32]).stream();
        runs.iter().map(|_| runs[stream.below(runs.len() as u32) as usize]).collect()
    };
    Scores::with_runs(scores.tasks().iter().enumerate().map(draw).collect())
}

fn percentiles(mut values: Vec<f64>) -> Interval {
    values.sort_unstable_by(f64::total_cmp);
    let tail = (1.0 - CONFIDENCE) / 2.0;
    Interval { low: percentile(&values, tail), high: percentile(&values, 1.0 - tail) }
}

/// Of sorted values, at least one; linear between neighbours.
fn percentile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (place - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aggregate::mean;

    #[test]
    fn percentiles_are_numpys() {
        // numpy.percentile([1, 2, 4, 8], [2.5, 97.5]) == [1.075, 7.7]
        let values = [1.0, 2.0, 4.0, 8.0];
        assert!((percentile(&values, 0.025) - 1.075).abs() < 1e-12);
        assert!((percentile(&values, 0.975) - 7.7).abs() < 1e-12);
        assert!((percentile(&[3.0], 0.975) - 3.0).abs() < 1e-12);
    }

    #[test]
    fn an_interval_is_pinned_and_does_not_depend_on_other_tasks() {
        let one = vec![0.1, 0.4, 0.5, 0.9];
        let scores = Scores::new(vec![one.clone(), vec![0.3, 0.2]]).unwrap();
        let first = interval(&scores, 1, 500, mean).unwrap();
        assert_eq!(interval(&scores, 1, 500, mean), Some(first));
        assert_ne!(interval(&scores, 2, 500, mean), Some(first));
        let alone = resampled(&Scores::new(vec![one]).unwrap(), 1, 7, 0);
        assert_eq!(resampled(&scores, 1, 7, 0).tasks()[0], alone.tasks()[0]);
    }

    #[test]
    fn a_single_run_has_no_interval() {
        let scores = Scores::new(vec![vec![0.5, 0.6], vec![0.5]]).unwrap();
        assert_eq!(interval(&scores, 1, 100, mean), None);
        let two = Scores::new(vec![vec![0.5, 0.6], vec![0.5, 0.7]]).unwrap();
        assert_eq!(interval_of_two([&two, &scores], 1, 100, |_, _| 0.0), None);
    }
}
