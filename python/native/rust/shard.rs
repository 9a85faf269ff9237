//! Some worlds that are stepped together by one thread.

use crate::observe::{Observer, Scratch, World};
use magex_assign::exact_points;
use magex_core::error::FieldError;
use magex_core::joint_state::group_positions;
use magex_core::metrics_table::METRICS;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Stage, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, Shape};
use magex_env::{Env, env_from_state, new_env};
use std::ops::Range;

/// What all shards share.
pub(crate) struct Plan {
    pub(crate) task: TaskConfig,
    pub(crate) observer: Observer,
    /// W.
    pub(crate) worlds: usize,
    /// Sizes of one world.
    pub(crate) shape: Shape,
    /// Whether goals are assigned by distance; otherwise every agent's goals have its own number.
    pub(crate) assigns: bool,
}

/// Episodes of consecutive worlds.
pub(crate) struct Shard {
    pub(crate) worlds: Range<usize>,
    pub(crate) env: Env,
    /// [B, N, K]
    pub(crate) goals: Vec<u32>,
    pub(crate) state: State,
    /// Of the episodes that ended last.
    pub(crate) scores: Vec<EpisodeMetrics>,
    scratch: Scratch,
}

/// [B, ...] where everything is after the last step.
#[derive(Default)]
pub(crate) struct State {
    pub(crate) positions: Vec<f32>,
    pub(crate) velocities: Vec<f32>,
    pub(crate) agent_state: Vec<f32>,
}

/// Where the episodes of all worlds begin.
#[derive(Clone, Copy)]
pub(crate) enum Begin<'a> {
    /// The k-th episode of a seed: world w draws where it begins from the stream (seed + w, Spawn, k).
    Drawn { seed: u64, episode: u32 },
    /// Positions and velocities [W, E, D], landmarks [W, N, D].
    Given([&'a [f32]; 3]),
}

impl Begin<'_> {
    fn env(self, plan: &Plan, worlds: &Range<usize>) -> Result<Env, FieldError> {
        match self {
            Self::Drawn { seed, episode } => {
                let stream = |w| Key::new(seed.wrapping_add(w as u64), Purpose::Spawn, &[episode]).stream();
                new_env(&plan.task, worlds.clone().map(stream), false)
            }
            Self::Given(arrays) => {
                let [positions, velocities, landmarks] = arrays.map(|array| {
                    let each = array.len() / plan.worlds;
                    &array[worlds.start * each..worlds.end * each]
                });
                env_from_state(&plan.task, positions, velocities, landmarks)
            }
        }
    }
}

impl Shard {
    /// Begins an episode in each of the worlds.
    pub(crate) fn new(plan: &Plan, worlds: Range<usize>, begin: Begin<'_>) -> Result<Self, FieldError> {
        let env = begin.env(plan, &worlds)?;
        let (count, s) = (worlds.len(), &plan.shape);
        let state = State {
            positions: vec![0.0; count * s.bodies * s.dims],
            velocities: vec![0.0; count * s.bodies * s.dims],
            agent_state: vec![0.0; count * s.agents * s.agent_state],
        };
        let mut shard = Self { worlds, env, goals: Vec::new(), state, scores: Vec::new(), scratch: Scratch::default() };
        shard.assign(plan)?;
        Ok(shard)
    }

    /// Begins the next episode in each of the worlds.
    pub(crate) fn restart(&mut self, plan: &Plan, begin: Begin<'_>) -> Result<(), FieldError> {
        self.env = begin.env(plan, &self.worlds)?;
        self.assign(plan)
    }

    /// Takes goals [B, N, K].
    pub(crate) fn set_goals(&mut self, goals: &[u32]) -> Result<(), FieldError> {
        self.env.set_goals(goals)?;
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    /// Writes the observations [B, N, V] of the present state.
    pub(crate) fn observe(&mut self, plan: &Plan, out: &mut [f32]) -> Result<(), FieldError> {
        if out.is_empty() {
            return Ok(());
        }
        self.look(plan)?;
        let (s, state) = (&plan.shape, &self.state);
        let [joint, extra, points, goals] =
            [s.bodies * s.dims, s.agents * s.agent_state, s.landmarks * s.dims, s.agents * s.goals_per_agent];
        let landmarks = self.env.statics().get(magex_core::statics::LANDMARKS);
        for (w, out) in out.chunks_exact_mut(s.agents * plan.observer.width()).enumerate() {
            let world = World {
                positions: &state.positions[w * joint..(w + 1) * joint],
                velocities: &state.velocities[w * joint..(w + 1) * joint],
                agent_state: &state.agent_state[w * extra..(w + 1) * extra],
                landmarks: &landmarks[w * points..(w + 1) * points],
                goals: &self.goals[w * goals..(w + 1) * goals],
            };
            plan.observer.write(world, &mut self.scratch, out);
        }
        Ok(())
    }

    /// Reads where everything is.
    pub(crate) fn look(&mut self, plan: &Plan) -> Result<(), FieldError> {
        self.env.write_positions(&mut self.state.positions)?;
        self.env.write_velocities(&mut self.state.velocities)?;
        if plan.shape.agent_state > 0 {
            self.env.write_agent_state(&mut self.state.agent_state)?;
        }
        Ok(())
    }

    /// Remembers what the episodes scored.
    pub(crate) fn finish(&mut self) {
        self.scores = self.env.scores();
    }

    /// The exact assignment of every stage.
    fn assign(&mut self, plan: &Plan) -> Result<(), FieldError> {
        let (s, stages) = (&plan.shape, plan.task.stages());
        let mut goals = Vec::with_capacity(self.worlds.len() * s.agents * s.goals_per_agent);
        if plan.assigns {
            self.look(plan)?;
            let landmarks = self.env.statics().get(magex_core::statics::LANDMARKS);
            let groups = (&self.state.positions[..], landmarks);
            for world in 0..self.worlds.len() {
                let solve = |stage: &Stage| {
                    let [from, to] = [stage.from, stage.to].map(|group| group_positions(s, groups, group, world));
                    exact_points(from, to, s.dims).map_err(|error| FieldError::new("goals", error.to_string()))
                };
                let answers = stages.iter().map(solve).collect::<Result<Vec<(Vec<u32>, f64)>, FieldError>>()?;
                for agent in 0..s.agents {
                    let mut at = agent;
                    for (answer, _) in &answers {
                        at = answer[at] as usize;
                        goals.push(at as u32);
                    }
                }
            }
        } else {
            let each = |agent: u32| std::iter::repeat_n(agent, s.goals_per_agent);
            goals.extend((0..self.worlds.len()).flat_map(|_| (0..s.agents as u32).flat_map(each)));
        }
        self.env.set_goals(&goals)?;
        self.goals = goals;
        Ok(())
    }
}

/// Names and `[W]` values of the metrics that the episodes have.
pub(crate) fn by_metric(scores: &[EpisodeMetrics]) -> Vec<(&'static str, Vec<f32>)> {
    let column = |metric| scores.iter().map(|score| score[metric]).collect();
    let present = |metric: &usize| scores.first().is_some_and(|score| score.get(*metric).is_some());
    (0..METRICS.len()).filter(present).map(|metric| (METRICS[metric].name, column(metric))).collect()
}
