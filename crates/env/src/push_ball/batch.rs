//! Push Ball on B worlds, W to a block: goals, reward and bookkeeping.

use super::constants::{AGENT_RADIUS, BALL_RADIUS};
use super::law::{Law, Legs};
use crate::env::all_covered;
use crate::particles::arrival::{Arrivals, View};
use crate::particles::cells::Cells;
use crate::particles::physics::{AgentsAndBalls, Bodies as _, Physics};
use crate::particles::real::Real;
use crate::particles::swarm::Swarm;
use crate::shell::{Moment, Rules};
use magex_core::error::FieldError;
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD,
    SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::task::TaskConfig;
use magex_core::trajectory::EpisodeMetrics;

/// The worlds and what Push Ball makes of them; arrays are laid out like those of [`Swarm`], with N per block where they
/// belong to agents.
#[derive(Debug, Clone)]
pub(super) struct Batch<R, const W: usize> {
    agents: usize,
    swarm: Swarm<R, W, AgentsAndBalls<R>>,
    law: Law<R>,
    /// `[blocks · N][W]` each agent's ball, and where that ball's landmark is.
    ball: Vec<[u32; W]>,
    lx: Vec<[R; W]>,
    ly: Vec<[R; W]>,
    /// `[blocks · N][W]` Φ at the present positions.
    potential: Vec<[R; W]>,
    /// `[B, N, 2]`
    landmarks: Vec<R>,
    arrivals: Arrivals<R, W>,
    /// The balls alone, sorted for the arrivals of a large world.
    cells: Option<Cells<R>>,
    /// `[blocks]` sums over agents and steps.
    reward_sum: Vec<[f64; W]>,
    hit_sum: Vec<[f64; W]>,
    /// `[N]` one block's rewards, lanes innermost.
    rewards: Vec<[R; W]>,
}

impl<R: Real, const W: usize> Batch<R, W> {
    /// Worlds with the given positions and velocities `[B, 2N, 2]`, agents first, and landmarks `[B, N, 2]`; until goals
    /// are set, every agent's are ball 0 and the origin.
    pub(super) fn new(
        task: &TaskConfig,
        positions: &[R],
        velocities: &[R],
        landmarks: Vec<R>,
        with_cells: bool,
    ) -> Result<Self, FieldError> {
        let agents = task.agents;
        let kinds = AgentsAndBalls::new(&Physics::standard(), agents, AGENT_RADIUS, BALL_RADIUS);
        let side = f64::from(task.side);
        let swarm = Swarm::new(kinds, (agents, 2 * agents), positions, velocities, with_cells.then_some(side));
        let blocks = swarm.worlds().div_ceil(W);
        let law = Law::new(task.push_ball()?);
        let zero = vec![[R::ZERO; W]; blocks * agents];
        Ok(Self {
            agents,
            ball: vec![[0; W]; blocks * agents],
            lx: zero.clone(),
            ly: zero.clone(),
            potential: zero,
            arrivals: Arrivals::new(swarm.worlds(), agents, law.reached2, &landmarks),
            cells: swarm.cells.is_some().then(|| Cells::new(agents, side, kinds.reach2().to_f64().sqrt())),
            swarm,
            law,
            landmarks,
            reward_sum: vec![[0.0; W]; blocks],
            hit_sum: vec![[0.0; W]; blocks],
            rewards: vec![[R::ZERO; W]; agents],
        })
    }

    /// `goals` is `[B, N, 2]`, checked.
    fn place_goals(&mut self, goals: &[u32]) {
        let n = self.agents;
        for (k, goal) in goals.chunks_exact(2).enumerate() {
            let (world, i) = (k / n, k % n);
            let (place, w) = (world / W * n + i, world % W);
            let from = 2 * (world * n + goal[1] as usize);
            self.ball[place][w] = goal[0];
            (self.lx[place][w], self.ly[place][w]) = (self.landmarks[from], self.landmarks[from + 1]);
        }
        for block in 0..self.swarm.worlds().div_ceil(W) {
            for i in 0..n {
                let legs = self.legs(block, i);
                self.potential[block * n + i] = legs.map(|legs| legs.potential);
            }
        }
    }

    /// One joint step of every world, the `step`-th (from 1). `actions` and `rewards` are `[B, N]`, checked.
    fn advance(&mut self, step: u32, actions: &[u8], rewards: &mut [R]) {
        let per_block = self.agents * W;
        let blocks = actions.chunks(per_block).zip(rewards.chunks_mut(per_block)).enumerate();
        for (block, (actions, rewards)) in blocks {
            self.swarm.step(block, actions);
            self.pay(block, rewards);
            self.observe(block, step, rewards.len() / self.agents);
        }
    }

    /// The legs of agent i of a block.
    #[inline(always)]
    fn legs(&self, block: usize, i: usize) -> [Legs<R>; W] {
        let n = self.agents;
        let (from, own) = (2 * block * n, block * n + i);
        let (x, y) = (&self.swarm.x[from..from + 2 * n], &self.swarm.y[from..from + 2 * n]);
        let (ball, lx, ly) = (&self.ball[own], &self.lx[own], &self.ly[own]);
        // The balls are gathered first, so that the rest is plain arithmetic on vectors.
        let (mut bx, mut by) = ([R::ZERO; W], [R::ZERO; W]);
        for w in 0..W {
            let ball = n + ball[w] as usize;
            (bx[w], by[w]) = (x[ball][w], y[ball][w]);
        }
        let (ax, ay) = (&x[i], &y[i]);
        std::array::from_fn(|w| self.law.legs((bx[w] - ax[w], by[w] - ay[w]), (lx[w] - bx[w], ly[w] - by[w])))
    }

