//! Runs a recording's bodies through the kernels of the rollouts and compares.

use super::recording::{Body, Frame, Recording, Scenario};
use crate::report::{Report, worse};
use magex_core::task::PushBallConfig;
use magex_env::particles::physics::{AgentsAndBalls, Alike, Bodies, Pair, Physics};
use magex_env::particles::swarm::Swarm;
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
fn replay<A: Bodies<f64> + Clone, B: Bodies<f32> + Clone>(recording: &Recording, double: A, single: B) -> Report {
    let (agents, steps) = (recording.agents, recording.actions.len());
    let free = recording.divergence.iter().take_while(|&&divergence| divergence <= WELL_CONDITIONED).count();
    let mut report =
        Report { content: format!("N = {agents}, {steps} steps, {free} of them free"), ..Report::default() };
    report.limited("one step", one_step(recording, &double, false), ONE_STEP);
    // There is no bound that holds for every recording.
    let words = "contacts multiply the rounding of a position by their stiffness";
    report.informative("one step in f32", one_step(recording, &single, true), words);
    let mut world = worlds::<f64, 1, A>(recording, &recording.frames[..1], double);
    let free_run = recording.actions[..free].iter().zip(&recording.frames[1..]).fold(0.0, |worst, (actions, frame)| {
        world.step(0, actions);
        worse(worst, apart(&world, std::slice::from_ref(frame), false)[0])
    });
    report.limited("free run", free_run, FREE_RUN);
    report
}

fn physics<R: Real>(recording: &Recording) -> Physics<R> {
    let Recording { dt, damping, contact_force, contact_margin, sensitivity, .. } = *recording;
    Physics::new(dt, damping, contact_force, contact_margin, sensitivity)
}

/// Worlds in recorded states.
fn worlds<R: Real, const W: usize, B: Bodies<R>>(recording: &Recording, frames: &[Frame], kinds: B) -> Swarm<R, W, B> {
    let bodies = recording.bodies.len();
    let numbers = |points: fn(&Frame) -> &[[f64; 2]]| -> Vec<R> {
        let moving = frames.iter().flat_map(|frame| points(frame)[..bodies].as_flattened());
        moving.map(|&number| R::from_f64(number)).collect()
    };
    let (positions, velocities) = (numbers(|frame| &frame.positions), numbers(|frame| &frame.velocities));
    Swarm::new(physics(recording), kinds, (recording.agents, bodies), [&positions, &velocities, &[]], None)
}

/// Largest difference of worlds from recorded frames: positions, velocities; over max(1, |recorded|) if `relative`.
fn apart<R: Real, const W: usize, B: Bodies<R>>(worlds: &Swarm<R, W, B>, frames: &[Frame], relative: bool) -> [f64; 2] {
    let bodies = worlds.bodies();
    let mut ours = vec![R::ZERO; 2 * bodies * frames.len()];
    let difference = |ours: &[R], points: fn(&Frame) -> &[[f64; 2]]| {
        let recorded = frames.iter().flat_map(|frame| points(frame)[..bodies].as_flattened());
        ours.iter().zip(recorded).fold(0.0, |worst, (&ours, &recorded)| {
            let scale = if relative { recorded.abs().max(1.0) } else { 1.0 };
            let ours: f64 = ours.into();
            worse(worst, (ours - recorded).abs() / scale)
        })
    };
    worlds.write_positions(&mut ours);
    let positions = difference(&ours, |frame| &frame.positions);
    worlds.write_velocities(&mut ours);
    [positions, difference(&ours, |frame| &frame.velocities)]
}

/// The worst coordinate after one step from every recorded state.
fn one_step<R: Real, B: Bodies<R> + Clone>(recording: &Recording, kinds: &B, relative: bool) -> f64 {
    recording.actions.chunks(LANES).enumerate().fold(0.0, |worst, (block, actions)| {
        let (first, last) = (LANES * block, LANES * block + actions.len());
        let mut worlds = worlds::<R, LANES, B>(recording, &recording.frames[first..last], kinds.clone());
        worlds.step(0, &actions.concat());
        apart(&worlds, &recording.frames[first + 1..=last], relative).into_iter().fold(worst, worse)
    })
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
