//! The reference model and the controller against a recorded flight.

use super::recording::{Mode, Physics, Trajectory};
use super::{FREE_RUN, ONE_STEP, RELATIVE, apart, turned};
use crate::report::{Report, worse};
use magex_env::drones::control::{Answer, Memory, Request};
use magex_env::drones::model::{Inputs, State};

/// Everything the model remembers of a flight.
#[derive(Debug, Clone)]
struct Flight {
    states: Vec<State>,
    lagged: Vec<[f64; 4]>,
    rpm_before: Vec<[f64; 4]>,
    rates: Vec<[f64; 3]>,
}

impl Flight {
    fn at(recording: &Trajectory, t: usize) -> Self {
        let drones = 0..recording.drones;
        Self {
            states: recording.frames[t].clone(),
            lagged: drones.clone().map(|i| recording.lagged(t, i)).collect(),
            rpm_before: drones.map(|i| recording.rpm_before(t, i)).collect(),
            rates: recording.rates.get(t).cloned().unwrap_or_default(),
        }
    }

    fn step(&mut self, recording: &Trajectory, rpm: &[[f64; 4]]) {
        let before = self.states.clone();
        for (i, &state) in before.iter().enumerate() {
            self.states[i] = match recording.physics {
                Physics::Bullet(effects) => {
                    let wash = if effects.downwash { wash(recording, &before, i) } else { 0.0 };
                    let inputs = Inputs { lagged: self.lagged[i], rpm: rpm[i], rpm_before: self.rpm_before[i], wash };
                    let loads = recording.craft.loads(&state, &inputs, effects);
                    recording.craft.integrate(&state, &loads, recording.dt)
                }
                Physics::Explicit => {
                    let (next, rates) = recording.craft.step_explicit(&state, self.rates[i], rpm[i], recording.dt);
                    self.rates[i] = rates;
                    next
                }
            };
            self.lagged[i] = state.attitude;
            self.rpm_before[i] = rpm[i];
        }
    }

    /// Largest difference from the recorded state before step `t`.
    fn apart(&self, recording: &Trajectory, t: usize) -> f64 {
        let mut worst = 0.0;
        for (ours, recorded) in self.states.iter().zip(&recording.frames[t]) {
            worst = worse(worst, difference(ours, recorded));
        }
        for (ours, recorded) in self.rates.iter().zip(recording.rates.get(t).into_iter().flatten()) {
            worst = worse(worst, apart(ours, recorded));
        }
        worst
    }
}

/// Largest difference of a coordinate over max(1, |recorded|).
pub(super) fn difference(ours: &State, recorded: &State) -> f64 {
    let mut worst = turned(ours.attitude, recorded.attitude);
    worst = worse(worst, apart(&ours.position, &recorded.position));
    worst = worse(worst, apart(&ours.velocity, &recorded.velocity));
    worse(worst, apart(&ours.spin, &recorded.spin))
}

/// Sum of the downwash of all drones above drone `i`, in their order.
fn wash(recording: &Trajectory, states: &[State], i: usize) -> f64 {
    let here = states[i].position;
    let mut sum = 0.0;
    for (j, other) in states.iter().enumerate() {
        if j != i {
            let [x, y, z] = std::array::from_fn(|d| other.position[d] - here[d]);
            sum += recording.craft.downwash(z, libm::hypot(x, y));
        }
    }
    sum
}

/// What drone `i` is asked for in control period `k`, seen from a state.
fn request(recording: &Trajectory, k: usize, i: usize, state: &State) -> Request {
    let [a, b, c, last] = recording.control[k].command[i];
    if recording.mode == Mode::Velocity {
        let length = libm::sqrt(a * a + b * b + c * c);
        let speed = if length == 0.0 { 0.0 } else { recording.speed_limit * last.abs() / length };
        Request::velocity(*state, [speed * a, speed * b, speed * c])
    } else {
        Request {
            state: *state,
            target_position: [a, b, c],
            target_velocity: [0.0; 3],
            target_yaw: Some(last),
            target_rates: [0.0; 3],
        }
    }
}

/// Intrinsic X-Y-Z angles of a rotation matrix.
pub(super) fn intrinsic(target: &[[f64; 3]; 3]) -> [f64; 3] {
    [
        libm::atan2(-target[1][2], target[2][2]),
        libm::asin(target[0][2].clamp(-1.0, 1.0)),
        libm::atan2(-target[0][1], target[0][0]),
    ]
}

