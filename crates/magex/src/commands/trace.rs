//! `magex trace`

use crate::artifacts;
use crate::evaluate::{Controller, Subject};
use crate::failure::usage;
use crate::local::commander;
use crate::options::CommonOptions;
use magex_actor::rollout::Roller;
use magex_commander::shard_goals::answer;
use magex_core::about::About;
use magex_core::config::RunConfig;
use magex_core::error::FieldError;
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::joint_state::JointState;
use magex_core::metrics_table::METRICS;
use magex_core::rng::Key;
use magex_core::task::{PushBallConfig, TaskConfig};
use magex_core::trajectory::{Shape, ShardResult};
use magex_env::Controller as Drive;
use magex_policy::acting::{Choice, TeamPolicy};
use magex_policy::trace::{Step, Trace, json, mcap, npz};
use magex_runtime::exit;
use magex_runtime::options;
use magex_runtime::sync::lock;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

const AFTER_HELP: &str = "\
Examples:
  magex trace RUN --out episode.jsonl         the first evaluation episode
  magex trace RUN --episode 7 --out episode.npz
  magex trace RUN --agents 200 --scheduler exact --out episode.mcap

FILE.jsonl: one JSON object per line, of the episode, every step and the end. \
    FILE.npz: the same arrays for NumPy, [steps, agents, ...]. FILE.mcap: scenes \
    for Foxglove, contacts in red. Actions and logits are along the axes of the \
    world. docs/policy.md names every array.

Exit codes: 0 success, 1 rollout failed, 64 wrong usage or configuration, \
    73 the file cannot be written";

/// Write every step of an evaluation episode: observations, logits, actions, states.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TraceArgs {
    /// The file: .jsonl, .npz or .mcap.
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
    /// Which episode of the evaluation set, from 0.
    #[arg(long, value_name = "K", default_value_t = 0, value_parser = options::whole::<u32>(0, 1_000_000))]
    episode: u32,
    #[command(flatten)]
    subject: Subject,
}

pub(crate) fn run(args: &TraceArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let format = args.out.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    if !["jsonl", "npz", "mcap"].contains(&format) {
        return Err(usage(format!("--out {}: name a file that ends in .jsonl, .npz or .mcap", args.out.display())));
    }
    if args.subject.vary.controller != Controller::Learned {
        return Err(usage("--controller: only the learned one has logits to trace; leave it out"));
    }
    artifacts::check(&args.out)?;
    let (trained, config) = args.subject.load()?;
    if let Ok(external) = config.task.external() {
        let name = &external.environment;
        return Err(usage(format!(
            "RUN: its task is {name}, which makes its observations itself; there is nothing to trace"
        )));
    }
    args.subject.environments(&config)?;
    let mut trace = episode(&config, &trained.weights, args)?;
    let about: Value = serde_json::from_str(&About::of(&config).to_json())?;
    trace.about.extend(about.as_object().cloned().unwrap_or_default());
    trace.about.insert("weights_sha256".into(), trained.sha256.clone().into());
    for (name, value) in [("episode", args.episode), ("evaluation_set", args.subject.eval_set)] {
        trace.about.insert(name.into(), value.into());
    }
    trace.about.insert("seed".into(), config.run.seed.into());
    let bytes = match format {
        "jsonl" => json::write(&trace).into_bytes(),
        "npz" => npz::write(&trace),
        _ => mcap::write(&trace),
    };
    artifacts::write(&args.out, &bytes)?;
    let output = options.output();
    output.say(format!("{} ({} steps of {} agents)", args.out.display(), trace.steps.len(), trace.agents));
    output.result(&json!({
        "out": args.out, "steps": trace.steps.len(), "agents": trace.agents, "weights_sha256": trained.sha256,
        "metrics": trace.metrics,
    }));
    Ok(exit::OK)
}

/// Rolls one greedy episode out, with a controller that acts by the policy and writes down what it does.
fn episode(config: &RunConfig, weights: &[u8], args: &TraceArgs) -> anyhow::Result<Trace> {
    let policy = Arc::new(TeamPolicy::load(config, weights)?);
    let goals = commander(config, weights, args.subject.vary.scheduler)?;
    let steps: Arc<Mutex<Vec<Step>>> = Arc::default();
    let (task, choices) = (&config.task, policy.choices().to_vec());
    let (shape, seen) = (task.shape(1), steps.clone());
    let roller = Roller::with_controller(
        config,
        Box::new(move |_: &TaskConfig, _: &[Key]| -> Result<Box<dyn Drive>, FieldError> {
            let memory = vec![0.0; shape.agents * policy.memory()];
            Ok(Box::new(Tracing { policy: policy.clone(), memory, shape, steps: seen.clone() }))
        }),
    )?;
    let shard = Shard {
        kind: ShardKind::Eval,
        iteration: Iteration(0),
        index: 0,
        episodes: 1,
        first_episode: args.episode,
        version: WeightsVersion(0),
        mode: Mode::Greedy,
        eval_set: args.subject.eval_set,
        record: false,
    };
    let ShardResult::Eval(outcome) = roller.rollout(&shard, |request| answer(&goals, 0.0, request, &|| true))? else {
        return Err(anyhow::anyhow!("the rollout trained"));
    };
    let metrics = outcome.metrics.iter().flat_map(|metrics| metrics.0);
    let scored = METRICS.iter().zip(metrics).filter(|(metric, _)| metric.applies(task));
    let definition = task.definition();
    let contact = task.observation().contact_radius;
    Ok(Trace {
        bodies: shape.bodies,
        agents: shape.agents,
        dims: shape.dims,
        choices,
        step_seconds: definition.step_seconds,
        radii: [contact / 2.0, PushBallConfig::BALL_RADIUS as f32, definition.landmark_radius],
        contact_radius: contact,
        steps: std::mem::take(&mut lock(&steps)),
        metrics: scored.map(|(metric, value)| (metric.name.to_owned(), Value::from(value))).collect(),
        ..Trace::default()
    })
}

/// Acts by a policy and keeps what it saw and did.
struct Tracing {
    policy: Arc<TeamPolicy>,
    memory: Vec<f32>,
    shape: Shape,
    steps: Arc<Mutex<Vec<Step>>>,
}

impl Drive for Tracing {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let memory = std::mem::take(&mut self.memory);
        let acted = self.policy.act_and_see(state, memory, Choice::GREEDY);
        let (decision, features) = acted.map_err(|error| FieldError::new("policy", error.to_string()))?;
        actions.copy_from_slice(&decision.actions);
        let choices = self.policy.choices().iter().sum();
        lock(&self.steps).push(Step::new(&self.shape, state, &features, &decision, choices));
        self.memory = decision.memory;
        Ok(())
    }
}
