//! The reference model of gym-pybullet-drones 2.1.0 on Bullet: what forces act on a drone, and Bullet's integration
//! step, both exactly (one step agrees with recordings to rounding).
//!
//! Motors answer at once: rpm acts in the very step it is commanded. The peculiarities of the reference are part of
//! the model because a recorded step shows them: forces in the body's frame are turned by the orientation before the
//! *previous* step ("lagged"), the engine's damping is linear plus quadratic, drag uses the rpm of the previous step
//! and world-frame coefficients.

use super::constants::cf2x;
use super::linalg::{Mat3, POLE, V3, add, cross, dot, norm, product, scale, sine_of_pitch, times, unit};

cf2x! {
    /// Constants of a quadrotor and of the engine it was recorded with. SI units.
    Craft {
        /// Mass in kg.
        mass: f64 = 0.027;
        /// Gravity in m/s².
        gravity: f64 = 9.8;
        /// Principal inertia in kg m², body axes.
        inertia: [f64; 3] = [1.4e-5, 1.4e-5, 2.17e-5];
        /// Arm in m: the lever of the explicit variant is arm / √2.
        arm: f64 = 0.0397;
        /// Propellers in the body frame, m.
        propellers: [[f64; 3]; 4] = [[0.028, -0.028, 0.0], [-0.028, -0.028, 0.0], [-0.028, 0.028, 0.0], [0.028, 0.028, 0.0]];
        /// Thrust in N per rpm².
        kf: f64 = 3.16e-10;
        /// Yaw moment in N m per rpm².
        km: f64 = 7.94e-12;
        /// Sign of each motor's yaw moment.
        yaw_signs: [f64; 4] = [-1.0, 1.0, -1.0, 1.0];
        /// Radius of a propeller in m.
        propeller_radius: f64 = 0.0231348;
        /// Coefficient of the ground effect.
        ground: f64 = 11.36859;
        /// Drag in N per (m/s) per (rad/s), world axes.
        drag: [f64; 3] = [9.1785e-7, 9.1785e-7, 10.311e-7];
        /// Coefficients of the downwash.
        downwash: [f64; 3] = [2267.18, 0.16, -0.11];
        /// The engine's damping of velocities in 1/s: Bullet's default of 0.04, stored there as f32.
        linear_damping: f64 = 0.039_999_999_105_930_33;
        /// The engine's damping of angular velocities in 1/s.
        angular_damping: f64 = 0.039_999_999_105_930_33;
        /// The engine's bound on every coordinate of velocity and angular velocity, in m/s and rad/s.
        most_speed: f64 = 100.0;
    }
}

impl Craft {
    /// m g, in N.
    pub fn weight(&self) -> f64 {
        self.mass * self.gravity
    }

    /// Thrust of every motor in N.
    #[inline]
    pub fn thrust(&self, rpm: [f64; 4]) -> [f64; 4] {
        rpm.map(|rpm| self.kf * (rpm * rpm))
    }

    /// Moment about body z in N m.
    #[inline]
    pub fn yaw_moment(&self, rpm: [f64; 4]) -> f64 {
        let q = |k: usize| self.yaw_signs[k] * (rpm[k] * rpm[k]);
        self.km * (q(0) + q(1) + q(2) + q(3))
    }

    /// Drag in N, world frame, of a velocity in m/s and the rpm of the *previous* step.
    #[inline]
    pub fn drag(&self, velocity: [f64; 3], rpm_before: [f64; 4]) -> [f64; 3] {
        let sum = rpm_before[0] + rpm_before[1] + rpm_before[2] + rpm_before[3];
        let turning = 2.0 * std::f64::consts::PI * sum / 60.0;
        times(scale(self.drag, -turning), velocity)
    }

