//! The eight ways to mirror and swap two axes, and back.

use magex_core::task::ActionCode;

/// Mirror x, mirror y, then swap them: a frame in which an agent sees the world, and in which its policy acts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Symmetry {
    mirror: [bool; 2],
    swap: bool,
}

impl Symmetry {
    /// The one that turns a direction into the first octant: 0 ≤ y ≤ x.
    pub(crate) fn to_first_octant(direction: [f32; 3]) -> Self {
        let [x, y, _] = direction;
        Self { mirror: [x < 0.0, y < 0.0], swap: y.abs() > x.abs() }
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
    fn every_direction_is_seen_in_the_first_octant() {
        for (x, y) in [(1.0, 0.2), (-1.0, 0.2), (0.2, -1.0), (-0.2, -1.0), (0.0, 0.0), (1.0, -1.0)] {
            let [a, b, _] = Symmetry::to_first_octant([x, y, 0.0]).see([x, y, 0.0]);
            assert!(0.0 <= b && b <= a, "{x} {y}: {a} {b}");
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
