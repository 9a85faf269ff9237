//! What Push Ball pays for and counts.

use super::constants::REACHED;
use super::law::Legs;
use crate::particles::batch::Objective;
use crate::particles::physics::{AgentsAndBalls, Physics};
use crate::particles::swarm::Swarm;
use magex_core::error::FieldError;
use magex_core::task::{PushBallConfig, RewardTarget, TaskConfig};

const REACHED2: f32 = REACHED as f32 * REACHED as f32;

type Bodies = AgentsAndBalls<f32>;

/// The reward and the goals: arrays are laid out like those of [`Swarm`], with N per block.
pub(super) struct PushBallObjective<const W: usize> {
    config: PushBallConfig,
    /// The team is paid: the nearest agent of each ball and the nearest ball of each landmark count, whatever the goals are.
    team: bool,
    /// Each agent's ball, and where that ball's landmark is; for the team, where each landmark is.
    ball: Vec<[u32; W]>,
    lx: Vec<[f32; W]>,
    ly: Vec<[f32; W]>,
    /// Φ at the present positions; the team's is that of its first agent.
    potential: Vec<[f32; W]>,
}

impl<const W: usize> Objective<W> for PushBallObjective<W> {
    type Bodies = Bodies;

    const BODIES: usize = 2;

    fn bodies(agents: usize) -> Bodies {
        AgentsAndBalls::new(&Physics::standard(), agents, PushBallConfig::AGENT_RADIUS, PushBallConfig::BALL_RADIUS)
    }

    fn new(task: &TaskConfig, blocks: usize) -> Result<Self, FieldError> {
        let zero = vec![[0.0; W]; blocks * task.agents];
        let ball = vec![[0; W]; blocks * task.agents];
        let (config, team) = (*task.push_ball()?, task.reward_target == RewardTarget::Team);
        Ok(Self { config, team, ball, lx: zero.clone(), ly: zero.clone(), potential: zero })
    }

    fn cover2(&self) -> f32 {
        REACHED2
    }

    fn place_goals(&mut self, swarm: &Swarm<f32, W, Bodies>, goals: &[u32]) {
        let n = swarm.agents();
        for (k, goal) in goals.chunks_exact(2).enumerate() {
            let world = k / n;
            let (place, w) = (world / W * n + k % n, world % W);
            let [x, y] = swarm.landmark(world, if self.team { k % n } else { goal[1] as usize });
            (self.ball[place][w], self.lx[place][w], self.ly[place][w]) = (goal[0], x, y);
        }
        if self.team {
            for block in 0..self.potential.len() / n {
                self.potential[block * n] = self.nearest(swarm, block).map(|nearest| nearest.potential);
            }
            return;
        }
        for own in 0..self.potential.len() {
            self.potential[own] = self.legs(swarm, own / n, own % n).map(|legs| legs.potential);
        }
    }

    fn rewards(&mut self, swarm: &Swarm<f32, W, Bodies>, block: usize, rewards: &mut [[f32; W]]) -> [f32; W] {
        let mut sum = [0.0; W];
        if self.team {
            let (nearest, n) = (self.nearest(swarm, block), rewards.len() as f32);
            let potential = &mut self.potential[block * swarm.agents()];
            for w in 0..W {
                let (now, gained) = (nearest[w], nearest[w].potential - potential[w]);
                let each = self
                    .config
                    .progress
                    .mul_add(gained, self.config.bonus * now.covered - self.config.distance * now.distance);
                rewards.iter_mut().for_each(|lanes| lanes[w] = each);
                (potential[w], sum[w]) = (now.potential, each * n);
            }
            return sum;
        }
        for (i, lanes) in rewards.iter_mut().enumerate() {
            let legs = self.legs(swarm, block, i);
            let potential = &mut self.potential[block * swarm.agents() + i];
            for w in 0..W {
                let bonus = if legs[w].last2 <= REACHED2 { self.config.bonus } else { 0.0 };
                let owed = self.config.distance * legs[w].distance;
                lanes[w] = self.config.progress.mul_add(legs[w].potential - potential[w], bonus - owed);
                potential[w] = legs[w].potential;
                sum[w] += lanes[w];
            }
        }
        sum
    }

