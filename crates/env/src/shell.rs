//! What the environments of all tasks share: lengths, goals, actions and the horizon are checked here, once. A task adds its
//! [`Rules`], which may take every argument as it is.

use crate::env::Env;
use crate::error::{EnvError, check_finite, check_len};
use magex_core::rng::Stream;
use magex_core::statics::{StaticArray, Statics};
use magex_core::task::{ActionCode, Group, Stage, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, Shape};

/// A task: where its episodes start and which rules they follow.
pub trait Task {
    /// The rules of a batch of episodes.
    type Rules: Rules + ?Sized;

    /// Draws the start of one episode from its own stream and appends it. In training, starts that help learning may be
    /// mixed in.
    fn start(task: &TaskConfig, training: bool, stream: &mut Stream, starts: &mut Starts) -> Result<(), EnvError>;

    /// The rules of episodes that start there. An error if the task is another one.
    fn rules(task: &TaskConfig, starts: &Starts) -> Result<Box<Self::Rules>, EnvError>;
}

/// The physics, the reward and the score of a batch of episodes.
pub trait Rules: Send {
    /// Takes goals [B, N, K].
    fn set_goals(&mut self, _goals: &[u32]) {}

    /// One joint step of every episode, the `step`-th (from 1): goals [B, N, K], actions [B, N, H], rewards [B, N].
    fn step(&mut self, step: u32, goals: &[u32], actions: &[u8], rewards: &mut [f32]);

    /// Writes [B, E, D].
    fn write_positions(&self, out: &mut [f32]);

    /// Writes [B, E, D].
    fn write_velocities(&self, out: &mut [f32]);

    /// Writes [B, N, X].
    fn write_agent_state(&self, _out: &mut [f32]) {}

    /// Share of the landmarks of an episode that are covered now.
    fn success(&self, episode: usize) -> f32;

    /// What an episode has scored up to now. The metrics of the assignment are absent.
    fn score(&self, episode: usize, moment: &Moment<'_>) -> EpisodeMetrics;
}

/// When an episode is scored.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// Joint steps done.
    pub steps: u32,
    /// T.
    pub horizon: u32,
    /// [N, K]; empty before the goals are set.
    pub goals: &'a [u32],
    /// Share of landmarks that were covered before the first step.
    pub spawn_success: f32,
}

/// Where the episodes of a batch start.
#[derive(Debug, Clone, Default)]
pub struct Starts {
    /// [B, E, D]
    pub positions: Vec<f32>,
    /// [B, E, D]
    pub velocities: Vec<f32>,
    /// The static arrays of the episodes.
    pub statics: Statics,
}

impl Starts {
    /// Appends the next episode's part of a static array.
    pub fn extend(&mut self, name: &str, values: &[f32]) {
        let array = self.statics.0.iter_mut().find(|array| array.name == name);
        array.into_iter().for_each(|array| array.values.extend_from_slice(values));
    }
}

/// B episodes of a task, stepped together. Episode b depends only on the task, its stream, its goals and its actions: not on
/// B, not on b.
pub struct Shell<T: Task> {
    pub(crate) rules: Box<T::Rules>,
    shape: Shape,
    horizon: u32,
    action_code: ActionCode,
    stages: &'static [Stage],
    statics: Statics,
    /// `[B]`
    spawn_success: Vec<f32>,
    /// [B, N, K]; empty until they are set.
    goals: Vec<u32>,
    steps: u32,
}

impl<T: Task> std::fmt::Debug for Shell<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shell").field("shape", &self.shape).field("steps", &self.steps).finish_non_exhaustive()
    }
}

impl<T: Task> Shell<T> {
    /// One episode per stream, started as the task says. In training, starts that help learning may be mixed in. An error
    /// if the task does not validate.
    pub fn new(task: &TaskConfig, streams: impl Iterator<Item = Stream>, training: bool) -> Result<Self, EnvError> {
        task.validate()?;
        let array = |spec: magex_core::statics::StaticSpec| StaticArray {
            name: spec.name.to_owned(),
            shape: spec.shape,
            values: Vec::new(),
        };
        let statics = Statics(task.statics().into_iter().map(array).collect());
        let mut starts = Starts { statics, ..Starts::default() };
        for mut stream in streams {
            T::start(task, training, &mut stream, &mut starts)?;
        }
        starts.velocities = vec![0.0; starts.positions.len()];
        Self::assemble(task, starts)
    }

    /// Episodes of a task without other static arrays that start from given positions and velocities [B, E, D] and
    /// landmarks [B, N, D].
    pub fn from_state(
        task: &TaskConfig,
        positions: &[f32],
        velocities: &[f32],
        landmarks: &[f32],
    ) -> Result<Self, EnvError> {
        task.validate()?;
        let (points, all) = (task.agents * task.dims(), task.shape(1).bodies * task.dims());
        check_len("landmarks", landmarks.len(), landmarks.len().next_multiple_of(points))?;
        let expected = landmarks.len() / points * all;
        check_len("positions", positions.len(), expected)?;
        check_len("velocities", velocities.len(), expected)?;
        for (field, values) in [("positions", positions), ("velocities", velocities), ("landmarks", landmarks)] {
            check_finite(field, values)?;
        }
        let statics = Statics::landmarks(task.agents, task.dims(), landmarks.to_vec());
        Self::assemble(task, Starts { positions: positions.to_vec(), velocities: velocities.to_vec(), statics })
    }

