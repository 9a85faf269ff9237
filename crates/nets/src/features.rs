//! From states to the numbers that the networks see. One code for actors and learner: the wire carries states.
//!
//! Everything is free of translation where it can be, and its scale does not depend on the team size, so that weights
//! trained with 50 agents serve 20 or 1000. Rows are ordered [.., N]: the N agents of a joint state are neighbours.
//!
//! [`Observation`] says in numbers what an agent sees of a task. One task has formulas of its own: those of Push Ball are in
//! `push`, for tasks in which an agent's way leads to a ball and with it to a landmark. The baselines see the classical flat
//! observation vector instead: `flat`.

mod flat;
mod goal;
mod neighbours;
mod push;
mod symmetry;

use magex_core::joint_state::JointState;
use magex_core::task::{Frame, Observation, TaskConfig};
use magex_core::trajectory::Shape;

pub use flat::FlatSpec;
pub use symmetry::Symmetry;

/// What a network wants to see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureSpec {
    /// Sizes of a joint state; steps and episodes are of no account.
    pub shape: Shape,
    /// Half side of the map: the unit of absolute positions.
    pub half_side: f32,
    /// Goal positions relative to the agent (ours), or absolute (literal reading of the paper).
    pub relative_goal: bool,
    /// Nearest neighbours that an agent sees one by one; 0 for none.
    pub neighbours: usize,
    /// Node and pair features, which the graph executors read.
    pub team: bool,
    /// The flat observation vector; `None` for networks that see goal, nodes and neighbours.
    pub flat: Option<FlatSpec>,
    /// Sizes that the features are measured with.
    pub observation: Observation,
}

/// Features of R = S·N agents.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// [R, node_width]: absolute position / half side, velocity / speed, further state, offset to the ball.
    pub nodes: Vec<f32>,
    /// [R, 2D]: position and velocity in metric units, for differences between pairs.
    pub pairs: Vec<f32>,
    /// [R, goal_width]
    pub goals: Vec<f32>,
    /// [R, k, neighbour_width] offset, relative velocity, closeness, closest approach, kind.
    pub neighbours: Vec<f32>,
    /// `[R]` how many of the k are real.
    pub counts: Vec<u8>,
    /// [R, V] the flat observation vector.
    pub vectors: Vec<f32>,
    /// [S, W] the state of the whole team, once per joint state.
    pub states: Vec<f32>,
    /// [R, A] 1 for a choice that is allowed; empty if all are.
    pub masks: Vec<u8>,
    /// `[S]` 1 for a joint state that begins an episode: what is remembered ends there. Empty if none but the first one does.
    pub firsts: Vec<u8>,
    /// `[R]` the frame that each agent sees the world in; empty if that is the world's own.
    pub symmetries: Vec<Symmetry>,
}

impl FeatureSpec {
    /// What a network with these wishes sees of a task.
    pub fn new(task: &TaskConfig, relative_goal: bool, neighbours: usize, team: bool) -> Self {
        let observation = task.observation();
        Self {
            shape: task.shape(1),
            half_side: task.side / 2.0,
            relative_goal,
            neighbours,
            team,
            flat: None,
            // The letter of the paper knows no frame but the world's.
            observation: if relative_goal { observation } else { Observation { frame: Frame::World, ..observation } },
        }
    }

    /// Width of a node's features.
    pub fn node_width(&self) -> usize {
        2 * self.shape.dims + self.shape.agent_state + if self.pushes() { self.shape.dims } else { 0 }
    }

    /// Width of an agent's goal features.
    pub fn goal_width(&self) -> usize {
        self.shape.agent_state
            + match (self.relative_goal, self.pushes()) {
                (false, _) => (2 + self.shape.goals_per_agent) * self.shape.dims,
                (true, false) => self.shape.dims + self.shape.goals_per_agent * (2 * self.shape.dims + 1),
                (true, true) => push::width(self.shape.dims),
            }
    }

