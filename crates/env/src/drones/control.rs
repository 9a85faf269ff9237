//! The cascaded PID controller of gym-pybullet-drones (`DSLPIDControl`, CF2X gains): position and velocity to rpm.

use super::constants::cf2x;
use super::linalg::{Mat3, V3, add, cross, dot, norm, roll_pitch_yaw, scale, sub, times};
use super::model::{Craft, State};

cf2x! {
    /// Gains and limits. Forces in N, torques in units of the motors' PWM.
    Gains {
        /// N per m.
        p_force: [f64; 3] = [0.4, 0.4, 1.25];
        /// N per m s.
        i_force: [f64; 3] = [0.05, 0.05, 0.05];
        /// N per m/s.
        d_force: [f64; 3] = [0.2, 0.2, 0.5];
        /// PWM per unit of attitude error.
        p_torque: [f64; 3] = [70_000.0, 70_000.0, 60_000.0];
        /// PWM per unit of attitude error and second.
        i_torque: [f64; 3] = [0.0, 0.0, 500.0];
        /// PWM per rad/s.
        d_torque: [f64; 3] = [20_000.0, 20_000.0, 12_000.0];
        /// Bound of the position integral, m s; every axis is also bounded by the first.
        most_position_integral: [f64; 3] = [2.0, 2.0, 0.15];
        /// Bound of the attitude integral, rad s; every axis is also bounded by the last.
        most_attitude_integral: [f64; 3] = [1.0, 1.0, 1500.0];
        /// Bound of the torques, PWM.
        most_torque: f64 = 3200.0;
        /// rpm per PWM.
        rpm_per_pwm: f64 = 0.2685;
        /// rpm at PWM 0.
        rpm_at_zero: f64 = 4070.3;
        /// Least PWM.
        least_pwm: f64 = 20_000.0;
        /// Largest PWM.
        most_pwm: f64 = 65_535.0;
        /// Torque of each axis on each motor.
        mixer: [[f64; 3]; 4] = [[-0.5, -0.5, -1.0], [-0.5, 0.5, 1.0], [0.5, 0.5, -1.0], [0.5, -0.5, 1.0]];
    }
}

/// What the controller remembers; all zero at the start.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Memory {
    /// ∫ position error dt, m s.
    pub position_integral: [f64; 3],
    /// −∫ attitude error dt, s.
    pub attitude_integral: [f64; 3],
    /// Roll, pitch and yaw at the previous call, rad.
    pub last_angles: [f64; 3],
}

/// What the controller sees (it computes angular velocities itself) and what it is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Request {
    /// The present state.
    pub state: State,
    /// m.
    pub target_position: [f64; 3],
    /// m/s.
    pub target_velocity: [f64; 3],
    /// rad; `None` for the present yaw.
    pub target_yaw: Option<f64>,
    /// Target of the rates of roll, pitch and yaw, rad/s.
    pub target_rates: [f64; 3],
}

impl Request {
    /// Track a velocity: the present place and the present yaw are the targets, so that only the velocity counts.
    pub fn velocity(state: State, target_velocity: [f64; 3]) -> Self {
        Self { state, target_position: state.position, target_velocity, target_yaw: None, target_rates: [0.0; 3] }
    }
}

/// What a call computes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Answer {
    /// Command of every motor.
    pub rpm: [f64; 4],
    /// m.
    pub position_error: [f64; 3],
    /// Collective thrust in PWM, before mixing, not bounded.
    pub thrust_pwm: f64,
    /// Target attitude, rows of the matrix.
    pub target: [[f64; 3]; 3],
}

impl Memory {
    /// One call of the controller, `dt` seconds after the previous one.
    pub fn call(&mut self, craft: &Craft, gains: &Gains, request: &Request, dt: f64) -> Answer {
        let now = Mat3::of(request.state.attitude);
        let angles = roll_pitch_yaw(request.state.attitude);
        // Position: a force.
        let position_error = sub(request.target_position, request.state.position);
        let velocity_error = sub(request.target_velocity, request.state.velocity);
        let [most, _, most_z] = gains.most_position_integral;
        let integral = add(self.position_integral, scale(position_error, dt)).map(|i| i.clamp(-most, most));
        self.position_integral = [integral[0], integral[1], integral[2].clamp(-most_z, most_z)];
        let mut force = times(gains.p_force, position_error);
        force = add(force, times(gains.i_force, self.position_integral));
        force = add(force, times(gains.d_force, velocity_error));
        force[2] += craft.weight();
        let lift = dot(force, now.axis(2)).max(0.0);
        let thrust_pwm = (libm::sqrt(lift / (4.0 * craft.kf)) - gains.rpm_at_zero) / gains.rpm_per_pwm;
        // The attitude that gives it, at the wanted yaw.
        let yaw = request.target_yaw.unwrap_or(angles[2]);
        let z = scale(force, 1.0 / norm(force));
        let side = cross(z, [libm::cos(yaw), libm::sin(yaw), 0.0]);
        let y = scale(side, 1.0 / norm(side));
        let target = Mat3::columns(cross(y, z), y, z);
        // Attitude: torques.
        let error = attitude_error(&target, &now);
        let rates = scale(sub(angles, self.last_angles), 1.0 / dt);
        self.last_angles = angles;
        let rate_error = sub(request.target_rates, rates);
        let [most_x, most_y, most] = gains.most_attitude_integral;
        let integral = sub(self.attitude_integral, scale(error, dt)).map(|i| i.clamp(-most, most));
        self.attitude_integral = [integral[0].clamp(-most_x, most_x), integral[1].clamp(-most_y, most_y), integral[2]];
        let mut torque = times(scale(gains.p_torque, -1.0), error);
        torque = add(torque, times(gains.d_torque, rate_error));
        torque = add(torque, times(gains.i_torque, self.attitude_integral));
        let torque = torque.map(|t| t.clamp(-gains.most_torque, gains.most_torque));
        let rpm = gains.mixer.map(|row| {
            let pwm = (thrust_pwm + dot(row, torque)).clamp(gains.least_pwm, gains.most_pwm);
            gains.rpm_per_pwm * pwm + gains.rpm_at_zero
        });
        Answer { rpm, position_error, thrust_pwm, target: target.0 }
    }
}

/// The skew part of RtᵀR − RᵀRt, without the usual half: about twice the angle for small errors.
fn attitude_error(target: &Mat3, now: &Mat3) -> V3 {
    // (RtᵀR)ij is target axis i · present axis j, and RᵀRt its transpose.
    let product = |i: usize, j: usize| dot(target.axis(i), now.axis(j));
    let skew = |i: usize, j: usize| product(i, j) - product(j, i);
    [skew(2, 1), skew(0, 2), skew(1, 0)]
}
