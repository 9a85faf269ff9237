//! Rolling out a shard in an external environment. Its worlds run side by side for T steps. A world whose episode ends before
//! begins another one with the next step of its own stream of seeds, in which no agent acts: the state before it is the true last one,
//! whose value the learner needs if the episode was cut. An evaluation plays one episode in each world.

use super::policy::{Carried, KeyedChooser};
use super::{Roller, RolloutError, Source, columns};
use crate::environment::{Environment, EnvironmentError, Observed, Taken};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use magex_core::ids::{Shard, ShardKind};
use magex_core::joint_state::JointState;
use magex_core::keys::{EpisodeKeys, episode_keys};
use magex_core::metrics_table::{EPISODE_LENGTH, EPISODE_RETURN, REWARD, SUCCESS_RATE};
use magex_core::rng::Stream;
use magex_core::statics::Statics;
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, ShardResult, Trajectory, mark};
use magex_nets::executor::Act;
use magex_nets::params::ParamError;
use std::sync::Arc;

/// Largest number of pictures of a recorded episode; of a longer one every second (third, …) step is drawn.
const PICTURES: usize = 200;

/// Why an attempt ended: for the environment's sake, after which another attempt may succeed, or another.
pub(super) enum Ended<E> {
    Environment(EnvironmentError),
    Rollout(RolloutError<E>),
}

impl<E> From<EnvironmentError> for Ended<E> {
    fn from(error: EnvironmentError) -> Self {
        Self::Environment(error)
    }
}

/// What the first episode of a world has scored so far.
#[derive(Clone, Default)]
struct Score {
    sum: f64,
    steps: u32,
    success: Option<f32>,
    over: bool,
}

impl Roller {
    /// Rolls out all worlds of a shard side by side.
    pub(super) fn rollout_external<E>(
        &self,
        shard: &Shard,
        environment: &mut Environment,
    ) -> Result<ShardResult, Ended<E>> {
        let (task, keep) = (&self.config.task, shard.kind == ShardKind::Train);
        let shape = task.shape(shard.episodes as usize);
        let (b, n) = (shape.episodes, shape.agents);
        let keys: Vec<EpisodeKeys> =
            (0..shard.episodes).map(|e| episode_keys(self.config.run.seed, shard, e)).collect();
        let mut seeds: Vec<Stream> = keys.iter().map(|k| k.spawn.stream()).collect();
        let mut draws: Vec<Stream> = keys.iter().map(|k| k.controller.stream()).collect();
        // Below 2^31: what every environment accepts.
        let mut next_seed = |world: usize| seeds[world].bits32() >> 1;

        let mut observed = environment.reset((0..b).map(&mut next_seed).collect())?;
        let mut begins = vec![true; b];
        let mut carried = Carried::new(&self.model, shard, n, keys.iter().map(|k| k.graph));
        let mut chosen = KeyedChooser::new(self.model.heads(), n, shard.mode, keys.iter().map(|k| k.action));
        let mut out = columns(&shape, shard, keep);
        let mut scores = vec![Score::default(); b];
        let (mut seen, mut pictures) = (Vec::new(), Vec::new());
        let renders = task.external().is_ok_and(|external| external.renders);
        let stride = shape.steps.div_ceil(PICTURES).max(1);
        for step in 0..=shape.steps {
            self.pulse.beat();
            let marks = marks(&observed, &begins, n);
            if keep {
                out.agent_state.extend_from_slice(&observed.observations);
                out.world_states.extend_from_slice(&observed.states);
                out.marks.extend_from_slice(&marks);
            } else if shard.record && !scores[0].over {
                seen.extend_from_slice(&observed.observations[..n * shape.agent_state]);
                if renders && step % stride == 0 {
                    pictures.push(STANDARD.encode(environment.render(0)?));
                }
            }
            if step == shape.steps || (!keep && scores.iter().all(|score| score.over)) {
                break;
            }
            match &self.source {
                Source::Policy(policy) => {
                    let seen = Seen { shape: &shape, observed: &observed, marks: &marks };
                    self.choose(policy.as_ref(), &seen, step, (&mut carried, &mut chosen)).map_err(Ended::Rollout)?;
                    if let Some(place) = chosen.not_finite {
                        let version = shard.version.0;
                        return Err(Ended::Rollout(RolloutError::NotFinite { place, step, version }));
                    }
                }
                Source::Controller(_) | Source::Random => {
                    random(&observed, &shape, &mut draws, &mut chosen, task.action_heads())
                }
            }
            // What an agent that does not act would have done is no number of the run.
            for (row, _) in observed.active.iter().enumerate().filter(|(_, active)| **active == 0) {
                chosen.forget(row);
            }
            if keep {
                out.actions.extend_from_slice(&chosen.actions);
                out.moves.extend_from_slice(&chosen.moves);
                out.log_probs.extend_from_slice(&chosen.log_probs);
                out.masks.extend_from_slice(&observed.masks);
            }
            let over = |world: &usize| keep && observed.over(*world, n);
            let restarts: Vec<(u32, u32)> = (0..b).filter(over).map(|world| (world as u32, next_seed(world))).collect();
            let taken = Taken { choices: &chosen.actions, moves: &chosen.moves };
            observed = environment.step(&taken, &restarts)?;
            begins.fill(false);
            restarts.iter().for_each(|&(world, _)| begins[world as usize] = true);
            if keep {
                out.rewards.extend_from_slice(&observed.rewards);
            }
            for (world, score) in scores.iter_mut().enumerate().filter(|(_, score)| !score.over) {
                let rewards = &observed.rewards[world * n..(world + 1) * n];
                score.sum += rewards.iter().map(|&reward| f64::from(reward)).sum::<f64>();
                score.steps += 1;
                score.over = observed.over(world, n);
                if score.over {
                    score.success = observed.successes.get(world).map(|&success| f32::from(success));
                }
            }
        }
        let metrics = scores.iter().map(|score| score.metrics(n, task.external().is_ok_and(|e| e.successes))).collect();
        if !keep {
            let recording = shard.record.then(|| Recording {
                shape: Shape { episodes: 1, ..shape },
                positions: Vec::new(),
                agent_state: {
                    // Zeros after its end.
                    seen.resize((shape.steps + 1) * n * shape.agent_state, 0.0);
                    seen
                },
                statics: Statics::default(),
                goals: Vec::new(),
                pictures,
            });
            return Ok(ShardResult::Eval(EvalOutcome { shard: *shard, metrics, recording }));
        }
        Ok(ShardResult::Train(Trajectory { metrics, ..out }))
    }

