//! Simple Spread on B worlds, W to a block: goals, reward and bookkeeping.

use crate::env::all_covered;
use crate::matching::maximum_matching;
use crate::particles::arrival::{Arrivals, View};
use crate::particles::constants::CONTACT_DISTANCE;
use crate::particles::physics::{Alike, Pair, Physics};
use crate::particles::real::Real;
use crate::particles::swarm::Swarm;
use crate::shell::{Moment, Rules};
use magex_core::error::FieldError;
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD,
    SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::task::{RewardConfig, TaskConfig};
use magex_core::trajectory::EpisodeMetrics;

/// A landmark is covered when an agent's centre is within this distance (agent radius 0.1 + landmark radius 0.05).
pub const COVER_RADIUS: f64 = 0.15;

/// Coefficients of the reward in the physics' scalar.
#[derive(Debug, Clone, Copy)]
struct RewardLaw<R> {
    bonus: R,
    /// β / d_ref.
    per_distance: R,
    collision: R,
    /// COVER_RADIUS².
    cover2: R,
}

impl<R: Real> RewardLaw<R> {
    fn new(config: &RewardConfig) -> Self {
        Self {
            bonus: R::from_f64(f64::from(config.bonus)),
            per_distance: R::from_f64(f64::from(config.distance) / f64::from(config.distance_unit)),
            collision: R::from_f64(f64::from(config.collision)),
            cover2: square(R::from_f64(COVER_RADIUS)),
        }
    }
}

fn square<R: Real>(x: R) -> R {
    x * x
}

/// The worlds and what Simple Spread makes of them; arrays are laid out like those of [`Swarm`].
#[derive(Debug, Clone)]
pub(crate) struct Batch<R, const W: usize> {
    agents: usize,
    swarm: Swarm<R, W, Alike<R>>,
    law: RewardLaw<R>,
    /// Where each agent's goal is.
    gx: Vec<[R; W]>,
    gy: Vec<[R; W]>,
    /// `[B, N, 2]`
    landmarks: Vec<R>,
    arrivals: Arrivals<R, W>,
    /// `[blocks]` sums over agents and steps.
    reward_sum: Vec<[f64; W]>,
    hit_sum: Vec<[f64; W]>,
    /// `[N]` one block's rewards, lanes innermost.
    rewards: Vec<[R; W]>,
}

impl<R: Real, const W: usize> Batch<R, W> {
    /// Worlds with the given positions, velocities and landmarks, each `[B, N, 2]`; the goals are at the origin.
    pub(crate) fn new(
        task: &TaskConfig,
        positions: &[R],
        velocities: &[R],
        landmarks: Vec<R>,
        with_cells: bool,
    ) -> Result<Self, FieldError> {
        let agents = task.agents;
        let kinds = Alike(Pair::equal(&Physics::standard(), CONTACT_DISTANCE));
        let cells_over = with_cells.then_some(f64::from(task.side));
        let swarm = Swarm::new(kinds, (agents, agents), positions, velocities, cells_over);
        let blocks = swarm.worlds().div_ceil(W);
        let law = RewardLaw::new(task.reward()?);
        Ok(Self {
            agents,
            gx: vec![[R::ZERO; W]; blocks * agents],
            gy: vec![[R::ZERO; W]; blocks * agents],
            arrivals: Arrivals::new(swarm.worlds(), agents, law.cover2, &landmarks),
            swarm,
            law,
            landmarks,
            reward_sum: vec![[0.0; W]; blocks],
            hit_sum: vec![[0.0; W]; blocks],
            rewards: vec![[R::ZERO; W]; agents],
        })
    }

    /// `goals` is `[B, N]`, checked.
    fn place_goals(&mut self, goals: &[u32]) {
        for (k, &goal) in goals.iter().enumerate() {
            let (world, i) = (k / self.agents, k % self.agents);
            let from = 2 * (world * self.agents + goal as usize);
            let (k, w) = self.swarm.place(world, i);
            (self.gx[k][w], self.gy[k][w]) = (self.landmarks[from], self.landmarks[from + 1]);
        }
    }

    /// One joint step of every world, the `step`-th (from 1). `actions` and `rewards` are `[B, N]`, checked.
    pub(crate) fn advance(&mut self, step: u32, actions: &[u8], rewards: &mut [R]) {
        let per_block = self.agents * W;
        let blocks = actions.chunks(per_block).zip(rewards.chunks_mut(per_block)).enumerate();
        for (block, (actions, rewards)) in blocks {
            self.swarm.step(block, actions);
            self.pay(block, rewards);
            self.observe(block, step, rewards.len() / self.agents);
        }
    }

