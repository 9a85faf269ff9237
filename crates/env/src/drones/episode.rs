//! One episode of the drone task: commands, controllers, crashes, reward, score.

use super::constants::{ACCELERATION, COVER_RADIUS, MOST_SPEED};
use super::control::{Gains, Memory, Request};
use super::linalg::{V3, norm, scale, sub};
use super::model::State;
use super::world::{Drone, Laws, World};
use crate::matching::maximum_matching;
use crate::rules::Score;
use magex_core::task::DroneConfig;

pub(super) struct Episode {
    pub(super) world: World,
    memories: Vec<Memory>,
    /// Target velocities, m/s.
    targets: Vec<V3>,
    /// The team is paid: the drone nearest to each landmark counts, whatever the goals are.
    team: bool,
    /// Distance of each drone to its landmark before the command, m; for the team, of each landmark to the drone nearest to it.
    /// Meaningless before the first command.
    before: Vec<f64>,
    /// Whether each drone was out before the command.
    was_out: Vec<bool>,
    rpm: Vec<[f64; 4]>,
    /// First command after which the landmarks were covered, 0 while it has not happened.
    arrival: u32,
    reward: f64,
}

fn vector(values: &[f32]) -> V3 {
    std::array::from_fn(|d| f64::from(values[d]))
}

impl Episode {
    /// Level drones; `positions` and `velocities` are `[N, 3]`.
    pub(super) fn new(positions: &[f32], velocities: &[f32], team: bool) -> Self {
        let state = |(position, velocity): (&[f32], &[f32])| State {
            position: vector(position),
            attitude: [0.0, 0.0, 0.0, 1.0],
            velocity: vector(velocity),
            spin: [0.0; 3],
        };
        let starts = positions.chunks_exact(3).zip(velocities.chunks_exact(3));
        let drones: Vec<Drone> = starts.map(|start| Drone::at(&state(start))).collect();
        let n = drones.len();
        Self {
            world: World::new(drones),
            memories: vec![Memory::default(); n],
            targets: velocities.chunks_exact(3).map(|v| limited(vector(v))).collect(),
            team,
            before: vec![0.0; n],
            was_out: vec![false; n],
            rpm: vec![[0.0; 4]; n],
            arrival: 0,
            reward: 0.0,
        }
    }

    /// Landmarks [N, 3] that are covered now.
    pub(super) fn covered(&self, landmarks: &[f32]) -> usize {
        self.near(landmarks).iter().filter(|drones| !drones.is_empty()).count()
    }

    /// Distance of a drone to its landmark, m.
    fn distance(&self, i: usize, goals: &[u32], landmarks: &[f32]) -> f64 {
        let goal = goals[i] as usize;
        norm(sub(self.place(i), vector(&landmarks[3 * goal..3 * goal + 3])))
    }

    /// Distance of the i-th drone to its landmark, or for the team of the i-th landmark to the nearest drone that flies; where
    /// none does it stays what it was.
    fn paid_distance(&self, i: usize, goals: &[u32], landmarks: &[f32]) -> f64 {
        if !self.team {
            return self.distance(i, goals, landmarks);
        }
        let landmark = vector(&landmarks[3 * i..3 * i + 3]);
        let flying = (0..goals.len()).filter(|&j| !self.world.drones[j].is_out());
        let nearest = flying.map(|j| norm(sub(self.place(j), landmark))).fold(f64::INFINITY, f64::min);
        if nearest.is_finite() { nearest } else { self.before[i] }
    }

    fn place(&self, i: usize) -> V3 {
        self.world.drones[i].motion.pose.translation.to_array().map(f64::from)
    }

    /// Executes a command: `actions` is `[N, 3]`, held for `hold` physics steps.
    pub(super) fn fly(&mut self, laws: &Laws, hold: u32, actions: &[u8]) {
        const CHANGE: f64 = ACCELERATION / DroneConfig::COMMANDS_HZ as f64;
        for (target, actions) in self.targets.iter_mut().zip(actions.chunks_exact(3)) {
            *target = limited(std::array::from_fn(|d| target[d] + CHANGE * (1.0 - f64::from(actions[d]))));
        }
        for _ in 0..hold {
            for (i, drone) in self.world.drones.iter().enumerate() {
                self.rpm[i] = if drone.is_out() {
                    [0.0; 4]
                } else {
                    let request = Request::velocity(drone.state(), self.targets[i]);
                    self.memories[i].call(&laws.craft, &Gains::CF2X, &request, laws.dt).rpm
                };
            }
            self.world.step(laws, &self.rpm);
            self.world.judge();
        }
        for (target, drone) in self.targets.iter_mut().zip(&self.world.drones) {
            if drone.is_out() {
                *target = [0.0; 3];
            }
        }
    }

