//! What a run trains for.

use crate::report::means::{EvalSummary, IterationMeans};
use magex_core::config::RunSection;
use magex_core::metrics_table::{COLLISIONS_PER_AGENT_STEP, SUCCESS_RATE, as_written};

/// Whether the weights are what the run trains for.
pub(super) fn reached(run: &RunSection, episodes: &IterationMeans) -> bool {
    // 0.99 is reached by 0.99, though single precision rounds it up.
    let written = |target: f32| as_written(target.into());
    let mean = |summary: Option<EvalSummary>, metric: usize| summary.and_then(|summary| summary.means[metric]);
    let (success, sampled) = (mean(episodes.greedy, SUCCESS_RATE), mean(episodes.sampled, SUCCESS_RATE));
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
        assert!(!super::reached(&run, &IterationMeans { greedy: None, sampled: Some(means(1.0, 0.0)) }));
    }
}