    /// Rewards of a block at the present positions.
    fn pay(&mut self, block: usize, rewards: &mut [R]) {
        let (n, law) = (self.agents, self.law);
        let (mut reward_sum, mut hit_sum) = ([R::ZERO; W], [R::ZERO; W]);
        for i in 0..n {
            let legs = self.legs(block, i);
            let (potential, hits) = (&mut self.potential[block * n + i], &self.swarm.hits[2 * block * n + i]);
            let lanes = &mut self.rewards[i];
            for w in 0..W {
                let bonus = if legs[w].last2 <= law.reached2 { law.bonus } else { R::ZERO };
                let owed = law.distance * legs[w].distance;
                lanes[w] = law.progress.mul_add(legs[w].potential - potential[w], bonus - owed);
                potential[w] = legs[w].potential;
                reward_sum[w] += lanes[w];
                hit_sum[w] += hits[w];
            }
        }
        for w in 0..W {
            self.reward_sum[block][w] += reward_sum[w].to_f64();
            self.hit_sum[block][w] += hit_sum[w].to_f64();
        }
        for (w, world) in rewards.chunks_exact_mut(n).enumerate() {
            for (reward, lanes) in world.iter_mut().zip(&self.rewards) {
                *reward = lanes[w];
            }
        }
    }

    fn observe(&mut self, block: usize, step: u32, worlds: usize) {
        let n = self.agents;
        let (from, balls) = (2 * block * W * n, (2 * block + 1) * n..(2 * block + 2) * n);
        let (x, y) = (&self.swarm.x[balls.clone()], &self.swarm.y[balls]);
        if let Some(cells) = &mut self.cells {
            cells.sort(x.as_flattened(), y.as_flattened());
        }
        let landmarks = &self.landmarks[from..from + 2 * worlds * n];
        self.arrivals.observe(block, step, &View { x, y, landmarks, cells: self.cells.as_ref() });
    }

    /// Sums over agents and steps of a world: rewards, overlaps of agents.
    fn sums(&self, world: usize) -> (f64, f64) {
        (self.reward_sum[world / W][world % W], self.hit_sum[world / W][world % W])
    }

    /// A count of landmarks as a share of them.
    fn share(&self, count: usize) -> f32 {
        (count as f64 / self.agents as f64) as f32
    }

    /// Landmarks of a world that have any ball within reach.
    fn covered(&self, world: usize) -> usize {
        let n = self.agents;
        let (from, w) = self.swarm.place(world, n);
        let points = |lanes: &[[R; W]]| -> Vec<R> { lanes[from..from + n].iter().map(|lanes| lanes[w]).collect() };
        let (x, y) = (points(&self.swarm.x), points(&self.swarm.y));
        let covered = |point: &&[R]| {
            let mut near = false;
            for (&x, &y) in x.iter().zip(&y) {
                near |= self.reaches((x, y), point);
            }
            near
        };
        self.landmarks[2 * world * n..2 * (world + 1) * n].chunks_exact(2).filter(covered).count()
    }

    /// Landmarks of a world whose own ball, by the world's goals `[N, 2]`, is within reach.
    fn matched(&self, world: usize, goals: &[u32]) -> usize {
        let n = self.agents;
        let (from, w) = self.swarm.place(world, n);
        let landmarks = &self.landmarks[2 * world * n..2 * (world + 1) * n];
        let mut matched = vec![false; n];
        for goal in goals.chunks_exact(2) {
            let (ball, landmark) = (from + goal[0] as usize, goal[1] as usize);
            let point = &landmarks[2 * landmark..2 * landmark + 2];
            matched[landmark] |= self.reaches((self.swarm.x[ball][w], self.swarm.y[ball][w]), point);
        }
        matched.iter().filter(|&&matched| matched).count()
    }

    #[inline(always)]
    fn reaches(&self, (x, y): (R, R), point: &[R]) -> bool {
        let (dx, dy) = (x - point[0], y - point[1]);
        dx.mul_add(dx, dy * dy) <= self.law.reached2
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
        self.share(self.covered(world))
    }

    fn score(&self, world: usize, moment: &Moment<'_>) -> EpisodeMetrics {
        let (reward, hits) = self.sums(world);
        let agent_steps = f64::from(moment.steps.max(1)) * self.agents as f64;
        let success = self.success(world);
        EpisodeMetrics::of([
            (SUCCESS_RATE, success),
            (MATCHED_SUCCESS_RATE, self.share(self.matched(world, moment.goals))),
            (ALL_COVERED_RATE, all_covered(success)),
            (SPAWN_SUCCESS_RATE, moment.spawn_success),
            (ARRIVAL_STEP, self.arrivals.step(world).unwrap_or(moment.horizon + 1) as f32),
            (COLLISIONS_PER_AGENT_STEP, (hits / agent_steps) as f32),
            (COLLISION_RATE, 0.0),
            (REWARD, (reward / agent_steps) as f32),
        ])
    }
}
