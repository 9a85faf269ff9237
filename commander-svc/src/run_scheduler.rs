//! The scheduler that a run's configuration names, with the run's weights.

use crate::scheduler::{AssignmentMethod, GoalReply, GoalRequest, Scheduler, SchedulerError, TeamReply};
use crate::shard_goals::answer;
use magex_assign::UNASSIGNED;
use magex_core::config::{CommanderPolicy, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_dispatch::Problem;
use magex_nets::commander::{Commander, CommanderError, Team};
use magex_proto::convert::ConvertError;
use std::sync::Arc;

/// The scheduler of one version of the weights.
#[derive(Debug)]
pub struct RunScheduler {
    commander: Commander,
    /// `commander.random_assignment_fraction` of the run.
    random_assignment_fraction: f32,
}

/// Makes the scheduler that the run's configuration (TOML) names, with its weights (safetensors).
pub fn load_scheduler(weights: &[u8], run_config_toml: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    let config = RunConfig::from_toml(run_config_toml).map_err(|error| SchedulerError::Load(error.to_string()))?;
    let commander = match Commander::classical(config.commander.kind) {
        Some(classical) => classical,
        None => Commander::load(&config.commander, config.task.agents, config.task.dims(), weights)
            .map_err(|error| SchedulerError::Load(error.to_string()))?,
    };
    Ok(Arc::new(RunScheduler { commander, random_assignment_fraction: config.commander.random_assignment_fraction }))
}

impl Scheduler for RunScheduler {
    fn assign_batch(
        &self,
        request: &GoalRequest,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<GoalReply, SchedulerError> {
        answer(&self.commander, self.random_assignment_fraction, request, should_continue).map_err(
            |error| match error {
                CommanderError::Instance(problem) => SchedulerError::Invalid(ConvertError::new("agents", problem)),
                CommanderError::Interrupted => SchedulerError::Interrupted,
                other => SchedulerError::Compute(other.to_string()),
            },
        )
    }

    fn method(&self) -> AssignmentMethod {
        match self.commander.kind() {
            CommanderPolicy::Exact => AssignmentMethod::Exact,
            CommanderPolicy::Greedy => AssignmentMethod::Greedy,
            CommanderPolicy::Random => AssignmentMethod::Random,
            CommanderPolicy::Pairwise | CommanderPolicy::Ranking => AssignmentMethod::Learned,
        }
    }

    fn assign_team(&self, problem: &Problem) -> Result<TeamReply, SchedulerError> {
        if self.method() != AssignmentMethod::Learned {
            return Err(SchedulerError::Unsupported("the run has no learned scheduler".to_owned()));
        }
        let team = Team { agents: &problem.agents, goals: &problem.goals, dims: problem.dims };
        let mut stream = Key::new(problem.seed, Purpose::Request, &[]).stream();
        let decision = self
            .commander
            .assign(&team, problem.mode, &mut stream)
            .map_err(|error| SchedulerError::Unsupported(error.to_string()))?;
        let goals = decision.goals.into_iter().map(|goal| (goal != UNASSIGNED).then_some(goal)).collect();
        Ok(TeamReply { goals, probabilities: Some(decision.probabilities) })
    }
}
