//! What an agent knows of itself and of where it is to go.

use super::{FeatureSpec, State, Symmetry, offset};

/// Point behind the ball, seen from its landmark, from which it is pushed: the two bodies' radii.
const BEHIND: f32 = 0.25;

/// Own velocity; ball: direction, squashed, near field, velocity; landmark seen from the ball: direction, squashed; the
/// point behind the ball; cos and sin between the two legs; closeness, distance left, reached.
pub(super) const fn push_width(dims: usize) -> usize {
    dims * 8 + 2 + 3
}

impl FeatureSpec {
    pub(super) fn goal_features(&self, state: &State<'_>, i: usize, symmetry: Symmetry, out: &mut Vec<f32>) {
        let o = &self.observation;
        let d = self.dims;
        let (p, v) = (state.position(i), state.velocity(i));
        let put = |vector: [f32; 3], scale: f32, out: &mut Vec<f32>| {
            out.extend(symmetry.see(vector)[..d].iter().map(|x| x * scale));
        };
        if !self.relative_goal {
            out.extend(v.iter().map(|x| x / o.speed));
            out.extend(p.iter().map(|x| x / self.half_side));
            for k in 0..self.goals_per_agent {
                out.extend(state.target(i, k).iter().map(|x| x / self.half_side));
            }
        } else if self.pushes() {
            let (ball, landmark) = (state.target(i, 0), state.target(i, 1));
            put(padded(v), 1.0 / o.speed, out);
            let (to_ball, near) = offset(p, ball);
            put(to_ball, 1.0 / near.max(o.fade_radius), out);
            put(to_ball, 1.0 / (1.0 + near), out);
            put(to_ball.map(|x| (3.0 * x).clamp(-1.0, 1.0)), 1.0, out);
            let rolling = state.target_body(i, 0).map_or([0.0; 3], |body| padded(state.velocity(body)));
            put(rolling, 1.0 / o.speed, out);
            let (way, left) = offset(ball, landmark);
            put(way, 1.0 / left.max(o.fade_radius), out);
            put(way, 1.0 / (1.0 + left), out);
            let back = BEHIND / left.max(o.fade_radius);
            let mut behind = [0.0f32; 3];
            for k in 0..3 {
                behind[k] = to_ball[k] - way[k] * back;
            }
            put(behind.map(|x| (2.0 * x).clamp(-2.0, 2.0)), 1.0, out);
            // Both legs fade near their ends, and with them the angle between them.
            let legs = 1.0 / (near.max(1e-6) * left.max(o.fade_radius));
            let [ax, ay, az] = symmetry.see(to_ball);
            let [bx, by, bz] = symmetry.see(way);
            out.push((ax.mul_add(bx, ay.mul_add(by, az * bz))) * legs);
            out.push((ax.mul_add(by, -(ay * bx))) * legs);
            out.push((BEHIND / near.max(1e-6)).min(2.0));
            out.push(left.min(1.0));
            out.push(if left <= o.success_radius { 1.0 } else { 0.0 });
        } else {
            put(padded(v), 1.0 / o.speed, out);
            for k in 0..self.goals_per_agent {
                let (offset, distance) = offset(p, state.target(i, k));
                put(offset, 1.0 / distance.max(o.fade_radius), out);
                put(offset, 1.0 / (1.0 + distance), out);
                out.push(if distance <= o.success_radius { 1.0 } else { 0.0 });
            }
        }
        out.extend_from_slice(state.extra(i));
    }
}

fn padded(vector: &[f32]) -> [f32; 3] {
    let mut out = [0.0; 3];
    out[..vector.len()].copy_from_slice(vector);
    out
}
