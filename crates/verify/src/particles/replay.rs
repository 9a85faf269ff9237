//! Runs a recording's bodies through the kernels of the rollouts and compares.

use super::recording::{Body, Frame, Recording, Scenario};
use crate::report::{Report, worse};
use magex_core::task::PushBallConfig;
use magex_env::particles::physics::{AgentsAndBalls, Alike, Bodies, Forces, Motion, Pair, Pairs, Physics, find_pairs};
use magex_env::{CONTACT_DISTANCE, Real};

/// Largest one-step, reward and success difference of an agreeing f64 simulator.
const ONE_STEP: f64 = 1e-12;
/// Free runs are compared while a perturbation of 1e-12 has grown to no more than this.
const WELL_CONDITIONED: f64 = 1e-9;
/// Largest difference of a free run.
const FREE_RUN: f64 = 1e-7;
/// Worlds side by side: the recorded states of as many steps.
const LANES: usize = 8;

/// Bodies of any size and mass.
#[derive(Clone)]
struct Mixed<R> {
    bodies: Vec<Body>,
    physics: Physics<R>,
}

impl<R: Real> Bodies<R> for Mixed<R> {
    fn pair(&self, i: usize, j: usize) -> Pair<R> {
        let (a, b) = (&self.bodies[i], &self.bodies[j]);
        let mut pair = Pair::equal(&self.physics, a.size + b.size);
        if !(a.collide && b.collide) {
            pair.reach2 = -R::ONE;
            pair.touch2 = -R::ONE;
        }
        // Between two movable bodies the authors scale the force by the ratio of the masses.
        let ratio = if a.movable && b.movable { b.mass / a.mass } else { 1.0 };
        pair.on_first = R::from_f64(ratio);
        pair.on_second = R::from_f64(1.0 / ratio);
        pair
    }

    fn inverse_mass(&self, i: usize) -> R {
        R::from_f64(1.0 / self.bodies[i].mass)
    }

    fn movable(&self, i: usize) -> bool {
        self.bodies[i].movable
    }

    fn reach2(&self) -> R {
        let radius = self.bodies.iter().map(|body| body.size).fold(0.0, f64::max);
        Pair::equal(&self.physics, 2.0 * radius).reach2
    }
}

/// The bodies in W worlds, and a step of them.
struct World<'a, R, const W: usize, B> {
    recording: &'a Recording,
    physics: Physics<R>,
    bodies: B,
    /// x, y, vx, vy: `[bodies][W]` each.
    state: [Vec<[R; W]>; 4],
    forces: [Vec<[R; W]>; 3],
    pairs: Pairs,
}

impl<'a, R: Real, const W: usize, B: Bodies<R>> World<'a, R, W, B> {
    fn new(recording: &'a Recording, physics: Physics<R>, bodies: B) -> Self {
        let zero = || vec![[R::ZERO; W]; recording.bodies.len()];
        Self {
            recording,
            physics,
            bodies,
            state: [zero(), zero(), zero(), zero()],
            forces: [zero(), zero(), zero()],
            pairs: Pairs::new(),
        }
    }

    /// Puts world `w` into a recorded state.
    fn load(&mut self, w: usize, frame: &Frame) {
        for i in 0..self.recording.bodies.len() {
            let [x, y] = frame.positions[i];
            let [vx, vy] = frame.velocities[i];
            for (lanes, value) in self.state.iter_mut().zip([x, y, vx, vy]) {
                lanes[i][w] = R::from_f64(value);
            }
        }
    }

    /// World w does the actions of step `steps[w]`.
    fn step(&mut self, steps: [usize; W]) {
        let [x, y, vx, vy] = &mut self.state;
        let found = find_pairs(&self.bodies, (x, y), &mut self.pairs);
        let [fx, fy, hits] = &mut self.forces;
        let mut forces = Forces { x: fx, y: fy, hits };
        forces.sum(&self.physics, &self.bodies, (x, y), &self.pairs[..found]);
        let recording = self.recording;
        let control = |i: usize| {
            let (mut ux, mut uy) = ([R::ZERO; W], [R::ZERO; W]);
            if i >= recording.agents {
                return (ux, uy);
            }
            for w in 0..W {
                let [dx, dy] = recording.directions[usize::from(recording.actions[steps[w]][i])];
                ux[w] = self.physics.sensitivity * R::from_f64(dx);
                uy[w] = self.physics.sensitivity * R::from_f64(dy);
            }
            (ux, uy)
        };
        Motion { x, y, vx, vy }.advance(&self.physics, &self.bodies, (fx, fy), control);
    }