    fn choose<E>(
        &self,
        policy: &dyn Act,
        seen: &Seen<'_>,
        step: usize,
        (carried, chosen): (&mut Carried, &mut KeyedChooser<'_>),
    ) -> Result<(), RolloutError<E>> {
        let statics = Statics::default();
        let state = JointState {
            positions: &[],
            velocities: &[],
            agent_state: &seen.observed.observations,
            world_states: &seen.observed.states,
            masks: &seen.observed.masks,
            marks: seen.marks,
            statics: statics.view(),
            goals: &[],
        };
        debug_assert_eq!(seen.shape.agents * seen.shape.episodes, seen.marks.len());
        let features = Arc::new(self.model.spec().compute(&state));
        carried.act(policy, &features, step, chosen).map_err(ParamError::from)?;
        Ok(())
    }
}

/// A joint state of all worlds.
struct Seen<'a> {
    shape: &'a Shape,
    observed: &'a Observed,
    marks: &'a [u8],
}

impl Score {
    fn metrics(&self, agents: usize, successes: bool) -> EpisodeMetrics {
        let total = self.sum / agents as f64;
        let mut metrics = EpisodeMetrics::of([
            (REWARD, (total / f64::from(self.steps.max(1))) as f32),
            (EPISODE_RETURN, total as f32),
            (EPISODE_LENGTH, self.steps as f32),
        ]);
        if successes {
            metrics[SUCCESS_RATE] = self.success.unwrap_or(0.0);
        }
        metrics
    }
}

/// See [`mark`].
fn marks(observed: &Observed, begins: &[bool], agents: usize) -> Vec<u8> {
    let rows = observed.active.iter().zip(&observed.terminated).zip(&observed.truncated).enumerate();
    rows.map(|(row, ((active, terminated), truncated))| {
        let first = begins[row / agents];
        let mut marks = if *active == 1 { mark::ACTIVE } else { 0 };
        marks |= if first { mark::FIRST } else { 0 };
        // A world that begins has ended nothing.
        marks |= if *terminated == 1 && !first { mark::TERMINATED } else { 0 };
        marks | if *truncated == 1 && !first { mark::TRUNCATED } else { 0 }
    })
    .collect()
}

/// Any action that is allowed, all alike; real numbers uniformly from their range, or normal where there is none.
fn random(observed: &Observed, shape: &Shape, draws: &mut [Stream], chosen: &mut KeyedChooser<'_>, heads: Vec<usize>) {
    let width: usize = heads.iter().sum();
    for row in 0..shape.episodes * shape.agents {
        let stream = &mut draws[row / shape.agents];
        let mut from = row * width;
        for (slot, &size) in chosen.actions[row * heads.len()..(row + 1) * heads.len()].iter_mut().zip(&heads) {
            let allowed: Vec<usize> =
                (0..size).filter(|choice| observed.masks.get(from + choice).is_none_or(|&mask| mask == 1)).collect();
            let pick = stream.below(allowed.len() as u32) as usize;
            *slot = allowed.get(pick).copied().unwrap_or(0) as u8;
            from += size;
        }
        for slot in &mut chosen.moves[row * shape.moves..(row + 1) * shape.moves] {
            // tanh takes it to a uniform number of the range.
            let u = stream.range(-1.0, 1.0).clamp(-0.999_999, 0.999_999);
            *slot = libm::atanh(u) as f32;
        }
    }
}
