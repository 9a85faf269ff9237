//! Drones (paper, section 5.1.2): Crazyflie 2.X quadrotors with the dynamics and the controller of gym-pybullet-drones
//! 2.1.0, integrated by rapier.
//!
//! Units are SI, z is up, quaternions are `[x, y, z, w]` and turn body vectors into world vectors; velocities and
//! angular velocities are in the world frame. Motors 0..3 are front right, rear right, rear left, front left.
//!
//! The authors' own environment for this task is not published: its physics is (the simulator's), spawn, success radius,
//! reward and the handling of crashes are this crate's, see [`Drones`].

pub mod control;
pub mod linalg;
pub mod model;
pub mod world;

mod engine;
mod episode;
mod script;

pub use script::scripted_drones;

use crate::env::{Env, Score};
use crate::error::{EnvError, check_finite, check_len};
use crate::spawn::uniform;
use episode::Episode;
use magex_core::rng::Stream;
use magex_core::task::{DroneConfig, TaskConfig, TaskName};
use model::{Craft, Effects};
use world::Laws;

/// Drones start, and landmarks hang, at this height, m.
pub const HEIGHT: f32 = 1.5;
/// A landmark is covered when the centre of a drone that has not crashed is within this distance, m.
pub const COVER_RADIUS: f64 = 0.15;
/// A command changes the target velocity of an axis by this per second, m/s².
pub const ACCELERATION: f64 = 5.0;
/// Largest target velocity, m/s.
pub const MOST_SPEED: f64 = 2.0;

/// B episodes of N drones and N landmarks, stepped together.
///
/// Positions, velocities and landmarks are `[B, N, 3]` in m and m/s, goals `[B, N]`, actions `[B, N, 3]`, rewards
/// `[B, N]`; agent_state `[B, N, 6]` are the target velocity, x and y of the body's up axis, and 1 for a drone that is out.
///
/// * **Command.** 30 per second. Each axis of the target velocity v\* changes by (+1, 0, −1) · 5 m/s² / 30 for the
///   actions (0 forward, 1 stop, 2 backward); then v\* is scaled to at most 2 m/s. A command is held for
///   `physics_hz` / 30 physics steps. In each of them the reference's PID controller ([`control`]) tracks v\* (the
///   present yaw is the target yaw) and rapier makes one step.
/// * **Spawn.** x and y uniform in the centred square of the task's side, z = 1.5 m, at least `spacing` apart; the same
///   for the landmarks.
/// * **Crash.** A drone that touches another one or the ground, tilts beyond 90°, or whose state stops being finite is
///   out for the rest of the episode, from the physics step in which it happens: its motors stop, it falls, and stays
///   where it comes to rest. It remains an obstacle, but makes no wash.
/// * **Reward.** [`DroneConfig`]; d is the distance to the own landmark and d_min that to the nearest other drone that is
///   not out. In the command in which a drone crashes it is paid in full, afterwards 0.
/// * **Score.** Success: share of landmarks with a drone that is not out within 0.15 m. Collision rate: share of drones
///   that are out; collisions per agent and step: the same divided by the commands.
///
/// Drag and ground effect are those of the reference. Its downwash ([`Craft::downwash`]) is singular: two drones at
/// almost equal height, as all are here, press each other down with 1 / Δz². Side by side at 0.3 m, the least distance of
/// the spawn, a drone 5 mm lower is pushed down with 263 times its weight and is shot into the ground (a test measures
/// it). So the default bounds the force of one upper drone by m g, its thrust in hover: a wash carries no more momentum
/// than the thrust that makes it.
pub struct Drones {
    laws: Laws,
    config: DroneConfig,
    agents: usize,
    horizon: u32,
    /// Physics steps per command.
    hold: u32,
    steps: u32,
    episodes: Vec<Episode>,
    /// `[B, N, 3]`
    landmarks: Vec<f32>,
    /// `[B, N]`
    goals: Vec<u32>,
}

impl Drones {
    /// One episode per stream, spawned as the task says. Errors if the task does not validate.
    pub fn new(task: &TaskConfig, streams: impl Iterator<Item = Stream>) -> Result<Self, EnvError> {
        check_task(task)?;
        let spacing = f64::from(task.drones.spacing);
        let (mut positions, mut landmarks) = (Vec::new(), Vec::new());
        for mut stream in streams {
            for points in [&mut positions, &mut landmarks] {
                let flat = uniform(task.agents, task.side, spacing, &mut stream);
                points.extend(flat.chunks_exact(2).flat_map(|xy| [xy[0], xy[1], HEIGHT]));
            }
        }
        let velocities = vec![0.0; positions.len()];
        Ok(Self::assemble(task, &positions, &velocities, landmarks))
    }

