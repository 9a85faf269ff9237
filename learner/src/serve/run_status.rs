//! The answer of `GetRun`, assembled from the four parts of the service.

use crate::serve::ledger::Ledger;
use crate::serve::shared::Shared;
use magex_core::ids::ShardKind;
use magex_proto::v1;

impl Shared {
    pub(crate) fn run_status(&self) -> v1::RunStatus {
        let latest = self.board.latest();
        let sessions = self.roster.sessions();
        // One lock for the state, the counters and the leases, so that they agree with each other.
        self.work.inspect(|ledger| {
            let (done, total) = ledger.progress();
            let rows = sessions.into_iter().map(|(session, actor)| v1::ActorStatus {
                leases: ledger.leases_of(session) as u32,
                actor_id: actor.actor_id,
                address: actor.address,
                shards_done: actor.shards_done,
                last_seen_ms: actor.last_seen.elapsed().as_millis() as u64,
                threads: actor.threads,
                weights_version: actor.weights_version.map(|version| version.0),
            });
            let actors: Vec<v1::ActorStatus> = rows.collect();
            v1::RunStatus {
                run_id: self.run.run_id.0.clone(),
                name: self.run.name.clone(),
                task_fingerprint: self.run.task_fingerprint.clone(),
                state: self.run_state(actors.len(), ledger).into(),
                actors,
                ledger: Some(ledger.counters()),
                episodes: Some(ledger.episodes()),
                shards_done: done as u32,
                shards_total: total as u32,
                weights_version: latest.as_ref().map_or(0, |weights| weights.version.0),
                weights_sha256: latest.as_ref().map_or_else(String::new, |weights| weights.sha256.clone()),
                ..self.status.reported()
            }
        })
    }

    fn run_state(&self, actors: usize, ledger: &Ledger) -> v1::RunState {
        let (done, total) = ledger.progress();
        if self.status.finished() {
            v1::RunState::Finished
        } else if self.control.stop_requested().is_some() {
            v1::RunState::Draining
        } else if done >= total {
            v1::RunState::Training
        } else if actors == 0 {
            v1::RunState::WaitingForActors
        } else if ledger.plan().all(|shard| shard.kind == ShardKind::Eval) {
            v1::RunState::Evaluating
        } else {
            v1::RunState::Collecting
        }
    }
}
