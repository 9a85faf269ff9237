//! Evaluation in this process: shards of whole episodes on spawns that training never saw.

use crate::external::EnvironmentArgs;
use crate::failure::usage;
use crate::folder::{self, Trained};
use crate::local::{LoadedPolicy, commander};
use crate::logging::set_live_line;
use crate::planning_clock::PlanningClock;
use indicatif::{ProgressBar, ProgressStyle};
use magex_actor::environment::Environments;
use magex_actor::rollout::Roller;
use magex_assign::POWERS;
use magex_core::config::{Algorithm, CommanderPolicy, RunConfig};
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::task::{AGENTS_MAX, HORIZON_MAX, Spawn, TaskName, TaskSettings};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, ShardResult};
use magex_env::Classical;
use magex_learner::trainer::{EVAL_SET_FINAL, EVAL_SET_TRAINING};
use magex_runtime::options;
use magex_runtime::sync::lock;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Evaluation set of `magex eval` unless another is named.
pub(crate) const EVAL_SET: u32 = 100;
/// Limit of agents per shard, unless a single episode has more: bounds the memory of a rollout.
const AGENTS_PER_SHARD: usize = 800;
const EPISODES_PER_SHARD: u32 = 16;

/// What chooses the actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub(crate) enum Controller {
    /// The trained executor.
    #[default]
    Learned,
    /// Steers to the goal, brakes in time, ignores the others.
    Scripted,
    /// Multi-agent A*: plans paths around each other and follows them.
    Astar,
    /// Optimal reciprocal collision avoidance.
    Orca,
    /// Scripted, to the nearest landmark, whatever the others do.
    Nearest,
    /// Random actions.
    Random,
}

impl Controller {
    /// The controller without weights.
    fn classical(self) -> Option<Classical> {
        match self {
            Self::Learned => None,
            Self::Scripted => Some(Classical::Scripted),
            Self::Astar => Some(Classical::Astar),
            Self::Orca => Some(Classical::Orca),
            Self::Nearest => Some(Classical::Nearest),
            Self::Random => Some(Classical::Random),
        }
    }

    /// Which modes are worth evaluating unless others are asked for: controllers without weights have one only.
    pub(crate) fn modes(self) -> Modes {
        if self == Self::Learned { Modes::Both } else { Modes::Greedy }
    }
}

impl std::fmt::Display for Controller {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.classical() {
            None => f.write_str("learned"),
            Some(classical) => classical.fmt(f),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Modes {
    /// The most likely action, goal and edges.
    Greedy,
    /// Sampled from the policy.
    Sampled,
    /// One row each.
    Both,
}

impl Modes {
    pub(crate) fn list(self) -> &'static [Mode] {
        match self {
            Self::Greedy => &[Mode::Greedy],
            Self::Sampled => &[Mode::Sampled],
            Self::Both => &[Mode::Greedy, Mode::Sampled],
        }
    }
}

pub(crate) fn mode_name(mode: Mode) -> &'static str {
    match mode {
        Mode::Greedy => "greedy",
        Mode::Sampled => "sampled",
    }
}

/// A run, and the starts on which it is evaluated.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Subject {
    /// Run folder, a weights file together with --config, or, where nothing learned is asked for, a configuration file.
    #[arg(value_name = "RUN")]
    pub(crate) run: PathBuf,
    /// Configuration of a weights file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Evaluation set: selects the starts; 3 or more.
    #[arg(long, value_name = "SET", default_value_t = EVAL_SET, value_parser = eval_set)]
    pub(crate) eval_set: u32,
    /// Fail unless the weights are those that a finished run ended with: no checkpoint in place of missing or damaged ones.
    #[arg(long)]
    strict: bool,
    #[command(flatten)]
    environment: EnvironmentArgs,
    #[command(flatten)]
    pub(crate) vary: Variation,
}

