//! How fast the environment runs. The only part of the crate that looks at a clock; nothing else depends on it.

use crate::controller::{Controller as _, DroneScript};
use crate::drones::Drones;
use crate::env::Env as _;
use crate::error::EnvError;
use crate::particles::constants::LANES;
use crate::particles::real::Real;
use crate::spread::Spread;
use crate::spread::batch::Batch;
use crate::tasks::new_env;
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{DroneConfig, Spawn, TaskConfig, TaskName};
use std::time::Instant;

/// Joint steps in the table of random actions.
const TABLE: usize = 64;

/// Joint steps per second of one core in Simple Spread: [`throughput_of`] the paper's task for N agents.
pub fn throughput(agents: usize, worlds: usize, seconds: f64) -> Result<f64, EnvError> {
    throughput_of(&TaskConfig::simple_spread(agents, Spawn::Uniform), worlds, seconds)
}

/// Joint steps per second of one core: `worlds` episodes of a task, random actions from a keyed table, spawned anew and
/// scored at every horizon; contacts, collisions, rewards and arrival included. Runs for about `seconds`.
pub fn throughput_of(task: &TaskConfig, worlds: usize, seconds: f64) -> Result<f64, EnvError> {
    let shape = task.shape(worlds);
    let table = random_actions(worlds * shape.agents * shape.action_components, task.action_heads()[0] as u32);
    let mut rewards = vec![0.0; worlds * shape.agents];
    // Every agent goes for what has its own number.
    let goals: Vec<u32> = (0..worlds)
        .flat_map(|_| (0..shape.agents as u32).flat_map(|agent| std::iter::repeat_n(agent, shape.goals_per_agent)))
        .collect();
    let (start, mut joint_steps, mut round) = (Instant::now(), 0u64, 0);
    loop {
        let streams = (0..worlds as u32).map(|world| Key::new(1, Purpose::Bench, &[1, round, world]).stream());
        let mut env = new_env(task, streams, false)?;
        env.set_goals(&goals)?;
        for step in 0..task.horizon as usize {
            env.step(&table[step % TABLE], &mut rewards)?;
            joint_steps += worlds as u64;
            if step % TABLE == 0 && start.elapsed().as_secs_f64() >= seconds {
                return Ok(joint_steps as f64 / start.elapsed().as_secs_f64());
            }
        }
        std::hint::black_box(env.scores());
        round += 1;
    }
}

/// Commands per second of one core of the drone task: `episodes` episodes of N drones flown by the scripted pilot (`piloted`) or at
/// random, spawned anew and scored at every horizon; controllers, physics, contacts and rewards included. Runs for about
/// `seconds`.
pub fn drone_throughput(agents: usize, episodes: usize, piloted: bool, seconds: f64) -> Result<f64, EnvError> {
    let task = TaskConfig::of(TaskName::Drones, agents, Spawn::Uniform);
    let numbers = agents * episodes;
    let mut stream = Key::new(1, Purpose::Bench, &[4]).stream();
    let table: Vec<Vec<u8>> = (0..TABLE).map(|_| (0..3 * numbers).map(|_| stream.below(3) as u8).collect()).collect();
    let goals: Vec<u32> = (0..episodes).flat_map(|_| 0..agents as u32).collect();
    let (mut positions, mut agent_state) = (vec![0.0; 3 * numbers], vec![0.0; DroneConfig::AGENT_STATE * numbers]);
    let mut pilot = DroneScript::new(agents);
    let (mut actions, mut rewards) = (vec![1; 3 * numbers], vec![0.0; numbers]);
    let (start, mut commands, mut round) = (Instant::now(), 0u64, 0);
    loop {
        let streams = (0..episodes as u32).map(|episode| Key::new(1, Purpose::Bench, &[3, round, episode]).stream());
        let mut drones = Drones::new(&task, streams, false)?;
        drones.set_goals(&goals)?;
        let statics = drones.statics().clone();
        for step in 0..task.horizon as usize {
            if piloted {
                drones.write_positions(&mut positions)?;
                drones.write_agent_state(&mut agent_state)?;
                let state = JointState {
                    positions: &positions,
                    velocities: &positions,
                    agent_state: &agent_state,
                    statics: statics.view(),
                    goals: &goals,
                };
                pilot.act(&state, &mut actions)?;
            } else {
                actions.copy_from_slice(&table[step % TABLE]);
            }
            drones.step(&actions, &mut rewards)?;
            commands += episodes as u64;
            if step % 8 == 0 && start.elapsed().as_secs_f64() >= seconds {
                return Ok(commands as f64 / start.elapsed().as_secs_f64());
            }
        }
        std::hint::black_box(drones.scores());
        round += 1;
    }
}

/// The same steps without spawning and scoring, in f32 and in f64: joint steps per second of each.
pub fn precisions(agents: usize, worlds: usize, seconds: f64) -> Result<[f64; 2], EnvError> {
    let task = TaskConfig::simple_spread(agents, Spawn::Uniform);
    let streams = (0..worlds as u32).map(|world| Key::new(1, Purpose::Bench, &[1, 0, world]).stream());
    let spread = Spread::new(&task, streams, false)?;
    let (positions, landmarks) = (spread.positions(), spread.landmarks());
    let table = random_actions(agents * worlds, 5);
    Ok([
        steps_only::<f32>(&task, &positions, landmarks, &table, seconds)?,
        steps_only::<f64>(&task, &positions, landmarks, &table, seconds)?,
    ])
}

fn steps_only<R: Real>(
    task: &TaskConfig,
    positions: &[f32],
    landmarks: &[f32],
    table: &[Vec<u8>],
    seconds: f64,
) -> Result<f64, EnvError> {
    let convert = |values: &[f32]| -> Vec<R> { values.iter().map(|&v| R::from_f64(f64::from(v))).collect() };
    let (positions, landmarks) = (convert(positions), convert(landmarks));
    let velocities = vec![R::ZERO; positions.len()];
    let mut rewards = vec![R::ZERO; positions.len() / 2];
    let worlds = positions.len() / (2 * task.agents);
    let (start, mut joint_steps) = (Instant::now(), 0);
    loop {
        let mut batch = Batch::<R, LANES>::new(task, &positions, &velocities, landmarks.clone(), false)?;
        for (step, actions) in table.iter().enumerate() {
            batch.advance(step as u32 + 1, actions, &mut rewards);
            joint_steps += worlds;
        }
        if start.elapsed().as_secs_f64() >= seconds {
            return Ok(joint_steps as f64 / start.elapsed().as_secs_f64());
        }
    }
}

fn random_actions(numbers: usize, choices: u32) -> Vec<Vec<u8>> {
    let mut stream = Key::new(1, Purpose::Bench, &[2]).stream();
    (0..TABLE).map(|_| (0..numbers).map(|_| stream.below(choices) as u8).collect()).collect()
}
