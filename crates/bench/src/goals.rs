//! `commander`, `ranking`: cost of the commanders' assignments over the exact cost, on unseen instances.

use crate::report::Report;
use magex::folder;
use magex::output::note;
use magex::settings::{self, named};
use magex_assign::exact_points;
use magex_assign::random::random;
use magex_core::config::{CanonicalOrder, CommanderConfig, CommanderPolicy, RunConfig};
use magex_core::ids::Mode;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig};
use magex_env::spawn::{Start, spawn};
use magex_learner::train::commander_ppo::{CommanderPpo, Sample, cost};
use magex_nets::commander::{Commander, Team};
use serde_json::json;
use std::path::PathBuf;
use std::time::Instant;

/// Instances to measure on; training uses other indices of the same purpose.
const TEST: u32 = 1;
const TRAIN: u32 = 2;

/// Options of `commander`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct CommanderArgs {
    /// A run whose trained commander is measured too.
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Instances per row.
    #[arg(long, value_name = "K", default_value_t = 1000, value_parser = settings::count)]
    instances: u32,
    /// Team sizes.
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_values_t = [5, 20, 50, 200])]
    agents: Vec<usize>,
}

/// Start k of a task's instances.
fn instance(task: &TaskConfig, set: u32, k: u32) -> Start {
    let layout = match task.spawn {
        Spawn::Uniform => 0,
        Spawn::Lines(fixed) | Spawn::Authors(fixed) => 1 + fixed.map_or(4, u32::from),
    };
    spawn(task, &mut Key::new(0, Purpose::Instances, &[set, task.agents as u32, layout, k]).stream())
}

/// Cost ratios of `decide` on `count` instances: mean, worst, and the median time of a decision in µs.
fn ratios(
    task: &TaskConfig,
    count: u32,
    mut decide: impl FnMut(&Team<'_>, u32) -> anyhow::Result<Vec<u32>>,
) -> anyhow::Result<[f64; 3]> {
    let (mut sum, mut worst, mut times) = (0.0, 0.0f64, Vec::new());
    for k in 0..count {
        let start = instance(task, TEST, k);
        let team = Team { agents: &start.agents, goals: &start.landmarks, dims: 2 };
        let clock = Instant::now();
        let goals = decide(&team, k)?;
        times.push(clock.elapsed().as_secs_f64() * 1e6);
        let exact = exact_points(&start.agents, &start.landmarks, 2)?.1.max(1e-9);
        let ratio = cost(&team, &goals) / exact;
        sum += ratio;
        worst = worst.max(ratio);
    }
    times.sort_unstable_by(f64::total_cmp);
    Ok([sum / f64::from(count), worst, times[times.len() / 2]])
}

fn greedy_of(commander: &Commander) -> impl FnMut(&Team<'_>, u32) -> anyhow::Result<Vec<u32>> + '_ {
    |team, k| {
        let mut stream = Key::new(0, Purpose::Bench, &[4, k]).stream();
        Ok(commander.assign(team, Mode::Greedy, &mut stream)?.goals)
    }
}

/// Cost ratio of greedy decisions on unseen uniform instances: mean, worst, and the median time of a decision in µs.
pub(crate) fn learned_ratio(commander: &Commander, agents: usize, instances: u32) -> anyhow::Result<[f64; 3]> {
    let task = TaskConfig::simple_spread(agents, Spawn::Uniform);
    task.validate().map_err(magex::failure::usage)?;
    ratios(&task, instances, greedy_of(commander))
}

pub(crate) fn commander(args: &CommanderArgs) -> anyhow::Result<Report> {
    let title =
        format!("Assignment cost over the exact cost, {} unseen instances per row, greedy decisions", args.instances);
    let heading = ["commander", "N", "spawn", "mean ratio", "worst", "median µs"];
    let mut report = Report::new("commander", title, 1, &heading);
    let config = RunConfig::default();
    let pairwise = CommanderConfig { kind: CommanderPolicy::Pairwise, ..config.commander.clone() };
    let untrained = Commander::of(&pairwise, 50, 2, &Commander::init(&pairwise, 50, 2, config.run.seed)?)?;
    let mut commanders = vec![("pairwise, untrained".to_owned(), untrained, None)];
    if let Some(run) = &args.run {
        let trained = folder::load(run, None)?;
        trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
        let own = &trained.config;
        let loaded = magex::local::commander(own, &trained.weights, None)?;
        let only = (own.commander.kind == CommanderPolicy::Ranking).then_some(own.task.agents);
        commanders.push((format!("{}, {}", own.commander.kind, trained.name), loaded, only));
    }
    if let Some(random) = Commander::classical(CommanderPolicy::Random) {
        commanders.push(("random".to_owned(), random, None));
    }
    for &agents in &args.agents {
        for spawn in [Spawn::Uniform, Spawn::Lines(None)] {
            let task = TaskConfig::simple_spread(agents, spawn);
            task.validate().map_err(magex::failure::usage)?;
            for (name, commander, only) in &commanders {
                if only.is_some_and(|only| only != agents) {
                    continue;
                }
                let [mean, worst, time] = ratios(&task, args.instances, greedy_of(commander))?;
                let cells = vec![
                    name.clone(),
                    agents.to_string(),
                    spawn.to_string(),
                    format!("{mean:.5}"),
                    format!("{worst:.4}"),
                    format!("{time:.0}"),
                ];
                let value = json!({
                    "commander": name, "agents": agents, "spawn": spawn, "cost_ratio": mean, "worst": worst,
                    "microseconds": time,
                });
                report.row(cells, value);
            }
        }
    }
    Ok(report)
}

/// Options of `ranking`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct RankingArgs {
    /// Team size.
    #[arg(long, value_name = "N", default_value_t = 20)]
    agents: usize,
    /// Updates.
    #[arg(long, value_name = "K", default_value_t = 600, value_parser = settings::count)]
    iterations: u32,
    /// Instances per update.
    #[arg(long, value_name = "K", default_value_t = 256, value_parser = settings::count)]
    batch: u32,
    /// Hidden units per layer.
    #[arg(long, value_name = "H", default_value_t = 128)]
    hidden: usize,
    /// Adam's step size, lowered linearly to zero.
    #[arg(long, value_name = "R", default_value_t = 1e-3)]
    learning_rate: f64,
    /// Weight of the entropy.
    #[arg(long, value_name = "W", default_value_t = 0.0)]
    entropy: f32,
    /// Canonical order: x, angle or hilbert.
    #[arg(long, value_name = "ORDER", value_parser = named::<CanonicalOrder>, default_value = "angle")]
    order: CanonicalOrder,
    /// Spawn modes: one commander is trained and measured on each.
    #[arg(long, value_name = "MODE,…", value_delimiter = ',',
          default_values_t = [Spawn::Lines(Some(0)), Spawn::Lines(Some(1)), Spawn::Lines(Some(2)), Spawn::Lines(Some(3)), Spawn::Lines(None)])]
    spawns: Vec<Spawn>,
    /// Unseen instances per row.
    #[arg(long, value_name = "K", default_value_t = 1000, value_parser = settings::count)]
    instances: u32,
    /// Seed of weights and samples.
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
}