impl Subject {
    /// Loads the run, with its configuration as it is evaluated.
    pub(crate) fn load(&self) -> anyhow::Result<(Trained, RunConfig)> {
        let trained = match &self.config {
            None if self.run.is_file() && self.run.extension().is_some_and(|ending| ending == "toml") => {
                self.untrained()?
            }
            config => folder::load(&self.run, config.as_deref())?,
        };
        if self.strict && !trained.is_final {
            let notes = trained.notes.join("; ");
            return Err(anyhow::anyhow!("--strict: these are not the weights of a finished run: {notes}"));
        }
        trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
        let mut config = self.vary.apply(&trained)?;
        // The run may have been trained without pictures, and be looked at with them.
        if let TaskSettings::External(external) = &mut config.task.settings
            && let Some(described) = self.environment.describe()?
        {
            external.renders = described.renders();
        }
        Ok((trained, config))
    }

    /// The environments of an external task.
    pub(crate) fn environments(&self, config: &RunConfig) -> anyhow::Result<Option<Arc<Environments>>> {
        self.environment.of_run(config)
    }

    /// What rolls the episodes out, and what a controller without weights took for it.
    pub(crate) fn policy(
        &self,
        config: &RunConfig,
        weights: &[u8],
    ) -> anyhow::Result<(LoadedPolicy, Option<PlanningClock>)> {
        let environments = self.environments(config)?;
        let (mut policy, planning) = self.vary.policy(config, weights)?;
        policy.roller.environments = environments;
        Ok((policy, planning))
    }

    /// A configuration file in place of a run, for what has no weights.
    fn untrained(&self) -> anyhow::Result<Trained> {
        let file = self.run.display();
        if self.vary.controller == Controller::Learned {
            return Err(usage(format!(
                "RUN: {file} is a configuration, not weights, which --controller learned needs; \
                 name a run folder, or add --controller scripted, astar, orca, nearest or random"
            )));
        }
        let described = self.environment.describe()?;
        let trained = folder::untrained(&self.run, described.as_ref())?;
        let scheduler = self.vary.scheduler_of(&trained.config);
        if scheduler.learned() {
            return Err(usage(format!(
                "RUN: {file} is a configuration, not weights, which the {scheduler} scheduler needs; \
                 name a run folder, or add --scheduler exact, makespan, greedy or random"
            )));
        }
        if self.strict {
            return Err(usage(format!("--strict: {file} is a configuration and has no weights; leave --strict out")));
        }
        Ok(trained)
    }
}

/// What an evaluation changes about the run.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "What is evaluated [default: as in the run]")]
pub(crate) struct Variation {
    /// Starts: uniform, lines, lines-0..3, authors or authors-0..3.
    #[arg(long, value_name = "MODE")]
    pub(crate) spawn: Option<Spawn>,
    /// Team size; the map scales with it. Not for the mlp executor and the ranking scheduler, which have a fixed size.
    #[arg(long, value_name = "N", value_parser = options::whole::<usize>(1, AGENTS_MAX as u64))]
    pub(crate) agents: Option<usize>,
    /// Goal scheduler: pairwise, ranking, exact, makespan, greedy or random.
    #[arg(long, value_name = "KIND")]
    pub(crate) scheduler: Option<CommanderPolicy>,
    /// Exponent of the distances that the exact and makespan schedulers sum; 2 lets the last agent arrive sooner [default: as in
    /// the run].
    #[arg(long, value_name = "P", value_parser = power)]
    pub(crate) power: Option<f64>,
    /// What chooses the actions.
    #[arg(long, value_enum, value_name = "KIND", default_value_t)]
    pub(crate) controller: Controller,
    /// Joint steps per episode.
    #[arg(long, value_name = "T", value_parser = options::whole::<u32>(1, HORIZON_MAX.into()))]
    pub(crate) horizon: Option<u32>,
}