    /// Width of one neighbour's features.
    pub fn neighbour_width(&self) -> usize {
        let approach = if self.observation.encounters { self.shape.dims + 2 } else { 0 };
        2 * self.shape.dims + 1 + approach + usize::from(self.shape.bodies > self.shape.agents)
    }

    /// Features of all agents of the given states, [Q·N] rows. The states are [Q, E, D] with statics [B, …] and goals [B, N, K] of
    /// the B episodes that they are of, episode innermost: state q is of episode q mod B.
    pub fn compute(&self, states: &JointState<'_>) -> Features {
        if self.shape.marks > 0 {
            return self.foreign_features(states);
        }
        let (n, d, joint) = (self.shape.agents, self.shape.dims, self.shape.bodies * self.shape.dims);
        let (count, landmarks) = (states.positions.len() / joint, states.landmarks());
        let episodes = states.goals.len() / (n * self.shape.goals_per_agent);
        let mut out = Features::default();
        if self.flat.is_none() {
            out.goals.reserve(count * n * self.goal_width());
        }
        if self.neighbours > 0 {
            out.neighbours = vec![0.0; count * n * self.neighbours * self.neighbour_width()];
            out.counts = vec![0; count * n];
        }
        if self.team {
            out.nodes.reserve(count * n * self.node_width());
            out.pairs.reserve(count * n * 2 * d);
        }
        let (mut symmetries, mut near) = (Vec::with_capacity(n), Vec::with_capacity(self.neighbours + 1));
        for s in 0..count {
            let episode = s % episodes;
            let state = State {
                p: &states.positions[s * joint..(s + 1) * joint],
                v: &states.velocities[s * joint..(s + 1) * joint],
                agent_state: &states.agent_state[s * n * self.shape.agent_state..(s + 1) * n * self.shape.agent_state],
                landmarks: &landmarks[episode * self.shape.landmarks * d..(episode + 1) * self.shape.landmarks * d],
                goals: &states.goals
                    [episode * n * self.shape.goals_per_agent..(episode + 1) * n * self.shape.goals_per_agent],
                dims: d,
                agents: n,
                goals_per_agent: self.shape.goals_per_agent,
            };
            symmetries.clear();
            symmetries.extend((0..n).map(|i| self.symmetry(&state, i)));
            if let Some(flat) = self.flat {
                self.flat_features(flat, &state, &mut out);
            } else {
                for i in 0..n {
                    self.goal_features(&state, i, symmetries[i], &mut out.goals);
                }
            }
            if self.neighbours > 0 {
                let width = n * self.neighbours * self.neighbour_width();
                self.neighbour_features(
                    &state,
                    &symmetries,
                    &mut near,
                    &mut out.neighbours[s * width..(s + 1) * width],
                    &mut out.counts[s * n..(s + 1) * n],
                );
            }
            if self.team {
                self.team_features(&state, &mut out);
            }
            if self.observation.frame != Frame::World {
                out.symmetries.extend_from_slice(&symmetries);
            }
        }
        out
    }

    /// What the graph is made of, along the axes of the world: all agents of a state must see the same space.
    fn team_features(&self, state: &State<'_>, out: &mut Features) {
        let (p_scale, v_scale) = (1.0 / self.half_side, 1.0 / self.observation.speed);
        for i in 0..self.shape.agents {
            let (p, v) = (state.position(i), state.velocity(i));
            out.nodes.extend(p.iter().map(|x| x * p_scale));
            out.nodes.extend(v.iter().map(|x| x * v_scale));
            out.nodes.extend_from_slice(state.extra(i));
            if self.pushes() {
                self.ball_offset(state, i, &mut out.nodes);
            }
            out.pairs.extend(p);
            out.pairs.extend(v.iter().map(|x| x * v_scale));
        }
    }
}

/// One joint state.
struct State<'a> {
    /// [E, D]
    p: &'a [f32],
    /// [E, D]
    v: &'a [f32],
    /// [N, X]
    agent_state: &'a [f32],
    /// [G, D]
    landmarks: &'a [f32],
    /// [N, K]
    goals: &'a [u32],
    dims: usize,
    agents: usize,
    goals_per_agent: usize,
}

