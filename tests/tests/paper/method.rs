//! Sections 3 and 4: preliminary, Goal Commander, Action Executor, Algorithm 1.

use crate::support::{act, network, run, scheduler, scores, stream};
use candle_core::{Device, Tensor};
use magex_assign::exact_points;
use magex_core::config::{CommanderPolicy, ExecutorKind, MappoConfig, RunConfig};
use magex_core::ids::Mode;
use magex_core::task::{RewardConfig, Spawn, TaskConfig, TaskSettings};
use magex_core::trajectory::Trajectory;
use magex_env::env_from_state;
use magex_learner::train::gae::Gae;
use magex_nets::commander::Team;
use magex_nets::ops::{GraphBlock, GraphNoise, graph_block};
use magex_tests::{small, train, updates};

// Section 3, Preliminary.

#[test]
fn section_3_1_rewards_are_discounted_and_advantages_are_generalised() {
    let mappo = MappoConfig::default();
    assert!((0.0..1.0).contains(&mappo.gamma));
    // Σ_l γ^l r_{t+l}: with λ = 1 and values of zero the return is that sum.
    let gae = Gae { gamma: mappo.gamma, lambda: 1.0, bootstrap: false };
    let (mut advantages, mut returns) = ([0.0; 3], [0.0; 3]);
    gae.run((&[1.0, 2.0, 4.0], &[0.0; 4], &[]), 1, &mut advantages, &mut returns);
    assert!((returns[0] - (1.0 + 0.99 * 2.0 + 0.99 * 0.99 * 4.0)).abs() < 1e-5, "{returns:?}");
    // Deviation: the horizon is a time limit and not an end, so the last state's value is bootstrapped by default; the
    // released code counts it as 0, and an observation without a clock cannot tell how far the end is.
    assert!(mappo.bootstrap_at_horizon);
    Gae { bootstrap: true, ..gae }.run((&[0.0], &[0.0, 10.0], &[]), 1, &mut advantages, &mut returns);
    assert!((returns[0] - 9.9).abs() < 1e-5);
}

#[test]
fn equation_2_and_6_a_fully_connected_graph_reaches_every_agent() {
    for kind in [ExecutorKind::Magex, ExecutorKind::MagexLiteral, ExecutorKind::Attention, ExecutorKind::Mlp] {
        let config = small(kind, 5, 1);
        let near: Vec<f32> = (0..10).map(|k| 0.2 * k as f32).collect();
        let mut moved = near.clone();
        moved[8] += 30.0;
        // To the letter an agent keeps nothing of itself and G_a is the same for all: without a sampled edge it sees nothing.
        let graphs: Vec<[Vec<f32>; 2]> =
            (0..8).map(|key| [&near, &moved].map(|at| act(&config, at, &[0.0; 5 * 32], Some(key)).0)).collect();
        for agent in 0..4 {
            let sees = |[a, b]: &[Vec<f32>; 2]| a[agent * 5..(agent + 1) * 5] != b[agent * 5..(agent + 1) * 5];
            let count = graphs.iter().filter(|logits| sees(logits)).count();
            let least = if kind == ExecutorKind::MagexLiteral { 1 } else { 8 };
            assert!(count >= least, "{kind}: in {count} of 8 graphs agent {agent} sees that agent 4 has moved");
        }
    }
}

#[test]
fn equation_2_a_message_is_the_mean_over_the_neighbours() {
    // Deviation: the paper divides by √(d_i d_j) with d "the dimension of feature"; here d is the degree, as in a GCN, and the sum
    // is a mean, so that the features do not grow with the number of agents. The agent's own feature is kept beside it.
    let (n, p, f) = (3, 16, 16);
    let row = |i: usize| -> Vec<f32> {
        let z = (0..f).map(|k| (i * f + k) as f32 * 0.1);
        let own = (0..f).map(|k| k as f32 - 8.0);
        std::iter::repeat_n(0.0, 2 * p).chain(z).chain(own).collect()
    };
    let features =
        Tensor::from_vec((0..n).flat_map(row).collect::<Vec<f32>>(), (n, 2 * (p + f)), &Device::Cpu).unwrap();
    let relative = Tensor::zeros((n, p), candle_core::DType::F32, &Device::Cpu).unwrap();
    for (logit, edges) in [(1.0f32, true), (-1.0, false)] {
        let mut score = vec![0.0f32; p + 1];
        score[p] = logit;
        let score = Tensor::from_vec(score, p + 1, &Device::Cpu).unwrap();
        let block = GraphBlock { agents: n, pair_hidden: p, width: f, block: 0, self_path: true, temperature: 1.0 };
        let y = graph_block(&features, &relative, &score, block, GraphNoise::Off).unwrap();
        let y: Vec<Vec<f32>> = y.to_vec2().unwrap();
        for (i, row) in y.iter().enumerate() {
            for (k, found) in row.iter().enumerate() {
                let others = (0..n).filter(|j| *j != i).map(|j| (j * f + k) as f32 * 0.1).sum::<f32>() / (n - 1) as f32;
                let expected = (k as f32 - 8.0 + if edges { others } else { 0.0 }).max(0.0);
                assert!((found - expected).abs() < 1e-5, "edges {edges}, agent {i}: {found} for {expected}");
            }
        }
    }
}

