//! The yardstick of Push Ball: looks a few steps ahead in a small model of what is around the agent.
//!
//! Rules ("go behind the ball, then push") lose the ball sideways all the time, because pushing is unstable. Trying what
//! happens does not: of all sequences of three actions, each held for two steps, the agent starts the one after which its
//! ball would come to rest best, and itself be best placed to push on.

use super::{Controller, check};
use crate::particles::physics::{Bodies, Forces, Motion, Pair, Physics, pack};
use crate::push_ball::REACHED;
use crate::push_ball::law::angle;
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::task::{PushBallConfig, Spawn, TaskConfig, TaskName};

/// Sequences tried at once: 5³, filled up to whole registers.
const LANES: usize = 128;
const SEQUENCES: usize = 125;
/// Steps looked ahead; an action is held for two.
const STEPS: usize = 6;
/// Bodies within these distances of the agent and of its ball take part.
const AROUND_AGENT: f32 = 0.8;
const AROUND_BALL: f32 = 0.7;
/// World units per radian that the ball must be walked around.
const ARC: f32 = 0.3;
/// Weight of the ball's way against the agent's.
const BALL_WEIGHT: f32 = 3.0;

/// Chooses an action for every agent of S states of Push Ball. Ties go to the lower action.
#[derive(Debug)]
pub struct PushBallScript {
    task: TaskConfig,
    model: Model,
}

impl PushBallScript {
    /// For teams of N agents.
    pub fn new(agents: usize) -> Self {
        Self { task: TaskConfig::of(TaskName::PushBall, agents, Spawn::Uniform), model: Model::new() }
    }
}

impl Controller for PushBallScript {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let episodes = check(&self.task, state, actions)?;
        let (n, landmarks) = (self.task.agents, state.landmarks());
        for (s, actions) in actions.chunks_exact_mut(n.max(1)).enumerate() {
            let (bodies, goals) = (4 * n * s..4 * n * (s + 1), 2 * n * (s % episodes)..);
            let world =
                World { agents: n, positions: &state.positions[bodies.clone()], velocities: &state.velocities[bodies] };
            for (i, action) in actions.iter_mut().enumerate() {
                let goal = &state.goals[goals.start + 2 * i..goals.start + 2 * i + 2];
                let landmark = goals.start + 2 * goal[1] as usize;
                self.model.load(&world, i, n + goal[0] as usize);
                *action = self.model.best([landmarks[landmark], landmarks[landmark + 1]]);
            }
        }
        Ok(())
    }
}

/// One joint state.
struct World<'a> {
    agents: usize,
    /// `[2N, 2]`
    positions: &'a [f32],
    velocities: &'a [f32],
}

impl World<'_> {
    fn position(&self, body: usize) -> [f32; 2] {
        [self.positions[2 * body], self.positions[2 * body + 1]]
    }
}

/// What the bodies of the model are.
#[derive(Debug)]
struct Kinds {
    /// Agent and agent, agent and ball, ball and ball.
    pairs: [Pair<f32>; 3],
    ball: Vec<bool>,
}

impl Bodies<f32> for Kinds {
    fn pair(&self, i: usize, j: usize) -> Pair<f32> {
        self.pairs[usize::from(self.ball[i]) + usize::from(self.ball[j])]
    }
    /// The agent and its ball; what else is around goes on as it goes.
    fn movable(&self, i: usize) -> bool {
        i < 2
    }
    fn reach2(&self) -> f32 {
        self.pairs[2].reach2
    }
}

/// The agent (body 0), its ball (body 1) and what is near them, once per sequence of actions.
#[derive(Debug)]
struct Model {
    physics: Physics<f32>,
    kinds: Kinds,
    /// x, y, vx, vy: `[bodies][LANES]`.
    state: [Vec<[f32; LANES]>; 4],
    forces: [Vec<[f32; LANES]>; 3],
    pairs: Vec<u32>,
}

impl Model {
    fn new() -> Self {
        let physics = Physics::standard();
        let pair = |touch| Pair::equal(&physics, touch);
        let (agent, ball) = (PushBallConfig::AGENT_RADIUS, PushBallConfig::BALL_RADIUS);
        let pairs = [pair(2.0 * agent), pair(PushBallConfig::PUSH_DISTANCE), pair(2.0 * ball)];
        Self {
            physics,
            kinds: Kinds { pairs, ball: Vec::new() },
            state: Default::default(),
            forces: Default::default(),
            pairs: Vec::new(),
        }
    }

