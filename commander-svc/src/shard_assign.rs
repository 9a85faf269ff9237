//! Answers the teams of a shard for an actor, with the scheduler of its run.

use crate::assign_service::AssignService;
use crate::call_budget::CallBudget;
use crate::cancel::{Work, on_thread};
use crate::error::to_status;
use crate::model_store::ModelStore;
use crate::scheduler::{AssignmentMethod, GoalReply, GoalRequest, WeightsKey};
use magex_core::error::FieldError;
use magex_dispatch::Limits;
use magex_runtime::status;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// How long an actor's request waits for the weights that it names, and for a thread.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum number of pairs of all teams of a shard: seconds of work.
const PAIRS: usize = 64_000_000;

/// Maximum number of teams of a shard.
const TEAMS: usize = 65_536;

/// Longest name of a run, and of weights, bytes.
const RUN_ID: usize = 128;
const SHA256: usize = 64;

/// Answers shards.
pub(crate) struct ShardAssign {
    store: Arc<ModelStore>,
    answering: Arc<AssignService>,
    /// Twice as many as processors: one is decoded while another is solved.
    threads: Arc<Semaphore>,
}

impl ShardAssign {
    pub(crate) fn new(store: Arc<ModelStore>, answering: Arc<AssignService>) -> Self {
        let threads = Arc::new(Semaphore::new(2 * magex_runtime::process::processors()));
        Self { store, answering, threads }
    }

    /// Answers a shard on a worker thread, for as long as the call waits, with the weights that it names, once they have arrived.
    /// Returns the method of their scheduler, too.
    pub(crate) async fn answer(
        &self,
        request: Arc<GoalRequest>,
        key: &WeightsKey,
        budget: CallBudget,
        draining: &CancellationToken,
    ) -> Result<(GoalReply, AssignmentMethod), Status> {
        let wait = self.store.wait(key, QUEUE_TIMEOUT.min(budget.left()));
        let Some(model) = draining.run_until_cancelled(wait).await.flatten() else {
            let (version, run) = (key.version, &key.run_id);
            let problem = format!("weights version {version} of run '{run}' have not arrived; retry later");
            return Err(status::unavailable(problem, Duration::from_millis(500)));
        };
        let refused =
            |reason: String| status::failed_precondition(format!("weights version {}: {reason}", key.version));
        let scheduler = model.scheduler.map_err(refused)?;
        let method = scheduler.method();
        let cells = request.agent_count.max(request.goal_count).pow(2);
        let places = async {
            let thread = self.threads.clone().acquire_owned().await.ok()?;
            Some((thread, self.answering.memory(cells).await?))
        };
        let Ok(Some(places)) = tokio::time::timeout(QUEUE_TIMEOUT.min(budget.left()), places).await else {
            return Err(status::resource_exhausted("all threads are busy with other shards", Duration::from_secs(1)));
        };
        let solve = move |work: &Work| scheduler.assign_batch(&request, &|| work.go_on());
        Ok((on_thread(places, budget, solve).await?.map_err(to_status)?, method))
    }
}

/// Rejects requests of unbounded memory or time. The lengths of the arrays bound the rest.
pub(crate) fn check(request: &GoalRequest, key: &WeightsKey, limits: &Limits) -> Result<(), FieldError> {
    let (n, g) = (request.agent_count, request.goal_count);
    for (field, found, most) in [
        ("agents.shape[2]", n, limits.members),
        ("goals.shape[2]", g, limits.members),
        ("agents.shape[3]", request.dims, 3),
    ] {
        let ok = (1..=most).contains(&found);
        FieldError::ensure(ok, || (field, format!("{found} is outside 1..={most}")))?;
    }
    let teams = (request.shard.episodes as usize).saturating_mul(request.stages);
    FieldError::ensure(teams <= TEAMS, || ("agents.shape", format!("{teams} teams exceed the limit of {TEAMS}")))?;
    FieldError::ensure(teams.saturating_mul(n).saturating_mul(g) <= PAIRS, || {
        let size = format!("{teams} teams of {n} agents and {g} goals");
        ("agents.shape", format!("{size} exceed the limit of {PAIRS} pairs; send fewer teams"))
    })?;
    for (field, length, most) in [("run_id", key.run_id.0.len(), RUN_ID), ("sha256", key.sha256.len(), SHA256)] {
        FieldError::ensure(length <= most, || (field, format!("{length} bytes exceed the limit of {most}")))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};

    #[test]
    fn requests_of_unbounded_memory_or_time_are_rejected() {
        let shard = Shard {
            kind: ShardKind::Train,
            iteration: Iteration(0),
            index: 0,
            episodes: 8,
            first_episode: 0,
            version: WeightsVersion(0),
            mode: Mode::Greedy,
            eval_set: 0,
            record: false,
        };
        let good = GoalRequest {
            shard,
            seed: 1,
            stages: 2,
            agent_count: 200,
            goal_count: 200,
            dims: 2,
            agents: Vec::new(),
            goals: Vec::new(),
        };
        let key = WeightsKey { run_id: RunId("r".into()), version: WeightsVersion(0), sha256: "ab".into() };
        let limits = Limits::default();
        check(&good, &key, &limits).unwrap();
        let huge = u32::MAX as usize;
        for (request, words) in [
            (GoalRequest { agent_count: huge, dims: 0, ..good.clone() }, "agents.shape[2]"),
            (GoalRequest { agent_count: 0, ..good.clone() }, "agents.shape[2]"),
            (GoalRequest { goal_count: huge, ..good.clone() }, "goals.shape[2]"),
            (GoalRequest { dims: 0, ..good.clone() }, "agents.shape[3]"),
            (GoalRequest { stages: huge, ..good.clone() }, "teams exceed"),
            (GoalRequest { agent_count: 5000, goal_count: 5000, ..good.clone() }, "the limit of 64000000 pairs"),
        ] {
            let refused = check(&request, &key, &limits).unwrap_err();
            assert!(refused.to_string().contains(words), "{refused}");
        }
        let long = WeightsKey { run_id: RunId("r".repeat(129)), ..key };
        assert!(check(&good, &long, &limits).unwrap_err().field.starts_with("run_id"));
    }
}
