//! What an agent sees, written straight into the caller's array. The formulas are those of the features of `magex-nets`
//! (`features/flat.rs`, `features/goal.rs`, `features/neighbours.rs`); tests/golden holds numbers that it made.

use magex_core::task::{Frame, Observation, TaskConfig};
use magex_core::trajectory::Shape;
use wide::f32x8;

/// Encounters farther ahead than this do not matter, seconds.
const AHEAD: f32 = 2.0;

/// Which numbers an agent sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Seen {
    /// The classical vector. With `goals` the offsets to the agent's own goals stand for those to all landmarks and balls.
    Vector { goals: bool },
    /// Nothing: the caller reads the state.
    Nothing,
    /// The own goals and the nearest bodies, free of translation and of the size of the team.
    Goal { neighbours: usize },
}

/// Writes observations.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observer {
    pub(crate) seen: Seen,
    shape: Shape,
    /// 1 / half side of the map.
    length: f32,
    sizes: Observation,
}

/// One world.
#[derive(Clone, Copy)]
pub(crate) struct World<'a> {
    /// [E, D]
    pub(crate) positions: &'a [f32],
    /// [E, D]
    pub(crate) velocities: &'a [f32],
    /// [N, X]
    pub(crate) agent_state: &'a [f32],
    /// [G, D]
    pub(crate) landmarks: &'a [f32],
    /// [N, K]
    pub(crate) goals: &'a [u32],
}

/// Memory between calls.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scratch {
    points: Vec<f32>,
    order: Vec<u32>,
    near: Vec<(f32, u32)>,
}

impl Observer {
    pub(crate) fn new(task: &TaskConfig, seen: Seen) -> Self {
        let sizes = Observation { frame: Frame::World, ..task.observation() };
        Self { seen, shape: task.shape(1), length: 1.0 / (task.side / 2.0), sizes }
    }

    /// V: numbers that an agent sees.
    pub(crate) fn width(&self) -> usize {
        let s = &self.shape;
        match self.seen {
            Seen::Vector { goals } => {
                let targets = if goals { s.goals_per_agent } else { s.bodies - s.agents + s.landmarks };
                (2 + targets + s.agents - 1) * s.dims + s.agent_state
            }
            Seen::Nothing => 0,
            Seen::Goal { neighbours } => self.own_width() + neighbours * self.neighbour_width(),
        }
    }

    fn own_width(&self) -> usize {
        let s = &self.shape;
        s.dims + s.goals_per_agent * (2 * s.dims + 1) + (s.goals_per_agent - 1) * s.dims + s.agent_state
    }

    fn neighbour_width(&self) -> usize {
        let s = &self.shape;
        let approach = if self.sizes.encounters { s.dims + 2 } else { 0 };
        2 * s.dims + 1 + approach + usize::from(s.bodies > s.agents)
    }

    /// Overwrites `out` [N, V] with what the agents of a world see.
    pub(crate) fn write(&self, world: World<'_>, scratch: &mut Scratch, out: &mut [f32]) {
        match (self.seen, self.shape.dims) {
            (Seen::Nothing, _) => {}
            // As many registers as it takes to hold whole points.
            (Seen::Vector { goals }, 2) => self.vector::<2, 1>(goals, world, scratch, out),
            (Seen::Vector { goals }, _) => self.vector::<3, 3>(goals, world, scratch, out),
            (Seen::Goal { neighbours }, 2) => self.goal::<2>(neighbours, world, scratch, out),
            (Seen::Goal { neighbours }, _) => self.goal::<3>(neighbours, world, scratch, out),
        }
    }

    /// Velocity / speed, position, further state, then offsets: to landmarks and balls or to the own goals, to the other agents.
    fn vector<const D: usize, const R: usize>(
        &self,
        goals: bool,
        world: World<'_>,
        scratch: &mut Scratch,
        out: &mut [f32],
    ) {
        let (s, length, speed) = (&self.shape, self.length, 1.0 / self.sizes.speed);
        let (agents, balls) = world.positions.split_at(s.agents * D);
        // All that a row has offsets to is one list, so that it is written in one run. From row to row one other agent changes.
        let points = &mut scratch.points;
        points.clear();
        if goals {
            points.resize(s.goals_per_agent * D, 0.0);
        } else {
            points.extend_from_slice(world.landmarks);
            points.extend_from_slice(balls);
        }
        let others = points.len();
        points.extend_from_slice(&agents[D..]);
        let head = 2 * D + s.agent_state;
        for (i, row) in out.chunks_exact_mut(self.width()).enumerate() {
            let (p, v) = (world.position::<D>(i), world.velocity::<D>(i));
            let (own, rest) = row.split_at_mut(head);
            for c in 0..D {
                own[c] = v[c] * speed;
                own[D + c] = p[c] * length;
            }
            // Loops of a known length: a call to copy so few numbers takes longer.
            own[2 * D..].iter_mut().zip(world.extra(s, i)).for_each(|(to, x)| *to = *x);
            if goals {
                for (k, place) in points[..others].chunks_exact_mut(D).enumerate() {
                    let target = world.target::<D>(s, i, k).1;
                    (0..D).for_each(|c| place[c] = target[c]);
                }
            }
            offsets::<D, R>(points, p, length, rest);
            if let Some(place) = points.get_mut(others + i * D..others + (i + 1) * D) {
                (0..D).for_each(|c| place[c] = p[c]);
            }
        }
    }