impl Variation {
    /// The run's configuration as it is evaluated.
    fn apply(&self, trained: &Trained) -> anyhow::Result<RunConfig> {
        let mut config = trained.config.clone();
        if let Some(agents) = self.agents.filter(|&agents| agents != config.task.agents) {
            let own = config.task.agents;
            let (executor, scheduler) = (config.executor.kind, self.scheduler_of(&config));
            let built_for = format!("of this run was built for {own} agents");
            if executor.fixed_team_size() && self.controller == Controller::Learned {
                return Err(usage(format!("--agents {agents}: the {executor} executor {built_for}")));
            }
            if scheduler.fixed_team_size() {
                let remedy = "use --scheduler exact";
                return Err(usage(format!("--agents {agents}: the {scheduler} scheduler {built_for}; {remedy}")));
            }
            config.task = config.task.resized(agents);
        }
        if let Some(kind) = self.scheduler.filter(|kind| kind.learned() && *kind != config.commander.kind) {
            let own = config.commander.kind;
            return Err(usage(format!(
                "--scheduler {kind}: the run trained the {own} scheduler; use {own}, exact, makespan, greedy or random"
            )));
        }
        config.task.spawn = self.spawn.unwrap_or(config.task.spawn);
        config.task.horizon = self.horizon.unwrap_or(config.task.horizon);
        // Evaluation does not train: the chunk length need not divide the horizon.
        if config.run.algorithm == Algorithm::Mappo {
            config.mappo.chunk_length = 1;
        }
        let mut config = config.validated()?;
        if let Some(power) = self.power {
            let scheduler = self.scheduler_of(&config);
            if !scheduler.knows_power() && power != 1.0 {
                return Err(usage(format!(
                    "--power {power}: the {scheduler} scheduler has none; use --scheduler exact or makespan"
                )));
            }
            config.commander.power = power;
        }
        if let Some(classical) = self.controller.classical() {
            classical.check(&config.task).map_err(|error| usage(format!("--{error}")))?;
        }
        Ok(config)
    }

    /// What rolls the episodes out, and what a controller without weights took for it.
    pub(crate) fn policy(
        &self,
        config: &RunConfig,
        weights: &[u8],
    ) -> anyhow::Result<(LoadedPolicy, Option<PlanningClock>)> {
        let (roller, planning) = match self.controller.classical() {
            None => (Roller::new(config, weights)?, None),
            Some(Classical::Random) if config.task.name == TaskName::External => (Roller::at_random(config)?, None),
            Some(classical) => {
                let clock = PlanningClock::default();
                (Roller::with_controller(config, clock.timed(classical))?, Some(clock))
            }
        };
        let commander = commander(config, weights, self.scheduler)?;
        Ok((LoadedPolicy { roller, commander, random_assignment_fraction: 0.0 }, planning))
    }

