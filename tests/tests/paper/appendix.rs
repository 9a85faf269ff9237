//! The appendix: the Hungarian algorithm, observations, tables of hyperparameters.

use crate::support::{actor, actor_shapes, stream};
use magex_assign::exact_points;
use magex_core::config::{CommanderConfig, CommanderPolicy, ExecutorKind, MappoConfig, RunConfig};
use magex_core::joint_state::JointState;
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_learner::train::gae::ValueNorm;
use magex_learner::train::learned::Moments;
use magex_learner::train::mappo::Mappo;
use magex_nets::commander::Commander;
use magex_tests::small;

// Appendix A.

#[test]
fn appendix_a_1_the_hungarian_cost_is_exact() {
    // Deviation: the paper calls the Hungarian algorithm approximate. It is exact, in O(N³).
    let mut random = stream(1);
    for _ in 0..50 {
        let mut points = || (0..10).map(|_| random.uniform32()).collect::<Vec<f32>>();
        let (agents, goals) = (points(), points());
        let cost = |order: &[usize]| -> f64 {
            let pair = |(i, &g): (usize, &usize)| {
                f64::from(agents[2 * i] - goals[2 * g]).hypot(f64::from(agents[2 * i + 1] - goals[2 * g + 1]))
            };
            order.iter().enumerate().map(pair).sum()
        };
        let mut best = f64::INFINITY;
        permutations(&mut [0, 1, 2, 3, 4], 0, &mut |order| best = best.min(cost(order)));
        let (_, found) = exact_points(&agents, &goals, 2).unwrap();
        assert!((found - best).abs() < 1e-6, "{found} for {best}");
    }
}

fn permutations(items: &mut [usize; 5], from: usize, visit: &mut impl FnMut(&[usize])) {
    if from == items.len() {
        return visit(items);
    }
    for k in from..items.len() {
        items.swap(from, k);
        permutations(items, from + 1, visit);
        items.swap(from, k);
    }
}

#[test]
fn appendix_a_2_the_literal_executor_sees_absolute_positions_and_ours_relative_ones() {
    // Moving agents and landmarks together changes nothing for an agent that sees only what is relative to it.
    let mut task = TaskConfig { side: 4.0, ..TaskConfig::simple_spread(1, Spawn::Uniform) };
    task.horizon = 20;
    for (kind, relative) in [(ExecutorKind::MagexLiteral, false), (ExecutorKind::Local, true)] {
        let mut config = small(kind, 1, 1);
        config.task = task.clone();
        let spec = *Mappo::new(&config).unwrap().spec();
        let seen = |shift: f32| {
            let positions = [0.5 + shift, 0.25];
            let statics = Statics::landmarks(1, 2, vec![1.0 + shift, 0.75]);
            spec.compute(&JointState {
                positions: &positions,
                velocities: &[0.5, 0.0],
                agent_state: &[],
                world_states: &[],
                masks: &[],
                marks: &[],
                statics: statics.view(),
                goals: &[0],
            })
            .goals
        };
        // A shift that f32 adds exactly.
        assert_eq!(seen(0.0) == seen(2.0), relative, "{kind}");
    }
}

#[test]
fn appendix_table_mappo_hyperparameters() {
    let RunConfig { executor, collect, run, .. } = RunConfig::default();
    let mappo = MappoConfig::default();
    assert_eq!((mappo.max_grad_norm, mappo.gae_lambda, mappo.gamma, mappo.huber_delta), (10.0, 0.95, 0.99, 10.0));
    assert_eq!(mappo.adam_epsilon, 1e-5);
    assert!(executor.feature_norm, "feature normalisation");
    // Deviation: "reward normalisation" is a running normalisation of the returns in the authors' code, and here.
    assert!(mappo.value_norm);
    let mut norm = ValueNorm::new(true);
    norm.update([9.0, 11.0].into_iter());
    let (mean, deviation) = norm.moments();
    assert!((mean - 10.0).abs() < 1e-3 && (deviation - 1.0).abs() < 1e-2);
    // Deviation: 2.5e-5 needs 5 to 20 times the steps; this is the rate of the released code.
    assert_eq!((mappo.actor_learning_rate, mappo.critic_learning_rate), (7e-4, 7e-4));
    // Deviation: 10 environments; 4 episodes of 50 agents learn the same in fewer steps.
    assert_eq!(collect.episodes_per_iteration, 4);
    // Deviation: 3,000,000 steps; the default run needs a few thousand.
    assert_eq!(run.max_steps, 20_000);
    // Adam without weight decay: no gradient, no step.
    let (mut adam, mut weights) = (Moments::adam(2), [1.0f32, -3.0]);
    adam.adam_step(&mut weights, &[0.0, 0.0], 1e-3, 1e-5, 10.0);
    assert_eq!(weights, [1.0, -3.0]);
    // The gradient is clipped to a norm of 10: as far as it goes after one of 10 in the same direction.
    let steps = [[30.0f32, 40.0], [6.0, 8.0]].map(|gradient| {
        let (mut adam, mut weights) = (Moments::adam(2), [0.0f32; 2]);
        adam.adam_step(&mut weights, &gradient, 1e-3, 1.0, 10.0);
        weights
    });
    assert!((steps[0][0] - steps[1][0]).abs() < 1e-9 && (steps[0][1] - steps[1][1]).abs() < 1e-9, "{steps:?}");
}