    /// Notes what the reward of the command to come compares with.
    pub(super) fn prepare(&mut self, goals: &[u32], landmarks: &[f32]) {
        for i in 0..goals.len() {
            self.before[i] = self.paid_distance(i, goals, landmarks);
            self.was_out[i] = self.world.drones[i].is_out();
        }
    }

    /// Rewards of the command just executed, `[N]`.
    pub(super) fn pay(&mut self, config: &DroneConfig, goals: &[u32], landmarks: &[f32], rewards: &mut [f32]) {
        let mut total = 0.0;
        for (i, reward) in rewards.iter_mut().enumerate() {
            *reward = 0.0;
            // What the way to a landmark earns is an agent's own, or the team's.
            let mut sum = 0.0;
            if self.team || !self.was_out[i] {
                let distance = self.paid_distance(i, goals, landmarks);
                sum += f64::from(config.progress) * (self.before[i] - distance);
                sum += if distance <= COVER_RADIUS { f64::from(config.bonus) } else { 0.0 };
            }
            if self.was_out[i] {
                total += sum;
                continue;
            }
            let crashed = self.world.drones[i].is_out();
            let others = (0..self.world.drones.len()).filter(|&j| j != i && !self.world.drones[j].is_out());
            let nearest = others.map(|j| norm(sub(self.place(i), self.place(j)))).fold(f64::INFINITY, f64::min);
            let closeness = (1.0 - nearest / f64::from(config.proximity_radius)).max(0.0);
            sum -= if crashed { f64::from(config.crash) } else { 0.0 };
            sum -= f64::from(config.proximity) * closeness;
            sum -= f64::from(config.tilt) * steepness(f64::from(self.world.drones[i].upright()));
            *reward = sum as f32;
            total += sum;
        }
        self.reward += total;
        if self.team {
            rewards.fill((total / rewards.len() as f64) as f32);
        }
    }

    /// Looks at the landmarks after command number `step` (from 1).
    pub(super) fn observe(&mut self, step: u32, landmarks: &[f32]) {
        let n = self.world.drones.len();
        if self.arrival == 0 && self.covered(landmarks) + n / 100 >= n {
            self.arrival = step;
        }
    }

    /// The drones that are not out within reach of each landmark.
    fn near(&self, landmarks: &[f32]) -> Vec<Vec<u32>> {
        let within = |landmark: V3, i: usize| norm(sub(self.place(i), landmark)) <= COVER_RADIUS;
        let flying = |i: &usize| !self.world.drones[*i].is_out();
        let near = |landmark: &[f32]| -> Vec<u32> {
            let landmark = vector(landmark);
            let drones = (0..self.world.drones.len()).filter(flying).filter(|&i| within(landmark, i));
            drones.map(|i| i as u32).collect()
        };
        landmarks.chunks_exact(3).map(near).collect()
    }

    /// `[N, 6]`: see [`super::Flight`].
    pub(super) fn agent_state(&self) -> impl Iterator<Item = [f32; DroneConfig::AGENT_STATE]> + '_ {
        self.world.drones.iter().zip(&self.targets).map(|(drone, target)| {
            let [vx, vy, vz] = target.map(|c| c as f32);
            let r = drone.motion.pose.rotation;
            let (up_x, up_y) = (2.0 * (r.x * r.z + r.w * r.y), 2.0 * (r.y * r.z - r.w * r.x));
            [vx, vy, vz, up_x, up_y, if drone.is_out() { 1.0 } else { 0.0 }]
        })
    }

    /// The score after a number of commands, at least 1.
    pub(super) fn score(&self, commands: f64, landmarks: &[f32]) -> Score {
        let n = self.world.drones.len();
        let crashed = self.world.drones.iter().filter(|drone| drone.is_out()).count() as f64 / n as f64;
        Score {
            matched: maximum_matching(&self.near(landmarks), n),
            arrival: Some(self.arrival).filter(|&arrival| arrival > 0),
            collisions: crashed / commands,
            crashed,
            reward: self.reward,
        }
    }
}

#[cfg(test)]
impl Episode {
    /// Makes a command no number.
    pub(super) fn spoil(&mut self, drone: usize) {
        self.targets[drone][0] = f64::NAN;
    }
}

fn limited(velocity: V3) -> V3 {
    let speed = norm(velocity);
    if speed > MOST_SPEED { scale(velocity, MOST_SPEED / speed) } else { velocity }
}

/// How far a tilt, given its cosine, is beyond 45°: 0 up to there, 1 at 90°.
pub(super) fn steepness(cosine: f64) -> f64 {
    (1.0 - cosine * std::f64::consts::SQRT_2).max(0.0)
}
