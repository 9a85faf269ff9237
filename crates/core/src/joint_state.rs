//! Joint states: what the agents of an episode, a controller and the networks' features see.

use crate::statics::{LANDMARKS, StaticsView};
use crate::task::Group;
use crate::trajectory::Shape;

/// S joint states of E bodies each, the first N of which are agents. Statics and goals are those of Q episodes; state s
/// belongs to episode s modulo Q.
#[derive(Debug, Clone, Copy)]
pub struct JointState<'a> {
    /// [S, E, D] world units.
    pub positions: &'a [f32],
    /// [S, E, D] world units per second.
    pub velocities: &'a [f32],
    /// [S, N, X] further state of the agents, by task.
    pub agent_state: &'a [f32],
    /// [S, W] state of the world that only the critic sees; empty for most tasks.
    pub world_states: &'a [f32],
    /// [S, N, A] 1 for a choice that is allowed; empty if all are.
    pub masks: &'a [u8],
    /// [S, N] what is said of agents and states, see [`crate::trajectory::mark`]; empty for most tasks.
    pub marks: &'a [u8],
    /// [Q, ...] the static arrays of the episodes, by name.
    pub statics: StaticsView<'a>,
    /// [Q, N, K]; see [`crate::task::TaskConfig::stages`].
    pub goals: &'a [u32],
}

impl<'a> JointState<'a> {
    /// [Q, G, D] world units.
    pub fn landmarks(&self) -> &'a [f32] {
        self.statics.get(LANDMARKS)
    }
}

/// Positions [N, D] of a group of an episode, given the positions [B, E, D] of all bodies and the landmarks [B, G, D].
pub fn group_positions<'a>(
    shape: &Shape,
    (positions, landmarks): (&'a [f32], &'a [f32]),
    group: Group,
    episode: usize,
) -> &'a [f32] {
    let (points, per_episode, first) = match group {
        Group::Agents => (positions, shape.bodies, 0),
        Group::Balls => (positions, shape.bodies, shape.agents),
        Group::Landmarks => (landmarks, shape.landmarks, 0),
    };
    let from = (episode * per_episode + first) * shape.dims;
    &points[from..from + shape.agents * shape.dims]
}
