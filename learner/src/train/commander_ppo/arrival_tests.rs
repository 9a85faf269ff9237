#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;
use magex_core::config::RunConfig;
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP};
use magex_core::rng::Stream;
use magex_core::statics::Statics;
use magex_core::task::Spawn;
use magex_core::trajectory::{EpisodeMetrics, Shape};

fn stream(k: u32) -> Stream {
    Key::new(6, Purpose::Instances, &[k]).stream()
}

#[test]
fn the_forecast_takes_out_what_the_instance_explains() {
    let mut stream = stream(0);
    let known: Vec<Vec<f64>> = (0..200).map(|_| vec![stream.range(0.0, 9.0), stream.range(3.0, 4.0), 7.0]).collect();
    let own: Vec<f64> = (0..200).map(|_| stream.range(-0.1, 0.1)).collect();
    let rewards: Vec<f64> = known.iter().zip(&own).map(|(x, own)| 5.0 - 2.0 * x[0] + 0.5 * x[1] + own).collect();
    let found = arrival::advantages(&rewards, &known);
    let mean = own.iter().sum::<f64>() / 200.0;
    let errors: Vec<f64> = found.iter().zip(&own).map(|(found, own)| (found - (own - mean)).abs()).collect();
    assert!(errors.iter().all(|error| *error < 0.05), "{errors:?}");
    assert!(found.iter().sum::<f64>().abs() < 1e-9);
    // Two features that say the same, and too few episodes for any fit.
    let twice: Vec<Vec<f64>> = known.iter().map(|x| vec![x[0], x[0], x[1]]).collect();
    let again = arrival::advantages(&rewards, &twice);
    again.iter().zip(&found).for_each(|(a, b)| assert!((a - b).abs() < 1e-3, "{a} and {b}"));
    assert_eq!(arrival::advantages(&[1.0, 3.0], &known[..2]), [-1.0, 1.0]);
    assert!(arrival::advantages(&[], &[]).is_empty());
}

#[test]
fn the_reward_is_the_last_arrival_and_the_collisions() {
    let metrics = EpisodeMetrics::of([(ARRIVAL_STEP, 30.0), (COLLISIONS_PER_AGENT_STEP, 0.25)]);
    assert_eq!(arrival::reward(&metrics, 60, 2.0), -1.0);
    assert!(arrival::reward(&EpisodeMetrics::of([]), 60, 2.0).is_nan());
}

#[test]
fn the_longest_way_counts_agents_with_a_goal() {
    let team = Team { agents: &[0.0, 0.0, 3.0, 4.0, 9.0, 9.0], goals: &[0.0, 0.0], dims: 2 };
    assert_eq!(arrival::longest(&team, &[u32::MAX, 0, u32::MAX]), 5.0);
}

/// Episodes of two agents and two goals, decided by the commander; the crossed decision is the longer one, and arrives sooner.
fn episodes(commander: &Commander, iteration: u32) -> Trajectory {
    const COUNT: usize = 32;
    let shape = Shape {
        steps: 1,
        episodes: COUNT,
        agents: 2,
        bodies: 2,
        landmarks: 2,
        dims: 2,
        goals_per_agent: 1,
        action_components: 1,
        ..Shape::default()
    };
    let shard = Shard {
        kind: ShardKind::Train,
        iteration: Iteration(iteration),
        index: 0,
        episodes: COUNT as u32,
        first_episode: 0,
        version: WeightsVersion(0),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    };
    let mut stream = stream(100 + iteration);
    let (mut positions, mut landmarks) = (Vec::new(), Vec::new());
    let (mut goals, mut log_probs, mut costs, mut exact, mut metrics) = (vec![], vec![], vec![], vec![], vec![]);
    for _ in 0..COUNT {
        let mut near = |x: f32| x + stream.range(-0.1, 0.1) as f32;
        let agents = [near(0.0), near(0.0), near(1.0), near(0.0)];
        let marks = [near(0.0), near(0.3), near(1.0), near(0.3)];
        let team = Team { agents: &agents, goals: &marks, dims: 2 };
        let decision = commander.assign(&team, Mode::Sampled, &mut stream).unwrap();
        let steps = if decision.goals == [1, 0] { 10.0 } else { 20.0 };
        costs.push(cost(&team, &decision.goals) as f32);
        exact.push(cost(&team, &[0, 1]) as f32);
        log_probs.push(decision.log_prob);
        goals.extend(decision.goals);
        metrics.push(EpisodeMetrics::of([(ARRIVAL_STEP, steps), (COLLISIONS_PER_AGENT_STEP, 0.0)]));
        positions.extend(agents);
        landmarks.extend(marks);
    }
    positions.extend_from_within(..);
    Trajectory {
        shard,
        shape,
        velocities: vec![0.0; positions.len()],
        positions,
        agent_state: vec![],
        statics: Statics::landmarks(2, 2, landmarks),
        goals,
        actions: vec![0; 2 * COUNT],
        log_probs: vec![0.0; 2 * COUNT],
        rewards: vec![0.0; 2 * COUNT],
        moves: vec![],
        masks: vec![],
        marks: vec![],
        world_states: vec![],
        goal_log_probs: log_probs,
        costs,
        exact_costs: exact,
        metrics,
    }
}

/// Mean arrival of the decisions of the last iterations.
fn trained(objective: CommanderObjective) -> f32 {
    let config = RunConfig {
        commander: CommanderConfig { learning_rate: 0.02, objective, ..CommanderConfig::default() },
        task: TaskConfig::simple_spread(2, Spawn::Uniform),
        ..RunConfig::default()
    };
    let ppo = CommanderPpo::new(&config.commander, &config.task, 1);
    let mut network = ppo.init().unwrap();
    let mut last = Vec::new();
    for iteration in 0..60 {
        let played = episodes(&ppo.commander(&network).unwrap(), iteration);
        let stats = ppo.update(&mut network, std::slice::from_ref(&played), iteration, 1.0).unwrap();
        assert_eq!((stats.skipped, stats.first_ratio_error), (0.0, 0.0));
        last = played.metrics.iter().map(|metrics| metrics[ARRIVAL_STEP]).collect();
    }
    last.iter().sum::<f32>() / last.len() as f32
}

#[test]
fn the_objective_decides_whether_the_short_way_or_the_early_arrival_is_learned() {
    let distance = trained(CommanderObjective::Distance);
    let arrival = trained(CommanderObjective::Arrival);
    assert!(distance > 19.0, "{distance}: the short way arrives after 20 steps");
    assert!(arrival < 12.0, "{arrival}: the crossed way arrives after 10");
}
