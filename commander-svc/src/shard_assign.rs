//! The teams of a shard, for actors: what may be asked, and on which threads it is answered.

use crate::assign_service::{Answering, Clock};
use crate::classical;
use crate::scheduler::{AssignError, GoalReply, GoalRequest, SchedulerKind, WeightsKey};
use crate::model_store::Store;
use magex_dispatch::Limits;
use magex_runtime::status;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// How long an actor's request waits for the weights that it names, and for a thread.
const PATIENCE: Duration = Duration::from_secs(5);

/// Pairs of all teams of a shard: seconds of work.
const PAIRS: usize = 64_000_000;

/// Teams of a shard.
const TEAMS: usize = 65_536;

/// Longest name of a run, and of weights, bytes.
const RUN_ID: usize = 128;
const SHA256: usize = 64;

/// Answers shards.
#[derive(Debug)]
pub(crate) struct Batches {
    store: Arc<Store>,
    answering: Arc<Answering>,
    /// Twice as many as processors: one is decoded while another is solved.
    threads: Arc<Semaphore>,
}

impl Batches {
    pub(crate) fn new(store: Arc<Store>, answering: Arc<Answering>) -> Self {
        let threads = Arc::new(Semaphore::new(2 * magex_runtime::process::processors()));
        Self { store, answering, threads }
    }

    /// Answers a shard with the weights of that name, as soon as they are here.
    pub(crate) async fn answer(
        &self,
        request: Arc<GoalRequest>,
        key: &WeightsKey,
        clock: Clock,
        draining: &CancellationToken,
    ) -> Result<GoalReply, Status> {
        if request.scheduler != SchedulerKind::Learned {
            return self.work(&request.clone(), clock, move |go_on| classical::assign_batch(&request, go_on)).await;
        }
        let wait = self.store.wait(key, PATIENCE.min(clock.left()));
        let Some(model) = draining.run_until_cancelled(wait).await.flatten() else {
            let (version, run) = (key.version, &key.run_id);
            let problem = format!("weights version {version} of run '{run}' are not here yet");
            return Err(status::unavailable(problem, Duration::from_millis(500)));
        };
        match model.scheduler {
            Ok(scheduler) => {
                self.work(&request.clone(), clock, move |go_on| scheduler.assign_batch(&request, go_on)).await
            }
            Err(reason) => Err(status::failed_precondition(format!("weights version {}: {reason}", key.version))),
        }
    }

    /// Runs work of the processor away from the threads that serve the network, for as long as somebody waits for it.
    async fn work(
        &self,
        request: &GoalRequest,
        clock: Clock,
        work: impl FnOnce(&dyn Fn() -> bool) -> Result<GoalReply, AssignError> + Send + 'static,
    ) -> Result<GoalReply, Status> {
        let patience = PATIENCE.min(clock.left());
        let places = async {
            let thread = self.threads.clone().acquire_owned().await.ok()?;
            Some((thread, self.answering.memory(request.agent_count.max(request.goal_count).pow(2)).await?))
        };
        let Ok(Some(places)) = tokio::time::timeout(patience, places).await else {
            return Err(status::resource_exhausted("all threads are busy with other shards", Duration::from_secs(1)));
        };
        let gone = Gone::default();
        let flag = gone.0.clone();
        let work = tokio::task::spawn_blocking(move || {
            let _held = places;
            work(&|| !flag.load(Ordering::Relaxed) && !clock.over())
        });
        match work.await {
            Ok(result) => result.map_err(to_status),
            Err(error) => Err(Status::internal(error.to_string())),
        }
    }
}

/// Set when the caller has gone: whatever still works for it stops.
#[derive(Debug, Default)]
pub(crate) struct Gone(pub(crate) Arc<AtomicBool>);

impl Drop for Gone {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Refuses what would take memory or time without bound. The arrays' own lengths bound the rest: they are full.
pub(crate) fn check(request: &GoalRequest, key: &WeightsKey, limits: &Limits) -> Result<(), Status> {
    let (n, g) = (request.agent_count, request.goal_count);
    for (field, found, most) in [
        ("agents.shape[2]", n, limits.members),
        ("goals.shape[2]", g, limits.members),
        ("agents.shape[3]", request.dims, 3),
    ] {
        if found == 0 || found > most {
            return Err(status::invalid_argument(field, format!("{found} is not in 1..{most}")));
        }
    }
    let teams = (request.shard.episodes as usize).saturating_mul(request.stages);
    if teams > TEAMS {
        return Err(status::invalid_argument("agents.shape", format!("{teams} teams are more than {TEAMS}")));
    }
    let pairs = teams.saturating_mul(n).saturating_mul(g);
    if pairs > PAIRS {
        let problem =
            format!("{teams} teams of {n} agents and {g} goals have more than {PAIRS} pairs; send fewer teams");
        return Err(status::invalid_argument("agents.shape", problem));
    }
    for (field, length, most) in [("run_id", key.run_id.0.len(), RUN_ID), ("sha256", key.sha256.len(), SHA256)] {
        if length > most {
            return Err(status::invalid_argument(field, format!("{length} bytes are more than {most}")));
        }
    }
    Ok(())
}

fn to_status(error: AssignError) -> Status {
    match error {
        AssignError::Invalid { field, problem } => status::invalid_argument(field, problem),
        AssignError::Unsupported(reason) => status::failed_precondition(reason),
        AssignError::Interrupted => Status::deadline_exceeded("nobody waits for the goals any more"),
        AssignError::Failed(reason) => Status::internal(reason),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};

    #[test]
    fn what_would_take_memory_or_time_without_bound_is_refused() {
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
            scheduler: SchedulerKind::Exact,
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
            (GoalRequest { stages: huge, ..good.clone() }, "teams are more"),
            (GoalRequest { agent_count: 5000, goal_count: 5000, ..good.clone() }, "more than 64000000 pairs"),
        ] {
            let refused = check(&request, &key, &limits).unwrap_err();
            assert!(refused.code() == tonic::Code::InvalidArgument && refused.message().contains(words), "{refused}");
        }
        let long = WeightsKey { run_id: RunId("r".repeat(129)), ..key };
        assert!(check(&good, &long, &limits).unwrap_err().message().starts_with("run_id"));
    }
}