pub(crate) fn ranking(args: &RankingArgs) -> anyhow::Result<Report> {
    let title = format!(
        "The paper's ranking commander alone, N = {}, order {:?}: assignment cost over the exact cost after {} × {} decisions",
        args.agents, args.order, args.iterations, args.batch
    );
    let heading = ["spawn", "trained", "worst", "untrained", "random", "seconds"];
    let mut report = Report::new("ranking", title, 1, &heading);
    for &spawn in &args.spawns {
        let task = TaskConfig::simple_spread(args.agents, spawn);
        task.validate().map_err(magex::failure::usage)?;
        let config = CommanderConfig {
            kind: CommanderPolicy::Ranking,
            hidden: args.hidden,
            order: args.order,
            learning_rate: args.learning_rate,
            entropy: args.entropy,
            ..CommanderConfig::default()
        };
        let ppo = CommanderPpo::new(&config, &task, args.seed);
        let mut network = ppo.init()?;
        let [untrained, ..] = ratios(&task, args.instances, greedy_of(&ppo.commander(&network)?))?;
        let [chance, ..] = ratios(&task, args.instances, |_, k| {
            Ok(random(args.agents, args.agents, &mut Key::new(args.seed, Purpose::Bench, &[5, k]).stream())?)
        })?;
        let clock = Instant::now();
        for iteration in 0..args.iterations {
            let samples = decisions(args, &task, &ppo.commander(&network)?, iteration)?;
            let rate = 1.0 - f64::from(iteration) / f64::from(args.iterations);
            ppo.improve(&mut network, &samples, iteration, rate)?;
        }
        let seconds = clock.elapsed().as_secs_f64();
        let [trained, worst, _] = ratios(&task, args.instances, greedy_of(&ppo.commander(&network)?))?;
        note(format!("{spawn}: {trained:.4} (random {chance:.4})"));
        let numbers = [trained, worst, untrained, chance].map(|x| format!("{x:.4}"));
        let cells = [spawn.to_string()].into_iter().chain(numbers).chain([format!("{seconds:.0}")]).collect();
        let value = json!({
            "spawn": spawn, "agents": args.agents, "trained": trained, "worst": worst, "untrained": untrained,
            "random": chance, "seconds": seconds, "order": args.order,
        });
        report.failed |= trained >= chance;
        report.row(cells, value);
    }
    Ok(report)
}

/// Sampled decisions with their advantage over the greedy decision on the same instance.
fn decisions(
    args: &RankingArgs,
    task: &TaskConfig,
    commander: &Commander,
    iteration: u32,
) -> anyhow::Result<Vec<Sample>> {
    (0..args.batch)
        .map(|k| {
            let start = instance(task, TRAIN, iteration * args.batch + k);
            let team = Team { agents: &start.agents, goals: &start.landmarks, dims: 2 };
            let instance = commander.instance(&team)?;
            let scores = commander.scores(&[&instance])?.flatten_all()?.to_vec1::<f32>()?;
            let key = Key::new(args.seed, Purpose::Commander, &[iteration, k]);
            let (decision, picks, log_probs) = instance.decide(&scores, Some(&mut key.stream()));
            let exact = exact_points(&start.agents, &start.landmarks, 2)?.1.max(1e-9);
            let greedy = cost(&team, &instance.decide(&scores, None).0.goals);
            let advantage = ((greedy - cost(&team, &decision.goals)) / exact) as f32;
            Ok(Sample { instance, picks, log_probs, advantage })
        })
        .collect()
}
