//! What Simple Spread pays for and counts.

use crate::matching::maximum_matching;
use crate::particles::batch::Objective;
use crate::particles::constants::CONTACT_DISTANCE;
use crate::particles::physics::{Alike, Pair, Physics};
use crate::particles::swarm::Swarm;
use magex_core::error::FieldError;
use magex_core::task::{RewardTarget, TaskConfig};

/// A landmark is covered when an agent's centre is within this distance (agent radius 0.1 + landmark radius 0.05).
pub const COVER_RADIUS: f64 = 0.15;

/// The coefficients of the reward ([`magex_core::task::RewardConfig`]) and the goals; arrays are laid out like those of
/// [`Swarm`].
pub(crate) struct SpreadObjective<const W: usize> {
    bonus: f32,
    /// β / d_ref.
    per_distance: f32,
    collision: f32,
    /// COVER_RADIUS².
    cover2: f32,
    /// The team is paid: the nearest agent of each landmark counts, whatever the goals are.
    team: bool,
    /// Where each agent's goal is; for the team, where each landmark is.
    gx: Vec<[f32; W]>,
    gy: Vec<[f32; W]>,
}

impl<const W: usize> Objective<W> for SpreadObjective<W> {
    type Bodies = Alike<f32>;

    const BODIES: usize = 1;

    fn bodies(_: usize) -> Alike<f32> {
        Alike(Pair::equal(&Physics::standard(), CONTACT_DISTANCE))
    }

    fn new(task: &TaskConfig, blocks: usize) -> Result<Self, FieldError> {
        let reward = task.reward()?;
        let radius = COVER_RADIUS as f32;
        Ok(Self {
            bonus: reward.bonus,
            per_distance: (f64::from(reward.distance) / f64::from(reward.distance_unit)) as f32,
            collision: reward.collision,
            team: task.reward_target == RewardTarget::Team,
            cover2: radius * radius,
            gx: vec![[0.0; W]; blocks * task.agents],
            gy: vec![[0.0; W]; blocks * task.agents],
        })
    }

    fn cover2(&self) -> f32 {
        self.cover2
    }

    fn place_goals(&mut self, swarm: &Swarm<f32, W, Alike<f32>>, goals: &[u32]) {
        for (k, &goal) in goals.iter().enumerate() {
            let world = k / swarm.agents();
            let own = k % swarm.agents();
            let [x, y] = swarm.landmark(world, if self.team { own } else { goal as usize });
            let (place, w) = swarm.place(world, own);
            (self.gx[place][w], self.gy[place][w]) = (x, y);
        }
    }

    fn rewards(&mut self, swarm: &Swarm<f32, W, Alike<f32>>, block: usize, rewards: &mut [[f32; W]]) -> [f32; W] {
        let n = swarm.block(block);
        let (x, y, hits) = (&swarm.x[n.clone()], &swarm.y[n.clone()], &swarm.hits[n.clone()]);
        let (gx, gy) = (&self.gx[n.clone()], &self.gy[n]);
        let (bonus, per_distance, collision, cover2) = (self.bonus, self.per_distance, self.collision, self.cover2);
        if self.team {
            return self.team_reward([x, y, gx, gy, hits], rewards);
        }
        let mut sum = [0.0; W];
        for (i, lanes) in rewards.iter_mut().enumerate() {
            for w in 0..W {
                let (dx, dy) = (x[i][w] - gx[i][w], y[i][w] - gy[i][w]);
                let d2 = dx.mul_add(dx, dy * dy);
                let bonus = if d2 <= cover2 { bonus } else { 0.0 };
                let charged = collision.mul_add(hits[i][w], per_distance * d2.sqrt());
                lanes[w] = bonus - charged;
                sum[w] += lanes[w];
            }
        }
        sum
    }

    fn covered(&self, swarm: &Swarm<f32, W, Alike<f32>>, world: usize) -> usize {
        self.near(swarm, world).iter().filter(|agents| !agents.is_empty()).count()
    }

    fn matched(&self, swarm: &Swarm<f32, W, Alike<f32>>, world: usize, _: &[u32]) -> usize {
        maximum_matching(&self.near(swarm, world), swarm.agents())
    }
}

impl<const W: usize> SpreadObjective<W> {
    /// Every agent gets the mean over the team: the distance of each landmark to the agent nearest to it, the covered landmarks,
    /// and the collisions of all.
    fn team_reward(&self, [x, y, lx, ly, hits]: [&[[f32; W]]; 5], rewards: &mut [[f32; W]]) -> [f32; W] {
        let mut sum = [0.0; W];
        for (lx, ly) in lx.iter().zip(ly) {
            let mut nearest2 = [f32::INFINITY; W];
            for (x, y) in x.iter().zip(y) {
                for w in 0..W {
                    let (dx, dy) = (x[w] - lx[w], y[w] - ly[w]);
                    nearest2[w] = nearest2[w].min(dx.mul_add(dx, dy * dy));
                }
            }
            for w in 0..W {
                let bonus = if nearest2[w] <= self.cover2 { self.bonus } else { 0.0 };
                sum[w] += bonus - self.per_distance * nearest2[w].sqrt();
            }
        }
        for hits in hits {
            for w in 0..W {
                sum[w] -= self.collision * hits[w];
            }
        }
        let share = 1.0 / rewards.len() as f32;
        let each = sum.map(|sum| sum * share);
        rewards.fill(each);
        sum
    }

    /// For each landmark of a world, the agents within the covering radius of it.
    pub(super) fn near(&self, swarm: &Swarm<f32, W, Alike<f32>>, world: usize) -> Vec<Vec<u32>> {
        // Agents in groups that fill a register; the last group is filled up with agents out of everything's reach.
        const GROUP: usize = 16;
        let (from, w) = swarm.place(world, 0);
        let groups = |lanes: &[[f32; W]]| -> Vec<[f32; GROUP]> {
            let mut groups = vec![[1e30; GROUP]; swarm.agents().div_ceil(GROUP)];
            let places = groups.as_flattened_mut().iter_mut();
            places.zip(&lanes[from..from + swarm.agents()]).for_each(|(place, lanes)| *place = lanes[w]);
            groups
        };
        let (x, y) = (groups(&swarm.x), groups(&swarm.y));
        let near = |landmark: usize| {
            let [px, py] = swarm.landmark(world, landmark);
            let mut agents = Vec::new();
            for (group, (x, y)) in x.iter().zip(&y).enumerate() {
                let mut d2 = [0.0; GROUP];
                let mut any = false;
                for k in 0..GROUP {
                    let (dx, dy) = (x[k] - px, y[k] - py);
                    d2[k] = dx.mul_add(dx, dy * dy);
                    any |= d2[k] <= self.cover2;
                }
                if any {
                    let within = (0..GROUP).filter(|&k| d2[k] <= self.cover2);
                    agents.extend(within.map(|k| (group * GROUP + k) as u32));
                }
            }
            agents
        };
        (0..swarm.agents()).map(near).collect()
    }
}

#[cfg(test)]
mod tests;
