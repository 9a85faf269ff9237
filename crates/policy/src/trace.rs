//! Every step of an episode: what was seen, what the networks said, what was done. For those that check a port of a policy.
//!
//! | format | content |
//! |---|---|
//! | [`json`] | JSON lines: one of the episode, one per step, one of its end |
//! | [`npz`] | the same arrays for NumPy, steps first |
//! | [`mcap`] | scenes for Foxglove |

pub mod json;
pub mod mcap;
pub mod npz;

use crate::acting::Decision;
use magex_core::joint_state::JointState;
use magex_core::trajectory::Shape;
use magex_nets::features::Features;
use serde_json::{Map, Value};

/// An episode of one team of N agents.
#[derive(Debug, Clone, Default)]
pub struct Trace {
    /// The metadata of the weights, and where the episode comes from.
    pub about: Map<String, Value>,
    /// E: bodies; the agents come first.
    pub bodies: usize,
    /// N.
    pub agents: usize,
    /// D.
    pub dims: usize,
    /// Choices of each component of an action.
    pub choices: Vec<usize>,
    /// Seconds from step to step.
    pub step_seconds: f32,
    /// Radii of an agent, a ball and a landmark, as they are drawn.
    pub radii: [f32; 3],
    /// Distance at which two agents touch.
    pub contact_radius: f32,
    /// The steps in order.
    pub steps: Vec<Step>,
    /// What the episode scored, by the name of the metric.
    pub metrics: Map<String, Value>,
}

/// One step: named arrays of N agents, row-major.
#[derive(Debug, Clone, Default)]
pub struct Step {
    /// Name, width per agent, values [N, width].
    pub arrays: Vec<(&'static str, Vec<usize>, Numbers)>,
}

/// Numbers of an array.
#[derive(Debug, Clone, PartialEq)]
pub enum Numbers {
    /// Single precision.
    Floats(Vec<f32>),
    /// Choices and counts.
    Bytes(Vec<u8>),
}

impl Step {
    /// What one team saw and did.
    pub fn new(
        shape: &Shape,
        state: &JointState<'_>,
        features: &Features,
        decision: &Decision,
        choices: usize,
    ) -> Self {
        let (n, d, e) = (shape.agents, shape.dims, shape.bodies);
        let mut arrays = Vec::new();
        let mut floats = |name: &'static str, inner: &[usize], values: &[f32]| {
            if !values.is_empty() {
                arrays.push((name, inner.to_vec(), Numbers::Floats(values.to_vec())));
            }
        };
        floats("positions", &[d], &state.positions[..n * d]);
        floats("velocities", &[d], &state.velocities[..n * d]);
        let targets = |k: usize| -> Vec<f32> {
            let of = |i: usize| state.goals[i * shape.goals_per_agent + k] as usize;
            (0..n)
                .flat_map(|i| {
                    let (points, at) = if k + 1 < shape.goals_per_agent {
                        (state.positions, (n + of(i)) * d)
                    } else {
                        (state.landmarks(), of(i) * d)
                    };
                    points[at..at + d].to_vec()
                })
                .collect()
        };
        floats("goals", &[d], &targets(shape.goals_per_agent - 1));
        floats("landmarks", &[d], state.landmarks());
        if e > n {
            let own = |from: &[f32]| -> Vec<f32> {
                let ball = |i: usize| (n + state.goals[i * shape.goals_per_agent] as usize) * d;
                (0..n).flat_map(|i| from[ball(i)..ball(i) + d].to_vec()).collect()
            };
            floats("balls", &[d], &own(state.positions));
            floats("ball_velocities", &[d], &own(state.velocities));
            floats("all_balls", &[d], &state.positions[n * d..e * d]);
        }
        floats("agent_state", &[shape.agent_state], state.agent_state);
        floats("logits", &[choices], &decision.logits);
        floats("probabilities", &[choices], &decision.probabilities);
        floats("memory", &[decision.memory.len() / n], &decision.memory);
        for (name, values) in [
            ("seen_goals", &features.goals),
            ("seen_nodes", &features.nodes),
            ("seen_pairs", &features.pairs),
            ("seen_neighbours", &features.neighbours),
            ("seen_vectors", &features.vectors),
        ] {
            floats(name, &[values.len() / n], values);
        }
        arrays.push(("actions", vec![shape.action_components], Numbers::Bytes(decision.actions.clone())));
        if !features.counts.is_empty() {
            arrays.push(("seen_counts", Vec::new(), Numbers::Bytes(features.counts.clone())));
        }
        Self { arrays }
    }

    /// The numbers of an array; none without it.
    pub fn floats(&self, name: &str) -> &[f32] {
        self.arrays
            .iter()
            .find_map(|(own, _, numbers)| match numbers {
                Numbers::Floats(values) if *own == name => Some(values.as_slice()),
                _ => None,
            })
            .unwrap_or_default()
    }
}
