//! The classical flat observation vector of the multi-agent particle environments, and the state of the whole team.

use super::{FeatureSpec, Features, State, offset};
use magex_core::config::Observes;

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
