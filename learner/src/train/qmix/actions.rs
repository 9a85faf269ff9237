//! Whether the actions of a trajectory are those that the weights give: the best by the recomputed values, or what the episode's own
//! stream draws. One pass forwards through the agents' network, where the gradient steps of an iteration do a hundred.

use super::Qmix;
use crate::train::batch::plain;
use crate::train::learned::Learned;
use crate::train::suspect::{LOG_PROB_TOLERANCE, Suspect, UpdateError};
use candle_core::Result as CandleResult;
use magex_core::ids::Mode;
use magex_core::joint_state::JointState;
use magex_core::keys::episode_keys;
use magex_core::rng::Stream;
use magex_core::trajectory::Trajectory;
use magex_nets::executor::QNetwork;
use magex_nets::params::ParamBuilder;
use rayon::prelude::*;

impl Qmix {
    /// Refuses a trajectory whose actions the networks do not give; nothing changes.
    ///
    /// # Errors
    /// [`Suspect`] names the first such trajectory.
    pub fn check_actions(&self, learned: &Learned, trajectories: &[Trajectory]) -> Result<(), UpdateError> {
        let agent = self.model.q_network(&mut ParamBuilder::with(learned.networks[0].params.tensors()?))?;
        let errors =
            trajectories.par_iter().map(|t| self.worst_action(&agent, t)).collect::<CandleResult<Vec<f64>>>()?;
        let limit = LOG_PROB_TOLERANCE;
        match errors.iter().position(|&error| error > limit) {
            Some(trajectory) => Err(Suspect { trajectory, field: "actions", error: errors[trajectory], limit }.into()),
            None => Ok(()),
        }
    }

    /// How much more the best action is worth than the one that was taken for it, at most; infinite if a draw is another one.
    fn worst_action(&self, agent: &QNetwork, t: &Trajectory) -> CandleResult<f64> {
        let (s, heads) = (&t.shape, self.model.heads());
        let rows = s.episodes * s.agents;
        let features = self.model.spec().compute(&JointState {
            positions: &t.positions[..s.steps * s.episodes * s.bodies * s.dims],
            velocities: &t.velocities[..s.steps * s.episodes * s.bodies * s.dims],
            agent_state: &t.agent_state[..s.steps * rows * s.agent_state],
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: t.statics.view(),
            goals: &t.goals,
        });
        // An action is what its agent remembers of the step, so that each is judged by the ones before it as they were.
        let known = &t.actions[..s.steps.saturating_sub(1) * rows * heads.count()];
        let values = plain(&agent.values(&features.vectors, known, s.steps)?)?;
        let epsilon = self.config.qmix.epsilon(u64::from(t.shard.iteration.0) * self.config.steps_per_iteration());
        let key = |b: usize| episode_keys(self.config.run.seed, &t.shard, b as u32).action;
        let mut streams: Vec<Stream> = (0..s.episodes).map(|b| key(b).stream()).collect();
        let (mut best, mut drawn) = (vec![0; heads.count()], vec![0; heads.count()]);
        let mut worst = 0.0f64;
        let taken = t.actions.chunks_exact(heads.count());
        for (row, (values, taken)) in values.chunks_exact(heads.logits()).zip(taken).enumerate() {
            let stream = &mut streams[row % rows / s.agents];
            let stream = (t.shard.mode == Mode::Sampled).then_some(stream);
            heads.choose_epsilon_greedy(values, epsilon, stream, &mut drawn);
            if taken == drawn {
                continue;
            }
            heads.best(values, &mut best);
            let less = f64::from(heads.value(values, &best)) - f64::from(heads.value(values, taken));
            worst = if drawn == best && !less.is_nan() { worst.max(less) } else { f64::INFINITY };
        }
        Ok(worst)
    }
}