    /// Largest difference of world `w` from a frame: positions, velocities; divided by max(1, |recorded|) if `relative`.
    fn error(&self, w: usize, frame: &Frame, relative: bool) -> [f64; 2] {
        let mut worst = [0.0; 2];
        for i in 0..self.recording.bodies.len() {
            let ([x, y], [vx, vy]) = (frame.positions[i], frame.velocities[i]);
            for (k, recorded) in [x, y, vx, vy].into_iter().enumerate() {
                let scale = if relative { recorded.abs().max(1.0) } else { 1.0 };
                let ours: f64 = self.state[k][i][w].into();
                worst[k / 2] = worse(worst[k / 2], (ours - recorded).abs() / scale);
            }
        }
        worst
    }
}

/// Compares the kernels and the authors' formulas with a recording.
pub(super) fn verify(recording: &Recording) -> Report {
    let (double, single) = (physics::<f64>(recording), physics::<f32>(recording));
    let (n, agent, ball) = (recording.agents, PushBallConfig::AGENT_RADIUS, PushBallConfig::BALL_RADIUS);
    // Standard bodies go through the very code of the rollouts, which knows their kinds.
    let standard = |bodies: &[Body], size| bodies.iter().all(|&body| body == Body::standard(size));
    let (agents, balls) = recording.bodies.split_at(n);
    let mut report = if !(standard(agents, agent) && standard(balls, ball)) {
        let bodies = &recording.bodies;
        let mixed = Mixed { bodies: bodies.clone(), physics: double };
        replay(recording, mixed, Mixed { bodies: bodies.clone(), physics: single })
    } else if balls.is_empty() {
        replay(recording, Alike(Pair::equal(&double, CONTACT_DISTANCE)), Alike(Pair::equal(&single, CONTACT_DISTANCE)))
    } else {
        let kinds = AgentsAndBalls::new(&double, n, agent, ball);
        replay(recording, kinds, AgentsAndBalls::new(&single, n, agent, ball))
    };
    let (mut rewards, mut successes, mut other_overlaps) = (0.0, 0.0, 0);
    for frame in &recording.frames {
        for (i, &reward) in frame.rewards.iter().enumerate() {
            rewards = worse(rewards, (authors_reward(recording, frame, i) - reward).abs());
        }
        successes = worse(successes, (authors_success(recording, frame) - frame.success_rate).abs());
        other_overlaps += u32::from(overlaps(recording, frame) != frame.overlaps);
    }
    report.limited("reward", rewards, ONE_STEP);
    report.limited("success", successes, ONE_STEP);
    report.limited("steps with other overlaps", other_overlaps.into(), 0.0);
    report
}

/// One step from every recorded state, and the free run from the first one.
fn replay<A: Bodies<f64> + Clone, B: Bodies<f32>>(recording: &Recording, double: A, single: B) -> Report {
    let one_step_f32 = one_step(World::new(recording, physics(recording), single), true);
    let one_step = one_step(World::new(recording, physics(recording), double.clone()), false);
    let (free, free_run) = free_run(World::new(recording, physics(recording), double));
    let (agents, steps) = (recording.agents, recording.actions.len());
    let mut report =
        Report { content: format!("N = {agents}, {steps} steps, {free} of them free"), ..Report::default() };
    report.limited("one step", one_step, ONE_STEP);
    // There is no bound that holds for every recording.
    report.informative(
        "one step in f32",
        one_step_f32,
        "contacts multiply the rounding of a position by their stiffness",
    );
    report.limited("free run", free_run, FREE_RUN);
    report
}

fn physics<R: Real>(recording: &Recording) -> Physics<R> {
    Physics::new(
        recording.dt,
        recording.damping,
        recording.contact_force,
        recording.contact_margin,
        recording.sensitivity,
    )
}

