//! What must hold for any states, any actions and any batch.

// Helpers of tests; the lint's exception covers test functions only.
#![allow(clippy::unwrap_used)]

use magex_core::metrics_table::{ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, SUCCESS_RATE};
use magex_core::task::{Spawn, TaskConfig};
use magex_env::{Env, env_from_state};
use proptest::prelude::*;

/// B worlds of N agents: positions (crowded, some coincident), velocities, landmarks, goals, and T joint actions.
#[derive(Debug, Clone)]
struct Case {
    agents: usize,
    positions: Vec<f32>,
    velocities: Vec<f32>,
    landmarks: Vec<f32>,
    goals: Vec<u32>,
    actions: Vec<Vec<u8>>,
}

fn cases() -> impl Strategy<Value = Case> {
    (1..40usize, 1..24usize).prop_flat_map(|(agents, worlds)| {
        let numbers = agents * worlds;
        // A coarse lattice makes coincident agents and exact distances common.
        let coordinate = prop_oneof![(-1.0..1.0f32), (-8..8i8).prop_map(|k| f32::from(k) * 0.1)];
        (
            prop::collection::vec(coordinate, 2 * numbers),
            prop::collection::vec(-2.0..2.0f32, 2 * numbers),
            prop::collection::vec(-1.0..1.0f32, 2 * numbers),
            prop::collection::vec(0..agents as u32, numbers),
            prop::collection::vec(prop::collection::vec(0..5u8, numbers), 1..6),
        )
            .prop_map(move |(positions, velocities, landmarks, goals, actions)| Case {
                agents,
                positions,
                velocities,
                landmarks,
                goals,
                actions,
            })
    })
}

impl Case {
    fn worlds(&self) -> usize {
        self.goals.len() / self.agents
    }

    /// World b alone.
    fn only(&self, b: usize) -> Case {
        let one = |values: &[f32]| values[2 * b * self.agents..2 * (b + 1) * self.agents].to_vec();
        let own = b * self.agents..(b + 1) * self.agents;
        Case {
            agents: self.agents,
            positions: one(&self.positions),
            velocities: one(&self.velocities),
            landmarks: one(&self.landmarks),
            goals: self.goals[own.clone()].to_vec(),
            actions: self.actions.iter().map(|actions| actions[own.clone()].to_vec()).collect(),
        }
    }

    /// Plays all steps; everything seen, per step: positions, velocities, rewards.
    fn play(&self) -> (Env, Vec<[Vec<f32>; 3]>) {
        let mut task = TaskConfig::simple_spread(self.agents, Spawn::Uniform);
        task.side = 20.0;
        let mut spread = env_from_state(&task, &self.positions, &self.velocities, &self.landmarks).unwrap();
        spread.set_goals(&self.goals).unwrap();
        let mut rewards = vec![0.0; self.goals.len()];
        let log = self.actions.iter().map(|actions| {
            spread.step(actions, &mut rewards).unwrap();
            [spread.positions(), spread.velocities(), rewards.clone()]
        });
        let log = log.collect();
        (spread, log)
    }
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_world_does_not_see_its_neighbours(case in cases()) {
        let (together, log) = case.play();
        let metrics = together.scores();
        for (b, metrics) in metrics.iter().enumerate() {
            let (alone, own) = case.only(b).play();
            for (all, own) in log.iter().zip(&own) {
                for (all, own) in all.iter().zip(own) {
                    let own_range = b * own.len()..(b + 1) * own.len();
                    prop_assert_eq!(bits(&all[own_range]), bits(own));
                }
            }
            prop_assert_eq!(&alone.scores()[0], metrics);
        }
    }

    #[test]
    fn numbers_stay_finite_and_rates_in_range(case in cases()) {
        let (spread, log) = case.play();
        let latest = TaskConfig::simple_spread(case.agents, Spawn::Uniform).horizon + 1;
        prop_assert!(log.iter().flatten().flatten().all(|value| value.is_finite()));
        for m in spread.scores() {
            prop_assert!((0.0..=1.0).contains(&m[SUCCESS_RATE]));
            prop_assert!(m[MATCHED_SUCCESS_RATE] <= m[SUCCESS_RATE]);
            prop_assert!(m[ARRIVAL_STEP] >= 1.0 && m[ARRIVAL_STEP] <= latest as f32);
            prop_assert!(m[COLLISIONS_PER_AGENT_STEP] >= 0.0 && m[COLLISIONS_PER_AGENT_STEP] < case.agents as f32);
        }
    }

    #[test]
    fn without_thrust_the_total_momentum_only_decays(case in cases()) {
        let case = Case { actions: vec![vec![0; case.goals.len()]], ..case };
        let (_, log) = case.play();
        for b in 0..case.worlds() {
            let sum = |velocities: &[f32], axis: usize| -> f64 {
                let own = &velocities[2 * b * case.agents..2 * (b + 1) * case.agents];
                own.iter().skip(axis).step_by(2).map(|&v| f64::from(v)).sum()
            };
            for axis in 0..2 {
                let (before, after) = (sum(&case.velocities, axis), sum(&log[0][1], axis));
                // Each pair's push is summed in f32 on either side: up to 20 per pair, 40 agents.
                prop_assert!((after - 0.75 * before).abs() < 1e-3, "{} {}", before, after);
            }
        }
    }
}
