//! The team's reward: the documented sum, the same for every agent, whatever the goals are.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_core::rng::{Key, Purpose, Stream};
use magex_core::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use magex_env::{Env, env_from_state};

fn stream(k: u32) -> Stream {
    Key::new(5, Purpose::Instances, &[k]).stream()
}

fn team(name: TaskName, agents: usize) -> TaskConfig {
    TaskConfig { reward_target: RewardTarget::Team, ..TaskConfig::of(name, agents, Spawn::Uniform) }
}

/// B crowded worlds with goals that no reward may depend on.
struct Worlds {
    positions: Vec<f32>,
    landmarks: Vec<f32>,
}

impl Worlds {
    fn new(task: &TaskConfig, worlds: usize) -> Self {
        let mut stream = stream(task.agents as u32);
        let s = task.shape(worlds);
        let mut draw = |count: usize| -> Vec<f32> {
            let point = |at: usize, x: f64| if at % 3 == 2 && s.dims == 3 { 1.5 } else { x as f32 };
            (0..count * s.dims).map(|at| point(at, stream.range(-0.6, 0.6))).collect()
        };
        Self { positions: draw(worlds * s.bodies), landmarks: draw(worlds * s.landmarks) }
    }

    fn env(&self, task: &TaskConfig, worlds: std::ops::Range<usize>, shift: usize) -> Env {
        let s = task.shape(1);
        let (state, marks) = (s.bodies * s.dims, s.landmarks * s.dims);
        let positions = &self.positions[worlds.start * state..worlds.end * state];
        let landmarks = &self.landmarks[worlds.start * marks..worlds.end * marks];
        let mut env = env_from_state(task, positions, &vec![0.0; positions.len()], landmarks).unwrap();
        let goals = worlds.flat_map(|_| (0..s.agents * s.goals_per_agent).map(|i| ((i + shift) % s.agents) as u32));
        env.set_goals(&goals.collect::<Vec<_>>()).unwrap();
        env
    }
}

fn distances<'a>(dims: usize, from: &'a [f32], to: &'a [f32]) -> impl Iterator<Item = f64> + 'a {
    let distance = move |a: &[f32], b: &[f32]| -> f64 {
        a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>().sqrt()
    };
    to.chunks_exact(dims)
        .map(move |to| from.chunks_exact(dims).map(|from| distance(from, to)).fold(f64::INFINITY, f64::min))
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    values.iter().sum::<f64>() / values.len() as f64
}

/// The reward of every world by the documented formula, given its states before and after the step.
fn expected(task: &TaskConfig, before: &[f32], after: &[f32], landmarks: &[f32]) -> f64 {
    let (s, d) = (task.shape(1), task.dims());
    let agents = &after[..s.agents * d];
    let share = |distances: &mut dyn Iterator<Item = f64>, radius: f64| mean(distances.map(|x| f64::from(x <= radius)));
    match task.name {
        TaskName::SimpleSpread => {
            let r = task.reward().unwrap();
            let place = |i: usize| &agents[2 * i..2 * i + 2];
            let touch = |i: usize, j: usize| i != j && distances(2, place(i), place(j)).next().unwrap() < 0.2;
            let hits: usize = (0..s.agents).map(|i| (0..s.agents).filter(|&j| touch(i, j)).count()).sum();
            f64::from(r.bonus) * share(&mut distances(2, agents, landmarks), 0.15)
                - f64::from(r.distance / r.distance_unit) * mean(distances(2, agents, landmarks))
                - f64::from(r.collision) * hits as f64 / s.agents as f64
        }
        TaskName::PushBall => {
            let p = task.push_ball().unwrap();
            let split = s.agents * d;
            let potential = |state: &[f32]| {
                let (agents, balls) = state.split_at(split);
                -mean(distances(2, agents, balls).map(|x| (x - 0.25).max(0.0)))
                    - 2.0 * mean(distances(2, balls, landmarks))
            };
            let balls = &after[split..];
            f64::from(p.progress) * (potential(after) - potential(before))
                + f64::from(p.bonus) * share(&mut distances(2, balls, landmarks), 0.3)
                - f64::from(p.distance) * (mean(distances(2, agents, balls)) + mean(distances(2, balls, landmarks)))
        }
        TaskName::External => unreachable!("simulated elsewhere"),
        TaskName::Drones => {
            let c = task.drones().unwrap();
            let gained = mean(distances(3, before, landmarks)) - mean(distances(3, after, landmarks));
            let place = |i: usize| &after[3 * i..3 * i + 3];
            let nearest = |i: usize| {
                let others = (0..s.agents).filter(|&j| j != i);
                others.map(|j| distances(3, place(i), place(j)).next().unwrap()).fold(f64::INFINITY, f64::min)
            };
            let close = mean((0..s.agents).map(|i| (1.0 - nearest(i) / f64::from(c.proximity_radius)).max(0.0)));
            f64::from(c.progress) * gained + f64::from(c.bonus) * share(&mut distances(3, after, landmarks), 0.15)
                - f64::from(c.proximity) * close
        }
    }
}

fn step(env: &mut Env, actions: &[u8], agents: usize) -> Vec<f32> {
    let mut rewards = vec![0.0; agents];
    env.step(actions, &mut rewards).unwrap();
    rewards
}

#[test]
fn every_agent_gets_the_documented_sum_whatever_the_goals_are() {
    for (name, agents, worlds) in [
        (TaskName::SimpleSpread, 5, 19),
        (TaskName::SimpleSpread, 130, 2),
        (TaskName::PushBall, 4, 19),
        (TaskName::Drones, 3, 1),
    ] {
        let mut task = team(name, agents);
        if let magex_core::task::TaskSettings::PushBall(p) = &mut task.settings {
            p.distance = 0.3;
        }
        let (s, all) = (task.shape(1), Worlds::new(&task, worlds));
        let all = if name == TaskName::Drones {
            // Apart from each other, so that no drone crashes.
            let positions = vec![-0.2, 0.0, 1.5, 0.0, 0.1, 1.5, 0.6, 0.0, 1.5];
            Worlds { positions, ..all }
        } else {
            all
        };
        let (mut env, mut other) = (all.env(&task, 0..worlds, 0), all.env(&task, 0..worlds, 1));
        let mut alone = all.env(&task, worlds - 1..worlds, 0);
        let mut stream = stream(77);
        let rows = worlds * agents;
        for _ in 0..6 {
            let choices = task.action_heads()[0];
            let actions: Vec<u8> =
                (0..rows * s.action_components).map(|_| stream.below(choices as u32) as u8).collect();
            let before = env.positions();
            let mut rewards = vec![0.0; rows];
            env.step(&actions, &mut rewards).unwrap();
            let mut same = rewards.clone();
            other.step(&actions, &mut same).unwrap();
            assert_eq!(rewards, same, "{name}: other goals");
            let own = step(&mut alone, &actions[(rows - agents) * s.action_components..], agents);
            assert_eq!(own, rewards[rows - agents..], "{name}: alone");
            let after = env.positions();
            let (state, marks) = (s.bodies * s.dims, s.landmarks * s.dims);
            for world in 0..worlds {
                let part = |x: &[f32]| x[world * state..(world + 1) * state].to_vec();
                let landmarks = &all.landmarks[world * marks..(world + 1) * marks];
                let expected = expected(&task, &part(&before), &part(&after), landmarks);
                for reward in &rewards[world * agents..(world + 1) * agents] {
                    let gap = (f64::from(*reward) - expected).abs();
                    assert!(gap < 2e-5 * (1.0 + expected.abs()), "{name} {world}: {reward} and {expected}");
                }
            }
        }
    }
}
