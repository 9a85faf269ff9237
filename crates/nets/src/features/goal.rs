//! What an agent knows of itself and of its goals.

use super::{FeatureSpec, State, Symmetry, offset};

impl FeatureSpec {
    pub(super) fn goal_features(&self, state: &State<'_>, i: usize, symmetry: Symmetry, out: &mut Vec<f32>) {
        let o = &self.observation;
        let d = self.shape.dims;
        let (p, v) = (state.position(i), state.velocity(i));
        let put = |vector: [f32; 3], scale: f32, out: &mut Vec<f32>| symmetry.put(vector, scale, d, out);
        if !self.relative_goal {
            out.extend(v.iter().map(|x| x / o.speed));
            out.extend(p.iter().map(|x| x / self.half_side));
            for k in 0..self.shape.goals_per_agent {
                out.extend(state.target(i, k).iter().map(|x| x / self.half_side));
            }
        } else if self.pushes() {
            self.push_features(state, i, symmetry, out);
        } else {
            put(padded(v), 1.0 / o.speed, out);
            for k in 0..self.shape.goals_per_agent {
                let (offset, distance) = offset(p, state.target(i, k));
                put(offset, 1.0 / distance.max(o.fade_radius), out);
                put(offset, 1.0 / (1.0 + distance), out);
                out.push(if distance <= o.success_radius { 1.0 } else { 0.0 });
            }
        }
        out.extend_from_slice(state.extra(i));
    }
}

pub(super) fn padded(vector: &[f32]) -> [f32; 3] {
    let mut out = [0.0; 3];
    out[..vector.len()].copy_from_slice(vector);
    out
}
