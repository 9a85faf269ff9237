//! `env`: stepping of the environments alone, on one core.

use crate::report::Report;
use magex::output::thousands;
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{DroneConfig, Spawn, TaskConfig, TaskName};
use magex_env::controller::DroneScript;
use magex_env::{Controller as _, new_env};
use serde_json::json;
use std::time::Instant;

/// Joint steps in the table of random actions.
const TABLE: usize = 64;

/// Options of `env`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct EnvArgs {
    /// Seconds per team size.
    #[arg(long, value_name = "S", default_value_t = 2.0)]
    seconds: f64,
}

pub(crate) fn env(args: &EnvArgs) -> anyhow::Result<Report> {
    let title = "Environment alone, one core: contacts, collisions, rewards, spawns and metrics included";
    let mut report = Report::new("env", title, 1, &["task", "N", "worlds", "joint steps/s", "agent steps/s"]);
    let sizes: [(TaskName, &[(usize, usize)]); 3] = [
        (TaskName::SimpleSpread, &[(5, 64), (20, 32), (50, 32), (200, 16), (1000, 16)]),
        (TaskName::PushBall, &[(5, 64), (20, 32), (50, 32)]),
        (TaskName::Drones, &[(2, 64), (4, 64), (8, 32)]),
    ];
    for (name, agents, worlds) in sizes.iter().flat_map(|(name, sizes)| sizes.iter().map(|s| (*name, s.0, s.1))) {
        let speed = match name {
            TaskName::Drones => drone_throughput(agents, worlds, args.seconds)?,
            _ => throughput(&TaskConfig::of(name, agents, Spawn::Uniform), worlds, args.seconds)?,
        };
        let numbers = [agents as f64, worlds as f64, speed, speed * agents as f64].map(thousands);
        let cells = [name.to_string()].into_iter().chain(numbers).collect();
        report.row(cells, json!({ "task": name, "agents": agents, "worlds": worlds, "joint_steps_per_s": speed }));
    }
    report.notes.push(
        "drones: a joint step is a command, 4 physics steps with their controllers, flown by the scripted pilot".into(),
    );
    Ok(report)
}

/// Joint steps per second of one core: `worlds` episodes of a task, random actions from a keyed table, spawned anew and
/// scored at every horizon; contacts, collisions, rewards and arrival included. Runs for about `seconds`.
fn throughput(task: &TaskConfig, worlds: usize, seconds: f64) -> Result<f64, FieldError> {
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

/// Commands per second of one core of the drone task: `episodes` episodes of N drones flown by the scripted controller,
/// spawned anew and scored at every horizon; controllers, physics, contacts and rewards included. Runs for about `seconds`.
fn drone_throughput(agents: usize, episodes: usize, seconds: f64) -> Result<f64, FieldError> {
    let task = TaskConfig::of(TaskName::Drones, agents, Spawn::Uniform);
    let numbers = agents * episodes;
    let goals: Vec<u32> = (0..episodes).flat_map(|_| 0..agents as u32).collect();
    let (mut positions, mut agent_state) = (vec![0.0; 3 * numbers], vec![0.0; DroneConfig::AGENT_STATE * numbers]);
    let mut pilot = DroneScript::new(agents);
    let (mut actions, mut rewards) = (vec![1; 3 * numbers], vec![0.0; numbers]);
    let (start, mut commands, mut round) = (Instant::now(), 0u64, 0);
    loop {
        let streams = (0..episodes as u32).map(|episode| Key::new(1, Purpose::Bench, &[3, round, episode]).stream());
        let mut drones = new_env(&task, streams, false)?;
        drones.set_goals(&goals)?;
        let statics = drones.statics().clone();
        for step in 0..task.horizon as usize {
            drones.write_positions(&mut positions)?;
            drones.write_agent_state(&mut agent_state)?;
            let state = JointState {
                positions: &positions,
                velocities: &positions,
                agent_state: &agent_state,
                world_states: &[],
                masks: &[],
                marks: &[],
                statics: statics.view(),
                goals: &goals,
            };
            pilot.act(&state, &mut actions)?;
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

fn random_actions(numbers: usize, choices: u32) -> Vec<Vec<u8>> {
    let mut stream = Key::new(1, Purpose::Bench, &[2]).stream();
    (0..TABLE).map(|_| (0..numbers).map(|_| stream.below(choices) as u8).collect()).collect()
}
