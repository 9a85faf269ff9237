//! What holds for any scores.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_stats::aggregate::{iqm, mean, median, optimality_gap};
use magex_stats::bootstrap::interval;
use magex_stats::curves::band;
use magex_stats::distribution::{performance_profile, probability_of_improvement};
use magex_stats::{Interval, Scores};
use proptest::prelude::*;

fn tasks(count: usize) -> impl Strategy<Value = Vec<Vec<f64>>> {
    prop::collection::vec(prop::collection::vec(0.0..=1.0, 2..6), count)
}

fn any_scores() -> impl Strategy<Value = Scores> {
    (1usize..5).prop_flat_map(tasks).prop_map(|tasks| Scores::new(tasks).unwrap())
}

fn ends(scores: &Scores) -> [f64; 2] {
    [f64::min, f64::max].map(|pick| scores.flat().reduce(pick).unwrap())
}

proptest! {
    #[test]
    fn aggregates_lie_between_the_scores_and_do_not_depend_on_the_order_of_runs(scores in any_scores()) {
        let [low, high] = ends(&scores);
        let reversed = scores.tasks().iter().map(|runs| runs.iter().rev().copied().collect()).collect();
        let reversed = Scores::new(reversed).unwrap();
        for statistic in [iqm as fn(&Scores) -> f64, mean, median] {
            let value = statistic(&scores);
            prop_assert!(low - 1e-12 <= value && value <= high + 1e-12);
            prop_assert!((statistic(&reversed) - value).abs() < 1e-12);
        }
        let shifted = scores.tasks().iter().map(|runs| runs.iter().map(|score| score + 2.0).collect()).collect();
        prop_assert!((iqm(&Scores::new(shifted).unwrap()) - iqm(&scores) - 2.0).abs() < 1e-12);
        prop_assert!(optimality_gap(&scores, 1.0) >= -1e-12);
    }

    #[test]
    fn an_interval_is_ordered_and_within_the_scores(scores in any_scores(), seed in 0u64..1000) {
        let [lowest, highest] = ends(&scores);
        let Interval { low, high } = interval(&scores, seed, 200, iqm).unwrap();
        prop_assert!(lowest - 1e-12 <= low && low <= high && high <= highest + 1e-12);
    }

    #[test]
    fn a_profile_falls_and_ends_at_zero(scores in any_scores()) {
        let thresholds: Vec<f64> = (-1..=20).map(|k| f64::from(k) / 20.0).collect();
        let profile = performance_profile(&scores, &thresholds);
        prop_assert!(profile.windows(2).all(|pair| pair[0] >= pair[1]));
        prop_assert_eq!((profile[0], profile[21]), (1.0, 0.0));
    }

    #[test]
    fn two_systems_share_one_probability((x, y) in (1usize..5).prop_flat_map(|count| (tasks(count), tasks(count)))) {
        let (x, y) = (Scores::new(x).unwrap(), Scores::new(y).unwrap());
        let (own, other) = (probability_of_improvement(&x, &y).unwrap(), probability_of_improvement(&y, &x).unwrap());
        prop_assert!((own + other - 1.0).abs() < 1e-12);
        prop_assert!((probability_of_improvement(&x, &x).unwrap() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn a_band_holds_its_mean(curves in prop::collection::vec(prop::collection::vec(0.0..1.0f64, 1..8), 1..4)) {
        let curves: Vec<Vec<[f64; 2]>> = curves
            .into_iter()
            .enumerate()
            .map(|(k, ys)| ys.into_iter().enumerate().map(|(i, y)| [(i * (k + 1)) as f64, y]).collect())
            .collect();
        for point in band(&curves) {
            prop_assert!(point.low - 1e-12 <= point.mean && point.mean <= point.high + 1e-12);
        }
    }
}
