//! The controller against recorded calls.

use super::exact::{angles_apart, intrinsic};
use super::recording::{craft, gains, quaternion};
use super::{RELATIVE, apart};
use crate::reader::Field;
use crate::report::{Report, worse};
use magex_core::error::FieldError;
use magex_env::drones::control::{Memory, Request};
use magex_env::drones::model::State;

/// Most sequences, and calls of a sequence.
const MOST: usize = 1_000_000;

/// Every sequence starts with an empty memory.
pub(crate) fn verify(root: &Field<'_>) -> Result<Report, FieldError> {
    let (craft, gains) = (craft(root)?, gains(root)?);
    let (mut rpm, mut target, mut remembered) = (0.0, 0.0, 0.0);
    let (mut sequences, mut calls) = (0, 0);
    for sequence in root.get("sequences")?.items(MOST)? {
        let mut memory = Memory::default();
        sequences += 1;
        for call in sequence.get("calls")?.items(MOST)? {
            calls += 1;
            let [_, _, yaw] = call.get("target_rpy")?.array()?;
            let state = State {
                position: call.get("pos")?.array()?,
                attitude: quaternion(&call.get("quat")?)?,
                velocity: call.get("vel")?.array()?,
                spin: [0.0; 3],
            };
            let request = Request {
                state,
                target_position: call.get("target_pos")?.array()?,
                target_velocity: call.get("target_vel")?.array()?,
                target_yaw: Some(yaw),
                target_rates: call.get("target_rpy_rates")?.array()?,
            };
            let answer = memory.call(&craft, &gains, &request, call.get("dt")?.positive()?);
            rpm = worse(rpm, apart(&answer.rpm, &call.get("rpm")?.array::<4>()?));
            let euler = intrinsic(&answer.target);
            let yaw_error = euler[2] - memory.last_angles[2];
            target = worse(target, angles_apart(euler, call.get("target_euler")?.array()?));
            target = worse(target, angles_apart([yaw_error, 0.0, 0.0], [call.get("yaw_error")?.number()?, 0.0, 0.0]));
            target = worse(target, apart(&[answer.thrust_pwm], &[call.get("thrust_pwm")?.number()?]));
            remembered = worse(remembered, apart(&answer.position_error, &call.get("pos_error")?.array::<3>()?));
            remembered = worse(remembered, angles_apart(memory.last_angles, call.get("rpy")?.array()?));
            for (ours, name) in [(memory.position_integral, "integral_pos"), (memory.attitude_integral, "integral_rpy")]
            {
                remembered = worse(remembered, apart(&ours, &call.get(name)?.array::<3>()?));
            }
        }
    }
    if calls == 0 {
        return Err(root.get("sequences")?.wrong("holds no call"));
    }
    let mut report = Report { content: format!("{calls} calls in {sequences} sequences"), ..Report::default() };
    report.limited("controller rpm", rpm, RELATIVE);
    report.limited("controller target", target, RELATIVE);
    report.limited("controller memory", remembered, RELATIVE);
    Ok(report)
}