    /// Velocity / speed; per goal: the offset faded and squashed, 1 where it is reached, and for a ball its velocity / speed;
    /// further state; the nearest bodies.
    fn goal<const D: usize>(&self, neighbours: usize, world: World<'_>, scratch: &mut Scratch, out: &mut [f32]) {
        let (s, o) = (&self.shape, &self.sizes);
        let speed = 1.0 / o.speed;
        self.sort_along_x::<D>(world, scratch);
        for (i, row) in out.chunks_exact_mut(self.width()).enumerate() {
            let mut at = 0;
            let mut put = |value: f32| {
                row[at] = value;
                at += 1;
            };
            world.velocity::<D>(i).iter().for_each(|v| put(v * speed));
            let mut from = world.position::<D>(i);
            for k in 0..s.goals_per_agent {
                let (body, to) = world.target::<D>(s, i, k);
                let (offset, square) = between::<D>(from, to);
                let distance = square.sqrt();
                let (faded, squashed) = (1.0 / distance.max(o.fade_radius), 1.0 / (1.0 + distance));
                offset.iter().for_each(|x| put(x * faded));
                offset.iter().for_each(|x| put(x * squashed));
                put(if distance <= o.success_radius { 1.0 } else { 0.0 });
                if let Some(body) = body {
                    world.velocity::<D>(body).iter().for_each(|v| put(v * speed));
                }
                from = to;
            }
            world.extra(s, i).iter().for_each(|x| put(*x));
            let (_, rest) = row.split_at_mut(self.own_width());
            rest.fill(0.0);
            if !self.is_out(world, i) && neighbours > 0 {
                self.nearest::<D>(neighbours, world, i, scratch);
                for (out, &(square, j)) in rest.chunks_exact_mut(self.neighbour_width()).zip(&scratch.near) {
                    self.neighbour::<D>(world, (i, j as usize), square, out);
                }
            }
        }
    }

    fn is_out(&self, world: World<'_>, body: usize) -> bool {
        let gone = |flag| world.extra(&self.shape, body)[flag] > 0.0;
        body < self.shape.agents && self.sizes.out.is_some_and(gone)
    }

    /// Those that can be seen, sorted along x.
    fn sort_along_x<const D: usize>(&self, world: World<'_>, scratch: &mut Scratch) {
        scratch.order.clear();
        scratch.order.extend((0..self.shape.bodies as u32).filter(|&j| !self.is_out(world, j as usize)));
        let x = |j: u32| world.positions[j as usize * D];
        scratch.order.sort_unstable_by(|&a, &b| x(a).total_cmp(&x(b)).then(a.cmp(&b)));
    }

    /// Fills `near` with the k nearest bodies within reach of an agent, nearest first, ties by index. Its ball is none.
    fn nearest<const D: usize>(&self, k: usize, world: World<'_>, i: usize, scratch: &mut Scratch) {
        let s = &self.shape;
        let Scratch { order, near, .. } = scratch;
        near.clear();
        let own = if s.goals_per_agent > 1 { s.agents + world.goals[i * s.goals_per_agent] as usize } else { i };
        let here = world.position::<D>(i);
        let reach2 = self.sizes.sensing_radius * self.sizes.sensing_radius;
        let key = |j: u32| (world.positions[j as usize * D], j);
        let place = order.partition_point(|&j| key(j).0.total_cmp(&here[0]).then(j.cmp(&(i as u32))).is_lt());
        // Beyond the farthest of k known ones along x alone, nothing can be nearer.
        let mut look = |j: u32| {
            let there = world.position::<D>(j as usize);
            let along = there[0] - here[0];
            let limit = if near.len() == k { near[k - 1].0 } else { reach2 };
            if along * along > limit {
                return false;
            }
            let square = between::<D>(here, there).1;
            if square <= reach2 && j as usize != own && j as usize != i {
                let at = near.iter().position(|&other| (square, j) < other).unwrap_or(near.len());
                if at < k {
                    near.truncate(k - 1);
                    near.insert(at, (square, j));
                }
            }
            true
        };
        order[..place].iter().rev().all(|&j| look(j));
        order[place..].iter().all(|&j| look(j));
    }