impl<'a> State<'a> {
    fn position(&self, body: usize) -> &'a [f32] {
        &self.p[body * self.dims..(body + 1) * self.dims]
    }

    fn velocity(&self, body: usize) -> &'a [f32] {
        &self.v[body * self.dims..(body + 1) * self.dims]
    }

    fn extra(&self, agent: usize) -> &'a [f32] {
        let width = self.agent_state.len() / self.agents;
        &self.agent_state[agent * width..(agent + 1) * width]
    }

    /// Index of an agent's k-th goal within its group.
    fn goal(&self, agent: usize, k: usize) -> usize {
        self.goals[agent * self.goals_per_agent + k] as usize
    }

    /// The body that is an agent's k-th target; `None` if that is a landmark, which the last one always is.
    fn target_body(&self, agent: usize, k: usize) -> Option<usize> {
        (k + 1 < self.goals_per_agent).then(|| self.agents + self.goal(agent, k))
    }

    fn target(&self, agent: usize, k: usize) -> &'a [f32] {
        match self.target_body(agent, k) {
            Some(body) => self.position(body),
            None => {
                let at = self.goal(agent, k) * self.dims;
                &self.landmarks[at..at + self.dims]
            }
        }
    }
}

/// to − from, filled up with zeros, and its length.
fn offset(from: &[f32], to: &[f32]) -> ([f32; 3], f32) {
    let mut out = [0.0f32; 3];
    let mut square = 0.0f32;
    for (k, (a, b)) in from.iter().zip(to).enumerate() {
        out[k] = b - a;
        square = out[k].mul_add(out[k], square);
    }
    (out, square.sqrt())
}

impl Features {
    /// None yet, with room for `count` rows like those of `other`, which has `rows` rows of teams of N agents.
    pub fn with_room(other: &Self, rows: usize, agents: usize, count: usize) -> Self {
        fn room<T>(source: &[T], rows: usize, count: usize) -> Vec<T> {
            Vec::with_capacity(source.len() / rows.max(1) * count)
        }
        let (states, joint) = (count / agents.max(1), rows / agents.max(1));
        Self {
            nodes: room(&other.nodes, rows, count),
            pairs: room(&other.pairs, rows, count),
            goals: room(&other.goals, rows, count),
            neighbours: room(&other.neighbours, rows, count),
            counts: room(&other.counts, rows, count),
            vectors: room(&other.vectors, rows, count),
            states: room(&other.states, joint, states),
            masks: room(&other.masks, rows, count),
            firsts: room(&other.firsts, joint, states),
            symmetries: room(&other.symmetries, rows, count),
        }
    }

    /// Appends the rows `from..from + count` of the `rows` of `other`: whole joint states of N agents.
    pub fn append(&mut self, other: &Self, (from, count): (usize, usize), rows: usize, agents: usize) {
        fn copy<T: Copy>(to: &mut Vec<T>, source: &[T], from: usize, count: usize, rows: usize) {
            // Most kinds of features are not there: no division for them.
            if source.is_empty() {
                return;
            }
            let width = source.len() / rows.max(1);
            to.extend_from_slice(&source[from * width..(from + count) * width]);
        }
        copy(&mut self.nodes, &other.nodes, from, count, rows);
        copy(&mut self.pairs, &other.pairs, from, count, rows);
        copy(&mut self.goals, &other.goals, from, count, rows);
        copy(&mut self.neighbours, &other.neighbours, from, count, rows);
        copy(&mut self.counts, &other.counts, from, count, rows);
        copy(&mut self.symmetries, &other.symmetries, from, count, rows);
        copy(&mut self.masks, &other.masks, from, count, rows);
        copy(&mut self.firsts, &other.firsts, from / agents, count / agents, rows / agents);
        copy(&mut self.vectors, &other.vectors, from, count, rows);
        copy(&mut self.states, &other.states, from / agents, count / agents, rows / agents);
    }
}

#[cfg(test)]
mod tests;
