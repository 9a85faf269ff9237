//! B worlds of moving bodies, W to a block: their state, their contacts and a step of them. What a task makes of it
//! (goals, reward, score) is the task's.

use super::cells::Cells;
use super::physics::{Bodies, Forces, Motion, Pairs, Physics, find_pairs};
use super::real::Real;
use std::ops::Range;

/// The worlds, E bodies each; the first N of them act. Array element `[block · E + i][w]` belongs to body i of world
/// block · W + w; the lanes of the last block that have no world hold bodies far apart, at rest.
#[derive(Debug, Clone)]
pub struct Swarm<R, const W: usize, B> {
    worlds: usize,
    agents: usize,
    bodies: usize,
    physics: Physics<R>,
    kinds: B,
    pub(crate) x: Vec<[R; W]>,
    pub(crate) y: Vec<[R; W]>,
    vx: Vec<[R; W]>,
    vy: Vec<[R; W]>,
    /// Contact forces and overlaps at the present positions: the reward after a step and the motion of the next one
    /// share one look at the pairs.
    fx: Vec<[R; W]>,
    fy: Vec<[R; W]>,
    pub(crate) hits: Vec<[R; W]>,
    /// Large worlds (W = 1) compare neighbours only.
    pub(crate) cells: Option<Cells<R>>,
    pairs: Pairs,
    /// `[B, N, 2]`
    pub(crate) landmarks: Vec<R>,
    /// `[E]` one block's actions, lanes innermost; those of bodies that do not act stay 0.
    actions: Vec<[u8; W]>,
}

impl<R: Real, const W: usize, B: Bodies<R>> Swarm<R, W, B> {
    /// Worlds with the given positions and velocities `[B, E, 2]`, E = `bodies` of which `agents` act, and landmarks
    /// `[B, N, 2]`. A `cells_over` the side of the map, if given and W = 1, finds neighbours by cells.
    pub fn new(
        physics: Physics<R>,
        kinds: B,
        (agents, bodies): (usize, usize),
        [positions, velocities, landmarks]: [&[R]; 3],
        cells_over: Option<f64>,
    ) -> Self {
        let worlds = positions.len() / (2 * bodies);
        let blocks = worlds.div_ceil(W);
        let zero = vec![[R::ZERO; W]; blocks * bodies];
        let cells = cells_over.filter(|_| W == 1);
        let mut swarm = Self {
            worlds,
            agents,
            bodies,
            physics,
            x: (0..blocks * bodies).map(|k| [R::from_f64((k % bodies) as f64); W]).collect(),
            y: zero.clone(),
            vx: zero.clone(),
            vy: zero.clone(),
            fx: zero.clone(),
            fy: zero.clone(),
            hits: zero,
            cells: cells.map(|side| Cells::new(bodies, side, Into::<f64>::into(kinds.reach2()).sqrt())),
            kinds,
            pairs: Vec::new(),
            landmarks: landmarks.to_vec(),
            actions: vec![[0; W]; bodies],
        };
        for world in 0..worlds {
            for i in 0..bodies {
                let from = 2 * (world * bodies + i);
                let (k, w) = swarm.place(world, i);
                (swarm.x[k][w], swarm.y[k][w]) = (positions[from], positions[from + 1]);
                (swarm.vx[k][w], swarm.vy[k][w]) = (velocities[from], velocities[from + 1]);
            }
        }
        for block in 0..blocks {
            swarm.find_contacts(block);
        }
        swarm
    }

    /// Place and lane of a body in the arrays.
    pub(crate) fn place(&self, world: usize, body: usize) -> (usize, usize) {
        (world / W * self.bodies + body, world % W)
    }

    /// Places of a block's bodies.
    pub(crate) fn block(&self, block: usize) -> Range<usize> {
        block * self.bodies..(block + 1) * self.bodies
    }

    /// E.
    pub fn bodies(&self) -> usize {
        self.bodies
    }

    pub(crate) fn worlds(&self) -> usize {
        self.worlds
    }

    pub(crate) fn agents(&self) -> usize {
        self.agents
    }

    /// A landmark of a world.
    #[inline(always)]
    pub(crate) fn landmark(&self, world: usize, landmark: usize) -> [R; 2] {
        let at = 2 * (world * self.agents + landmark);
        [self.landmarks[at], self.landmarks[at + 1]]
    }

    /// One step of a block: moves its bodies, then looks for contacts. `actions` is `[worlds of the block, N]`.
    pub fn step(&mut self, block: usize, actions: &[u8]) {
        for (w, world) in actions.chunks_exact(self.agents).enumerate() {
            for (lanes, &action) in self.actions.iter_mut().zip(world) {
                lanes[w] = action;
            }
        }
        self.advance(block);
        self.find_contacts(block);
    }

    fn advance(&mut self, block: usize) {
        let n = self.block(block);
        let mut motion = Motion {
            x: &mut self.x[n.clone()],
            y: &mut self.y[n.clone()],
            vx: &mut self.vx[n.clone()],
            vy: &mut self.vy[n.clone()],
        };
        let forces = (&self.fx[n.clone()], &self.fy[n]);
        let (u, actions) = (self.physics.sensitivity, &self.actions);
        motion.advance(&self.physics, &self.kinds, forces, |i| {
            // Plain loops without branches: what the compiler turns into vectors.
            let (mut ux, mut uy) = ([R::ZERO; W], [R::ZERO; W]);
            let a = &actions[i];
            for w in 0..W {
                ux[w] = u * R::from(i8::from(a[w] == 1) - i8::from(a[w] == 2));
                uy[w] = u * R::from(i8::from(a[w] == 3) - i8::from(a[w] == 4));
            }
            (ux, uy)
        });
    }

    /// Contact forces and overlaps at the present positions of a block.
    fn find_contacts(&mut self, block: usize) {
        let n = self.block(block);
        let positions = (&self.x[n.clone()], &self.y[n.clone()]);
        let mut forces = Forces { x: &mut self.fx[n.clone()], y: &mut self.fy[n.clone()], hits: &mut self.hits[n] };
        // Both ways list the pairs in the same order, so that they give the same bits; a pair too many adds nothing.
        let found = match &mut self.cells {
            None => find_pairs(&self.kinds, positions, &mut self.pairs),
            Some(cells) => {
                cells.sort(positions.0.as_flattened(), positions.1.as_flattened());
                cells.pairs(self.kinds.reach2(), &mut self.pairs);
                self.pairs.len()
            }
        };
        forces.sum(&self.physics, &self.kinds, positions, &self.pairs[..found]);
    }

    /// Writes `[B, E, 2]`.
    pub fn write_positions(&self, out: &mut [R]) {
        self.interleave(&self.x, &self.y, out);
    }

    /// Writes `[B, E, 2]`.
    pub fn write_velocities(&self, out: &mut [R]) {
        self.interleave(&self.vx, &self.vy, out);
    }

    fn interleave(&self, x: &[[R; W]], y: &[[R; W]], out: &mut [R]) {
        for (world, out) in out.chunks_exact_mut(2 * self.bodies).enumerate() {
            let (from, w) = self.place(world, 0);
            let lanes = x[from..from + self.bodies].iter().zip(&y[from..from + self.bodies]);
            for (out, (x, y)) in out.chunks_exact_mut(2).zip(lanes) {
                (out[0], out[1]) = (x[w], y[w]);
            }
        }
    }
}