    /// Rewards of a block at the present positions.
    fn pay(&mut self, block: usize, rewards: &mut [R]) {
        let n = self.swarm.block(block);
        let (x, y) = (&self.swarm.x[n.clone()], &self.swarm.y[n.clone()]);
        let (gx, gy, hits) = (&self.gx[n.clone()], &self.gy[n.clone()], &self.swarm.hits[n]);
        let law = self.law;
        let (mut reward_sum, mut hit_sum) = ([R::ZERO; W], [R::ZERO; W]);
        for (i, lanes) in self.rewards.iter_mut().enumerate() {
            for w in 0..W {
                let (dx, dy) = (x[i][w] - gx[i][w], y[i][w] - gy[i][w]);
                let d2 = dx.mul_add(dx, dy * dy);
                let bonus = if d2 <= law.cover2 { law.bonus } else { R::ZERO };
                let charged = law.collision.mul_add(hits[i][w], law.per_distance * d2.sqrt());
                lanes[w] = bonus - charged;
                reward_sum[w] += lanes[w];
                hit_sum[w] += hits[i][w];
            }
        }
        for w in 0..W {
            self.reward_sum[block][w] += reward_sum[w].to_f64();
            self.hit_sum[block][w] += hit_sum[w].to_f64();
        }
        for (w, world) in rewards.chunks_exact_mut(self.agents).enumerate() {
            for (reward, lanes) in world.iter_mut().zip(&self.rewards) {
                *reward = lanes[w];
            }
        }
    }

    fn observe(&mut self, block: usize, step: u32, worlds: usize) {
        let n = self.swarm.block(block);
        let from = 2 * block * W * self.agents;
        let view = View {
            x: &self.swarm.x[n.clone()],
            y: &self.swarm.y[n],
            landmarks: &self.landmarks[from..from + 2 * worlds * self.agents],
            cells: self.swarm.cells.as_ref(),
        };
        self.arrivals.observe(block, step, &view);
    }

    /// For each landmark of a world, the agents within the covering radius of it.
    fn near(&self, world: usize) -> Vec<Vec<u32>> {
        // Agents in groups that fill a register; the last group is filled up with agents out of everything's reach.
        const GROUP: usize = 16;
        let (from, w) = self.swarm.place(world, 0);
        let groups = |lanes: &[[R; W]]| -> Vec<[R; GROUP]> {
            let mut groups = vec![[R::from_f64(1e30); GROUP]; self.agents.div_ceil(GROUP)];
            let places = groups.as_flattened_mut().iter_mut();
            places.zip(&lanes[from..from + self.agents]).for_each(|(place, lanes)| *place = lanes[w]);
            groups
        };
        let (x, y) = (groups(&self.swarm.x), groups(&self.swarm.y));
        let near = |point: &[R]| {
            let mut agents = Vec::new();
            for (group, (x, y)) in x.iter().zip(&y).enumerate() {
                let mut d2 = [R::ZERO; GROUP];
                let mut any = false;
                for k in 0..GROUP {
                    let (dx, dy) = (x[k] - point[0], y[k] - point[1]);
                    d2[k] = dx.mul_add(dx, dy * dy);
                    any |= d2[k] <= self.law.cover2;
                }
                if any {
                    let within = (0..GROUP).filter(|&k| d2[k] <= self.law.cover2);
                    agents.extend(within.map(|k| (group * GROUP + k) as u32));
                }
            }
            agents
        };
        let landmarks = &self.landmarks[2 * world * self.agents..2 * (world + 1) * self.agents];
        landmarks.chunks_exact(2).map(near).collect()
    }
}

impl<const W: usize> Rules for Batch<f32, W> {
    fn set_goals(&mut self, goals: &[u32]) {
        self.place_goals(goals);
    }

    fn step(&mut self, step: u32, _: &[u32], actions: &[u8], rewards: &mut [f32]) {
        self.advance(step, actions, rewards);
    }

    fn write_positions(&self, out: &mut [f32]) {
        self.swarm.write_positions(out);
    }

    fn write_velocities(&self, out: &mut [f32]) {
        self.swarm.write_velocities(out);
    }

    fn success(&self, world: usize) -> f32 {
        covered(&self.near(world), self.agents)
    }

    fn score(&self, world: usize, moment: &Moment<'_>) -> EpisodeMetrics {
        let near = self.near(world);
        let (reward, hits) = (self.reward_sum[world / W][world % W], self.hit_sum[world / W][world % W]);
        let share = |count: usize| (count as f64 / self.agents as f64) as f32;
        let agent_steps = f64::from(moment.steps.max(1)) * self.agents as f64;
        let success = covered(&near, self.agents);
        EpisodeMetrics::of([
            (SUCCESS_RATE, success),
            (MATCHED_SUCCESS_RATE, share(maximum_matching(&near, self.agents))),
            (ALL_COVERED_RATE, all_covered(success)),
            (SPAWN_SUCCESS_RATE, moment.spawn_success),
            (ARRIVAL_STEP, self.arrivals.step(world).unwrap_or(moment.horizon + 1) as f32),
            (COLLISIONS_PER_AGENT_STEP, (hits / agent_steps) as f32),
            (COLLISION_RATE, 0.0),
            (REWARD, (reward / agent_steps) as f32),
        ])
    }
}

/// Share of landmarks with anything near.
fn covered(near: &[Vec<u32>], landmarks: usize) -> f32 {
    (near.iter().filter(|agents| !agents.is_empty()).count() as f64 / landmarks as f64) as f32
}

#[cfg(test)]
mod tests;
