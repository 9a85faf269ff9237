//! The drones of one episode between two commands of the motors.
//!
//! Forces are those of the reference ([`Craft::loads`], f64, from the f32 state); rapier integrates. Far from each
//! other and from the ground rapier has nothing to say beyond its own integration of a free body, so there the same
//! arithmetic is done here: the same bits (a test holds both against each other), without the cost of its pipeline.

use super::engine::{
    CYLINDER_HALF_HEIGHT, CYLINDER_RADIUS, Engine, FORESIGHT, Motion, REACH, Touch, parameters, upright,
};
use super::model::{Craft, Effects, Inputs, State};
use magex_core::task::Downwash;
use rapier3d::parry::query::intersection_test;
use rapier3d::parry::shape::Cylinder;
use rapier3d::prelude::*;

/// Room beyond rapier's foresight in which its pipeline already runs, m: more than all roundings.
const MARGIN: f32 = 0.005;
/// A crashed drone that rests on the ground for this many steps becomes scenery.
const RESTING: u32 = 15;

/// Why a drone is out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crash {
    /// It touched another drone.
    Contact,
    /// It touched the ground.
    Ground,
    /// Its body z axis points below the horizon.
    Tilt,
    /// Its state stopped being numbers; it stays where it was last.
    NotFinite,
}

/// A drone.
#[derive(Debug, Clone, Copy)]
pub struct Drone {
    pub(crate) motion: Motion,
    before: Pose,
    /// rpm of the previous step.
    pub rpm_before: [f64; 4],
    pub(crate) crash: Option<Crash>,
    pub(crate) fixed: bool,
    resting: u32,
}

impl Drone {
    /// A drone with a state, as if it had been there before.
    pub fn at(state: &State) -> Self {
        let vector = |v: [f64; 3]| Vector::new(v[0] as f32, v[1] as f32, v[2] as f32);
        let [x, y, z, w] = state.attitude.map(|c| c as f32);
        let rotation = Rotation::from_xyzw(x, y, z, w);
        Self {
            motion: Motion {
                pose: Pose::from_parts(vector(state.position), rotation),
                linvel: vector(state.velocity),
                angvel: vector(state.spin),
            },
            before: Pose::from_parts(vector(state.position), rotation),
            rpm_before: [0.0; 4],
            crash: None,
            fixed: false,
            resting: 0,
        }
    }

    /// Its state in f64.
    pub fn state(&self) -> State {
        let vector = |v: Vector| v.to_array().map(f64::from);
        State {
            position: vector(self.motion.pose.translation),
            attitude: quaternion(self.motion.pose.rotation),
            velocity: vector(self.motion.linvel),
            spin: vector(self.motion.angvel),
        }
    }

    /// Sets the attitude before the previous step.
    pub fn remember(&mut self, attitude: [f64; 4]) {
        let [x, y, z, w] = attitude.map(|c| c as f32);
        self.before.rotation = Rotation::from_xyzw(x, y, z, w);
    }

    /// The place half-way through the previous step, in the present attitude.
    fn half_way(&self) -> Pose {
        Pose::from_parts(0.5 * (self.before.translation + self.motion.pose.translation), self.motion.pose.rotation)
    }

    /// Whether it has crashed.
    pub fn is_out(&self) -> bool {
        self.crash.is_some()
    }

    /// R_zz: the cosine of the tilt.
    pub(crate) fn upright(&self) -> f32 {
        let r = self.motion.pose.rotation;
        1.0 - 2.0 * (r.x * r.x + r.y * r.y)
    }

    /// Height of the lowest point of the cylinder over the ground, m.
    fn clearance(&self) -> f32 {
        let c = self.upright().clamp(-1.0, 1.0);
        let edge = CYLINDER_HALF_HEIGHT * c.abs() + CYLINDER_RADIUS * libm::sqrtf(1.0 - c * c);
        self.motion.pose.translation.z - edge
    }

    fn freeze(&mut self, last: Motion) {
        self.motion = Motion { pose: last.pose, linvel: Vector::ZERO, angvel: Vector::ZERO };
        (self.crash, self.fixed) = (Some(self.crash.unwrap_or(Crash::NotFinite)), true);
    }
}

pub(crate) fn quaternion(r: Rotation) -> [f64; 4] {
    [r.x, r.y, r.z, r.w].map(f64::from)
}

/// What is the same for all worlds of a task.
#[derive(Debug, Clone, Copy)]
pub struct Laws {
    pub(crate) craft: Craft,
    pub(crate) effects: Effects,
    pub(crate) downwash: Downwash,
    pub(crate) dt: f64,
    /// Run rapier's pipeline in every step (for checks).
    pub always: bool,
    properties: MassProperties,
    parameters: IntegrationParameters,
}

