//! Speed of the parts, one core each.

use super::Report;
use crate::output::thousands;
use crate::settings;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_env::bench::{drone_throughput, throughput, throughput_of};
use magex_learner::bench::minibatch;
use serde_json::json;

/// Agent samples of the minibatch that is timed.
const MINIBATCH: usize = 4096;

/// Options of `bench env`.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct EnvArgs {
    /// Seconds per team size.
    #[arg(long, value_name = "S", default_value_t = 2.0)]
    seconds: f64,
}

impl Default for EnvArgs {
    fn default() -> Self {
        Self { seconds: 2.0 }
    }
}

pub(super) fn env(args: &EnvArgs) -> anyhow::Result<Report> {
    let title = "Environment alone, one core: contacts, collisions, rewards, spawns and metrics included";
    let mut report = Report::new("env", title, 1, &["task", "N", "worlds", "joint steps/s", "agent steps/s"]);
    let sizes: [(TaskName, &[(usize, usize)]); 3] = [
        (TaskName::SimpleSpread, &[(5, 64), (20, 32), (50, 32), (200, 16), (1000, 16)]),
        (TaskName::PushBall, &[(5, 64), (20, 32), (50, 32)]),
        (TaskName::Drones, &[(2, 64), (4, 64), (8, 32)]),
    ];
    for (name, agents, worlds) in sizes.iter().flat_map(|(name, sizes)| sizes.iter().map(|s| (*name, s.0, s.1))) {
        let speed = match name {
            TaskName::SimpleSpread => throughput(agents, worlds, args.seconds)?,
            TaskName::PushBall => throughput_of(&TaskConfig::of(name, agents, Spawn::Uniform), worlds, args.seconds)?,
            TaskName::Drones => drone_throughput(agents, worlds, true, args.seconds)?,
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

/// Options of `bench update`.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct UpdateArgs {
    /// Updates that the median is taken of.
    #[arg(long, value_name = "K", default_value_t = 9, value_parser = settings::count)]
    rounds: u32,
}

impl Default for UpdateArgs {
    fn default() -> Self {
        Self { rounds: 9 }
    }
}

pub(super) fn update(args: &UpdateArgs) -> anyhow::Result<Report> {
    let title = "One PPO minibatch, one core: actor and critic, forward, loss, backward, Adam";
    let heading = ["executor", "N", "samples", "ms", "ms with values and advantages"];
    let mut report = Report::new("update", title, 1, &heading);
    for (kind, agents) in [
        (ExecutorKind::Local, 64),
        (ExecutorKind::Magex, 50),
        (ExecutorKind::MagexLiteral, 50),
        (ExecutorKind::Attention, 50),
        (ExecutorKind::Mlp, 50),
    ] {
        let mut config = RunConfig { task: TaskConfig::simple_spread(agents, Spawn::Uniform), ..RunConfig::default() };
        config.executor.kind = kind;
        config.mappo.minibatch_size = MINIBATCH;
        let rounds = if kind == ExecutorKind::Local { args.rounds } else { args.rounds.div_ceil(3) };
        let time = minibatch(&config, 8, rounds as usize)?;
        let cells = vec![
            kind.to_string(),
            agents.to_string(),
            time.samples.to_string(),
            format!("{:.2}", time.gradient_ms),
            format!("{:.2}", time.update_ms),
        ];
        report.row(cells, json!({ "executor": kind, "agents": agents, "time": time }));
    }
    Ok(report)
}
