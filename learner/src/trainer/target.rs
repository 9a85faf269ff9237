//! What a run trains for.

use crate::report::means::{EvalSummary, IterationMeans};
use magex_core::config::{RETURN_ANY, RunSection};
use magex_core::metrics_table::{COLLISIONS_PER_AGENT_STEP, EPISODE_RETURN, SUCCESS_RATE, as_written};

/// Whether the weights are what the run trains for.
pub(super) fn reached(run: &RunSection, episodes: &IterationMeans) -> bool {
    // 0.99 is reached by 0.99, though single precision rounds it up.
    let written = |target: f32| as_written(target.into());
    let mean = |summary: Option<EvalSummary>, metric: usize| summary.and_then(|summary| summary.means[metric]);
    let (success, sampled) = (mean(episodes.greedy, SUCCESS_RATE), mean(episodes.sampled, SUCCESS_RATE));
    let reward = mean(episodes.greedy, EPISODE_RETURN);
    if run.target_return < RETURN_ANY && reward >= Some(written(run.target_return)) {
        return true;
    }
    let collisions = mean(episodes.greedy, COLLISIONS_PER_AGENT_STEP).unwrap_or_default();
    success >= Some(written(run.target_success))
        && sampled.unwrap_or_default() >= written(run.target_sampled_success)
        && collisions <= written(run.target_collisions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::metrics_table::METRICS;

    fn means(success: f64, collisions: f64) -> EvalSummary {
        let mut means = [None; METRICS.len()];
        (means[SUCCESS_RATE], means[COLLISIONS_PER_AGENT_STEP]) = (Some(success), Some(collisions));
        EvalSummary { episodes: 1, means }
    }

    #[test]
    fn a_target_is_reached_by_every_measure_that_it_names() {
        let mut run = RunSection { target_success: 0.99, ..RunSection::default() };
        let reached = |run: &RunSection, greedy: [f64; 2], sampled: Option<f64>| {
            let [success, collisions] = greedy;
            let sampled = sampled.map(|success| means(success, 9.0));
            super::reached(run, &IterationMeans { greedy: Some(means(success, collisions)), sampled })
        };
        // Success alone, whatever the rest is.
        assert!(reached(&run, [0.99, 5.0], None) && !reached(&run, [0.98, 0.0], Some(1.0)));
        (run.target_sampled_success, run.target_collisions) = (0.95, 0.05);
        assert!(reached(&run, [0.99, 0.05], Some(0.95)));
        assert!(!reached(&run, [0.98, 0.05], Some(0.95)));
        assert!(!reached(&run, [0.99, 0.06], Some(0.95)));
        assert!(!reached(&run, [0.99, 0.05], Some(0.94)));
        assert!(!reached(&run, [0.99, 0.05], None));
        // The return of an external environment, which knows no success.
        run.target_return = -12.5;
        let mut external = means(0.0, 0.0);
        (external.means[SUCCESS_RATE], external.means[COLLISIONS_PER_AGENT_STEP]) = (None, None);
        for (value, enough) in [(-12.5, true), (-12.6, false)] {
            external.means[EPISODE_RETURN] = Some(value);
            let episodes = IterationMeans { greedy: Some(external), sampled: None };
            assert_eq!(super::reached(&run, &episodes), enough);
        }
        assert!(!super::reached(&run, &IterationMeans { greedy: None, sampled: Some(means(1.0, 0.0)) }));
    }
}
