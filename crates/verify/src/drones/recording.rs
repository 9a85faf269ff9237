//! A recorded flight as data.

use crate::reader::Field;
use magex_core::error::FieldError;
use magex_env::drones::control::Gains;
use magex_env::drones::model::{Craft, Effects, State};

/// Most steps a recording may have: far beyond any, small enough that sizes cannot overflow.
const MOST: usize = 1_000_000;
/// Most drones: all pairs are looked at.
const MOST_DRONES: usize = 1000;
/// How far from 1 the length of a recorded quaternion may be (the explicit variant does not normalise).
const UNIT: f64 = 1e-3;

/// What moved the drones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Physics {
    Bullet(Effects),
    Explicit,
}

/// What commanded the motors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    Rpm,
    Velocity,
    Position,
}

/// What the controller computed on the way, per control period and drone.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Trace {
    /// Velocity: direction and fraction of the speed limit; position: x, y, z, yaw.
    pub(super) command: Vec<[f64; 4]>,
    pub(super) thrust_pwm: Vec<f64>,
    /// Intrinsic X-Y-Z angles of the target attitude.
    pub(super) target_euler: Vec<[f64; 3]>,
}

/// A recorded flight.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Trajectory {
    pub(super) craft: Craft,
    pub(super) gains: Gains,
    pub(super) physics_name: String,
    pub(super) physics: Physics,
    pub(super) mode: Mode,
    pub(super) physics_hz: f64,
    pub(super) control_hz: f64,
    /// Seconds per physics step.
    pub(super) dt: f64,
    /// Seconds per control period.
    pub(super) control_dt: f64,
    /// Physics steps per control period.
    pub(super) hold: usize,
    /// N.
    pub(super) drones: usize,
    /// m/s of a full command in velocity mode, else 0.
    pub(super) speed_limit: f64,
    /// `[T + 1][N]` frame t is the state before step t.
    pub(super) frames: Vec<Vec<State>>,
    /// `[T + 1][N]` body rates of the explicit model, else empty.
    pub(super) rates: Vec<Vec<[f64; 3]>>,
    /// `[T][N]`
    pub(super) rpm: Vec<Vec<[f64; 4]>>,
    /// `[K]`, closed loop only.
    pub(super) control: Vec<Trace>,
    /// Whether a perturbation grows too fast for free runs to be compared to the end.
    pub(super) chaotic: bool,
    pub(super) horizon: usize,
}

pub(super) fn quaternion(field: &Field<'_>) -> Result<[f64; 4], FieldError> {
    let q = field.array::<4>()?;
    let length = libm::sqrt(q.iter().map(|c| c * c).sum());
    if (length - 1.0).abs() > UNIT {
        return Err(field.wrong(format!("a quaternion of length {length}; must be 1")));
    }
    Ok(q)
}

/// The drone of `meta.constants`.
pub(super) fn craft(root: &Field<'_>) -> Result<Craft, FieldError> {
    let c = root.get("meta")?.get("constants")?;
    let number = |name: &str| c.get(name)?.number();
    let positive = |name: &str| c.get(name)?.positive();
    let along = number("drag_coeff_xy")?;
    Ok(Craft {
        mass: positive("mass_kg")?,
        gravity: number("gravity_m_s2")?,
        inertia: c.get("inertia_diag_kg_m2")?.fixed(Field::positive)?,
        arm: number("arm_m")?,
        propellers: c.get("prop_positions_m")?.fixed(Field::array)?,
        kf: positive("kf_N_per_rpm2")?,
        km: number("km_Nm_per_rpm2")?,
        yaw_signs: c.get("yaw_sign_per_motor")?.array()?,
        propeller_radius: positive("prop_radius_m")?,
        ground: positive("gnd_eff_coeff")?,
        drag: [along, along, number("drag_coeff_z")?],
        downwash: [number("dw_coeff_1")?, number("dw_coeff_2")?, number("dw_coeff_3")?],
        linear_damping: number("pyb_linear_damping")?,
        angular_damping: number("pyb_angular_damping")?,
        most_speed: positive("pyb_max_coordinate_velocity")?,
    })
}

/// The controller of `meta.constants.pid`.
pub(super) fn gains(root: &Field<'_>) -> Result<Gains, FieldError> {
    let pid = root.get("meta")?.get("constants")?.get("pid")?;
    let vector = |name: &str| pid.get(name)?.array();
    let most = pid.get("pwm_max")?;
    let (least_pwm, most_pwm) = (pid.get("pwm_min")?.number()?, most.number()?);
    if least_pwm > most_pwm {
        return Err(most.wrong(format!("{most_pwm} is below pwm_min")));
    }
    Ok(Gains {
        p_force: vector("P_for")?,
        i_force: vector("I_for")?,
        d_force: vector("D_for")?,
        p_torque: vector("P_tor")?,
        i_torque: vector("I_tor")?,
        d_torque: vector("D_tor")?,
        most_position_integral: pid.get("integral_pos_clip")?.fixed(Field::positive)?,
        most_attitude_integral: pid.get("integral_rpy_clip")?.fixed(Field::positive)?,
        most_torque: pid.get("torque_clip")?.positive()?,
        rpm_per_pwm: pid.get("pwm2rpm_scale")?.positive()?,
        rpm_at_zero: pid.get("pwm2rpm_const")?.number()?,
        least_pwm,
        most_pwm,
        mixer: pid.get("mixer")?.fixed(Field::array)?,
    })
}

