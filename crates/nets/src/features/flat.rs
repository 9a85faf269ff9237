//! The classical flat observation vector of the multi-agent particle environments, and the state of the whole team.

use super::{FeatureSpec, Features, State, offset};
use magex_core::config::Observes;
use magex_core::joint_state::JointState;
use magex_core::trajectory::mark;

/// What the flat observation vector holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlatSpec {
    /// All landmarks and balls, or the agent's own goals.
    pub observes: Observes,
    /// Whether landmarks, balls and agents stand in the order of their distance, not of their index.
    pub nearest_first: bool,
    /// Whether the vector ends with the agent's index, one-hot.
    pub agent_index: bool,
    /// Whether a critic sees the state of the whole team.
    pub states: bool,
}

impl FeatureSpec {
    /// V: width of the flat observation vector, 0 without one.
    pub fn vector_width(&self) -> usize {
        let s = &self.shape;
        self.flat.map_or(0, |flat| {
            let targets = match flat.observes {
                Observes::Landmarks => s.bodies - s.agents + s.landmarks,
                Observes::Goals => s.goals_per_agent,
            };
            let index = if flat.agent_index { s.agents } else { 0 };
            if s.marks > 0 {
                return s.agent_state + index;
            }
            (2 + targets + s.agents - 1) * s.dims + s.agent_state + index
        })
    }

    /// W: width of the state of the whole team, 0 if no critic sees it.
    pub fn state_width(&self) -> usize {
        let s = &self.shape;
        let width = match (s.marks, s.world_state) {
            (0, _) => (2 * s.bodies + s.landmarks) * s.dims + s.agents * s.agent_state,
            (_, 0) => s.agents * s.agent_state,
            (_, width) => width,
        };
        self.flat.filter(|flat| flat.states).map_or(0, |_| width)
    }

    /// What an external environment lets agents see: its observations as they are, and the state of the world or, where there is
    /// none, the observations of all agents.
    pub(super) fn foreign_features(&self, states: &JointState<'_>) -> Features {
        let s = &self.shape;
        let index = self.flat.is_some_and(|flat| flat.agent_index);
        let mut out = Features { masks: states.masks.to_vec(), ..Features::default() };
        out.vectors.reserve(states.marks.len() * self.vector_width());
        for row in 0..states.marks.len() {
            out.vectors.extend_from_slice(&states.agent_state[row * s.agent_state..(row + 1) * s.agent_state]);
            if index {
                out.vectors.extend((0..s.agents).map(|j| f32::from(u8::from(j == row % s.agents))));
            }
        }
        if self.state_width() > 0 {
            out.states = if s.world_state > 0 { states.world_states } else { states.agent_state }.to_vec();
        }
        out.firsts = states.marks.chunks(s.agents).map(|marks| u8::from(marks[0] & mark::FIRST != 0)).collect();
        out
    }

    /// Velocity / speed, position, then offsets: to the landmarks and the balls (or to the agent's own goals), to the other
    /// agents; by index or nearest first. Lengths are in half sides of the map.
    pub(super) fn flat_features(&self, flat: FlatSpec, state: &State<'_>, out: &mut Features) {
        let (s, d) = (&self.shape, self.shape.dims);
        let (length, speed) = (1.0 / self.half_side, 1.0 / self.observation.speed);
        for i in 0..s.agents {
            let (p, to) = (state.position(i), &mut out.vectors);
            to.extend(state.velocity(i).iter().map(|v| v * speed));
            to.extend(p.iter().map(|p| p * length));
            to.extend_from_slice(state.extra(i));
            let mut put = |mut group: Vec<&[f32]>| {
                if flat.nearest_first {
                    // Stable: equals stay in the order of their index.
                    group.sort_by(|a, b| offset(p, a).1.total_cmp(&offset(p, b).1));
                }
                group.into_iter().for_each(|place| to.extend(place.iter().zip(p).map(|(t, p)| (t - p) * length)));
            };
            match flat.observes {
                Observes::Landmarks => {
                    put(state.landmarks.chunks_exact(d).collect());
                    put((s.agents..s.bodies).map(|ball| state.position(ball)).collect());
                }
                // Goals have an order of their own: the ball, then its landmark.
                Observes::Goals => (0..s.goals_per_agent).for_each(|k| put(vec![state.target(i, k)])),
            }
            put((0..s.agents).filter(|&j| j != i).map(|j| state.position(j)).collect());
            if flat.agent_index {
                to.extend((0..s.agents).map(|j| f32::from(u8::from(j == i))));
            }
        }
        if flat.states {
            let to = &mut out.states;
            to.extend(state.p.iter().map(|p| p * length));
            to.extend(state.v.iter().map(|v| v * speed));
            to.extend(state.landmarks.iter().map(|p| p * length));
            to.extend_from_slice(state.agent_state);
        }
    }
}