    /// Episodes that start level at given positions with given velocities (of at most 2 m/s to be kept: they are the first
    /// target velocities), each `[B, N, 3]`.
    pub fn from_state(
        task: &TaskConfig,
        positions: &[f32],
        velocities: &[f32],
        landmarks: &[f32],
    ) -> Result<Self, EnvError> {
        check_task(task)?;
        let expected = landmarks.len().next_multiple_of(3 * task.agents);
        check_len("landmarks", landmarks.len(), expected)?;
        check_len("positions", positions.len(), expected)?;
        check_len("velocities", velocities.len(), expected)?;
        for (field, values) in [("positions", positions), ("velocities", velocities), ("landmarks", landmarks)] {
            check_finite(field, values)?;
        }
        Ok(Self::assemble(task, positions, velocities, landmarks.to_vec()))
    }

    fn assemble(task: &TaskConfig, positions: &[f32], velocities: &[f32], landmarks: Vec<f32>) -> Self {
        let n = 3 * task.agents;
        let effects = Effects { ground: true, drag: true, downwash: true };
        let dt = 1.0 / f64::from(task.drones.physics_hz);
        let starts = positions.chunks_exact(n).zip(velocities.chunks_exact(n)).zip(landmarks.chunks_exact(n));
        Self {
            laws: Laws::new(Craft::CF2X, effects, task.drones.downwash, dt),
            config: task.drones,
            agents: task.agents,
            horizon: task.horizon,
            hold: task.drones.physics_hz / DroneConfig::COMMANDS_HZ,
            steps: 0,
            episodes: starts.map(|((p, v), landmarks)| Episode::new(p, v, landmarks)).collect(),
            landmarks,
            goals: Vec::new(),
        }
    }

    /// N.
    pub fn agents(&self) -> usize {
        self.agents
    }

    /// T.
    pub fn horizon(&self) -> u32 {
        self.horizon
    }

    /// `[B, N]` landmark of each drone; empty until they are set.
    pub fn goals(&self) -> &[u32] {
        &self.goals
    }

    /// B · N.
    fn numbers(&self) -> usize {
        self.episodes.len() * self.agents
    }
}

fn check_task(task: &TaskConfig) -> Result<(), EnvError> {
    if task.name != TaskName::Drones {
        return Err(EnvError::Task(format!("task.name: {} is not drones", task.name)));
    }
    task.validate().map_err(EnvError::Task)
}

impl Env for Drones {
    fn episodes(&self) -> usize {
        self.episodes.len()
    }

    fn steps(&self) -> u32 {
        self.steps
    }

    fn landmarks(&self) -> &[f32] {
        &self.landmarks
    }

    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("positions", out.len(), 3 * self.numbers())?;
        let drones = self.episodes.iter().flat_map(|episode| &episode.world.drones);
        for (out, drone) in out.chunks_exact_mut(3).zip(drones) {
            out.copy_from_slice(&drone.motion.pose.translation.to_array());
        }
        Ok(())
    }

    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("velocities", out.len(), 3 * self.numbers())?;
        let drones = self.episodes.iter().flat_map(|episode| &episode.world.drones);
        for (out, drone) in out.chunks_exact_mut(3).zip(drones) {
            out.copy_from_slice(&drone.motion.linvel.to_array());
        }
        Ok(())
    }

    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("agent_state", out.len(), DroneConfig::AGENT_STATE * self.numbers())?;
        let rows = out.chunks_exact_mut(DroneConfig::AGENT_STATE);
        for (out, agent_state) in rows.zip(self.episodes.iter().flat_map(Episode::agent_state)) {
            out.copy_from_slice(&agent_state);
        }
        Ok(())
    }

    fn set_goals(&mut self, goals: &[u32]) -> Result<(), EnvError> {
        check_len("goals", goals.len(), self.numbers())?;
        if let Some(place) = goals.iter().position(|&goal| goal as usize >= self.agents) {
            return Err(EnvError::Goal { place, goal: goals[place], landmarks: self.agents });
        }
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), EnvError> {
        check_len("actions", actions.len(), 3 * self.numbers())?;
        check_len("rewards", rewards.len(), self.numbers())?;
        if self.goals.len() != self.numbers() {
            return Err(EnvError::GoalsNotSet);
        }
        if self.steps >= self.horizon {
            return Err(EnvError::EpisodeOver { horizon: self.horizon });
        }
        if let Some(place) = actions.iter().position(|&action| action > 2) {
            return Err(EnvError::AxisAction { place, action: actions[place] });
        }
        self.steps += 1;
        let n = self.agents;
        let inputs =
            actions.chunks_exact(3 * n).zip(self.goals.chunks_exact(n)).zip(self.landmarks.chunks_exact(3 * n));
        let outputs = self.episodes.iter_mut().zip(rewards.chunks_exact_mut(n));
        for ((episode, rewards), ((actions, goals), landmarks)) in outputs.zip(inputs) {
            episode.prepare(goals, landmarks);
            episode.fly(&self.laws, self.hold, actions);
            episode.pay(&self.config, goals, landmarks, rewards);
            episode.observe(self.steps, landmarks);
        }
        Ok(())
    }

    fn scores(&self) -> Vec<Score> {
        let worlds = self.episodes.iter().zip(self.landmarks.chunks_exact(3 * self.agents));
        worlds.map(|(episode, landmarks)| episode.score(self.steps, self.horizon, landmarks)).collect()
    }
}

#[cfg(test)]
mod tests;
