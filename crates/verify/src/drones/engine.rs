//! The drone task's own physics, rapier in f32, against a recorded flight.

use super::exact::{call, difference};
use super::recording::{Mode, Physics, Trajectory};
use super::turned;
use crate::report::{Report, worse};
use magex_core::task::Downwash;
use magex_env::drones::control::Memory;
use magex_env::drones::model::State;
use magex_env::drones::world::{Drone, Laws, World};

/// Seconds of flight that the closed loop is compared for.
const SECONDS: f64 = 2.5;
/// Control rates from which on the closed loop is compared, Hz.
const LEAST_CONTROL_HZ: f64 = 120.0;
/// Recordings count as fast from this speed limit on, m/s: upstream's own limit is 0.25.
const FAST: f64 = 1.0;
/// Bounds of the closed loop: m (slow and without drag, else), m/s, degrees.
const POSITION: f64 = 5e-3;
const POSITION_FAST: f64 = 15e-3;
const VELOCITY: f64 = 2e-2;
const ATTITUDE: f64 = 1.0;
/// Largest difference of a step, over max(1, |recorded|).
const ONE_STEP: f64 = 1e-5;
/// rapier turns a body by 2 atan(|w| dt / 2) instead of |w| dt; up to this |w| dt the difference, (|w| dt)³ / 12 in the
/// angle and half of it in the quaternion, is below the bound of a step.
const SMALL_TURN: f64 = 0.06;

/// A world in the recorded state before step `t`.
fn world(recording: &Trajectory, t: usize) -> World {
    let drones = (0..recording.drones).map(|i| {
        let mut drone = Drone::at(&recording.frames[t][i]);
        drone.remember(recording.lagged(t, i));
        drone.rpm_before = recording.rpm_before(t, i);
        drone
    });
    World::new(drones.collect())
}

/// Adds what rapier can and cannot follow.
pub(super) fn verify(recording: &Trajectory, report: &mut Report) {
    let Physics::Bullet(effects) = recording.physics else { return };
    let mut laws = Laws::new(recording.craft, effects, Downwash::Reference, recording.dt);
    laws.always = true;
    one_step(recording, &laws, report);
    let followed = recording.horizon.min((SECONDS * recording.physics_hz) as usize);
    let [position, velocity, attitude] = run(recording, &laws, followed);
    if recording.mode == Mode::Rpm {
        let words = format!("nothing corrects roundings of f32; attitude {attitude:.1e} degrees");
        report.informative("rapier open loop, m", position, words);
    } else if recording.chaotic || recording.control_hz < LEAST_CONTROL_HZ {
        let words = format!("over {followed} steps; a controller below 120 Hz amplifies roundings of f32");
        report.informative("rapier closed loop, m", position, words);
    } else {
        let bound = if recording.speed_limit >= FAST || effects.drag { POSITION_FAST } else { POSITION };
        report.limited("rapier closed loop, m", position, bound);
        report.limited("rapier closed loop, m/s", velocity, VELOCITY);
        report.limited("rapier closed loop, degrees", attitude, ATTITUDE);
    }
}

/// One step of rapier from every recorded state.
fn one_step(recording: &Trajectory, laws: &Laws, report: &mut Report) {
    let (mut motion, mut attitude, mut fast, mut fastest, mut beyond) = (0.0, 0.0, 0.0, 0.0f64, 0.0f64);
    for t in 0..recording.steps() {
        let mut world = world(recording, t);
        world.step(laws, &recording.rpm[t]);
        for (drone, recorded) in world.drones.iter().zip(&recording.frames[t + 1]) {
            let ours = drone.state();
            let turn = magex_env::drones::linalg::norm(recorded.spin) * recording.dt;
            motion = worse(motion, difference(&State { attitude: recorded.attitude, ..ours }, recorded));
            let error = turned(ours.attitude, recorded.attitude);
            if turn <= SMALL_TURN {
                attitude = worse(attitude, error);
            } else {
                // Half the missing angle, and a tenth for what comes after the cube.
                beyond = worse(beyond, error / (ONE_STEP + 1.1 * turn.powi(3) / 24.0));
                fast = worse(fast, error);
                fastest = fastest.max(turn);
            }
        }
    }
    report.limited("rapier one step, motion", motion, ONE_STEP);
    report.limited("rapier one step, attitude", attitude, ONE_STEP);
    if fastest > 0.0 {
        report.limited("rapier one step, fast turn over what it may miss", beyond, 1.0);
        let short = fastest.powi(3) / 12.0;
        let words =
            format!("rapier linearises rotations: a turn of {fastest:.3} rad in a step is short by {short:.1e}");
        report.informative("rapier one step, fast turn", fast, words);
    }
}

/// From the initial state, own controller in the loop: largest differences in m, m/s and degrees.
fn run(recording: &Trajectory, laws: &Laws, steps: usize) -> [f64; 3] {
    let mut world = world(recording, 0);
    let mut memories = vec![Memory::default(); recording.drones];
    let mut rpm = vec![[0.0; 4]; recording.drones];
    let mut worst = [0.0; 3];
    for t in 0..steps {
        if recording.mode == Mode::Rpm {
            rpm.clone_from(&recording.rpm[t]);
        } else if t % recording.hold == 0 {
            for (i, memory) in memories.iter_mut().enumerate() {
                rpm[i] = call(recording, memory, t / recording.hold, i, &world.drones[i].state()).rpm;
            }
        }
        world.step(laws, &rpm);
        for (drone, recorded) in world.drones.iter().zip(&recording.frames[t + 1]) {
            let ours = drone.state();
            let distance = |a: [f64; 3], b: [f64; 3]| (0..3).fold(0.0, |w, d| worse(w, (a[d] - b[d]).abs()));
            worst[0] = worse(worst[0], distance(ours.position, recorded.position));
            worst[1] = worse(worst[1], distance(ours.velocity, recorded.velocity));
            worst[2] = worse(worst[2], angle(ours.attitude, recorded.attitude));
        }
    }
    worst
}

fn angle(a: [f64; 4], b: [f64; 4]) -> f64 {
    let [x, y, z, w] = magex_env::drones::linalg::product(a, [-b[0], -b[1], -b[2], b[3]]);
    2.0 * libm::atan2(libm::sqrt(x * x + y * y + z * z), w.abs()).to_degrees()
}
