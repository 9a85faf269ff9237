//! B worlds of N agents, W to a block: state, step, reward and bookkeeping.

use crate::arrival::{Arrivals, View};
use crate::cells::Cells;
use crate::physics::{Alike, Forces, Motion, Pair, Pairs, Physics, find_pairs};
use crate::real::Real;
use crate::spread::{CONTACT_DISTANCE, COVER_RADIUS};
use magex_core::task::{RewardConfig, TaskConfig};

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

/// The worlds. Array element `[block · N + i][w]` belongs to agent i of world block · W + w; the lanes of the last block
/// that have no world hold agents far apart, at rest.
#[derive(Debug, Clone)]
pub(crate) struct Batch<R, const W: usize> {
    worlds: usize,
    agents: usize,
    physics: Physics<R>,
    bodies: Alike<R>,
    law: RewardLaw<R>,
    x: Vec<[R; W]>,
    y: Vec<[R; W]>,
    vx: Vec<[R; W]>,
    vy: Vec<[R; W]>,
    /// Contact forces and overlaps at the present positions: the reward after a step and the motion of the next one
    /// share one look at the pairs.
    fx: Vec<[R; W]>,
    fy: Vec<[R; W]>,
    hits: Vec<[R; W]>,
    /// Where each agent's goal is.
    gx: Vec<[R; W]>,
    gy: Vec<[R; W]>,
    /// `[B, N, 2]`
    landmarks: Vec<R>,
    arrivals: Arrivals<R, W>,
    /// `[blocks]` sums over agents and steps.
    reward_sum: Vec<[f64; W]>,
    hit_sum: Vec<[f64; W]>,
    /// Large worlds (W = 1) compare neighbours only.
    cells: Option<Cells<R>>,
    pairs: Pairs,
    /// `[N]` one block's actions and rewards, lanes innermost.
    actions: Vec<[u8; W]>,
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
    ) -> Self {
        let agents = task.agents;
        let worlds = landmarks.len() / (2 * agents);
        let blocks = worlds.div_ceil(W);
        let physics = Physics::standard();
        let pair = Pair::equal(&physics, CONTACT_DISTANCE);
        let law = RewardLaw::new(&task.reward);
        let zero = vec![[R::ZERO; W]; blocks * agents];
        let mut batch = Self {
            worlds,
            agents,
            physics,
            bodies: Alike(pair),
            law,
            x: (0..blocks * agents).map(|k| [R::from_f64((k % agents) as f64); W]).collect(),
            y: zero.clone(),
            vx: zero.clone(),
            vy: zero.clone(),
            fx: zero.clone(),
            fy: zero.clone(),
            hits: zero.clone(),
            gx: zero.clone(),
            gy: zero,
            arrivals: Arrivals::new(worlds, agents, law.cover2, &landmarks),
            landmarks,
            reward_sum: vec![[0.0; W]; blocks],
            hit_sum: vec![[0.0; W]; blocks],
            cells: (with_cells && W == 1).then(|| {
                let reach = physics.reach(pair.touch).to_f64();
                Cells::new(agents, f64::from(task.side), reach)
            }),
            pairs: Vec::new(),
            actions: vec![[0; W]; agents],
            rewards: vec![[R::ZERO; W]; agents],
        };
        for world in 0..worlds {
            for i in 0..agents {
                let from = 2 * (world * agents + i);
                let (k, w) = batch.place(world, i);
                (batch.x[k][w], batch.y[k][w]) = (positions[from], positions[from + 1]);
                (batch.vx[k][w], batch.vy[k][w]) = (velocities[from], velocities[from + 1]);
            }
        }
        for block in 0..blocks {
            batch.find_contacts(block);
        }
        batch
    }

    fn place(&self, world: usize, agent: usize) -> (usize, usize) {
        (world / W * self.agents + agent, world % W)
    }

    /// `goals` is `[B, N]`, checked.
    pub(crate) fn set_goals(&mut self, goals: &[u32]) {
        for (k, &goal) in goals.iter().enumerate() {
            let (world, i) = (k / self.agents, k % self.agents);
            let from = 2 * (world * self.agents + goal as usize);
            let (k, w) = self.place(world, i);
            (self.gx[k][w], self.gy[k][w]) = (self.landmarks[from], self.landmarks[from + 1]);
        }
    }

    /// One joint step of every world, the `step`-th (from 1). `actions` and `rewards` are `[B, N]`, checked.
    pub(crate) fn step(&mut self, step: u32, actions: &[u8], rewards: &mut [R]) {
        let per_block = self.agents * W;
        let blocks = actions.chunks(per_block).zip(rewards.chunks_mut(per_block)).enumerate();
        for (block, (actions, rewards)) in blocks {
            self.advance(block, actions);
            self.find_contacts(block);
            self.pay(block, rewards);
            self.observe(block, step, rewards.len() / self.agents);
        }
    }

    /// Moves a block's agents.
    fn advance(&mut self, block: usize, actions: &[u8]) {
        for (w, world) in actions.chunks_exact(self.agents).enumerate() {
            for (lanes, &action) in self.actions.iter_mut().zip(world) {
                lanes[w] = action;
            }
        }
        let n = block * self.agents..(block + 1) * self.agents;
        let mut motion = Motion {
            x: &mut self.x[n.clone()],
            y: &mut self.y[n.clone()],
            vx: &mut self.vx[n.clone()],
            vy: &mut self.vy[n.clone()],
        };
        let forces = (&self.fx[n.clone()], &self.fy[n]);
        let (u, actions) = (self.physics.sensitivity, &self.actions);
        motion.advance(&self.physics, &self.bodies, forces, |i| {
            // Plain loops without branches: what the compiler turns into vectors.
            let (mut ux, mut uy) = ([R::ZERO; W], [R::ZERO; W]);
            let a = &actions[i];
            for w in 0..W {
                ux[w] = u * R::from_i8(i8::from(a[w] == 1) - i8::from(a[w] == 2));
                uy[w] = u * R::from_i8(i8::from(a[w] == 3) - i8::from(a[w] == 4));
            }
            (ux, uy)
        });
    }

    /// Contact forces and overlaps at the present positions of a block.
    fn find_contacts(&mut self, block: usize) {
        let n = block * self.agents..(block + 1) * self.agents;
        let positions = (&self.x[n.clone()], &self.y[n.clone()]);
        let mut forces = Forces { x: &mut self.fx[n.clone()], y: &mut self.fy[n.clone()], hits: &mut self.hits[n] };
        // Both ways list the pairs in the same order, so that they give the same bits.
        let found = match &mut self.cells {
            None => find_pairs(&self.bodies, positions, &mut self.pairs),
            Some(cells) => {
                cells.sort(positions.0.as_flattened(), positions.1.as_flattened());
                cells.pairs(self.bodies.0.reach2, &mut self.pairs);
                self.pairs.len()
            }
        };
        forces.sum(&self.physics, &self.bodies, positions, &self.pairs[..found]);
    }

    /// Rewards of a block at the present positions.
    fn pay(&mut self, block: usize, rewards: &mut [R]) {
        let n = block * self.agents..(block + 1) * self.agents;
        let (x, y) = (&self.x[n.clone()], &self.y[n.clone()]);
        let (gx, gy, hits) = (&self.gx[n.clone()], &self.gy[n.clone()], &self.hits[n]);
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
        let n = block * self.agents..(block + 1) * self.agents;
        let from = 2 * block * W * self.agents;
        let view = View {
            x: &self.x[n.clone()],
            y: &self.y[n],
            landmarks: &self.landmarks[from..from + 2 * worlds * self.agents],
            cells: self.cells.as_ref(),
        };
        self.arrivals.observe(block, step, &view);
    }

    pub(crate) fn worlds(&self) -> usize {
        self.worlds
    }

    pub(crate) fn landmarks(&self) -> &[R] {
        &self.landmarks
    }

    /// Writes `[B, N, 2]`.
    pub(crate) fn write_positions(&self, out: &mut [R]) {
        self.interleave(&self.x, &self.y, out);
    }

    /// Writes `[B, N, 2]`.
    pub(crate) fn write_velocities(&self, out: &mut [R]) {
        self.interleave(&self.vx, &self.vy, out);
    }

    fn interleave(&self, x: &[[R; W]], y: &[[R; W]], out: &mut [R]) {
        for (world, out) in out.chunks_exact_mut(2 * self.agents).enumerate() {
            let (from, w) = self.place(world, 0);
            let lanes = x[from..from + self.agents].iter().zip(&y[from..from + self.agents]);
            for (out, (x, y)) in out.chunks_exact_mut(2).zip(lanes) {
                (out[0], out[1]) = (x[w], y[w]);
            }
        }
    }

    /// Step of arrival of a world, if it has arrived.
    pub(crate) fn arrival(&self, world: usize) -> Option<u32> {
        self.arrivals.step(world)
    }

    /// Sums over agents and steps of a world: rewards, overlaps.
    pub(crate) fn sums(&self, world: usize) -> (f64, f64) {
        (self.reward_sum[world / W][world % W], self.hit_sum[world / W][world % W])
    }

    /// For each landmark of a world, the agents within the covering radius of it.
    pub(crate) fn near(&self, world: usize) -> Vec<Vec<u32>> {
        // Agents in groups that fill a register; the last group is filled up with agents out of everything's reach.
        const GROUP: usize = 16;
        let (from, w) = self.place(world, 0);
        let groups = |lanes: &[[R; W]]| -> Vec<[R; GROUP]> {
            let mut groups = vec![[R::from_f64(1e30); GROUP]; self.agents.div_ceil(GROUP)];
            let places = groups.as_flattened_mut().iter_mut();
            places.zip(&lanes[from..from + self.agents]).for_each(|(place, lanes)| *place = lanes[w]);
            groups
        };
        let (x, y) = (groups(&self.x), groups(&self.y));
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

#[cfg(test)]
mod tests;