    fn assemble(task: &TaskConfig, starts: Starts) -> Result<Self, EnvError> {
        let rules = T::rules(task, &starts)?;
        let mut shape = task.shape(0);
        shape.episodes = starts.positions.len() / (shape.bodies * shape.dims);
        Ok(Self {
            spawn_success: (0..shape.episodes).map(|episode| rules.success(episode)).collect(),
            rules,
            shape,
            horizon: task.horizon,
            action_code: task.action_code(),
            stages: task.stages(),
            statics: starts.statics,
            goals: Vec::new(),
            steps: 0,
        })
    }

    /// N.
    pub fn agents(&self) -> usize {
        self.shape.agents
    }

    /// T.
    pub fn horizon(&self) -> u32 {
        self.horizon
    }

    /// [B, N, K]; empty until they are set.
    pub fn goals(&self) -> &[u32] {
        &self.goals
    }

    /// The present positions [B, E, D].
    pub fn positions(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.joint()];
        self.rules.write_positions(&mut out);
        out
    }

    /// The present velocities [B, E, D].
    pub fn velocities(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.joint()];
        self.rules.write_velocities(&mut out);
        out
    }

    /// B · E · D.
    fn joint(&self) -> usize {
        self.shape.episodes * self.shape.bodies * self.shape.dims
    }

    /// B · N.
    pub(crate) fn rows(&self) -> usize {
        self.shape.episodes * self.shape.agents
    }

    fn check_actions(&self, actions: &[u8]) -> Result<(), EnvError> {
        let most = match self.action_code {
            ActionCode::Thrust => 4,
            ActionCode::PerAxis => 2,
        };
        // The maximum first: it vectorises, the search does not.
        if actions.iter().fold(0, |largest, &action| largest.max(action)) <= most {
            return Ok(());
        }
        let place = actions.iter().position(|&action| action > most).unwrap_or_default();
        let action = actions[place];
        Err(match self.action_code {
            ActionCode::Thrust => EnvError::Action { place, action },
            ActionCode::PerAxis => EnvError::AxisAction { place, action },
        })
    }
}

impl<T: Task> Env for Shell<T> {
    fn episodes(&self) -> usize {
        self.shape.episodes
    }

    fn steps(&self) -> u32 {
        self.steps
    }

    fn statics(&self) -> &Statics {
        &self.statics
    }

    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("positions", out.len(), self.joint())?;
        self.rules.write_positions(out);
        Ok(())
    }

    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("velocities", out.len(), self.joint())?;
        self.rules.write_velocities(out);
        Ok(())
    }

    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("agent_state", out.len(), self.rows() * self.shape.agent_state)?;
        self.rules.write_agent_state(out);
        Ok(())
    }

    fn set_goals(&mut self, goals: &[u32]) -> Result<(), EnvError> {
        check_goals(self.shape.agents, self.stages, goals, self.shape.episodes)?;
        self.rules.set_goals(goals);
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), EnvError> {
        check_len("actions", actions.len(), self.rows() * self.shape.action_components)?;
        check_len("rewards", rewards.len(), self.rows())?;
        if self.goals.len() != self.rows() * self.shape.goals_per_agent {
            return Err(EnvError::GoalsNotSet);
        }
        if self.steps >= self.horizon {
            return Err(EnvError::EpisodeOver { horizon: self.horizon });
        }
        self.check_actions(actions)?;
        self.steps += 1;
        self.rules.step(self.steps, &self.goals, actions, rewards);
        Ok(())
    }

    fn scores(&self) -> Vec<EpisodeMetrics> {
        let own = self.shape.agents * self.shape.goals_per_agent;
        let score = |(episode, &spawn_success): (usize, &f32)| {
            let goals = self.goals.get(episode * own..(episode + 1) * own).unwrap_or_default();
            self.rules.score(episode, &Moment { steps: self.steps, horizon: self.horizon, goals, spawn_success })
        };
        self.spawn_success.iter().enumerate().map(score).collect()
    }
}

/// `Ok` if goals [B, N, K] have their length and every one names something that exists.
pub(crate) fn check_goals(agents: usize, stages: &[Stage], goals: &[u32], episodes: usize) -> Result<(), EnvError> {
    check_len("goals", goals.len(), episodes * agents * stages.len())?;
    let Some(place) = goals.iter().position(|&goal| goal as usize >= agents) else { return Ok(()) };
    let goal = goals[place];
    Err(match stages[place % stages.len()].to {
        Group::Balls => EnvError::Ball { place, goal, balls: agents },
        Group::Agents | Group::Landmarks => EnvError::Goal { place, goal, landmarks: agents },
    })
}
