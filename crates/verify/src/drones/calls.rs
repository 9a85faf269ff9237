//! The controller against recorded calls.

use super::exact::{angles_apart, intrinsic, rpm_apart};
use super::recording::{array, craft, gains, quaternion};
use super::{DroneReport, apart};
use crate::check::{Check, worse};
use crate::error::RecordingError;
use crate::reader::Field;
use magex_env::drones::control::{Memory, Request};

/// Most sequences, and calls of a sequence.
const MOST: usize = 1_000_000;

/// Every sequence starts with an empty memory.
pub(super) fn verify(root: &Field<'_>) -> Result<DroneReport, RecordingError> {
    let (craft, gains) = (craft(root)?, gains(root)?);
    let (mut rpm, mut target, mut remembered) = (0.0, 0.0, 0.0);
    let (mut sequences, mut calls) = (0, 0);
    for sequence in root.get("sequences")?.items(MOST)? {
        let mut memory = Memory::default();
        sequences += 1;
        for call in sequence.get("calls")?.items(MOST)? {
            calls += 1;
            let [_, _, yaw] = array(&call.get("target_rpy")?)?;
            let request = Request {
                position: array(&call.get("pos")?)?,
                attitude: quaternion(&call.get("quat")?)?,
                velocity: array(&call.get("vel")?)?,
                target_position: array(&call.get("target_pos")?)?,
                target_velocity: array(&call.get("target_vel")?)?,
                target_yaw: Some(yaw),
                target_rates: array(&call.get("target_rpy_rates")?)?,
            };
            let answer = memory.call(&craft, &gains, &request, call.get("dt")?.positive()?);
            rpm = worse(rpm, rpm_apart(answer.rpm, array(&call.get("rpm")?)?));
            let euler = intrinsic(&answer.target);
            let yaw_error = euler[2] - memory.last_angles[2];
            target = worse(target, angles_apart(euler, array(&call.get("target_euler")?)?));
            target = worse(target, angles_apart([yaw_error, 0.0, 0.0], [call.get("yaw_error")?.number()?, 0.0, 0.0]));
            target = worse(target, apart(&[answer.thrust_pwm], &[call.get("thrust_pwm")?.number()?]));
            remembered = worse(remembered, apart(&answer.position_error, &array::<3>(&call.get("pos_error")?)?));
            remembered = worse(remembered, angles_apart(memory.last_angles, array(&call.get("rpy")?)?));
            for (ours, name) in [(memory.position_integral, "integral_pos"), (memory.attitude_integral, "integral_rpy")]
            {
                remembered = worse(remembered, apart(&ours, &array::<3>(&call.get(name)?)?));
            }
        }
    }
    if calls == 0 {
        return Err(root.get("sequences")?.wrong("holds no call"));
    }
    Ok(DroneReport {
        content: format!("{calls} calls in {sequences} sequences"),
        checks: vec![
            Check::limited("controller rpm", rpm, DroneReport::RELATIVE),
            Check::limited("controller target", target, DroneReport::RELATIVE),
            Check::limited("controller memory", remembered, DroneReport::RELATIVE),
        ],
    })
}
