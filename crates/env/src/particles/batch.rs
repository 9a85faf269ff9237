//! A particle task on B worlds, W to a block: steps, sums and score. What is paid and what counts is the task's
//! [`Objective`].

use super::arrival::{Arrivals, View};
use super::cells::Cells;
use super::physics::{Bodies, Physics};
use super::swarm::Swarm;
use crate::rules::{Rules, Score, Starts};
use magex_core::error::FieldError;
use magex_core::task::{Integration, TaskConfig};

/// Goals, reward and success of a particle task in W worlds to a block.
pub(crate) trait Objective<const W: usize>: Sized + Send {
    /// Bodies of the task.
    type Bodies: Bodies<f32> + Send;

    /// Bodies per agent: agents come first, and the last N bodies cover landmarks.
    const BODIES: usize;

    fn bodies(agents: usize) -> Self::Bodies;

    /// Until goals are set they are at the origin.
    fn new(task: &TaskConfig, blocks: usize) -> Result<Self, FieldError>;

    /// The squared distance within which a landmark is covered.
    fn cover2(&self) -> f32;

    /// Takes goals [B, N, K].
    fn place_goals(&mut self, swarm: &Swarm<f32, W, Self::Bodies>, goals: &[u32]);

    /// Writes what each agent of a block [N] is paid for the step that led to the present positions; returns the sums over the
    /// agents. Summed in the same loop: without a sum the compiler makes vectors of agents, which it gathers, not of worlds.
    fn rewards(&mut self, swarm: &Swarm<f32, W, Self::Bodies>, block: usize, rewards: &mut [[f32; W]]) -> [f32; W];

    /// Landmarks of a world that are covered.
    fn covered(&self, swarm: &Swarm<f32, W, Self::Bodies>, world: usize) -> usize;

    /// Landmarks of a world that are matched one-to-one to what covers them; its goals are [N, K].
    fn matched(&self, swarm: &Swarm<f32, W, Self::Bodies>, world: usize, goals: &[u32]) -> usize;
}

/// The worlds and what the task makes of them; arrays are laid out like those of [`Swarm`].
pub(crate) struct Batch<const W: usize, O: Objective<W>> {
    pub(crate) swarm: Swarm<f32, W, O::Bodies>,
    pub(crate) objective: O,
    pub(crate) arrivals: Arrivals<W>,
    /// The covering bodies alone, sorted for the arrivals of a large world in which others do not cover.
    cells: Option<Cells<f32>>,
    /// `[blocks]` sums over agents and steps.
    pub(crate) reward_sum: Vec<[f64; W]>,
    pub(crate) hit_sum: Vec<[f64; W]>,
    /// `[N]` one block's rewards, lanes innermost.
    rewards: Vec<[f32; W]>,
}

impl<const W: usize, O: Objective<W>> Batch<W, O> {
    /// Worlds that start there; with `cells` and W = 1, neighbours are found by cells.
    pub(crate) fn new(task: &TaskConfig, starts: &Starts, cells: bool) -> Result<Self, FieldError> {
        let (agents, side, kinds) = (task.agents, f64::from(task.side), O::bodies(task.agents));
        let reach = f64::from(kinds.reach2()).sqrt();
        let position_first = task.integration == Integration::PositionFirst;
        let swarm = Swarm::new(
            Physics { position_first, ..Physics::standard() },
            kinds,
            (agents, O::BODIES * agents),
            [&starts.positions, &starts.velocities, starts.landmarks()],
            cells.then_some(side),
        );
        let blocks = swarm.worlds().div_ceil(W);
        let objective = O::new(task, blocks)?;
        Ok(Self {
            arrivals: Arrivals::new(swarm.worlds(), agents, objective.cover2(), starts.landmarks()),
            cells: (O::BODIES > 1 && swarm.cells.is_some()).then(|| Cells::new(agents, side, reach)),
            swarm,
            objective,
            reward_sum: vec![[0.0; W]; blocks],
            hit_sum: vec![[0.0; W]; blocks],
            rewards: vec![[0.0; W]; agents],
        })
    }

    /// Rewards of a block at the present positions.
    fn pay(&mut self, block: usize, rewards: &mut [f32]) {
        let reward_sum = self.objective.rewards(&self.swarm, block, &mut self.rewards);
        let mut hit_sum = [0.0; W];
        let first = self.swarm.block(block).start;
        for hits in &self.swarm.hits[first..first + self.rewards.len()] {
            for w in 0..W {
                hit_sum[w] += hits[w];
            }
        }
        for w in 0..W {
            self.reward_sum[block][w] += f64::from(reward_sum[w]);
            self.hit_sum[block][w] += f64::from(hit_sum[w]);
        }
        for (w, world) in rewards.chunks_exact_mut(self.rewards.len()).enumerate() {
            for (reward, lanes) in world.iter_mut().zip(&self.rewards) {
                *reward = lanes[w];
            }
        }
    }

    fn observe(&mut self, block: usize, step: u32, worlds: usize) {
        let (swarm, n) = (&self.swarm, self.rewards.len());
        let end = swarm.block(block).end;
        let bodies = end - n..end;
        let (x, y) = (&swarm.x[bodies.clone()], &swarm.y[bodies]);
        let cells = match &mut self.cells {
            Some(cells) => {
                cells.sort(x.as_flattened(), y.as_flattened());
                Some(&*cells)
            }
            None => swarm.cells.as_ref(),
        };
        let landmarks = &swarm.landmarks[2 * block * W * n..2 * (block * W + worlds) * n];
        self.arrivals.observe(block, step, &View { x, y, landmarks, cells });
    }
}

impl<const W: usize, O: Objective<W>> Rules for Batch<W, O> {
    fn set_goals(&mut self, goals: &[u32]) {
        self.objective.place_goals(&self.swarm, goals);
    }

    fn step(&mut self, step: u32, _: &[u32], actions: &[u8], rewards: &mut [f32]) {
        let agents = self.rewards.len();
        let blocks = actions.chunks(agents * W).zip(rewards.chunks_mut(agents * W)).enumerate();
        for (block, (actions, rewards)) in blocks {
            self.swarm.step(block, actions);
            self.pay(block, rewards);
            self.observe(block, step, rewards.len() / agents);
        }
    }

    fn write_positions(&self, out: &mut [f32]) {
        self.swarm.write_positions(out);
    }

    fn write_velocities(&self, out: &mut [f32]) {
        self.swarm.write_velocities(out);
    }

    fn covered(&self, world: usize) -> usize {
        self.objective.covered(&self.swarm, world)
    }

    fn score(&self, world: usize, steps: f64, goals: &[u32]) -> Score {
        let (block, w) = (world / W, world % W);
        Score {
            matched: self.objective.matched(&self.swarm, world, goals),
            arrival: self.arrivals.step(world),
            collisions: self.hit_sum[block][w] / (steps * self.rewards.len() as f64),
            crashed: 0.0,
            reward: self.reward_sum[block][w],
        }
    }
}
