//! The numbers of rliable 1.2.0, recorded by testdata/generate.py.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_stats::aggregate::{iqm, mean, median, optimality_gap, standard_deviation};
use magex_stats::bootstrap::interval;
use magex_stats::distribution::{performance_profile, probability_of_improvement};
use magex_stats::{Interval, Scores};
use serde_json::Value;

fn recorded() -> Value {
    serde_json::from_str(include_str!("../testdata/rliable.json")).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn scores(value: &Value) -> Scores {
    Scores::new(value.as_array().unwrap().iter().map(numbers).collect()).unwrap()
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

#[test]
fn point_estimates_agree_to_twelve_digits() {
    let recorded = recorded();
    let thresholds = numbers(&recorded["thresholds"]);
    let cases = list(&recorded["cases"]);
    assert_eq!(cases.len(), 7);
    for case in cases {
        let scores = scores(&case["scores"]);
        let mut rows = vec![
            ("iqm", iqm(&scores)),
            ("mean", mean(&scores)),
            ("median", median(&scores)),
            ("optimality_gap", optimality_gap(&scores, 1.0)),
            ("optimality_gap_half", optimality_gap(&scores, 0.5)),
        ];
        match standard_deviation(&scores.flat().collect::<Vec<_>>()) {
            Some(deviation) => rows.push(("standard_deviation", deviation)),
            None => assert!(case["standard_deviation"].is_null()),
        }
        for (name, own) in rows {
            let theirs = case[name].as_f64().unwrap();
            assert!((own - theirs).abs() < 1e-12, "{}: {name} is {own}, rliable has {theirs}", case["name"]);
        }
        let profile = performance_profile(&scores, &thresholds);
        for ((tau, own), theirs) in thresholds.iter().zip(profile).zip(numbers(&case["profile"])) {
            assert!((own - theirs).abs() < 1e-12, "{}: above {tau}: {own}, rliable has {theirs}", case["name"]);
        }
    }
}

#[test]
fn probabilities_of_improvement_agree_to_twelve_digits() {
    for pair in list(&recorded()["pairs"]) {
        let own = probability_of_improvement(&scores(&pair["x"]), &scores(&pair["y"])).unwrap();
        let theirs = pair["probability_of_improvement"].as_f64().unwrap();
        assert!((own - theirs).abs() < 1e-12, "{own}, rliable has {theirs}");
    }
}

/// The draws differ, the distribution does not: both ends are within 0.01 of those of 50,000 resamples.
#[test]
fn intervals_are_those_of_the_same_scheme() {
    let recorded = recorded();
    for row in list(&recorded["intervals"]) {
        let case = list(&recorded["cases"]).iter().find(|case| case["name"] == row["name"]).unwrap();
        let Interval { low, high } = interval(&scores(&case["scores"]), 1, 20_000, iqm).unwrap();
        let theirs = numbers(&row["iqm_interval"]);
        for (own, theirs) in [low, high].into_iter().zip(theirs) {
            assert!((own - theirs).abs() < 0.01, "{}: {own}, rliable has {theirs}", row["name"]);
        }
    }
}
