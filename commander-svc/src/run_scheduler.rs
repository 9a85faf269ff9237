//! The scheduler that a run's configuration names, with the run's weights.

use crate::scheduler::{AssignmentMethod, GoalReply, GoalRequest, Scheduler, SchedulerError, TeamReply};
use crate::shard_goals::answer;
use magex_assign::{GoOn, UNASSIGNED};
use magex_core::config::{CommanderPolicy, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_dispatch::Problem;
use magex_nets::commander::{Commander, CommanderError, Team};
use magex_nets::weights_file;
use magex_policy::acting::Policies;
use magex_proto::convert::ConvertError;
use std::sync::Arc;

/// Largest coordinate that a network sees as it is: single precision holds a thousandth of a unit.
const LARGEST_AS_IT_IS: f64 = 8192.0;

/// The scheduler of one version of the weights.
#[derive(Debug)]
pub struct RunScheduler {
    commander: Commander,
    /// `commander.random_assignment_fraction` of the run.
    random_assignment_fraction: f32,
    /// What acts, or why nothing does.
    policies: Result<Policies, String>,
}

/// Makes the scheduler that the run's configuration (TOML) names, with its weights (safetensors).
pub fn load_scheduler(weights: &[u8], run_config_toml: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    let config = RunConfig::from_toml(run_config_toml).map_err(|error| SchedulerError::Load(error.to_string()))?;
    let commander = match Commander::classical(config.commander.kind) {
        Some(classical) => classical.with_power(config.commander.power),
        None => Commander::load(&config.commander, config.task.agents, config.task.dims(), weights)
            .map_err(|error| SchedulerError::Load(error.to_string()))?,
    };
    let warnings = weights_file::check(weights, &config).map_err(|error| SchedulerError::Load(error.to_string()))?;
    warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
    let policies = Policies::load(&config, weights).map_err(|error| error.to_string());
    let random_assignment_fraction = config.commander.random_assignment_fraction;
    Ok(Arc::new(RunScheduler { commander, random_assignment_fraction, policies }))
}

impl Scheduler for RunScheduler {
    fn assign_batch(&self, request: &GoalRequest, go_on: GoOn<'_>) -> Result<GoalReply, SchedulerError> {
        answer(&self.commander, self.random_assignment_fraction, request, go_on).map_err(|error| match error {
            CommanderError::Instance(problem) => SchedulerError::Invalid(ConvertError::new("agents", problem)),
            CommanderError::Interrupted => SchedulerError::Interrupted,
            other => SchedulerError::Compute(other.to_string()),
        })
    }

    fn method(&self) -> AssignmentMethod {
        match self.commander.kind() {
            CommanderPolicy::Exact => AssignmentMethod::Exact,
            CommanderPolicy::Makespan => AssignmentMethod::Makespan,
            CommanderPolicy::Greedy => AssignmentMethod::Greedy,
            CommanderPolicy::Random => AssignmentMethod::Random,
            CommanderPolicy::Pairwise | CommanderPolicy::Ranking => AssignmentMethod::Learned,
        }
    }

    fn policies(&self) -> Result<&Policies, &str> {
        self.policies.as_ref().map_err(String::as_str)
    }

    fn assign_team(&self, problem: &Problem) -> Result<TeamReply, SchedulerError> {
        if self.method() != AssignmentMethod::Learned {
            return Err(SchedulerError::Unsupported("the run has no learned scheduler".to_owned()));
        }
        let (agents, goals) = in_single(problem, self.commander.kind() == CommanderPolicy::Pairwise);
        let team = Team { agents: &agents, goals: &goals, dims: problem.dims };
        let mut stream = Key::new(problem.seed, Purpose::Request, &[]).stream();
        let decision = self
            .commander
            .assign(&team, problem.mode, &mut stream)
            .map_err(|error| SchedulerError::Unsupported(error.to_string()))?;
        let goals = decision.goals.into_iter().map(|goal| (goal != UNASSIGNED).then_some(goal)).collect();
        Ok(TeamReply { goals, probabilities: Some(decision.probabilities) })
    }
}

/// The positions `[N, D]` and `[G, D]` in the single precision of networks. `movable`: the network looks at distances only, so that
/// large coordinates may lose their common part first, and keep their digits.
fn in_single(problem: &Problem, movable: bool) -> (Vec<f32>, Vec<f32>) {
    let all = || problem.agents.iter().chain(&problem.goals);
    let fits = all().all(|x| x.abs() <= LARGEST_AS_IT_IS);
    let origin: Vec<f64> = (0..problem.dims)
        .map(|axis| {
            if movable && !fits {
                all().skip(axis).step_by(problem.dims).copied().fold(f64::INFINITY, f64::min)
            } else {
                0.0
            }
        })
        .collect();
    let single = |points: &[f64]| points.iter().zip(origin.iter().cycle()).map(|(x, from)| (x - from) as f32).collect();
    (single(&problem.agents), single(&problem.goals))
}
