//! Formulas of Push Ball: an agent goes to its ball and pushes it to a landmark.

use super::goal::padded;
use super::{FeatureSpec, Frame, State, Symmetry, offset};
use magex_core::task::PushBallConfig;

/// Distance from the ball's centre to the point behind it, seen from its landmark, from which it is pushed.
const BEHIND: f32 = PushBallConfig::PUSH_DISTANCE as f32;

/// Own velocity; ball: direction, squashed, near field, velocity; landmark seen from the ball: direction, squashed; the
/// point behind the ball; cos and sin between the two legs; closeness, distance left, reached.
pub(super) const fn width(dims: usize) -> usize {
    dims * 8 + 2 + 3
}

impl FeatureSpec {
    /// Whether an agent's way leads to a ball and with it to a landmark.
    pub(super) fn pushes(&self) -> bool {
        self.shape.bodies > self.shape.agents && self.shape.goals_per_agent == 2
    }

    /// The frame that agent i sees the world in.
    pub(super) fn symmetry(&self, state: &State<'_>, i: usize) -> Symmetry {
        match self.observation.frame {
            Frame::World => Symmetry::default(),
            Frame::Push => {
                let (ball, landmark) = (state.target(i, 0), state.target(i, self.shape.goals_per_agent - 1));
                Symmetry::facing(offset(ball, landmark).0, offset(state.position(i), ball).0)
            }
        }
    }

    /// Squashed offset to the agent's ball, along the axes of the world.
    pub(super) fn ball_offset(&self, state: &State<'_>, i: usize, out: &mut Vec<f32>) {
        let (offset, distance) = offset(state.position(i), state.target(i, 0));
        out.extend(offset[..self.shape.dims].iter().map(|x| x / (1.0 + distance)));
    }

    /// The agent, its ball, that ball's landmark: [`width()`] numbers.
    pub(super) fn push_features(&self, state: &State<'_>, i: usize, symmetry: Symmetry, out: &mut Vec<f32>) {
        let o = &self.observation;
        let (p, v) = (state.position(i), state.velocity(i));
        let put = |vector: [f32; 3], scale: f32, out: &mut Vec<f32>| symmetry.put(vector, scale, self.shape.dims, out);
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
    }
}
