//! From states to the numbers that the networks see. One code for actors and learner: the wire carries states.
//!
//! Everything is free of translation where it can be, and its scale does not depend on the team size, so that weights
//! trained with 50 agents serve 20 or 1000. Rows are ordered [.., N]: the N agents of a joint state are neighbours.

/// Joint states to compute features of: S of them, N agents each.
#[derive(Debug, Clone, Copy)]
pub struct JointStates<'a> {
    /// N.
    pub agents: usize,
    /// D: 2 or 3.
    pub dims: usize,
    /// K: targets per agent.
    pub targets_per_agent: usize,
    /// [S, N, D] world units.
    pub positions: &'a [f32],
    /// [S, N, D] world units per second.
    pub velocities: &'a [f32],
    /// [S, N, K, D] positions of the targets.
    pub targets: &'a [f32],
}

/// What a network wants to see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureSpec {
    /// Space dimensions.
    pub dims: usize,
    /// Targets per agent.
    pub targets: usize,
    /// Half side of the map: the unit of absolute positions.
    pub half_side: f32,
    /// Goal positions relative to the agent (ours), or absolute (literal reading of the paper).
    pub relative_goal: bool,
    /// Nearest neighbours of the `local` executor; 0 for none.
    pub neighbours: usize,
}

/// Terminal speed of an agent: 2 units per second (0.1 · 5 / 0.25 of the physics).
const SPEED: f32 = 2.0;
/// Within this distance the direction to a goal fades, so that it has no jump at the goal.
const NEAR: f32 = 0.3;
/// Neighbours farther than this do not matter to the `local` executor.
const REACH: f32 = 1.0;
/// Distance at which a goal counts as reached.
const REACHED: f32 = 0.15;
/// Diameter of an agent.
const DIAMETER: f32 = 0.2;

/// Features of R = S·N agents.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// [R, node_width]: absolute position / half side, velocity / 2.
    pub nodes: Vec<f32>,
    /// [R, 2D]: position and velocity in metric units, for differences between pairs.
    pub pairs: Vec<f32>,
    /// [R, goal_width]
    pub goals: Vec<f32>,
    /// [R, k, 2D + 1] offset, relative velocity, closeness.
    pub neighbours: Vec<f32>,
    /// `[R]` how many of the k are real.
    pub counts: Vec<u8>,
}

impl FeatureSpec {
    /// Width of a node's features.
    pub fn node_width(&self) -> usize {
        2 * self.dims
    }

    /// Width of an agent's goal features.
    pub fn goal_width(&self) -> usize {
        if self.relative_goal { self.dims + self.targets * (2 * self.dims + 1) } else { (2 + self.targets) * self.dims }
    }

    /// Width of one neighbour's features.
    pub fn neighbour_width(&self) -> usize {
        2 * self.dims + 1
    }

    /// Features of all agents of all states.
    pub fn compute(&self, states: &JointStates<'_>) -> Features {
        let rows = states.positions.len() / self.dims;
        let mut out = Features::default();
        out.goals.reserve(rows * self.goal_width());
        for r in 0..rows {
            self.goal_features(states, r, &mut out.goals);
        }
        if self.neighbours == 0 {
            let (p_scale, v_scale) = (1.0 / self.half_side, 1.0 / SPEED);
            out.nodes.reserve(rows * 2 * self.dims);
            out.pairs.reserve(rows * 2 * self.dims);
            for (p, v) in states.positions.chunks_exact(self.dims).zip(states.velocities.chunks_exact(self.dims)) {
                out.nodes.extend(p.iter().map(|x| x * p_scale));
                out.nodes.extend(v.iter().map(|x| x * v_scale));
                out.pairs.extend(p);
                out.pairs.extend(v.iter().map(|x| x * v_scale));
            }
        } else {
            let width = self.neighbours * self.neighbour_width();
            out.neighbours = vec![0.0; rows * width];
            out.counts = vec![0; rows];
            let joint = states.agents * self.dims;
            let mut near = Vec::with_capacity(states.agents);
            for s in 0..rows / states.agents {
                self.neighbour_features(
                    &states.positions[s * joint..(s + 1) * joint],
                    &states.velocities[s * joint..(s + 1) * joint],
                    &mut near,
                    &mut out.neighbours[s * states.agents * width..(s + 1) * states.agents * width],
                    &mut out.counts[s * states.agents..(s + 1) * states.agents],
                );
            }
        }
        out
    }