    /// Those that have any ball within reach.
    fn covered(&self, swarm: &Swarm<f32, W, Bodies>, world: usize) -> usize {
        let n = swarm.agents();
        let (from, w) = swarm.place(world, n);
        let points = |lanes: &[[f32; W]]| -> Vec<f32> { lanes[from..from + n].iter().map(|lanes| lanes[w]).collect() };
        let (x, y) = (points(&swarm.x), points(&swarm.y));
        let covered = |&landmark: &usize| {
            let point = swarm.landmark(world, landmark);
            let mut near = false;
            for (&x, &y) in x.iter().zip(&y) {
                near |= reaches([x, y], point);
            }
            near
        };
        (0..n).filter(covered).count()
    }

    /// Those whose own ball is within reach.
    fn matched(&self, swarm: &Swarm<f32, W, Bodies>, world: usize, goals: &[u32]) -> usize {
        let mut matched = vec![false; swarm.agents()];
        for goal in goals.chunks_exact(2) {
            let (ball, w) = swarm.place(world, swarm.agents() + goal[0] as usize);
            let landmark = goal[1] as usize;
            let at = [swarm.x[ball][w], swarm.y[ball][w]];
            matched[landmark] |= reaches(at, swarm.landmark(world, landmark));
        }
        matched.iter().filter(|&&matched| matched).count()
    }
}

/// How far a team is, as means over its balls and landmarks.
#[derive(Debug, Clone, Copy, Default)]
struct Nearest {
    /// −(the way of the nearest agent to each ball + 2 · that of the nearest ball to each landmark).
    potential: f32,
    /// The same ways between the centres, not weighted.
    distance: f32,
    /// Share of the landmarks that a ball is within reach of.
    covered: f32,
}

impl<const W: usize> PushBallObjective<W> {
    /// How far the teams of a block are.
    fn nearest(&self, swarm: &Swarm<f32, W, Bodies>, block: usize) -> [Nearest; W] {
        let n = swarm.agents();
        let (x, y) = (&swarm.x[swarm.block(block)], &swarm.y[swarm.block(block)]);
        let (lx, ly) = (&self.lx[block * n..(block + 1) * n], &self.ly[block * n..(block + 1) * n]);
        let distances = |[fx, fy]: [&[[f32; W]]; 2], tx: [f32; W], ty: [f32; W]| {
            let mut nearest2 = [f32::INFINITY; W];
            for (x, y) in fx.iter().zip(fy) {
                for w in 0..W {
                    let (dx, dy) = (x[w] - tx[w], y[w] - ty[w]);
                    nearest2[w] = nearest2[w].min(dx.mul_add(dx, dy * dy));
                }
            }
            nearest2.map(f32::sqrt)
        };
        let mut sums = [Nearest::default(); W];
        for i in 0..n {
            let to_ball = distances([&x[..n], &y[..n]], x[n + i], y[n + i]);
            let to_landmark = distances([&x[n..], &y[n..]], lx[i], ly[i]);
            for w in 0..W {
                let way = (to_ball[w] - PushBallConfig::PUSH_DISTANCE as f32).max(0.0);
                sums[w].potential -= 2.0f32.mul_add(to_landmark[w], way);
                sums[w].distance += to_ball[w] + to_landmark[w];
                sums[w].covered += if to_landmark[w] <= REACHED as f32 { 1.0 } else { 0.0 };
            }
        }
        let share = 1.0 / n as f32;
        sums.map(|sum| Nearest {
            potential: sum.potential * share,
            distance: sum.distance * share,
            covered: sum.covered * share,
        })
    }

    /// The legs of agent i of a block.
    #[inline(always)]
    fn legs(&self, swarm: &Swarm<f32, W, Bodies>, block: usize, i: usize) -> [Legs; W] {
        let n = swarm.agents();
        let own = block * n + i;
        let (x, y) = (&swarm.x[swarm.block(block)], &swarm.y[swarm.block(block)]);
        let (ball, lx, ly) = (&self.ball[own], &self.lx[own], &self.ly[own]);
        // The balls are gathered first, so that the rest is plain arithmetic on vectors.
        let (mut bx, mut by) = ([0.0; W], [0.0; W]);
        for w in 0..W {
            let ball = n + ball[w] as usize;
            (bx[w], by[w]) = (x[ball][w], y[ball][w]);
        }
        let (ax, ay, turn) = (&x[i], &y[i], self.config.turn_length);
        std::array::from_fn(|w| Legs::new((bx[w] - ax[w], by[w] - ay[w]), (lx[w] - bx[w], ly[w] - by[w]), turn))
    }
}

#[inline(always)]
fn reaches(body: [f32; 2], landmark: [f32; 2]) -> bool {
    let (dx, dy) = (body[0] - landmark[0], body[1] - landmark[1]);
    dx.mul_add(dx, dy * dy) <= REACHED2
}