    /// Extra thrust of every motor in N near the ground plane z = 0, given position, attitude (also as a matrix) and thrust;
    /// `None` for a drone on its side or upside down.
    #[inline]
    pub fn ground_effect(&self, p: V3, q: [f64; 4], r: &Mat3, thrust: [f64; 4]) -> Option<[f64; 4]> {
        // |roll| < π/2 is R_zz > 0; |pitch| < π/2 holds short of the poles.
        if sine_of_pitch(q).abs() >= POLE || r.0[2][2] <= 0.0 {
            return None;
        }
        // Below this height the reference clips; at the clip the factor is 4 / 15.
        let lowest = 0.25 * self.propeller_radius * libm::sqrt(15.0 * 0.25 * self.ground);
        Some(std::array::from_fn(|k| {
            let height = (p[2] + dot(r.0[2], self.propellers[k])).max(lowest);
            let ratio = self.propeller_radius / (4.0 * height);
            thrust[k] * self.ground * (ratio * ratio)
        }))
    }

    /// Downwash in N along body z (negative: down) on a drone from another one that is `above` metres higher and
    /// `aside` metres away horizontally; 0 unless it is higher and within 10 m.
    ///
    /// The law is singular: the force grows as 1 / above², and the width vanishes at 0.6875 m. With `aside` = 0 exactly
    /// there it is not a number, as in the reference.
    #[inline]
    pub fn downwash(&self, above: f64, aside: f64) -> f64 {
        if !(above > 0.0 && aside < 10.0) {
            return 0.0;
        }
        let [c1, c2, c3] = self.downwash;
        let ratio = self.propeller_radius / (4.0 * above);
        let (strength, width) = (c1 * (ratio * ratio), c2 * above + c3);
        let off = aside / width;
        -strength * libm::exp(-0.5 * (off * off))
    }
}

/// Which effects act beyond thrust, gravity and the engine's damping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Effects {
    /// Extra thrust near the ground.
    pub ground: bool,
    /// Drag of the propellers.
    pub drag: bool,
    /// Wash of the drones above.
    pub downwash: bool,
}

/// A drone's state between two steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State {
    /// Centre of mass, m.
    pub position: [f64; 3],
    /// Unit quaternion, body to world.
    pub attitude: [f64; 4],
    /// m/s, world.
    pub velocity: [f64; 3],
    /// rad/s, world.
    pub spin: [f64; 3],
}

/// What a step needs to know beyond the present state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inputs {
    /// Attitude before the previous step; the present one in the first step.
    pub lagged: [f64; 4],
    /// rpm during the step.
    pub rpm: [f64; 4],
    /// rpm during the previous step; zero in the first one.
    pub rpm_before: [f64; 4],
    /// Sum of [`Craft::downwash`] over the drones above, N.
    pub wash: f64,
}

/// Force and moment on a drone during a step: everything but gravity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Loads {
    /// N, world.
    pub force: [f64; 3],
    /// N m, world, gyroscopic moment included.
    pub moment: [f64; 3],
}

impl Craft {
    /// Force and moment on a drone during a step from its state before the step.
    #[inline]
    pub fn loads(&self, state: &State, inputs: &Inputs, effects: Effects) -> Loads {
        let now = Mat3::of(state.attitude);
        let lagged = Mat3::of(inputs.lagged);
        let thrust = self.thrust(inputs.rpm);
        let up = lagged.axis(2);
        let mut force = scale(up, total(thrust));
        // Each thrust is turned by the lagged attitude and acts at the present place of its propeller.
        let mut moment = cross(now.turn(self.lever(thrust)), up);
        moment = add(moment, scale(up, self.yaw_moment(inputs.rpm)));
        // The ground effect looks up where the propellers are, which refreshes the engine's frames of this drone: what
        // comes after it is turned by the present attitude.
        let mut frame = &lagged;
        if effects.ground {
            frame = &now;
            if let Some(extra) = self.ground_effect(state.position, state.attitude, &now, thrust) {
                let up = now.axis(2);
                force = add(force, scale(up, total(extra)));
                moment = add(moment, cross(now.turn(self.lever(extra)), up));
            }
        }
        if effects.drag {
            let drag = self.drag(state.velocity, inputs.rpm_before);
            force = add(force, frame.turn(now.back(drag)));
        }
        if effects.downwash {
            force = add(force, scale(frame.axis(2), inputs.wash));
        }
        // The engine's damping: accelerations, so proportional to mass and inertia.
        let speed = norm(state.velocity);
        force = add(force, scale(state.velocity, -self.mass * self.linear_damping * (1.0 + speed)));
        let spin = now.back(state.spin);
        let damping = -self.angular_damping * (1.0 + norm(spin));
        let momentum = times(self.inertia, spin);
        let body = add(scale(momentum, damping), cross(momentum, spin));
        Loads { force, moment: add(moment, now.turn(body)) }
    }

