//! What the run does when results turn out to be wrong: before they are trained on (refuse them, keep them, have the work done
//! again) and afterwards (go back to a checkpoint from before them).

use super::{TrainError, Trainer};
use crate::checkpoint;
use crate::collector::Collector;
use crate::origin::{Conviction, Origin};
use crate::report::observer::FileError;
use crate::report::records::Timing;
use crate::run_events::{CollectError, RunEvent, StopReason, describe};
use crate::train::commander_ppo::CommanderStats;
use crate::train::stats::UpdateStats;
use crate::train::suspect::UpdateError;
use magex_core::ids::Shard;
use magex_core::trajectory::{ShardResult, Trajectory};
use magex_proto::convert::encode_result;

/// Where results that cannot be trained on are kept, below the run folder.
const QUARANTINE: &str = "quarantine";
/// Results that are kept. A file has about the size of a shard.
const QUARANTINED: usize = 32;
/// Updates that fail in a row at the same iteration, each with the results of other actors, before the run ends.
const ATTEMPTS: u32 = 8;

/// How a plan ended.
pub(super) enum Collected {
    Results(Vec<ShardResult>),
    Stopped(StopReason),
    /// Results were wrong: begin the iteration again. It may be an earlier one now.
    Again,
}

impl Trainer {
    pub(super) fn collect(&mut self, collector: &mut dyn Collector, plan: Vec<Shard>) -> Result<Collected, TrainError> {
        let results = collector.collect(plan);
        self.judged(collector, results)
    }

    /// Has the shards that a step towards the target rests on computed a second time, and waits for every other check.
    pub(super) fn confirm(&mut self, collector: &mut dyn Collector, shards: &[Shard]) -> Result<Collected, TrainError> {
        let confirmed = collector.confirm(shards).map(|()| Vec::new());
        self.judged(collector, confirmed)
    }

    fn judged(
        &mut self,
        collector: &mut dyn Collector,
        results: Result<Vec<ShardResult>, CollectError>,
    ) -> Result<Collected, TrainError> {
        match results {
            Ok(results) => Ok(Collected::Results(results)),
            Err(CollectError::Stopped(reason)) => Ok(Collected::Stopped(reason)),
            Err(CollectError::Convicted(conviction)) => {
                self.convicted(collector, &conviction)?;
                Ok(Collected::Again)
            }
            Err(other) => Err(other.into()),
        }
    }

    /// Goes back to before the first iteration that may have trained on wrong results of the convicted actor.
    fn convicted(&mut self, collector: &mut dyn Collector, conviction: &Conviction) -> Result<(), TrainError> {
        let Conviction { origin, shard, since, .. } = conviction;
        let what =
            format!("actor {} (process {:x}) computed {} wrongly", origin.actor, origin.process, describe(shard));
        let Some(since) = since.filter(|since| *since < self.progress.iteration) else {
            // The closing evaluation comes after the line of its iteration, which is written again.
            let (iteration, steps) = (self.progress.iteration, self.progress.joint_env_steps);
            self.cut_back(iteration, steps)?;
            self.event(&RunEvent::Log(format!("{what}; nothing of it was trained on")));
            return Ok(());
        };
        let from = self.progress.iteration;
        let Some((progress, learned)) = checkpoint::go_back(self.place.folder(), since, &self.learned) else {
            checkpoint::set_aside(self.place.folder());
            return Err(TrainError::Tainted { what, iteration: since });
        };
        let (to, steps) = (progress.iteration, progress.joint_env_steps);
        tracing::error!(
            actor = &*origin.actor,
            process = origin.process,
            from,
            to,
            "going back to the checkpoint before its results"
        );
        self.learned = learned;
        // The time that was spent stays spent.
        self.progress =
            checkpoint::Progress { wall_s: self.progress.wall_s, config: self.progress.config.clone(), ..progress };
        self.progress.config_sha256 = magex_core::sha256::hex(self.progress.config.as_bytes());
        self.cut_back(to, steps)?;
        collector.went_back(to);
        self.event(&RunEvent::Log(format!("{what}; the run went back from iteration {from} to {to}")));
        Ok(())
    }