// Section 4.1, Goal Commander.

#[test]
fn equation_3_goals_are_ranked_by_their_probability_and_handed_out_in_order() {
    let n = 6;
    let commander = scheduler(CommanderPolicy::Ranking, n);
    // Deviation: "agent 1..N" is the order along an axis (or angle, or curve), not the index: with indices in random order one score
    // per goal cannot be learned. Both groups stand in that order here, so index and order agree.
    let agents: Vec<f32> = (0..n).flat_map(|k| [k as f32, 0.3 * (k % 2) as f32]).collect();
    let goals: Vec<f32> = (0..n).flat_map(|k| [k as f32 + 0.5, 1.0 - 0.2 * k as f32]).collect();
    let team = Team { agents: &agents, goals: &goals, dims: 2 };
    let scores = scores(&commander, &team);
    assert_eq!(scores.len(), n, "f_sche: 4N positions to N scores");
    let mut ranked: Vec<u32> = (0..n as u32).collect();
    ranked.sort_by(|&a, &b| scores[b as usize].total_cmp(&scores[a as usize]));
    let decision = commander.assign(&team, Mode::Greedy, &mut stream(0)).unwrap();
    assert_eq!(decision.goals, ranked);
    // P_goal = softmax(f_sche(P_a, P_g)) is the distribution of the first goal.
    let total: f32 = scores.iter().map(|s| s.exp()).sum();
    let first = scores[ranked[0] as usize].exp() / total;
    assert!((decision.probabilities[0] - first).abs() < 1e-5, "{} for {first}", decision.probabilities[0]);
    // The last has no choice left.
    assert!((decision.probabilities[n - 1] - 1.0).abs() < 1e-6);
}

#[test]
fn section_4_1_deviation_the_default_scheduler_scores_pairs_and_does_not_depend_on_indices() {
    // One score per goal can only be learned where indices are ordered in space; a score per pair needs no order and serves
    // any number of agents.
    assert_eq!(RunConfig::default().commander.kind, CommanderPolicy::Pairwise);
    let commander = scheduler(CommanderPolicy::Pairwise, 4);
    let agents = [0.0, 0.0, 3.0, 0.1, 0.2, 4.0, 3.3, 3.7];
    let goals = [3.1, 3.2, 0.4, 0.1, 2.8, 0.3, 0.1, 3.6];
    let decided = |agents: &[f32]| {
        commander.assign(&Team { agents, goals: &goals, dims: 2 }, Mode::Greedy, &mut stream(0)).unwrap().goals
    };
    let given = decided(&agents);
    let mut turned = agents;
    turned.rotate_left(2);
    let mut expected = given.clone();
    expected.rotate_left(1);
    assert_eq!(decided(&turned), expected);
}

#[test]
fn equation_4_the_reward_of_the_commander_is_one_minus_the_cost_ratio() {
    // R_c = 1 − C_c / C_h: 0 for the exact assignment, below 0 for any other.
    for (kind, exact) in [(CommanderPolicy::Exact, true), (CommanderPolicy::Random, false)] {
        let mut config = small(ExecutorKind::Local, 5, 1);
        config.commander.kind = kind;
        let (trajectories, ..) = run(&config);
        let rewards = |t: &Trajectory| t.costs.iter().zip(&t.exact_costs).map(|(c, h)| 1.0 - c / h).collect::<Vec<_>>();
        let rewards: Vec<f32> = trajectories.iter().flat_map(rewards).collect();
        assert_eq!(rewards.len(), 8, "one decision per episode");
        assert!(rewards.iter().all(|r| *r <= 1e-6), "{rewards:?}");
        assert_eq!(rewards.iter().all(|r| r.abs() < 1e-6), exact, "{kind}: {rewards:?}");
    }
    // The costs are the summed distances of the episode's goals at spawn.
    let (trajectories, ..) = run(&small(ExecutorKind::Local, 5, 1));
    for t in &trajectories {
        for b in 0..t.shape.episodes {
            let agents = &t.positions[b * 10..(b + 1) * 10];
            let landmarks = &t.statics.get("landmarks")[b * 10..(b + 1) * 10];
            let distance =
                |i: usize, g: usize| (agents[2 * i] - landmarks[2 * g]).hypot(agents[2 * i + 1] - landmarks[2 * g + 1]);
            let cost: f32 = (0..5).map(|i| distance(i, t.goals[b * 5 + i] as usize)).sum();
            assert!((t.costs[b] - cost).abs() < 1e-4, "C_c {} for {cost}", t.costs[b]);
            let (_, exact) = exact_points(agents, landmarks, 2).unwrap();
            assert!((f64::from(t.exact_costs[b]) - exact).abs() < 1e-4, "C_h {} for {exact}", t.exact_costs[b]);
        }
    }
}