impl Laws {
    /// Laws for drones of this kind.
    pub fn new(craft: Craft, effects: Effects, downwash: Downwash, dt: f64) -> Self {
        let parameters = parameters(dt as f32, craft.most_speed as f32);
        Self {
            craft,
            effects: Effects { downwash: effects.downwash && downwash != Downwash::Off, ..effects },
            downwash,
            dt,
            always: false,
            properties: Engine::properties(&craft, parameters),
            parameters,
        }
    }

    /// Force along body z on a drone from another one, N.
    fn wash(&self, on: &Drone, from: &Drone) -> f64 {
        let d = from.motion.pose.translation - on.motion.pose.translation;
        let [x, y, z] = d.to_array().map(f64::from);
        let force = self.craft.downwash(z, libm::sqrt(x * x + y * y));
        if self.downwash == Downwash::Limited { force.max(-self.craft.weight()) } else { force }
    }
}

/// The drones of an episode.
pub struct World {
    /// `[N]`
    pub drones: Vec<Drone>,
    /// Made when something first comes within its reach.
    engine: Option<Box<Engine>>,
    /// Force and torque on each drone in this step.
    loads: Vec<(Vector, Vector)>,
    touches: Vec<Touch>,
    /// Downwash on one drone from each other one.
    washes: Vec<f64>,
}

impl World {
    /// A world of these drones.
    pub fn new(drones: Vec<Drone>) -> Self {
        let n = drones.len();
        Self {
            drones,
            engine: None,
            loads: vec![(Vector::ZERO, Vector::ZERO); n],
            touches: vec![Touch::default(); n],
            washes: Vec::with_capacity(n),
        }
    }

    /// One physics step with a command of the motors per drone.
    pub fn step(&mut self, laws: &Laws, rpm: &[[f64; 4]]) {
        self.find_loads(laws, rpm);
        self.touches.fill(Touch::default());
        let near = laws.always || self.near();
        let before = self.drones.iter().map(|drone| drone.motion);
        if near {
            let engine = self.engine.get_or_insert_with(|| {
                let engine = Engine::new(before, laws.parameters, &laws.craft);
                Box::new(engine)
            });
            for (i, (drone, &(force, torque))) in self.drones.iter().zip(&self.loads).enumerate() {
                if drone.fixed {
                    engine.fix(i);
                }
                engine.place(i, &drone.motion);
                engine.load(i, force, torque);
            }
            engine.step();
            engine.mark_contacts(&mut self.touches);
        }
        for (i, (drone, &(force, torque))) in self.drones.iter_mut().zip(&self.loads).enumerate() {
            let before = drone.motion;
            (drone.before, drone.rpm_before) = (before.pose, rpm[i]);
            if drone.fixed {
                continue;
            }
            let engine = if near { self.engine.as_ref() } else { None };
            drone.motion = match engine {
                Some(engine) => engine.motion(i),
                None => free(laws, &before, force, torque),
            };
            if !drone.motion.is_finite() || engine.is_some_and(|engine| engine.is_quarantined(i)) {
                drone.freeze(before);
            }
        }
    }

    /// Force and torque on each drone. A drone that is out has no motors, makes no wash and feels none.
    fn find_loads(&mut self, laws: &Laws, rpm: &[[f64; 4]]) {
        for i in 0..self.drones.len() {
            let drone = &self.drones[i];
            if drone.fixed {
                self.loads[i] = (Vector::ZERO, Vector::ZERO);
                continue;
            }
            let mut wash = 0.0;
            if laws.effects.downwash && !drone.is_out() {
                self.washes.clear();
                for (j, other) in self.drones.iter().enumerate() {
                    if j != i && !other.is_out() {
                        self.washes.push(laws.wash(drone, other));
                    }
                }
                // In an order that does not depend on the numbers of the drones.
                self.washes.sort_unstable_by(f64::total_cmp);
                wash = self.washes.iter().sum();
            }
            let inputs =
                Inputs { lagged: quaternion(drone.before.rotation), rpm: rpm[i], rpm_before: drone.rpm_before, wash };
            let loads = laws.craft.loads(&drone.state(), &inputs, laws.effects);
            let vector = |v: [f64; 3]| Vector::new(v[0] as f32, v[1] as f32, v[2] as f32);
            let (force, torque) = (vector(loads.force), vector(loads.moment));
            self.loads[i] = (force, torque);
            if !(force.is_finite() && torque.is_finite()) {
                // Nothing of this may reach rapier.
                self.loads[i] = (Vector::ZERO, Vector::ZERO);
                let last = drone.motion;
                self.drones[i].freeze(last);
            }
        }
    }

