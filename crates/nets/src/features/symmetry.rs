//! The eight ways to mirror and swap two axes, and back.

use magex_core::task::ActionCode;

/// Mirror x, mirror y, then swap them: a frame in which an agent sees the world, and in which its policy acts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Symmetry {
    mirror: [bool; 2],
    swap: bool,
}

impl Symmetry {
    /// The one that turns the ball's way to its landmark along the first axis, |y| ≤ x, with the agent's way to the ball
    /// turning left into it: (to_ball × way) ≥ 0.
    pub(crate) fn facing(way: [f32; 3], to_ball: [f32; 3]) -> Self {
        let [x, y, _] = way;
        let swap = y.abs() > x.abs();
        let along = usize::from(swap);
        let mut mirror = [false; 2];
        mirror[along] = way[along] < 0.0;
        let cross = to_ball[0].mul_add(y, -(to_ball[1] * x));
        // Every mirror and every swap turns left into right.
        let left = if swap ^ mirror[along] { -cross } else { cross };
        mirror[1 - along] = left < 0.0;
        Self { mirror, swap }
    }

    /// A vector of the world as the agent sees it. The third axis stays.
    #[inline]
    pub(crate) fn see(self, mut vector: [f32; 3]) -> [f32; 3] {
        for axis in 0..2 {
            if self.mirror[axis] {
                vector[axis] = -vector[axis];
            }
        }
        if self.swap {
            vector.swap(0, 1);
        }
        vector
    }

    /// Appends the first `dims` components of a vector as the agent sees it, scaled.
    #[inline]
    pub(super) fn put(self, vector: [f32; 3], scale: f32, dims: usize, out: &mut Vec<f32>) {
        out.extend(self.see(vector)[..dims].iter().map(|x| x * scale));
    }

    /// What an action chosen in this frame is along the axes of the world; in place.
    pub fn act(self, code: ActionCode, action: &mut [u8]) {
        match code {
            ActionCode::Thrust => {
                if let Some(thrust) = action.first_mut()
                    && (1..=4).contains(thrust)
                {
                    let (axis, negative) = ((*thrust - 1) / 2, (*thrust - 1) % 2);
                    let axis = if self.swap { 1 - axis } else { axis };
                    *thrust = 1 + 2 * axis + (negative ^ u8::from(self.mirror[usize::from(axis)]));
                }
            }
            ActionCode::Own => {}
            ActionCode::PerAxis => {
                if let [x, y, ..] = action {
                    if self.swap {
                        std::mem::swap(x, y);
                    }
                    for (component, mirror) in [x, y].into_iter().zip(self.mirror) {
                        if mirror {
                            *component = 2 - (*component).min(2);
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> impl Iterator<Item = Symmetry> {
        (0..8).map(|k| Symmetry { mirror: [k & 1 > 0, k & 2 > 0], swap: k & 4 > 0 })
    }

    #[test]
    fn every_way_is_seen_along_the_first_axis_from_the_same_side() {
        let directions = [(1.0, 0.2), (-1.0, 0.2), (0.2, -1.0), (-0.2, -1.0), (0.0, 0.0), (1.0, -1.0), (0.3, 0.7)];
        for (x, y) in directions {
            for (u, v) in directions {
                let symmetry = Symmetry::facing([x, y, 0.0], [u, v, 0.0]);
                let ([a, b, _], [c, d, _]) = (symmetry.see([x, y, 0.0]), symmetry.see([u, v, 0.0]));
                assert!(b.abs() <= a && c * b - d * a >= 0.0, "{x} {y}, {u} {v}");
            }
        }
    }

    #[test]
    fn acting_undoes_seeing() {
        const DIRECTIONS: [[f32; 3]; 5] =
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]];
        for symmetry in all() {
            for thrust in 0..5u8 {
                let mut action = [thrust];
                symmetry.act(ActionCode::Thrust, &mut action);
                assert_eq!(symmetry.see(DIRECTIONS[usize::from(action[0])]), DIRECTIONS[usize::from(thrust)]);
            }
            for code in 0..27u8 {
                let chosen = [code % 3, code / 3 % 3, code / 9];
                let mut action = chosen;
                symmetry.act(ActionCode::PerAxis, &mut action);
                let vector = |a: [u8; 3]| a.map(|c| 1.0 - f32::from(c));
                assert_eq!(symmetry.see(vector(action)), vector(chosen));
            }
        }
    }
}