    pub(crate) fn scheduler_of(&self, config: &RunConfig) -> CommanderPolicy {
        self.scheduler.unwrap_or(config.commander.kind)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Episodes {
    pub(crate) count: u32,
    pub(crate) set: u32,
    pub(crate) mode: Mode,
    /// Number of episodes to record, from the first.
    pub(crate) record: u32,
}

/// Parses an exponent of distances.
fn power(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.trim().parse().ok().filter(|number| POWERS.contains(number));
    number.ok_or_else(|| format!("write a number from {} to {}", POWERS.start(), POWERS.end()))
}

/// Parses an evaluation set; the sets that training uses are rejected.
fn eval_set(text: &str) -> Result<u32, String> {
    let first = EVAL_SET_TRAINING.max(EVAL_SET_FINAL) + 1;
    let set = options::whole(0, u32::MAX.into())(text)?;
    if set < first {
        return Err(format!("sets below {first} belong to training; use {first} or more"));
    }
    Ok(set)
}

/// Shows how many episodes are done: a line that moves in a terminal, log lines elsewhere.
struct Waiting {
    bar: ProgressBar,
    mode: Mode,
    /// When the next log line is due.
    next: Mutex<Instant>,
}

impl Waiting {
    const LOG_EVERY: Duration = Duration::from_secs(10);

    fn start(episodes: Episodes) -> Self {
        // Hidden where standard error is no terminal.
        let bar = ProgressBar::new(episodes.count.into()).with_message(mode_name(episodes.mode));
        let template = "{spinner:.cyan} {bar:20.cyan/dim} {human_pos} of {human_len} {msg} episodes · {elapsed}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("━━─"));
        }
        bar.enable_steady_tick(Duration::from_millis(100));
        set_live_line(Some(bar.clone()));
        Self { bar, mode: episodes.mode, next: Mutex::new(Instant::now() + Self::LOG_EVERY) }
    }

    fn done(&self, episodes: u32) {
        self.bar.inc(episodes.into());
        let mut next = lock(&self.next);
        if self.bar.is_hidden() && Instant::now() >= *next {
            *next = Instant::now() + Self::LOG_EVERY;
            let (done, of) = (self.bar.position(), self.bar.length());
            tracing::info!(done, of, mode = mode_name(self.mode), "episodes");
        }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        set_live_line(None);
        self.bar.finish_and_clear();
    }
}

/// Rolls the episodes out: their metrics in order, and the recordings of the first ones.
pub(crate) fn roll_out(
    policy: &LoadedPolicy,
    config: &RunConfig,
    episodes: Episodes,
    threads: usize,
) -> anyhow::Result<(Vec<EpisodeMetrics>, Vec<Recording>)> {
    let plan = plan(episodes, config.task.agents);
    let (mut metrics, mut recordings) = (Vec::new(), Vec::new());
    let waiting = Waiting::start(episodes);
    for result in policy.rollout_all(&plan, threads, |shard| waiting.done(shard.episodes))? {
        if let ShardResult::Eval(EvalOutcome { metrics: more, recording, .. }) = result {
            metrics.extend(more);
            recordings.extend(recording);
        }
    }
    Ok((metrics, recordings))
}

/// A shard records only its first episode, so every recorded episode gets its own shard. The partition does not change
/// results.
fn plan(episodes: Episodes, agents: usize) -> Vec<Shard> {
    let most = (AGENTS_PER_SHARD / agents.max(1)).clamp(1, EPISODES_PER_SHARD as usize) as u32;
    let mut shards = Vec::new();
    let mut first = 0;
    while first < episodes.count {
        let record = first < episodes.record;
        let count = if record { 1 } else { most.min(episodes.count - first) };
        shards.push(Shard {
            kind: ShardKind::Eval,
            iteration: Iteration(0),
            index: shards.len() as u32,
            episodes: count,
            first_episode: first,
            version: WeightsVersion(0),
            mode: episodes.mode,
            eval_set: episodes.set,
            record,
        });
        first += count;
    }
    shards
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_episode_is_in_one_shard_and_memory_is_bounded() {
        for (count, agents, record) in [(100, 5, 0), (100, 50, 1), (7, 1000, 0), (33, 200, 3), (1, 50, 1)] {
            let shards = plan(Episodes { count, set: EVAL_SET, mode: Mode::Greedy, record }, agents);
            let mut next = 0;
            for shard in &shards {
                assert_eq!(shard.first_episode, next);
                assert!(shard.episodes == 1 || shard.episodes as usize * agents <= AGENTS_PER_SHARD);
                next += shard.episodes;
            }
            assert_eq!(next, count);
            assert_eq!(shards.iter().filter(|s| s.record).count() as u32, record);
        }
    }

    #[test]
    fn training_sets_are_rejected() {
        for set in ["0", "1", "2"] {
            assert!(eval_set(set).unwrap_err().contains("3 or more"));
        }
        assert_eq!(eval_set("100"), Ok(EVAL_SET));
    }

    fn trained(toml: &str) -> Trained {
        let config = RunConfig::from_toml(toml).unwrap();
        let (weights, sha256, name) = (Vec::new(), String::new(), String::new());
        Trained { config, weights, sha256, name, folder: None, notes: Vec::new(), is_final: true }
    }

    #[test]
    fn another_size_keeps_the_density_and_fixed_sizes_are_rejected() {
        let vary = Variation { agents: Some(200), horizon: Some(77), ..Variation::default() };
        let config = vary.apply(&trained("")).unwrap();
        assert_eq!((config.task.agents, config.task.side, config.task.horizon), (200, 20.0, 77));
        let error = vary.apply(&trained("[executor]\nkind = 'mlp'")).unwrap_err().to_string();
        assert!(error.contains("mlp") && error.contains("50"), "{error}");
        let error = vary.apply(&trained("[commander]\nkind = 'ranking'")).unwrap_err().to_string();
        assert!(error.contains("--scheduler exact"), "{error}");
        let exact = Variation { scheduler: Some(CommanderPolicy::Exact), ..vary.clone() };
        exact.apply(&trained("[commander]\nkind = 'ranking'")).unwrap();
        let ranking = Variation { scheduler: Some(CommanderPolicy::Ranking), ..Variation::default() };
        assert!(
            ranking
                .apply(&trained(""))
                .unwrap_err()
                .to_string()
                .contains("use pairwise, exact, makespan, greedy or random")
        );
    }
}
