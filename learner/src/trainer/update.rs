//! The update of everything that is learned.

use super::Trainer;
use crate::report::records::Timing;
use crate::train::commander_ppo::{self, CommanderStats};
use crate::train::stats::UpdateStats;
use crate::train::suspect::UpdateError;
use magex_core::trajectory::Trajectory;
use magex_runtime::trace;
use magex_viewer::page::Phase;
use std::time::Instant;

impl Trainer {
    /// Updates the executor and the commander on an iteration's trajectories. After an error what was learned is of no use.
    pub(super) fn update(
        &mut self,
        trajectories: &[Trajectory],
        timing: &mut Timing,
    ) -> Result<(UpdateStats, CommanderStats), UpdateError> {
        self.notify(|observer| observer.phase(Phase::Training));
        let _span = tracing::info_span!(target: trace::TARGET, "update").entered();
        let iteration = self.progress.iteration;
        let done = self.progress.joint_env_steps as f64 / self.config.run.max_steps.max(1) as f64;
        let rate = if self.config.mappo.linear_decay { 1.0 - done.min(1.0) } else { 1.0 };
        let (algorithm, commander, seed) = (&self.algorithm, &self.commander, self.config.run.seed);
        // The commander's network shares nothing with the others, and one thread is enough for it: both updates go side by side.
        let (place, mut network) = self.learned.take(commander_ppo::NAME)?;
        let learned = &mut self.learned;
        let clock = Instant::now();
        let ((stats, executor_s), decisions) = self.pool.install(|| {
            rayon::join(
                || {
                    let stats = algorithm.update(learned, seed, trajectories, iteration, done.min(1.0));
                    (stats, clock.elapsed().as_secs_f64())
                },
                || commander.update(&mut network, trajectories, iteration, rate),
            )
        });
        self.learned.networks.insert(place, network);
        (timing.executor_s, timing.commander_s) = (executor_s, clock.elapsed().as_secs_f64() - executor_s);
        Ok((stats?, decisions?))
    }
}