impl Trajectory {
    /// Reads the format `drone-golden-1`. Every error names its field.
    pub(super) fn read(root: &Field<'_>) -> Result<Self, FieldError> {
        let name = root.get("physics")?;
        let physics = physics(&name)?;
        let mode = root.get("mode")?;
        let mode = match mode.text()? {
            "rpm" => Mode::Rpm,
            "velocity" => Mode::Velocity,
            "position" => Mode::Position,
            other => return Err(mode.wrong(format!("'{other}' is unknown; use rpm, velocity or position"))),
        };
        let drones = root.get("n_drones")?.count(MOST_DRONES)?;
        let steps = root.get("T")?.count(MOST)?;
        let periods = root.get("K")?.count(MOST)?;
        let hold_field = root.get("steps_per_ctrl")?;
        let hold = hold_field.count(MOST)?;
        if periods.checked_mul(hold) != Some(steps) {
            return Err(hold_field.wrong(format!("{hold} times K = {periods} is not T = {steps}")));
        }
        let (physics_hz, control_hz) = (root.get("pyb_freq")?.positive()?, root.get("ctrl_freq")?.positive()?);
        let period = |name: &str, hz: f64| {
            let field = root.get(name)?;
            let dt = field.positive()?;
            // Ten digits: the file holds the quotient itself.
            if (dt * hz - 1.0).abs() > 1e-9 {
                return Err(field.wrong(format!("{dt} is not the period of {hz} Hz")));
            }
            Ok(dt)
        };
        let (dt, control_dt) = (period("dt", physics_hz)?, period("ctrl_dt", control_hz)?);
        if (control_dt / dt - hold as f64).abs() > 1e-6 {
            return Err(hold_field.wrong(format!("{hold} is not ctrl_dt / dt = {}", control_dt / dt)));
        }
        let speed_limit = if mode == Mode::Velocity { root.get("speed_limit")?.positive()? } else { 0.0 };
        Ok(Self {
            craft: craft(root)?,
            gains: gains(root)?,
            physics_name: name.text()?.to_owned(),
            physics,
            mode,
            physics_hz,
            control_hz,
            dt,
            control_dt,
            hold,
            drones,
            speed_limit,
            frames: frames(root, drones, steps)?,
            rates: match physics {
                Physics::Explicit => root.series("body_rates", steps, |step| step.each(drones, Field::array))?,
                Physics::Bullet(_) => Vec::new(),
            },
            rpm: root.get("rpm")?.each(steps, |step| step.each(drones, Field::array))?,
            control: if mode == Mode::Rpm { Vec::new() } else { traces(root, drones, periods)? },
            chaotic: root.get("chaotic")?.flag()?,
            // Of none, nothing would be compared.
            horizon: root.get("free_run_horizon_steps")?.count(MOST)?.min(steps),
        })
    }

    pub(super) fn steps(&self) -> usize {
        self.rpm.len()
    }

    /// The attitude that turns body forces during step `t`.
    pub(super) fn lagged(&self, t: usize, drone: usize) -> [f64; 4] {
        self.frames[t.saturating_sub(1)][drone].attitude
    }

    pub(super) fn rpm_before(&self, t: usize, drone: usize) -> [f64; 4] {
        if t == 0 { [0.0; 4] } else { self.rpm[t - 1][drone] }
    }
}

fn physics(field: &Field<'_>) -> Result<Physics, FieldError> {
    let none = Effects::default();
    Ok(match field.text()? {
        "PYB" => Physics::Bullet(none),
        "PYB_GND" => Physics::Bullet(Effects { ground: true, ..none }),
        "PYB_DRAG" => Physics::Bullet(Effects { drag: true, ..none }),
        "PYB_DW" => Physics::Bullet(Effects { downwash: true, ..none }),
        "PYB_GND_DRAG_DW" => Physics::Bullet(Effects { ground: true, drag: true, downwash: true }),
        "DYN" => Physics::Explicit,
        other => {
            let known = "PYB, PYB_GND, PYB_DRAG, PYB_DW, PYB_GND_DRAG_DW or DYN";
            return Err(field.wrong(format!("'{other}' is unknown; use {known}")));
        }
    })
}

fn frames(root: &Field<'_>, drones: usize, steps: usize) -> Result<Vec<Vec<State>>, FieldError> {
    let vectors = |name: &str| root.series(name, steps, |step| step.each(drones, Field::array));
    let (positions, velocities, spins) = (vectors("pos")?, vectors("vel")?, vectors("ang_vel")?);
    let attitudes = root.series("quat", steps, |step| step.each(drones, quaternion))?;
    let state = |t: usize, i: usize| State {
        position: positions[t][i],
        attitude: attitudes[t][i],
        velocity: velocities[t][i],
        spin: spins[t][i],
    };
    Ok((0..=steps).map(|t| (0..drones).map(|i| state(t, i)).collect()).collect())
}

fn traces(root: &Field<'_>, drones: usize, periods: usize) -> Result<Vec<Trace>, FieldError> {
    let commands = root.get("command")?.each(periods, |period| period.each(drones, Field::array))?;
    let pwm = root.get("ctrl_thrust_pwm")?.each(periods, |period| period.each(drones, Field::number))?;
    let euler = root.get("ctrl_target_euler")?.each(periods, |period| period.each(drones, Field::array))?;
    let all = commands.into_iter().zip(pwm).zip(euler);
    Ok(all.map(|((command, thrust_pwm), target_euler)| Trace { command, thrust_pwm, target_euler }).collect())
}
