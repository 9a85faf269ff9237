//! `magex train-commander`: trains the learned goal scheduler alone, on synthetic instances.
//!
//! Imitation of the exact solver comes first, then PPO with the paper's reward R_c = 1 − C_c / C_h.

use crate::artifacts;
use crate::failure::{cannot_create, usage};
use crate::folder;
use crate::options::CommonOptions;
use crate::output::{Output, Table, note, program, seconds};
use crate::parallel;
use crate::settings;
use crate::synthetic::Synthetic;
use magex_assign::exact_points;
use magex_core::about::About;
use magex_core::config::{CommanderObjective, CommanderPolicy, RunConfig, SEED_MAX};
use magex_core::ids::Mode;
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::sha256;
use magex_core::task::Spawn;
use magex_learner::run_folder::FolderError;
use magex_learner::train::commander_ppo::{CommanderPpo, Lesson, Sample, cost};
use magex_learner::train::learned::Network;
use magex_nets::weights_file;
use magex_runtime::options;
use magex_runtime::process::processors;
use magex_runtime::{exit, shutdown};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;
use tokio_util::sync::CancellationToken;

const AFTER_HELP: &str = "\
Examples:
  magex train-commander --out runs/scheduler        about a minute
  magex train-commander my.toml --ppo 0 --seed 2    imitation only
  magex commander --weights runs/scheduler          serves it

The folder gets config.toml, metrics.jsonl, summary.json and \
    weights.safetensors, which contains the commander alone: magex eval needs a run \
    of magex train. The same options and seed give the same weights with any number \
    of threads.

Exit codes: 0 success, 1 training failed, 64 wrong usage or configuration, \
    73 --out exists or cannot be written, 75 stopped before the end (nothing is kept), 130 interrupted twice";

/// Train the goal scheduler alone, on synthetic teams of 2 to 200 agents.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TrainCommanderArgs {
    /// Configuration file (TOML); only its [commander] section and run.seed are used.
    #[arg(value_name = "CONFIG.toml")]
    config: Option<PathBuf>,
    /// Folder of the result [default: runs/commander-s<seed>, with -2, -3, … if it exists].
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Seed of weights, instances and samples [run.seed].
    #[arg(long, value_name = "S", value_parser = options::whole::<u64>(0, SEED_MAX))]
    seed: Option<u64>,
    /// Gradient steps of imitation.
    #[arg(long, value_name = "K", default_value_t = 300, value_parser = options::whole::<u32>(0, 1_000_000))]
    imitation: u32,
    /// Updates of PPO.
    #[arg(long, value_name = "K", default_value_t = 200, value_parser = options::whole::<u32>(0, 1_000_000))]
    ppo: u32,
    /// Synthetic instances per step or update.
    #[arg(long, value_name = "K", default_value_t = 64, value_parser = settings::count)]
    batch: u32,
    /// Threads that draw and solve instances [default: the cores of this machine].
    #[arg(long, value_name = "T", value_parser = settings::threads)]
    threads: Option<usize>,
}

/// Sets of instances; the benchmarks use other ones.
const IMITATION: u32 = 3;
const REWARD: u32 = 4;
const VALIDATION: u32 = 5;

/// Team sizes on which progress is measured, and instances of each, half of them uniform, half on lines.
const VALIDATION_SIZES: [usize; 5] = [5, 20, 50, 100, 200];
const VALIDATION_INSTANCES: u32 = 32;

const MEASUREMENTS: u32 = 20;

pub(crate) fn run(args: &TrainCommanderArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let mut config = settings::read(args.config.as_deref())?;
    config.run.seed = args.seed.unwrap_or(config.run.seed);
    let config = config.validated()?;
    if config.commander.kind != CommanderPolicy::Pairwise {
        let kind = config.commander.kind;
        return Err(usage(format!("commander.kind: {kind} has a fixed team size; use pairwise")));
    }
    if config.commander.objective != CommanderObjective::Distance {
        return Err(usage(
            "commander.objective: \"arrival\" is measured in episodes, and there are none; magex train has it",
        ));
    }
    if args.imitation + args.ppo == 0 {
        return Err(usage("--imitation and --ppo: both are 0; at least one must be positive"));
    }
    let name = format!("commander-s{}", config.run.seed);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let stop = runtime.block_on(async { shutdown::on_signal_or_hangup() })?;
    let begun = folder::begin(args.out.as_deref(), &name, &config.to_toml()?, "magex train-commander", true);
    let (out, claim) = begun.map_err(|error| match error {
        FolderError::Exists(out, _) => cannot_create(format!("--out {} exists; choose another folder", out.display())),
        other => folder::refused(other),
    })?;
    let training = Training {
        stop,
        ppo: CommanderPpo::new(&config.commander, &config.task, config.run.seed),
        args: args.clone(),
        threads: args.threads.unwrap_or_else(processors),
        config,
        out,
    };
    let output = options.output();
    match training.run(output) {
        Ok(true) => Ok(exit::OK),
        Ok(false) => {
            claim.abandon();
            output.say("\nStopped before the end; nothing was kept. The same command begins again.");
            output.result(&json!({ "stopped": true, "exit_code": exit::TEMPORARY }));
            Ok(exit::TEMPORARY)
        }
        Err(error) => {
            claim.abandon();
            Err(error)
        }
    }
}