    /// Whether some drone is so near to another one or to the ground that rapier could find a contact in this step:
    /// it looks where the drones are now, as far as its foresight.
    fn near(&self) -> bool {
        let foresight = FORESIGHT + MARGIN;
        self.drones.iter().enumerate().any(|(i, drone)| {
            let low = !drone.fixed && drone.motion.pose.translation.z < REACH + foresight;
            low || self.drones[..i].iter().any(|other| {
                let reach = 2.0 * REACH + foresight;
                let d = drone.motion.pose.translation - other.motion.pose.translation;
                !(drone.fixed && other.fixed) && d.length_squared() < reach * reach
            })
        })
    }

    /// Finds the drones that crashed in the step just done and takes them out.
    pub(crate) fn judge(&mut self) {
        self.mark_overlaps();
        for (drone, touch) in self.drones.iter_mut().zip(&self.touches) {
            if drone.fixed {
                continue;
            }
            let grounded = touch.ground || drone.clearance() <= 0.0;
            if drone.is_out() {
                drone.rest(grounded || touch.drone);
            } else if grounded {
                drone.crash = Some(Crash::Ground);
            } else if touch.drone {
                drone.crash = Some(Crash::Contact);
            } else if drone.upright() < 0.0 {
                drone.crash = Some(Crash::Tilt);
            }
        }
    }

    /// Pairs that overlap after the step or half-way through it. Drones one above the other overlap over 50 mm of way: two
    /// in flight close at up to 4 m/s, 33 mm per step of 120 Hz, but one may be falling; so seen, up to 12 m/s.
    fn mark_overlaps(&mut self) {
        for i in 1..self.drones.len() {
            for j in 0..i {
                let (a, b) = (&self.drones[i], &self.drones[j]);
                if overlap(&a.motion.pose, &b.motion.pose) || overlap(&a.half_way(), &b.half_way()) {
                    (self.touches[i].drone, self.touches[j].drone) = (true, true);
                }
            }
        }
    }
}

/// Whether the cylinders of two drones overlap.
fn overlap(a: &Pose, b: &Pose) -> bool {
    if (a.translation - b.translation).length_squared() > 4.0 * REACH * REACH {
        return false;
    }
    let shape = Cylinder::new(CYLINDER_HALF_HEIGHT, CYLINDER_RADIUS);
    // Two cylinders are a supported pair of shapes, so there is always an answer.
    intersection_test(&(*a * upright()), &shape, &(*b * upright()), &shape).is_ok_and(|answer| answer.intersecting)
}

impl Drone {
    /// Counts the rest of a crashed drone.
    fn rest(&mut self, on_something: bool) {
        let still = self.motion.linvel.length() < 0.05 && self.motion.angvel.length() < 0.5;
        self.resting = if on_something && still { self.resting + 1 } else { 0 };
        self.fixed = self.resting >= RESTING;
        if self.fixed {
            (self.motion.linvel, self.motion.angvel) = (Vector::ZERO, Vector::ZERO);
        }
    }
}

/// A step of a body that touches nothing, operation by operation as rapier 0.36 does it: external forces into
/// velocities, the speed limits, then the pose, with a linearised and normalised rotation.
fn free(laws: &Laws, before: &Motion, force: Vector, torque: Vector) -> Motion {
    let dt = laws.parameters.dt;
    let inv_mass = Vector::splat(laws.properties.inv_mass);
    let mass = inv_mass.map(|m| 1.0 / m);
    let force = force + Vector::new(0.0, 0.0, -(laws.craft.gravity as f32)) * mass * 1.0;
    let inverse_inertia = laws.properties.world_inv_inertia(&before.pose.rotation);
    let mut linvel = before.linvel + force * inv_mass * dt;
    let mut angvel = before.angvel + inverse_inertia * torque * dt;
    let most = laws.parameters.max_linear_velocity();
    let speed = linvel.length();
    if speed > most {
        linvel *= most / speed;
    }
    let most = std::f32::consts::FRAC_PI_4 * laws.parameters.inv_dt();
    let rate = angvel.length();
    if rate > most {
        angvel *= most / rate;
    }
    let half = angvel * (dt * 0.5);
    let rotation = (Rotation::from_xyzw(half.x, half.y, half.z, 1.0) * before.pose.rotation).normalize();
    let pose = Pose::from_parts(before.pose.translation + linvel * dt, rotation);
    Motion { pose, linvel, angvel }
}
