//! Drones (paper, section 5.1.2): Crazyflie 2.X quadrotors with the dynamics and the controller of gym-pybullet-drones
//! 2.1.0, integrated by rapier. Units are SI, z is up, quaternions are `[x, y, z, w]` and turn body vectors into world vectors; velocities and
//! angular velocities are in the world frame. Motors 0..3 are front right, rear right, rear left, front left.
//!
//! The authors' own environment for this task is not published: its physics is (the simulator's), spawn, success radius,
//! reward and the handling of crashes are this crate's, see [`Flight`].

mod constants;
pub mod control;
pub mod linalg;
pub mod model;
pub mod world;

mod engine;
mod episode;

use crate::particles::placement::uniform;
use crate::rules::{Rules, Score, Starts};
use episode::Episode;
use magex_core::error::FieldError;
use magex_core::rng::Stream;
use magex_core::statics::LANDMARKS;
use magex_core::task::{DroneConfig, RewardTarget, TaskConfig};
use model::{Craft, Effects};
use world::{Drone, Laws};

pub use constants::{ACCELERATION, COVER_RADIUS, HEIGHT, MOST_SPEED};

/// The rules of B episodes of N drones and N landmarks.
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
/// Drag and ground effect are those of the reference. Its downwash ([`Craft::downwash`]) is singular: side by side at 0.3 m,
/// the least distance of the spawn, a drone 5 mm lower is pushed down with 263 times its weight and is shot into the ground
/// (a test measures it). So the default bounds the force of one upper drone by m g, its thrust in hover: a wash carries no
/// more momentum than the thrust that makes it.
///
/// Positions that are given with velocities of more than 2 m/s do not keep them: they are the first target velocities.
pub struct Flight {
    laws: Laws,
    config: DroneConfig,
    agents: usize,
    /// Physics steps per command.
    hold: u32,
    episodes: Vec<Episode>,
    /// `[B, N, 3]`
    landmarks: Vec<f32>,
}

/// Draws the start of one episode.
pub(crate) fn start(task: &TaskConfig, stream: &mut Stream, starts: &mut Starts) -> Result<(), FieldError> {
    let spacing = f64::from(task.drones()?.spacing);
    let mut draw = || -> Vec<f32> {
        let flat = uniform(task.agents, task.side, spacing, stream);
        flat.chunks_exact(2).flat_map(|xy| [xy[0], xy[1], HEIGHT]).collect()
    };
    starts.positions.extend(draw());
    starts.extend(LANDMARKS, &draw());
    Ok(())
}

impl Flight {
    /// The rules of episodes that start there.
    pub(crate) fn new(task: &TaskConfig, starts: &Starts) -> Result<Self, FieldError> {
        let (n, config) = (3 * task.agents, *task.drones()?);
        let effects = Effects { ground: true, drag: true, downwash: true };
        let dt = 1.0 / f64::from(config.physics_hz);
        let team = task.reward_target == RewardTarget::Team;
        let states = starts.positions.chunks_exact(n).zip(starts.velocities.chunks_exact(n));
        Ok(Self {
            laws: Laws::new(Craft::CF2X, effects, config.downwash, dt),
            config,
            agents: task.agents,
            hold: config.physics_hz / DroneConfig::COMMANDS_HZ,
            episodes: states.map(|(positions, velocities)| Episode::new(positions, velocities, team)).collect(),
            landmarks: starts.landmarks().to_vec(),
        })
    }

    fn drones(&self) -> impl Iterator<Item = &Drone> {
        self.episodes.iter().flat_map(|episode| &episode.world.drones)
    }

    fn landmarks(&self, episode: usize) -> &[f32] {
        &self.landmarks[3 * self.agents * episode..3 * self.agents * (episode + 1)]
    }
}

impl Rules for Flight {
    fn step(&mut self, step: u32, goals: &[u32], actions: &[u8], rewards: &mut [f32]) {
        let n = self.agents;
        let inputs = actions.chunks_exact(3 * n).zip(goals.chunks_exact(n)).zip(self.landmarks.chunks_exact(3 * n));
        let outputs = self.episodes.iter_mut().zip(rewards.chunks_exact_mut(n));
        for ((episode, rewards), ((actions, goals), landmarks)) in outputs.zip(inputs) {
            episode.prepare(goals, landmarks);
            episode.fly(&self.laws, self.hold, actions);
            episode.pay(&self.config, goals, landmarks, rewards);
            episode.observe(step, landmarks);
        }
    }

    fn write_positions(&self, out: &mut [f32]) {
        for (out, drone) in out.chunks_exact_mut(3).zip(self.drones()) {
            out.copy_from_slice(&drone.motion.pose.translation.to_array());
        }
    }

    fn write_velocities(&self, out: &mut [f32]) {
        for (out, drone) in out.chunks_exact_mut(3).zip(self.drones()) {
            out.copy_from_slice(&drone.motion.linvel.to_array());
        }
    }

    fn write_agent_state(&self, out: &mut [f32]) {
        let rows = out.chunks_exact_mut(DroneConfig::AGENT_STATE);
        for (out, agent_state) in rows.zip(self.episodes.iter().flat_map(Episode::agent_state)) {
            out.copy_from_slice(&agent_state);
        }
    }

    fn covered(&self, episode: usize) -> usize {
        self.episodes[episode].covered(self.landmarks(episode))
    }

    fn score(&self, episode: usize, commands: f64, _: &[u32]) -> Score {
        self.episodes[episode].score(commands, self.landmarks(episode))
    }
}

#[cfg(test)]
mod tests;