#[test]
fn appendix_table_mappo_hyperparameters_orthogonal_initialisation() {
    let mappo = Mappo::new(&small(ExecutorKind::Magex, 5, 1)).unwrap();
    let actor = actor(&mappo);
    // Every weight matrix [rows, columns]: the shorter side is an orthogonal basis times the layer's gain.
    let matrices = actor.entries.iter().filter(|entry| entry.shape.len() == 2);
    let mut checked = 0;
    for entry in matrices {
        let (rows, columns) = (entry.shape[0], entry.shape[1]);
        let at = |i: usize, j: usize| f64::from(actor.values[entry.start + i * columns + j]);
        let vector = |k: usize| -> Vec<f64> {
            if rows <= columns {
                (0..columns).map(|j| at(k, j)).collect()
            } else {
                (0..rows).map(|i| at(i, k)).collect()
            }
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let gain = dot(&vector(0), &vector(0));
        for k in 1..rows.min(columns) {
            assert!((dot(&vector(k), &vector(k)) - gain).abs() < 1e-4, "{}: one gain", entry.name);
            assert!(dot(&vector(0), &vector(k)).abs() < 1e-4, "{}: orthogonal", entry.name);
        }
        checked += 1;
    }
    assert!(checked >= 8, "{checked} matrices");
}

#[test]
fn appendix_table_architecture_hyperparameters() {
    let config = small(ExecutorKind::Magex, 5, 1);
    assert_eq!((config.executor.feature_size, config.executor.graph_blocks), (32, 2), "feature size, l_g");
    let shapes = actor_shapes(&config);
    // f_o per agent instead of per team: (position, velocity) → 32, so that the number of agents is not built in.
    assert_eq!(shapes["f_o.weight"], [4, 32]);
    // f_g: per node to a pair network and a message, for each of the two blocks.
    for block in ["block0", "block1"] {
        assert_eq!(shapes[&format!("{block}.project.weight")], [32, 2 * 16 + 2 * 32]);
    }
    assert!(!shapes.contains_key("block2.project.weight"));
    assert_eq!(shapes["f_goal.weight"][1], 32);
    assert_eq!(shapes["f_state.weight"], [32 * 2, 32]);
    assert_eq!(shapes["head.weight"], [32, 5]);
    // f_sche: 4N positions in, N scores out. Deviation: two hidden layers as in the authors' code, where one layer of 4N × N is
    // linear and cannot rank.
    let kind = CommanderPolicy::Ranking;
    let params = Commander::init(&CommanderConfig { kind, ..CommanderConfig::default() }, 7, 2, 1).unwrap();
    let weights: Vec<&Vec<usize>> =
        params.entries.iter().map(|entry| &entry.shape).filter(|shape| shape.len() == 2).collect();
    assert_eq!((weights.first().unwrap()[0], weights.last().unwrap()[1]), (4 * 7, 7));
}

#[test]
fn appendix_c_2_one_set_of_parameters_is_shared_by_all_agents() {
    // MAPPO "equips all agents with one shared set of parameters": the actor's size does not depend on N.
    let count = |agents| actor(&Mappo::new(&small(ExecutorKind::Magex, agents, 1)).unwrap()).values.len();
    assert_eq!(count(3), count(50));
    assert!(count(5) > 5_000);
}