    fn load(&mut self, world: &World<'_>, agent: usize, ball: usize) {
        self.state.iter_mut().for_each(Vec::clear);
        self.kinds.ball.clear();
        self.pairs.clear();
        self.pairs.push(pack(0, 1));
        self.add(world, agent);
        self.add(world, ball);
        let centres = [(world.position(agent), AROUND_AGENT), (world.position(ball), AROUND_BALL)];
        for other in (0..2 * world.agents).filter(|&other| other != agent && other != ball) {
            let at = world.position(other);
            let number = self.kinds.ball.len();
            for (k, &(centre, reach)) in centres.iter().enumerate() {
                let (dx, dy) = (at[0] - centre[0], at[1] - centre[1]);
                if dx.mul_add(dx, dy * dy) < reach * reach {
                    self.pairs.push(pack(k, number));
                    if self.kinds.ball.len() == number {
                        self.add(world, other);
                    }
                }
            }
        }
        let bodies = self.kinds.ball.len();
        self.forces.iter_mut().for_each(|lanes| lanes.resize(bodies, [0.0; LANES]));
    }

    fn add(&mut self, world: &World<'_>, body: usize) {
        let numbers = [world.positions, world.velocities].map(|all| [all[2 * body], all[2 * body + 1]]);
        for (lanes, number) in self.state.iter_mut().zip(numbers.concat()) {
            lanes.push([number; LANES]);
        }
        self.kinds.ball.push(body >= world.agents);
    }

    /// First action of the best sequence.
    fn best(&mut self, landmark: [f32; 2]) -> u8 {
        let bodies = self.kinds.ball.len();
        let mut cost = [0.0; LANES];
        for step in 0..STEPS {
            self.step(step, bodies);
            if step == STEPS - 3 || step == STEPS - 1 {
                self.charge(landmark, &mut cost);
            }
        }
        let mut best = 0;
        for (sequence, &value) in cost.iter().enumerate().take(SEQUENCES) {
            best = if value < cost[best] { sequence } else { best };
        }
        (best / 25) as u8
    }

    fn step(&mut self, step: usize, bodies: usize) {
        let [x, y, vx, vy] = &mut self.state;
        let [fx, fy, hits] = &mut self.forces;
        let forces = [&mut *fx, fy, hits].map(|lanes| &mut lanes[..bodies]);
        let [fx, fy, hits] = forces;
        let mut forces = Forces { x: fx, y: fy, hits };
        forces.sum(&self.physics, &self.kinds, (x, y), &self.pairs);
        let (u, dt) = (self.physics.sensitivity, self.physics.dt);
        let held = [25, 5, 1][step / 2];
        let thrust = |i: usize| {
            let (mut ux, mut uy) = ([0.0; LANES], [0.0; LANES]);
            if i == 0 {
                for w in 0..LANES {
                    let action = w / held % 5;
                    ux[w] = u * f32::from(i8::from(action == 1) - i8::from(action == 2));
                    uy[w] = u * f32::from(i8::from(action == 3) - i8::from(action == 4));
                }
            }
            (ux, uy)
        };
        Motion { x, y, vx, vy }.advance(&self.physics, &self.kinds, (fx, fy), thrust);
        for k in 2..bodies {
            for w in 0..LANES {
                x[k][w] = dt.mul_add(vx[k][w], x[k][w]);
                y[k][w] = dt.mul_add(vy[k][w], y[k][w]);
            }
        }
    }

    /// Adds what the present state costs each sequence: the ball's way from where it would come to rest, and the agent's
    /// way to where it could push, which matters less the nearer the ball is.
    fn charge(&self, [lx, ly]: [f32; 2], cost: &mut [f32; LANES]) {
        let [x, y, vx, vy] = &self.state;
        let coast = self.physics.dt * self.physics.keep / (1.0 - self.physics.keep);
        for (w, cost) in cost.iter_mut().enumerate() {
            let (ax, ay) = (x[1][w] - x[0][w], y[1][w] - y[0][w]);
            let (bx, by) = (lx - x[1][w], ly - y[1][w]);
            let (sx, sy) = (bx - coast * vx[1][w], by - coast * vy[1][w]);
            let (d_ab, d_bl) = (ax.mul_add(ax, ay * ay).sqrt(), bx.mul_add(bx, by * by).sqrt());
            let stop = sx.mul_add(sx, sy * sy).sqrt();
            let theta = angle(ax.mul_add(bx, ay * by), ax.mul_add(by, -(ay * bx)), d_ab * d_bl);
            let fade = (stop / REACHED as f32).min(1.0);
            let gap = (d_ab - PushBallConfig::PUSH_DISTANCE as f32).max(0.0);
            *cost += fade.mul_add(ARC.mul_add(theta, gap), BALL_WEIGHT * stop);
        }
    }
}