/// The worst coordinate after one step from every recorded state.
fn one_step<R: Real, B: Bodies<R>>(mut world: World<'_, R, LANES, B>, relative: bool) -> f64 {
    let recording = world.recording;
    let last = recording.actions.len().saturating_sub(1);
    let mut worst = 0.0;
    for first in (0..recording.actions.len()).step_by(LANES) {
        // Lanes beyond the last step repeat it.
        let steps: [usize; LANES] = std::array::from_fn(|w| (first + w).min(last));
        for (w, &step) in steps.iter().enumerate() {
            world.load(w, &recording.frames[step]);
        }
        world.step(steps);
        for (w, &step) in steps.iter().enumerate() {
            worst = world.error(w, &recording.frames[step + 1], relative).into_iter().fold(worst, worse);
        }
    }
    worst
}

/// Steps compared and the worst position on the way.
fn free_run<B: Bodies<f64>>(mut world: World<'_, f64, 1, B>) -> (usize, f64) {
    let recording = world.recording;
    let steps = recording.divergence.iter().take_while(|&&divergence| divergence <= WELL_CONDITIONED).count();
    world.load(0, &recording.frames[0]);
    let worst = (0..steps).fold(0.0, |worst, step| {
        world.step([step]);
        worse(worst, world.error(0, &recording.frames[step + 1], false)[0])
    });
    (steps, worst)
}

/// As the authors write it: no fused operations, so that comparisons fall the same way.
fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    (dx * dx + dy * dy).sqrt()
}

/// The reward the authors' code pays. In Simple Spread it has two defects: the bonus compares the normalised distance
/// with the radius, and an agent collides with itself.
fn authors_reward(recording: &Recording, frame: &Frame, i: usize) -> f64 {
    let (n, first_landmark) = (recording.agents, recording.bodies.len());
    let (agents, landmark) = (&recording.bodies[..n], recording.landmarks[0]);
    match &recording.scenario {
        Scenario::Spread { goals, distance_unit } => {
            let goal = frame.positions[first_landmark + goals[i]];
            let normalised = distance(frame.positions[i], goal) / distance_unit;
            let bonus = if normalised <= agents[0].size + landmark.size { 1.0 } else { 0.0 };
            let hit = |&a: &usize| distance(frame.positions[a], frame.positions[i]) < agents[a].size + agents[i].size;
            -normalised + bonus - (0..n).filter(hit).count() as f64
        }
        Scenario::PushBall { goals } => {
            let [ball, goal] = [frame.positions[n + goals[i][0]], frame.positions[first_landmark + goals[i][1]]];
            let (to_ball, to_goal) = (distance(frame.positions[i], ball), distance(ball, goal));
            let bonus = if to_goal <= 2.0 * landmark.size { 1.0 } else { 0.0 };
            -(to_ball + to_goal) + bonus
        }
    }
}

/// Share of the landmarks within reach of any agent, or in Push Ball of any ball.
fn authors_success(recording: &Recording, frame: &Frame) -> f64 {
    let (bodies, landmarks) = frame.positions.split_at(recording.bodies.len());
    let first = match recording.scenario {
        Scenario::Spread { .. } => 0,
        Scenario::PushBall { .. } => recording.agents,
    };
    let covered = |(landmark, body): &(&[f64; 2], &Body)| {
        let reach = recording.bodies[first].size + body.size;
        bodies[first..].iter().any(|&position| distance(position, **landmark) <= reach)
    };
    landmarks.iter().zip(&recording.landmarks).filter(covered).count() as f64 / landmarks.len() as f64
}

/// Pairs of colliding bodies that overlap.
fn overlaps(recording: &Recording, frame: &Frame) -> usize {
    let bodies = || recording.bodies.iter().zip(&frame.positions).filter(|(body, _)| body.collide);
    let hits = |(k, (a, pa)): (usize, (&Body, &[f64; 2]))| {
        bodies().skip(k + 1).filter(|&(b, pb)| distance(*pa, *pb) < a.size + b.size).count()
    };
    bodies().enumerate().map(hits).sum()
}