    /// Σ r_k f_k in the body frame.
    #[inline]
    fn lever(&self, thrust: [f64; 4]) -> V3 {
        let p = &self.propellers;
        std::array::from_fn(|d| p[0][d] * thrust[0] + p[1][d] * thrust[1] + p[2][d] * thrust[2] + p[3][d] * thrust[3])
    }

    /// Bullet's integration step: semi-implicit Euler, bounded velocities, the rotation by its exponential.
    pub fn integrate(&self, state: &State, loads: &Loads, dt: f64) -> State {
        let now = Mat3::of(state.attitude);
        let mut a = scale(loads.force, 1.0 / self.mass);
        a[2] -= self.gravity;
        let moment = now.back(loads.moment);
        let turning = now.turn(std::array::from_fn(|d| moment[d] / self.inertia[d]));
        let bound = |v: V3| v.map(|c| c.clamp(-self.most_speed, self.most_speed));
        let velocity = bound(add(state.velocity, scale(a, dt)));
        let spin = bound(add(state.spin, scale(turning, dt)));
        State {
            position: add(state.position, scale(velocity, dt)),
            attitude: unit(product(exponential(spin, dt), state.attitude)),
            velocity,
            spin,
        }
    }

    /// One step of the explicit variant (`Physics.DYN`): no engine, no damping, no lag, body rates integrated on their
    /// own. `rates` are the body rates; the state's spin is what the reference reports, old attitude · new rates.
    pub fn step_explicit(&self, state: &State, rates: [f64; 3], rpm: [f64; 4], dt: f64) -> (State, [f64; 3]) {
        let now = Mat3::of(state.attitude);
        let f = self.thrust(rpm);
        let lever = self.arm / libm::sqrt(2.0);
        let moment = [-(f[0] + f[1] - f[2] - f[3]) * lever, (-f[0] + f[1] + f[2] - f[3]) * lever, self.yaw_moment(rpm)];
        let gyroscopic = cross(times(self.inertia, rates), rates);
        let rates = std::array::from_fn(|d| rates[d] + dt * (moment[d] + gyroscopic[d]) / self.inertia[d]);
        let mut force = scale(now.axis(2), total(f));
        force[2] -= self.weight();
        let velocity = add(state.velocity, scale(force, dt / self.mass));
        let rate = norm(rates);
        let attitude = if rate <= 1e-8 {
            state.attitude
        } else {
            let (sin, cos) = (libm::sin(0.5 * rate * dt), libm::cos(0.5 * rate * dt));
            let [x, y, z] = scale(rates, sin / rate);
            product(state.attitude, [x, y, z, cos])
        };
        let position = add(state.position, scale(velocity, dt));
        (State { position, attitude, velocity, spin: now.turn(rates) }, rates)
    }
}

/// f₀ + f₁ + f₂ + f₃.
#[inline]
fn total(f: [f64; 4]) -> f64 {
    (f[0] + f[3]) + (f[1] + f[2])
}

/// Bullet's quaternion of a turn by `spin · dt` (world rates).
fn exponential(spin: V3, dt: f64) -> [f64; 4] {
    const MOST: f64 = 0.5 * std::f64::consts::FRAC_PI_2;
    let mut rate = norm(spin);
    if rate * dt > MOST {
        rate = MOST / dt;
    }
    let share = if rate < 1e-3 {
        0.5 * dt - dt * dt * dt * 0.020_833_333_333 * rate * rate
    } else {
        libm::sin(0.5 * rate * dt) / rate
    };
    let [x, y, z] = scale(spin, share);
    [x, y, z, libm::cos(0.5 * rate * dt)]
}
