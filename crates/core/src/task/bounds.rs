//! What the numbers of a trajectory can be at all: wide enough for everything that the physics does, narrow enough for arithmetic
//! in single precision. A result outside was not made by the task.

use super::TaskConfig;

/// Largest magnitudes, for every component of every step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// World units.
    pub position: f32,
    /// World units per second.
    pub velocity: f32,
    /// The further numbers of an agent's state.
    pub agent_state: f32,
}

/// Where agents, balls and landmarks can start: layouts are lines and grids of N points no more than a unit apart, around the map.
pub(super) fn start(task: &TaskConfig) -> f32 {
    2.0 * task.side + 2.0 * task.agents as f32 * task.layout_scale.max(1.0)
}

/// Of particles that are pushed with a force of 5 and by every other one with at most 31 (100 times the overlap of two balls),
/// and keep three quarters of their velocity per step of 0.1 s.
pub(super) fn of_particles(task: &TaskConfig, bodies: usize) -> Bounds {
    let velocity = 0.1 * (5.0 + 31.0 * bodies as f32) / 0.25;
    Bounds { position: start(task) + 0.1 * velocity * task.horizon as f32, velocity, agent_state: 0.0 }
}

impl TaskConfig {
    /// What the states of an episode can be.
    pub fn bounds(&self) -> Bounds {
        (self.definition().bounds)(self)
    }

    /// Smallest and largest reward of an agent in a step, if no two points are farther apart than `extent` (world units).
    pub fn reward_range(&self, extent: f32) -> [f32; 2] {
        let [low, high] = (self.definition().reward_range)(self, extent);
        // Sums in single precision.
        let slack = 1e-3 * (1.0 + low.abs() + high.abs());
        [low - slack, high + slack]
    }
}