    fn cut_back(&mut self, iteration: u32, joint_env_steps: u64) -> Result<(), FileError> {
        self.observers.iter_mut().try_for_each(|observer| observer.went_back(iteration, joint_env_steps))
    }

    /// Updates, or finds the results that made the update fail: these are kept aside and their actors evicted, and the update
    /// has changed nothing (`None`).
    pub(super) fn update_or_refuse(
        &mut self,
        collector: &mut dyn Collector,
        trajectories: &[Trajectory],
        timing: &mut Timing,
    ) -> Result<Option<(UpdateStats, CommanderStats)>, TrainError> {
        let before = self.learned.clone();
        let error = match self.update(trajectories, timing) {
            Ok(stats) => {
                self.refused = 0;
                return Ok(Some(stats));
            }
            Err(error) => error,
        };
        self.learned = before;
        let origins = trained(collector, trajectories.len());
        let culprits = match &error {
            UpdateError::Suspect(suspect) => vec![(suspect.trajectory, suspect.to_string())],
            _ => self.failing(trajectories),
        };
        self.refused += 1;
        // Without senders the results are this process's own, and so is the fault.
        if origins.is_empty() || culprits.is_empty() || self.refused > ATTEMPTS {
            return Err(error.into());
        }
        for (trajectory, reason) in culprits {
            let (Some(result), Some(origin)) = (trajectories.get(trajectory), origins.get(trajectory)) else {
                continue;
            };
            self.quarantine(result, origin, &reason);
            collector.reject(origin, &reason);
        }
        Ok(None)
    }

    /// The trajectories that an update fails on by themselves, and why.
    fn failing(&mut self, trajectories: &[Trajectory]) -> Vec<(usize, String)> {
        let before = self.learned.clone();
        let mut failing = Vec::new();
        for (place, trajectory) in trajectories.iter().enumerate() {
            let alone = self.update(std::slice::from_ref(trajectory), &mut Timing::default());
            failing.extend(alone.err().map(|error| (place, error.to_string())));
            self.learned = before.clone();
        }
        failing
    }

    /// Keeps a result that cannot be trained on, with its sender and the reason.
    fn quarantine(&self, result: &Trajectory, origin: &Origin, reason: &str) {
        let shard = describe(&result.shard);
        tracing::error!(
            actor = &*origin.actor,
            process = origin.process,
            shard,
            reason,
            "a result cannot be trained on; it is kept in quarantine, its actor is evicted, and the shard is computed again"
        );
        let folder = self.place.folder().join(QUARANTINE);
        let name = format!(
            "{:06}-{:04}-{}",
            result.shard.iteration.0,
            result.shard.index,
            &origin.digest[..12.min(origin.digest.len())]
        );
        let about = serde_json::json!({
            "shard": shard, "actor": &*origin.actor, "process": format!("{:x}", origin.process), "sha256": origin.digest,
            "reason": reason,
        });
        let kept = || -> std::io::Result<()> {
            self.place.check()?;
            std::fs::create_dir_all(&folder)?;
            if std::fs::read_dir(&folder)?.count() >= 2 * QUARANTINED {
                return Ok(());
            }
            let bytes = encode_result(&self.run_id, "", &ShardResult::Train(result.clone()));
            std::fs::write(folder.join(format!("{name}.shard")), &bytes)?;
            std::fs::write(folder.join(format!("{name}.json")), format!("{about:#}\n"))
        };
        if let Err(error) = kept() {
            tracing::warn!(%error, path = %folder.display(), "the result cannot be kept");
        }
    }
}

/// The origins of the training results of the last plan, if other processes computed them. They follow the evaluation's.
fn trained(collector: &dyn Collector, count: usize) -> Vec<Origin> {
    let origins = collector.origins();
    origins.get(origins.len().saturating_sub(count)..).unwrap_or_default().to_vec()
}
