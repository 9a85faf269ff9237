//! The forces of the effects against recorded ones.

use super::RELATIVE;
use super::recording::{craft, quaternion};
use crate::reader::Field;
use crate::report::{Report, worse};
use magex_core::error::FieldError;
use magex_env::drones::linalg::{Mat3, norm, sub};

/// Most samples.
const MOST: usize = 1_000_000;
/// Forces below this are compared absolutely, N (and N m).
const TINY: f64 = 1e-12;

fn relative(ours: f64, recorded: f64) -> f64 {
    (ours - recorded).abs() / recorded.abs().max(TINY)
}

fn relative_vector(ours: [f64; 3], recorded: [f64; 3]) -> f64 {
    norm(sub(ours, recorded)) / norm(recorded).max(TINY)
}

/// Recomputes thrust, ground effect, drag and downwash of every sample.
pub(crate) fn verify(root: &Field<'_>) -> Result<Report, FieldError> {
    let craft = craft(root)?;
    let (mut thrust, mut ground, mut drag, mut downwash) = (0.0, 0.0, 0.0, 0.0);
    let mut samples = 0;
    for sample in root.get("samples")?.items(MOST)? {
        samples += 1;
        let recorded = sample.get("drones")?;
        let drones: Vec<_> = recorded.items(1000)?.collect();
        let n = drones.len();
        let positions: Vec<[f64; 3]> = sample.get("pos")?.each(n, Field::array)?;
        let attitudes = sample.get("quat")?.each(n, quaternion)?;
        let velocities: Vec<[f64; 3]> = sample.get("vel")?.each(n, Field::array)?;
        let rpm: Vec<[f64; 4]> = sample.get("rpm")?.each(n, Field::array)?;
        let rpm_before: Vec<[f64; 4]> = sample.get("rpm_prev")?.each(n, Field::array)?;
        for (i, recorded) in drones.iter().enumerate() {
            for (ours, theirs) in craft.thrust(rpm[i]).into_iter().zip(recorded.get("thrust_N")?.array::<4>()?) {
                thrust = worse(thrust, relative(ours, theirs));
            }
            let moment = recorded.get("yaw_torque_Nm")?.number()?;
            thrust = worse(thrust, relative(craft.yaw_moment(rpm[i]), moment));
            let field = recorded.get("gnd_N")?;
            let (r, thrusts) = (Mat3::of(attitudes[i]), craft.thrust(rpm[i]));
            match (craft.ground_effect(positions[i], attitudes[i], &r, thrusts), field.is_null()) {
                (None, true) => {}
                (Some(ours), false) => {
                    for (ours, theirs) in ours.into_iter().zip(field.array::<4>()?) {
                        ground = worse(ground, relative(ours, theirs));
                    }
                }
                // One of the two has no force at all.
                _ => ground = worse(ground, f64::INFINITY),
            }
            let world = craft.drag(velocities[i], rpm_before[i]);
            drag = worse(drag, relative_vector(world, recorded.get("drag_world_N")?.array()?));
            let body = r.back(world);
            drag = worse(drag, relative_vector(body, recorded.get("drag_body_N")?.array()?));
            let here = positions[i];
            let others = (0..n)
                .filter(|&j| j != i)
                .map(|j| sub(positions[j], here))
                .filter(|d| d[2] > 0.0 && libm::hypot(d[0], d[1]) < 10.0);
            let ours: Vec<f64> = others.map(|[x, y, z]| craft.downwash(z, libm::hypot(x, y))).collect();
            let theirs = recorded.get("downwash_body_z_N")?;
            for (ours, theirs) in ours.iter().zip(theirs.each(ours.len(), Field::number)?) {
                downwash = worse(downwash, relative(*ours, theirs));
            }
        }
    }
    if samples == 0 {
        return Err(root.get("samples")?.wrong("holds no sample"));
    }
    let mut report = Report { content: format!("{samples} samples"), ..Report::default() };
    report.limited("thrust", thrust, RELATIVE);
    report.limited("ground effect", ground, RELATIVE);
    report.limited("drag", drag, RELATIVE);
    report.limited("downwash", downwash, RELATIVE);
    Ok(report)
}