struct Training {
    stop: CancellationToken,
    config: RunConfig,
    ppo: CommanderPpo,
    args: TrainCommanderArgs,
    threads: usize,
    out: PathBuf,
}

impl Training {
    /// Trains and writes the folder at the end, all at once; false if it was stopped.
    fn run(&self, output: Output) -> anyhow::Result<bool> {
        let clock = Instant::now();
        let mut metrics = String::new();
        let mut network = self.ppo.init()?;
        let untrained = self.validate(&network)?;
        let mut measured = untrained.clone();
        let TrainCommanderArgs { imitation, ppo, batch, .. } = self.args;
        for (stage, steps) in [("imitation", imitation), ("ppo", ppo)] {
            for step in 0..steps {
                if self.stop.is_cancelled() {
                    return Ok(false);
                }
                let rate = 1.0 - f64::from(step) / f64::from(steps);
                let (loss, entropy) = match stage {
                    "imitation" => (self.imitate(&mut network, step, rate)?, None),
                    _ => self.reinforce(&mut network, step, rate).map(|(loss, entropy)| (loss, Some(entropy)))?,
                };
                let done = step + 1;
                if done % steps.div_ceil(MEASUREMENTS / 2).max(1) == 0 || done == steps {
                    measured = self.validate(&network)?;
                    let line = json!({
                        "stage": stage, "step": done, "instances": u64::from(done) * u64::from(batch), "loss": loss,
                        "entropy": entropy, "cost_ratio": named(&measured), "wall_s": clock.elapsed().as_secs_f64(),
                    });
                    metrics += &format!("{line}\n");
                    note(format!("{stage} {done} of {steps}: loss {loss:.4}, cost ratio {}", list(&measured)));
                }
            }
        }
        let weights = weights_file::write(&[("commander", &network.params)], &About::of(&self.config))?;
        let summary = json!({
            "weights_sha256": sha256::hex(&weights), "imitation_steps": imitation, "ppo_updates": ppo,
            "batch": batch, "synthetic_instances": u64::from(imitation + ppo) * u64::from(batch),
            "cost_ratio": named(&measured), "untrained_cost_ratio": named(&untrained),
            "wall_s": clock.elapsed().as_secs_f64(),
        });
        artifacts::write(&self.out.join("metrics.jsonl"), metrics.as_bytes())?;
        artifacts::write(&self.out.join(folder::WEIGHTS), &weights)?;
        artifacts::write(&self.out.join(folder::SUMMARY), &serde_json::to_vec(&summary)?)?;
        self.report(output, &untrained, &measured, summary);
        Ok(true)
    }

    fn stream(&self, set: u32, step: u32, k: u32) -> Stream {
        Key::new(self.config.run.seed, Purpose::Instances, &[set, step, k]).stream()
    }

    fn imitate(&self, network: &mut Network, step: u32, rate: f64) -> anyhow::Result<f64> {
        let commander = self.ppo.commander(network)?;
        let lessons = in_parallel(self.threads, self.args.batch, |k| {
            let team = Synthetic::draw(&mut self.stream(IMITATION, step, k));
            let team = team.team();
            let (exact, _) = exact_points(team.agents, team.goals, 2)?;
            Ok(Lesson::new(&commander, &team, &exact)?)
        })?;
        Ok(self.ppo.imitate(network, &lessons, rate)?)
    }

