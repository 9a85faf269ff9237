//! The classical flat observation vector of the multi-agent particle environments, and the state of the whole team.

use super::{FeatureSpec, Features, State};
use magex_core::config::Observes;

/// What the flat observation vector holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlatSpec {
    /// All landmarks and balls, or the agent's own goals.
    pub observes: Observes,
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
            (2 + targets + s.agents - 1) * s.dims + s.agent_state + index
        })
    }

    /// W: width of the state of the whole team, 0 if no critic sees it.
    pub fn state_width(&self) -> usize {
        let s = &self.shape;
        let width = (2 * s.bodies + s.landmarks) * s.dims + s.agents * s.agent_state;
        self.flat.filter(|flat| flat.states).map_or(0, |_| width)
    }

    /// Velocity / speed, position, then offsets: to the landmarks and the balls (or to the agent's own goals), to the other
    /// agents in order of their index. Lengths are in half sides of the map.
    pub(super) fn flat_features(&self, flat: FlatSpec, state: &State<'_>, out: &mut Features) {
        let (s, d) = (&self.shape, self.shape.dims);
        let (length, speed) = (1.0 / self.half_side, 1.0 / self.observation.speed);
        for i in 0..s.agents {
            let (p, v, to) = (state.position(i), state.velocity(i), &mut out.vectors);
            let toward =
                |target: &[f32], to: &mut Vec<f32>| to.extend(target.iter().zip(p).map(|(t, p)| (t - p) * length));
            to.extend(v.iter().map(|v| v * speed));
            to.extend(p.iter().map(|p| p * length));
            to.extend_from_slice(state.extra(i));
            match flat.observes {
                Observes::Landmarks => {
                    state.landmarks.chunks_exact(d).for_each(|landmark| toward(landmark, to));
                    (s.agents..s.bodies).for_each(|ball| toward(state.position(ball), to));
                }
                Observes::Goals => (0..s.goals_per_agent).for_each(|k| toward(state.target(i, k), to)),
            }
            (0..s.agents).filter(|&j| j != i).for_each(|j| toward(state.position(j), to));
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