    /// Body j as agent i sees it.
    fn neighbour<const D: usize>(&self, world: World<'_>, (i, j): (usize, usize), square: f32, out: &mut [f32]) {
        let o = &self.sizes;
        let offset = between::<D>(world.position::<D>(i), world.position::<D>(j)).0;
        let velocity = between::<D>(world.velocity::<D>(i), world.velocity::<D>(j)).0;
        for c in 0..D {
            out[c] = offset[c];
            out[D + c] = velocity[c] / o.speed;
        }
        out[2 * D] = (o.contact_radius / square.sqrt().max(1e-6)).min(2.0);
        let mut at = 2 * D + 1;
        if o.encounters {
            let (mut closing, mut speed, mut nearest) = (0.0f32, 0.0f32, 0.0f32);
            for c in 0..D {
                closing = offset[c].mul_add(-velocity[c], closing);
                speed = velocity[c].mul_add(velocity[c], speed);
            }
            let time = (closing / speed.max(1e-4)).clamp(0.0, AHEAD);
            for c in 0..D {
                let miss = velocity[c].mul_add(time, offset[c]);
                nearest = miss.mul_add(miss, nearest);
                out[at + c] = (2.0 * miss).clamp(-1.0, 1.0);
            }
            out[at + D] = time / AHEAD;
            out[at + D + 1] = (o.contact_radius / nearest.sqrt().max(1e-6)).min(2.0);
            at += D + 2;
        }
        if self.shape.bodies > self.shape.agents {
            out[at] = if j < self.shape.agents { 0.0 } else { 1.0 };
        }
    }
}

impl<'a> World<'a> {
    fn position<const D: usize>(&self, body: usize) -> &'a [f32] {
        &self.positions[body * D..(body + 1) * D]
    }

    fn velocity<const D: usize>(&self, body: usize) -> &'a [f32] {
        &self.velocities[body * D..(body + 1) * D]
    }

    fn extra(&self, shape: &Shape, agent: usize) -> &'a [f32] {
        &self.agent_state[agent * shape.agent_state..(agent + 1) * shape.agent_state]
    }

    /// An agent's k-th goal: the body that it is, unless it is a landmark, and where it is.
    fn target<const D: usize>(&self, shape: &Shape, agent: usize, k: usize) -> (Option<usize>, &'a [f32]) {
        let goal = self.goals[agent * shape.goals_per_agent + k] as usize;
        if k + 1 < shape.goals_per_agent {
            return (Some(shape.agents + goal), self.position::<D>(shape.agents + goal));
        }
        (None, &self.landmarks[goal * D..(goal + 1) * D])
    }
}

/// to − from, and its squared length.
#[inline(always)]
fn between<const D: usize>(from: &[f32], to: &[f32]) -> ([f32; D], f32) {
    let offset: [f32; D] = std::array::from_fn(|c| to[c] - from[c]);
    (offset, offset.iter().fold(0.0, |square, x| x.mul_add(*x, square)))
}

/// Writes (points − here) · length: R registers of whole points at a time, the last ones point by point.
#[inline(always)]
fn offsets<const D: usize, const R: usize>(points: &[f32], here: &[f32], length: f32, out: &mut [f32]) {
    let lanes: [f32x8; R] = std::array::from_fn(|r| f32x8::new(std::array::from_fn(|k| here[(8 * r + k) % D])));
    let (groups, to) = (points.chunks_exact(8 * R), out.chunks_exact_mut(8 * R));
    let done = groups.len() * 8 * R;
    for (to, group) in to.zip(groups) {
        for ((to, group), here) in to.as_chunks_mut::<8>().0.iter_mut().zip(group.as_chunks::<8>().0).zip(lanes) {
            *to = ((f32x8::new(*group) - here) * length).to_array();
        }
    }
    for (to, point) in out[done..].chunks_exact_mut(D).zip(points[done..].chunks_exact(D)) {
        for c in 0..D {
            to[c] = (point[c] - here[c]) * length;
        }
    }
}