/// Largest difference of angles, whole turns apart being equal.
pub(super) fn angles_apart(ours: [f64; 3], recorded: [f64; 3]) -> f64 {
    ours.iter().zip(recorded).fold(0.0, |worst, (a, b)| {
        let turn = 2.0 * std::f64::consts::PI;
        worse(worst, (a - b - turn * libm::round((a - b) / turn)).abs())
    })
}

/// Measures the model and, in closed loop, the controller.
pub(super) fn verify(recording: &Trajectory) -> Report {
    let mode = match recording.mode {
        Mode::Rpm => "open loop".to_owned(),
        Mode::Velocity => format!("velocity at {} Hz, up to {} m/s", recording.control_hz, recording.speed_limit),
        Mode::Position => format!("position at {} Hz", recording.control_hz),
    };
    let (drones, steps, hz) = (recording.drones, recording.steps(), recording.physics_hz);
    let chaotic = if recording.chaotic { ", chaotic" } else { "" };
    let content = format!("{}, {mode}, N = {drones}, {steps} steps at {hz} Hz{chaotic}", recording.physics_name);
    let mut report = Report { content, ..Report::default() };
    report.limited("one step", one_step(recording), ONE_STEP);
    report.limited("free run", free_run(recording), FREE_RUN);
    if recording.mode != Mode::Rpm {
        let (rpm, trace) = controller(recording);
        report.limited("controller rpm", rpm, RELATIVE);
        report.limited("controller target", trace, RELATIVE);
        let closed = closed_loop(recording);
        if recording.chaotic {
            let words = "chaotic: a difference of 1e-12 has grown to 1e-9 at the horizon";
            report.informative("closed loop", closed, words);
        } else {
            report.limited("closed loop", closed, FREE_RUN);
        }
    }
    report
}

fn one_step(recording: &Trajectory) -> f64 {
    (0..recording.steps()).fold(0.0, |worst, t| {
        let mut flight = Flight::at(recording, t);
        flight.step(recording, &recording.rpm[t]);
        worse(worst, flight.apart(recording, t + 1))
    })
}

/// From the initial state with the recorded rpm.
fn free_run(recording: &Trajectory) -> f64 {
    let mut flight = Flight::at(recording, 0);
    (0..recording.horizon).fold(0.0, |worst, t| {
        flight.step(recording, &recording.rpm[t]);
        worse(worst, flight.apart(recording, t + 1))
    })
}

/// The controller on the recorded states: rpm, relative; thrust and target attitude.
fn controller(recording: &Trajectory) -> (f64, f64) {
    let mut memories = vec![Memory::default(); recording.drones];
    let (mut rpm, mut trace) = (0.0, 0.0);
    for (k, recorded) in recording.control.iter().enumerate() {
        let t = k * recording.hold;
        for (i, memory) in memories.iter_mut().enumerate() {
            let answer = call(recording, memory, k, i, &recording.frames[t][i]);
            rpm = worse(rpm, apart(&answer.rpm, &recording.rpm[t][i]));
            trace = worse(trace, apart(&[answer.thrust_pwm], &[recorded.thrust_pwm[i]]));
            trace = worse(trace, angles_apart(intrinsic(&answer.target), recorded.target_euler[i]));
        }
    }
    (rpm, trace)
}

pub(super) fn call(recording: &Trajectory, memory: &mut Memory, k: usize, i: usize, state: &State) -> Answer {
    memory.call(&recording.craft, &recording.gains, &request(recording, k, i, state), recording.control_dt)
}

/// Model and controller from the initial state.
fn closed_loop(recording: &Trajectory) -> f64 {
    let mut flight = Flight::at(recording, 0);
    let mut memories = vec![Memory::default(); recording.drones];
    let mut rpm = vec![[0.0; 4]; recording.drones];
    (0..recording.horizon).fold(0.0, |worst, t| {
        if t % recording.hold == 0 {
            for (i, memory) in memories.iter_mut().enumerate() {
                rpm[i] = call(recording, memory, t / recording.hold, i, &flight.states[i]).rpm;
            }
        }
        flight.step(recording, &rpm);
        worse(worst, flight.apart(recording, t + 1))
    })
}