    fn goal_features(&self, states: &JointStates<'_>, r: usize, out: &mut Vec<f32>) {
        let d = self.dims;
        let p = &states.positions[r * d..(r + 1) * d];
        let v = &states.velocities[r * d..(r + 1) * d];
        let targets = &states.targets[r * self.targets * d..(r + 1) * self.targets * d];
        out.extend(v.iter().map(|x| x / SPEED));
        if !self.relative_goal {
            out.extend(p.iter().map(|x| x / self.half_side));
            out.extend(targets.iter().map(|x| x / self.half_side));
            return;
        }
        for target in targets.chunks_exact(d) {
            let mut offset = [0.0f32; 3];
            let mut square = 0.0f32;
            for k in 0..d {
                offset[k] = target[k] - p[k];
                square = offset[k].mul_add(offset[k], square);
            }
            let distance = square.sqrt();
            let (direction, squash) = (1.0 / distance.max(NEAR), 1.0 / (1.0 + distance));
            out.extend(offset[..d].iter().map(|x| x * direction));
            out.extend(offset[..d].iter().map(|x| x * squash));
            out.push(if distance <= REACHED { 1.0 } else { 0.0 });
        }
    }

    /// The k nearest agents within reach, nearest first, ties by index.
    fn neighbour_features(
        &self,
        p: &[f32],
        v: &[f32],
        near: &mut Vec<(f32, usize)>,
        out: &mut [f32],
        counts: &mut [u8],
    ) {
        let (d, k) = (self.dims, self.neighbours);
        let agents = p.len() / d;
        let width = self.neighbour_width();
        // Agents sorted along x: only those within reach of one another on this axis are looked at.
        let mut order: Vec<usize> = (0..agents).collect();
        order.sort_by(|&a, &b| p[a * d].total_cmp(&p[b * d]).then(a.cmp(&b)));
        for (at, &i) in order.iter().enumerate() {
            near.clear();
            let mut look = |j: usize| -> bool {
                if (p[j * d] - p[i * d]).abs() > REACH {
                    return false;
                }
                let mut square = 0.0f32;
                for c in 0..d {
                    let offset = p[j * d + c] - p[i * d + c];
                    square = offset.mul_add(offset, square);
                }
                if square <= REACH * REACH {
                    // Insertion into a short sorted list.
                    let place = near.iter().position(|&(s, other)| (square, j) < (s, other)).unwrap_or(near.len());
                    if place < k {
                        near.insert(place, (square, j));
                        near.truncate(k);
                    }
                }
                true
            };
            for &j in order[..at].iter().rev() {
                if !look(j) {
                    break;
                }
            }
            for &j in &order[at + 1..] {
                if !look(j) {
                    break;
                }
            }
            counts[i] = near.len() as u8;
            for (slot, &(square, j)) in near.iter().enumerate() {
                let out = &mut out[(i * k + slot) * width..(i * k + slot + 1) * width];
                for c in 0..d {
                    out[c] = p[j * d + c] - p[i * d + c];
                    out[d + c] = (v[j * d + c] - v[i * d + c]) / SPEED;
                }
                out[2 * d] = (DIAMETER / square.sqrt().max(1e-6)).min(2.0);
            }
        }
    }
}

impl Features {
    /// Appends the rows `from..from + count` of `other`.
    pub fn append(&mut self, other: &Self, from: usize, count: usize, rows: usize) {
        fn copy<T: Copy>(to: &mut Vec<T>, source: &[T], from: usize, count: usize, rows: usize) {
            let width = source.len() / rows.max(1);
            to.extend_from_slice(&source[from * width..(from + count) * width]);
        }
        copy(&mut self.nodes, &other.nodes, from, count, rows);
        copy(&mut self.pairs, &other.pairs, from, count, rows);
        copy(&mut self.goals, &other.goals, from, count, rows);
        copy(&mut self.neighbours, &other.neighbours, from, count, rows);
        copy(&mut self.counts, &other.counts, from, count, rows);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(neighbours: usize) -> FeatureSpec {
        FeatureSpec { dims: 2, targets: 1, half_side: 5.0, relative_goal: true, neighbours }
    }

    #[test]
    fn goal_features_are_translation_free_and_fade_at_the_goal() {
        let at = |x: f32, y: f32, gx: f32, gy: f32| {
            let states = JointStates {
                agents: 1,
                dims: 2,
                targets_per_agent: 1,
                positions: &[x, y],
                velocities: &[1.0, 0.0],
                targets: &[gx, gy],
            };
            spec(0).compute(&states).goals
        };
        assert_eq!(at(0.0, 0.0, 3.0, 4.0), at(1.0, 2.0, 4.0, 6.0));
        assert_eq!(at(0.0, 0.0, 3.0, 4.0), vec![0.5, 0.0, 0.6, 0.8, 0.5, 4.0 / 6.0, 0.0]);
        assert_eq!(at(0.0, 0.0, 0.0, 0.0), vec![0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn neighbours_are_the_nearest_within_reach() {
        let positions = [0.0, 0.0, 0.5, 0.0, 0.0, 0.1, 3.0, 0.0, -0.9, 0.0];
        let states = JointStates {
            agents: 5,
            dims: 2,
            targets_per_agent: 1,
            positions: &positions,
            velocities: &[0.0; 10],
            targets: &[0.0; 10],
        };
        let features = spec(2).compute(&states);
        assert_eq!(features.counts, [2, 2, 2, 0, 2]);
        assert_eq!(features.neighbours[..10], [0.0, 0.1, 0.0, 0.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.4]);
    }
}