    /// Sampled decisions, their advantage over the greedy ones, and PPO on them.
    fn reinforce(&self, network: &mut Network, step: u32, rate: f64) -> anyhow::Result<(f64, f64)> {
        let commander = self.ppo.commander(network)?;
        let samples = in_parallel(self.threads, self.args.batch, |k| {
            let synthetic = Synthetic::draw(&mut self.stream(REWARD, step, k));
            let team = synthetic.team();
            let instance = commander.instance(&team)?;
            let scores = commander.scores(&[&instance])?.flatten_all()?.to_vec1::<f32>()?;
            let mut stream = Key::new(self.config.run.seed, Purpose::Commander, &[step, k]).stream();
            let (decision, picks, log_probs) = instance.decide(&scores, Some(&mut stream));
            let exact = exact_points(team.agents, team.goals, 2)?.1.max(1e-9);
            let greedy = cost(&team, &instance.decide(&scores, None).0.goals);
            let advantage = ((greedy - cost(&team, &decision.goals)) / exact) as f32;
            Ok(Sample { instance, picks, log_probs, advantage })
        })?;
        let stats = self.ppo.improve(network, &samples, step, rate)?;
        Ok((stats.loss, stats.entropy))
    }

    /// Mean cost ratio of greedy decisions for each of the validation sizes.
    fn validate(&self, network: &Network) -> anyhow::Result<Vec<f64>> {
        let commander = self.ppo.commander(network)?;
        let mut means = Vec::new();
        for n in VALIDATION_SIZES {
            let ratios = in_parallel(self.threads, VALIDATION_INSTANCES, |k| {
                let layout = if k % 2 == 0 { Spawn::Uniform } else { Spawn::Lines(None) };
                let synthetic = Synthetic::starts(n, layout, &mut self.stream(VALIDATION, n as u32, k));
                let team = synthetic.team();
                let mut unused = Key::new(0, Purpose::Commander, &[]).stream();
                let goals = commander.assign(&team, Mode::Greedy, &mut unused)?.goals;
                Ok(cost(&team, &goals) / exact_points(team.agents, team.goals, 2)?.1.max(1e-9))
            })?;
            means.push(ratios.iter().sum::<f64>() / ratios.len() as f64);
        }
        Ok(means)
    }

    fn report(&self, output: Output, untrained: &[f64], measured: &[f64], mut summary: Value) {
        let mut table = Table::new(1, &["N", "untrained", "trained"]);
        for ((n, before), after) in VALIDATION_SIZES.iter().zip(untrained).zip(measured) {
            table.row(vec![n.to_string(), format!("{before:.5}"), format!("{after:.5}")]);
        }
        let wall = seconds(summary["wall_s"].as_f64().unwrap_or_default());
        let out = self.out.display();
        output.say(format!(
            "\nDone in {wall}. Cost over the exact cost on {VALIDATION_INSTANCES} unseen instances each:\n\n{table}\n"
        ));
        output.say(format!("Next:\n  {} commander --weights {out}", program()));
        summary["out"] = json!(self.out);
        output.result(&summary);
    }
}

fn named(ratios: &[f64]) -> Value {
    VALIDATION_SIZES.iter().zip(ratios).map(|(n, ratio)| (n.to_string(), *ratio)).collect()
}

fn list(ratios: &[f64]) -> String {
    let one = |(n, ratio): (&usize, &f64)| format!("{ratio:.5} (N = {n})");
    VALIDATION_SIZES.iter().zip(ratios).map(one).collect::<Vec<_>>().join(", ")
}

/// [`parallel::in_order`] for work that can fail.
fn in_parallel<T: Send>(
    threads: usize,
    count: u32,
    work: impl Fn(u32) -> anyhow::Result<T> + Sync,
) -> anyhow::Result<Vec<T>> {
    parallel::in_order(threads, count as usize, |k| work(k as u32))?.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_training_leaves_a_folder_that_loads_and_the_same_weights_with_any_number_of_threads() {
        let place = std::env::temp_dir().join(format!("magex-train-commander-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&place);
        let train = |threads: usize| {
            let out = place.join(threads.to_string());
            let config = RunConfig::default();
            let args = TrainCommanderArgs {
                config: None,
                out: None,
                seed: None,
                imitation: 2,
                ppo: 1,
                batch: 4,
                threads: None,
            };
            std::fs::create_dir_all(&out).unwrap();
            std::fs::write(out.join(folder::CONFIG), config.to_toml().unwrap()).unwrap();
            let ppo = CommanderPpo::new(&config.commander, &config.task, config.run.seed);
            Training { stop: CancellationToken::new(), config, ppo, args, threads, out: out.clone() }
                .run(Output::new(true))
                .unwrap();
            let loaded = folder::load(&out, None).unwrap();
            assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
            crate::local::commander(&loaded.config, &loaded.weights, None).unwrap();
            assert_eq!(std::fs::read_to_string(out.join("metrics.jsonl")).unwrap().lines().count(), 3);
            loaded.sha256
        };
        assert_eq!(train(1), train(2));
        std::fs::remove_dir_all(&place).unwrap();
    }
}