// Section 4.2, Action Executor.

#[test]
fn equation_5_the_reward_of_an_agent_is_bonus_minus_distance_minus_collisions() {
    let mut task = TaskConfig { horizon: 10, ..TaskConfig::simple_spread(3, Spawn::Uniform) };
    task.settings =
        TaskSettings::SimpleSpread(RewardConfig { bonus: 1.5, distance: 2.0, collision: 0.7, distance_unit: 4.0 });
    // Agent 0 on its landmark, agents 1 and 2 on their way into each other and away from theirs.
    let (start, landmarks) = ([0.0, 0.0, 2.0, 0.0, 2.3, 0.0], [0.1, 0.0, 4.0, 0.0, 2.0, 3.0]);
    let mut env = env_from_state(&task, &start, &[0.0, 0.0, 1.0, 0.0, -1.0, 0.0], &landmarks).unwrap();
    env.set_goals(&[0, 1, 2]).unwrap();
    let mut rewards = [0.0; 3];
    env.step(&[0, 0, 0], &mut rewards).unwrap();
    let at = env.positions();
    let apart = |i: usize, x: f32, y: f32| (at[2 * i] - x).hypot(at[2 * i + 1] - y);
    for i in 0..3 {
        let left = apart(i, landmarks[2 * i], landmarks[2 * i + 1]);
        let bonus = if left <= 0.15 { 1.0 } else { 0.0 };
        // Deviation: the released code counts the agent itself as a collision, always.
        let hits = (0..3).filter(|&j| j != i && apart(i, at[2 * j], at[2 * j + 1]) < 0.2).count() as f32;
        let expected = 1.5 * bonus - 2.0 * left / 4.0 - 0.7 * hits;
        assert!((rewards[i] - expected).abs() < 1e-5, "agent {i}: {} for {expected}", rewards[i]);
    }
    assert!(rewards[0] > 1.0 && apart(1, at[4], at[5]) < 0.2, "the bonus and the collision were both there");
}

#[test]
fn equation_7_edges_are_sampled_and_the_same_noise_samples_the_same_edges() {
    let config = small(ExecutorKind::Magex, 5, 1);
    let positions: Vec<f32> = (0..10).map(|k| 0.2 * k as f32).collect();
    let drawn = |noise| act(&config, &positions, &[0.0; 5 * 32], noise).0;
    assert_eq!(drawn(Some(1)), drawn(Some(1)), "an epoch of the update sees the graph that acted");
    let others = (2..40).filter(|&key| drawn(Some(key)) != drawn(Some(1))).count();
    assert!(others > 20, "{others} of 38 keys give another graph");
    assert_eq!(drawn(None), drawn(None), "an evaluation samples nothing");
}

#[test]
fn equations_8_to_10_the_executor_sees_goal_subgraph_and_history() {
    let config = small(ExecutorKind::Magex, 5, 1);
    let positions: Vec<f32> = (0..10).map(|k| 0.2 * k as f32).collect();
    let zeros = [0.0; 5 * 32];
    let (first, memory) = act(&config, &positions, &zeros, None);
    assert_eq!((first.len(), memory.len()), (5 * 5, 5 * 32), "RNN of the feature size");
    let (second, _) = act(&config, &positions, &memory, None);
    assert_ne!(first, second, "E_all depends on the state before");
    // E_goal: another place relative to the goal, alone on the map, is another action.
    let mut alone = config.clone();
    alone.task.agents = 1;
    let ((a, _), (b, _)) = (act(&alone, &[0.5, 0.5], &[0.0; 32], None), act(&alone, &[-0.5, 0.5], &[0.0; 32], None));
    assert_ne!(a, b);
}

