//! The bodies around an agent, one by one.

use super::{FeatureSpec, State, Symmetry, offset};

/// Encounters farther ahead than this do not matter, seconds.
const AHEAD: f32 = 2.0;

impl FeatureSpec {
    /// The k nearest bodies within reach of every agent, nearest first, ties by index. Its own ball is no neighbour.
    pub(super) fn neighbour_features(
        &self,
        state: &State<'_>,
        symmetries: &[Symmetry],
        near: &mut Vec<(f32, usize)>,
        out: &mut [f32],
        counts: &mut [u8],
    ) {
        let (d, k, reach) = (self.shape.dims, self.neighbours, self.observation.sensing_radius);
        let p = state.p;
        let width = self.neighbour_width();
        let gone =
            |j: usize| j < self.shape.agents && self.observation.out.is_some_and(|flag| state.extra(j)[flag] > 0.0);
        // Bodies sorted along x: only those within reach of one another on this axis are looked at.
        let mut order: Vec<usize> = (0..self.shape.bodies).filter(|&j| !gone(j)).collect();
        order.sort_by(|&a, &b| p[a * d].total_cmp(&p[b * d]).then(a.cmp(&b)));
        for (at, &i) in order.iter().enumerate().filter(|(_, i)| **i < self.shape.agents) {
            near.clear();
            let own = if self.pushes() { state.target_body(i, 0) } else { None };
            let mut look = |j: usize| -> bool {
                if (p[j * d] - p[i * d]).abs() > reach {
                    return false;
                }
                let mut square = 0.0f32;
                for c in 0..d {
                    let offset = p[j * d + c] - p[i * d + c];
                    square = offset.mul_add(offset, square);
                }
                if square <= reach * reach && own != Some(j) {
                    // Insertion into a short sorted list.
                    let place = near.iter().position(|&(s, other)| (square, j) < (s, other)).unwrap_or(near.len());
                    if place < k {
                        near.insert(place, (square, j));
                        near.truncate(k);
                    }
                }
                true
            };
            for &j in order[..at].iter().rev() {
                if !look(j) {
                    break;
                }
            }
            for &j in &order[at + 1..] {
                if !look(j) {
                    break;
                }
            }
            counts[i] = near.len() as u8;
            for (slot, &(square, j)) in near.iter().enumerate() {
                let at = (i * k + slot) * width;
                self.neighbour(state, (i, j), square, symmetries[i], &mut out[at..at + width]);
            }
        }
    }

    /// Body j as agent i sees it.
    fn neighbour(&self, state: &State<'_>, (i, j): (usize, usize), square: f32, symmetry: Symmetry, out: &mut [f32]) {
        let o = &self.observation;
        let d = self.shape.dims;
        let (offset, velocity) =
            (offset(state.position(i), state.position(j)).0, offset(state.velocity(i), state.velocity(j)).0);
        let (offset, velocity) = (symmetry.see(offset), symmetry.see(velocity));
        for c in 0..d {
            out[c] = offset[c];
            out[d + c] = velocity[c] / o.speed;
        }
        out[2 * d] = (o.contact_radius / square.sqrt().max(1e-6)).min(2.0);
        let mut at = 2 * d + 1;
        if o.encounters {
            let (mut closing, mut speed) = (0.0f32, 0.0f32);
            for c in 0..d {
                closing = offset[c].mul_add(-velocity[c], closing);
                speed = velocity[c].mul_add(velocity[c], speed);
            }
            let time = (closing / speed.max(1e-4)).clamp(0.0, AHEAD);
            let mut nearest = 0.0f32;
            for c in 0..d {
                let miss = velocity[c].mul_add(time, offset[c]);
                nearest = miss.mul_add(miss, nearest);
                out[at + c] = (2.0 * miss).clamp(-1.0, 1.0);
            }
            out[at + d] = time / AHEAD;
            out[at + d + 1] = (o.contact_radius / nearest.sqrt().max(1e-6)).min(2.0);
            at += d + 2;
        }
        if self.shape.bodies > self.shape.agents {
            out[at] = if j < self.shape.agents { 0.0 } else { 1.0 };
        }
    }
}
