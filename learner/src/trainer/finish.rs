//! The end of a run: the evaluation that closes it, and the files that it leaves.

use super::trust::Collected;
use super::{EVAL_SET_FINAL, SUMMARY_FILE, TrainError, TrainOutcome, Trainer, plan, split};
use crate::collector::Collector;
use crate::report::means::{ClosingMeans, summarise};
use crate::report::records::Summary;
use crate::run_events::RunEvent;
use crate::train::learned::Learned;
use magex_core::ids::{Mode, Shard};
use magex_core::metrics_table::SUCCESS_RATE;
use magex_core::sha256;
use magex_core::trajectory::Recording;
use magex_proto::v1::FinishedEvent;
use magex_viewer::page::Phase;
use std::path::Path;

impl Trainer {
    /// The last checkpoint, the evaluation that closes the run, and the files that the run leaves. `None`: results were wrong,
    /// and the run is not at its end.
    pub(super) fn finish(
        &mut self,
        collector: &mut dyn Collector,
        target_reached: bool,
    ) -> Result<Option<TrainOutcome>, TrainError> {
        let wall_s = self.wall_s();
        self.save();
        let (iteration, episodes) = (self.progress.iteration, self.config.run.final_episodes);
        let mut plan: Vec<Shard> = plan::evaluation(iteration, EVAL_SET_FINAL, episodes, Mode::Greedy, true).collect();
        plan.extend(plan::evaluation(iteration, EVAL_SET_FINAL, episodes, Mode::Sampled, false));
        self.notify(|observer| observer.phase(Phase::Evaluating));
        let results = match self.collect(collector, plan)? {
            Collected::Results(results) => results,
            Collected::Stopped(reason) => return Ok(Some(TrainOutcome::Stopped(reason))),
            Collected::Again => return Ok(None),
        };
        // What is wrong in the last iterations must show before the run says that it is done.
        match self.confirm(collector, &[])? {
            Collected::Results(_) => {}
            Collected::Stopped(reason) => return Ok(Some(TrainOutcome::Stopped(reason))),
            Collected::Again => return Ok(None),
        }
        let (_, outcomes) = split(results);
        self.notify(|observer| observer.evaluated(&outcomes));
        let means_of = |mode: Mode| {
            let evaluation = summarise(outcomes.iter().filter(|o| o.shard.mode == mode).flat_map(|o| &o.metrics));
            evaluation.map(|evaluation| evaluation.means).ok_or(TrainError::EmptyEvaluation)
        };
        let (greedy, sampled_success_rate) = (means_of(Mode::Greedy)?, means_of(Mode::Sampled)?[SUCCESS_RATE]);
        let (config, joint_env_steps, weights) = (&self.config, self.progress.joint_env_steps, self.learned.weights()?);
        let summary = Summary {
            episodes: ClosingMeans { greedy, sampled_success_rate },
            joint_env_steps,
            agent_steps: joint_env_steps * config.task.agents as u64,
            wall_s,
            iterations: iteration,
            final_episodes: episodes,
            target_reached,
            weights_sha256: sha256::hex(&weights),
            task: config.task.name.to_string(),
            executor: config.executor.kind.to_string(),
            scheduler: config.commander.kind.to_string(),
            agents: config.task.agents,
            seed: config.run.seed,
        };
        let recordings: Vec<&Recording> = outcomes.iter().filter_map(|o| o.recording.as_ref()).collect();
        let (line, recordings) = (serde_json::to_string(&summary)?, serde_json::to_vec(&recordings)?);
        // The summary is written last: a reader that finds it finds the other files too.
        let files: [(&str, &[u8]); 3] =
            [("weights.safetensors", &weights), ("recordings.json", &recordings), (SUMMARY_FILE, line.as_bytes())];
        if let Some(reason) = self.write_last_files(collector, &files)? {
            return Ok(Some(TrainOutcome::Stopped(reason)));
        }
        self.event(&RunEvent::Finished(FinishedEvent { summary_json: line }));
        Ok(Some(TrainOutcome::Finished(Box::new(summary))))
    }
}

/// The summary of a complete run: summary.json exists and describes the weights of the checkpoint.
pub(super) fn summary_of(
    folder: &Path,
    iteration: u32,
    learned: &Learned,
) -> Result<Option<(Summary, String)>, TrainError> {
    let Ok(line) = std::fs::read_to_string(folder.join(SUMMARY_FILE)) else { return Ok(None) };
    let Ok(summary) = serde_json::from_str::<Summary>(&line) else { return Ok(None) };
    let same = summary.iterations == iteration && summary.weights_sha256 == sha256::hex(&learned.weights()?);
    Ok(same.then_some((summary, line)))
}