// Section 4.3, Algorithm 1.

#[test]
fn algorithm_1_lines_3_to_14_goals_once_per_episode_then_a_step_at_a_time() {
    let config = small(ExecutorKind::Magex, 5, 1);
    let (trajectories, ..) = run(&config);
    assert_eq!(trajectories.iter().map(|t| t.shape.episodes).sum::<usize>(), 8);
    for t in &trajectories {
        let (s, b, n) = (t.shape.steps, t.shape.episodes, t.shape.agents);
        // Lines 5 to 7: one decision of the commander, with its probability.
        assert_eq!((t.goals.len(), t.goal_log_probs.len()), (b * n, b));
        assert!(t.goal_log_probs.iter().all(|p| *p <= 0.0));
        for goals in t.goals.chunks(n) {
            let mut sorted = goals.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, [0, 1, 2, 3, 4], "every goal once");
        }
        // Line 8. Deviation: no state is terminal, so every episode has T_e steps.
        assert_eq!(s, config.task.horizon as usize);
        // Lines 10 to 13: action, probability and reward of each agent at each step. Deviation: states are stored instead of
        // observations, and V is computed by the learner, because both follow from the states; the last state is among them.
        assert_eq!((t.actions.len(), t.log_probs.len(), t.rewards.len()), (s * b * n, s * b * n, s * b * n));
        assert_eq!(t.positions.len(), (s + 1) * b * n * 2);
        assert!(t.actions.iter().all(|a| *a < 5) && t.log_probs.iter().all(|p| *p < 0.0));
        // A fresh policy is nearly uniform (gain 0.01 of the head).
        let mean = t.log_probs.iter().sum::<f32>() / t.log_probs.len() as f32;
        assert!((mean + 5f32.ln()).abs() < 0.05, "{mean}");
    }
}

#[test]
fn algorithm_1_line_19_an_iteration_updates_every_network() {
    let (_, before, after) = run(&small(ExecutorKind::Magex, 5, 1));
    assert_ne!(network(&before, "actor").params, network(&after, "actor").params, "θ'");
    assert_ne!(network(&before, "critic").params, network(&after, "critic").params, "φ'");
    // Deviation: the commander has no value network φ; one decision per episode is compared with the greedy decision on the same
    // team, whose cost is known at once. Where both agree nothing is learned, so more than one iteration is looked at.
    let (_, before, after) = run(&small(ExecutorKind::Local, 5, 4));
    assert_ne!(network(&before, "commander").params, network(&after, "commander").params, "θ");
    assert_ne!(before.value_norm, after.value_norm);
}

#[test]
fn section_4_3_the_likelihoods_of_acting_are_those_of_the_update() {
    // PPO's ratio π_θ / π_old is 1 before the first step, with sampled graphs and all.
    let ran = train(&small(ExecutorKind::Magex, 5, 2), tempfile::tempdir().unwrap().path(), 1, 1);
    let lines: Vec<_> = updates(&ran.events).into_iter().filter(|line| !line["executor"].is_null()).collect();
    assert_eq!(lines.len(), 2);
    for line in lines {
        assert_eq!(line["executor"]["first_ratio_error"], 0.0);
    }
}

#[test]
fn section_4_3_the_surrogate_is_clipped_and_the_first_step_is_not() {
    let learned = |epochs: u32, clip: f32| {
        let mut config = small(ExecutorKind::Local, 5, 1);
        (config.mappo.epochs, config.mappo.minibatch_size, config.mappo.clip_epsilon) = (epochs, 100_000, clip);
        let learned = run(&config).2;
        (["actor", "critic"].map(|name| network(&learned, name).clone()), learned.value_norm)
    };
    // One step: every ratio is 1 and every value the old one, so the limits cannot matter. From the second step on they do.
    assert_eq!(learned(1, 0.001), learned(1, 0.2));
    assert_ne!(learned(3, 0.001), learned(3, 0.2));
}

#[test]
fn section_4_3_the_value_loss_is_linear_beyond_delta() {
    let critic = |delta: f32| {
        let mut config = small(ExecutorKind::Local, 5, 1);
        config.mappo.huber_delta = delta;
        network(&run(&config).2, "critic").params.clone()
    };
    // Targets are normalised: no error of this run is as large as 10, many are larger than 0.01.
    assert_eq!(critic(10.0), critic(1e6));
    assert_ne!(critic(10.0), critic(0.01));
}
