//! The scheduler of production: the commander that a run's weights contain.

use crate::shard_goals::answer;
use crate::scheduler::{AssignError, GoalReply, GoalRequest, Scheduler, TeamReply, TeamRequest};
use magex_assign::UNASSIGNED;
use magex_core::config::RunConfig;
use magex_core::rng::{Key, Purpose};
use magex_nets::commander::{Commander, CommanderError, Team};
use std::sync::Arc;

/// The commander of one version of the weights.
#[derive(Debug)]
pub struct TrainedScheduler {
    commander: Commander,
    /// `commander.random_assignment_fraction` of the run.
    random_assignment_fraction: f32,
}

/// Makes the scheduler that the run's configuration (TOML) names, with its weights (safetensors).
pub fn load_scheduler(weights: &[u8], run_config_toml: &str) -> Result<Arc<dyn Scheduler>, AssignError> {
    let failed = |error: String| AssignError::Failed(error);
    let config = RunConfig::from_toml(run_config_toml).map_err(|error| failed(error.to_string()))?;
    let commander = match Commander::classical(config.commander.kind) {
        Some(classical) => classical,
        None => Commander::load(&config.commander, config.task.agents, config.task.dims(), weights)
            .map_err(|error| failed(error.to_string()))?,
    };
    Ok(Arc::new(TrainedScheduler {
        commander,
        random_assignment_fraction: config.commander.random_assignment_fraction,
    }))
}

impl Scheduler for TrainedScheduler {
    fn assign_batch(&self, request: &GoalRequest, go_on: &dyn Fn() -> bool) -> Result<GoalReply, AssignError> {
        answer(&self.commander, self.random_assignment_fraction, request, go_on).map_err(|error| match error {
            CommanderError::Instance(problem) => AssignError::Invalid { field: "agents".to_owned(), problem },
            CommanderError::Interrupted => AssignError::Interrupted,
            other => AssignError::Failed(other.to_string()),
        })
    }

    fn teams(&self) -> bool {
        self.commander.kind().learned()
    }

    fn assign_team(&self, request: &TeamRequest) -> Result<TeamReply, AssignError> {
        if !self.teams() {
            return Err(AssignError::Unsupported("the run has no learned commander".to_owned()));
        }
        let team = Team { agents: &request.agents, goals: &request.goals, dims: request.dims };
        let mut stream = Key::new(request.seed, Purpose::Request, &[]).stream();
        let decision = self
            .commander
            .assign(&team, request.mode, &mut stream)
            .map_err(|error| AssignError::Unsupported(error.to_string()))?;
        let goals = decision.goals.into_iter().map(|goal| (goal != UNASSIGNED).then_some(goal)).collect();
        Ok(TeamReply { goals, probabilities: Some(decision.probabilities) })
    }
}
