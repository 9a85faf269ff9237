//! Generalised advantage estimation (Schulman et al. 2016) and the running normalisation of value targets.

use magex_core::trajectory::mark;

/// Rewards, values and discount of one agent's episode.
#[derive(Debug, Clone, Copy)]
pub struct Gae {
    /// γ.
    pub gamma: f32,
    /// λ.
    pub lambda: f32,
    /// Whether the value of the last state is bootstrapped (the horizon is a time limit) or counts as zero (an end).
    pub bootstrap: bool,
}

impl Gae {
    /// Advantages and returns of one episode, in raw units:
    /// δ_t = r_t + γ V_{t+1} − V_t, A_t = δ_t + γ λ A_{t+1}, R_t = A_t + V_t.
    ///
    /// `rewards` `[T]`, `values` [T+1] where the last one is V of the true last state, before any reset. `stride` steps
    /// over interleaved agents: element t of this agent is at index t · stride.
    ///
    /// `marks` [T+1], interleaved like the rest, say where episodes end in between ([`mark`]): after an end the value of the next
    /// state counts as zero, after a cut it is bootstrapped (it is that of the true last state), and neither lets a later
    /// advantage pass. Empty: nowhere.
    pub fn run(
        &self,
        (rewards, values, marks): (&[f32], &[f32], &[u8]),
        stride: usize,
        advantages: &mut [f32],
        returns: &mut [f32],
    ) {
        let steps = rewards.len().div_ceil(stride);
        let mut next_advantage = 0.0;
        for t in (0..steps).rev() {
            let (at, after) = (t * stride, (t + 1) * stride);
            let next = marks.get(after).copied().unwrap_or(mark::ACTIVE);
            if next & mark::ACTIVE == 0 {
                next_advantage = 0.0;
            }
            let over = next & mark::TERMINATED != 0 || (t + 1 == steps && !self.bootstrap);
            let next_value = if over { 0.0 } else { values[after] };
            let delta = rewards[at] + self.gamma * next_value - values[at];
            next_advantage = delta + self.gamma * self.lambda * next_advantage;
            advantages[at] = next_advantage;
            returns[at] = next_advantage + values[at];
        }
    }
}

/// Running mean and variance of value targets with debiasing (ValueNorm of the MAPPO authors): β = 0.99999, ε = 1e-5, variance
/// at least 0.01.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ValueNorm {
    /// Off: mean 0, deviation 1.
    pub enabled: bool,
    mean: f64,
    square: f64,
    debias: f64,
}

impl ValueNorm {
    const BETA: f64 = 0.99999;
    const EPSILON: f64 = 1e-5;

    /// Statistics of nothing yet.
    pub fn new(enabled: bool) -> Self {
        Self { enabled, mean: 0.0, square: 0.0, debias: 0.0 }
    }

    /// Takes in one minibatch of returns (raw units), unless one of them is not finite: it would never leave the statistics.
    pub fn update(&mut self, returns: impl Iterator<Item = f32>) {
        let (mut sum, mut square, mut count) = (0.0f64, 0.0f64, 0.0f64);
        for r in returns {
            let r = f64::from(r);
            sum += r;
            square += r * r;
            count += 1.0;
        }
        if count > 0.0 && sum.is_finite() && square.is_finite() {
            self.mean = Self::BETA * self.mean + (1.0 - Self::BETA) * sum / count;
            self.square = Self::BETA * self.square + (1.0 - Self::BETA) * square / count;
            self.debias = Self::BETA * self.debias + (1.0 - Self::BETA);
        }
    }

    /// Debiased mean and standard deviation.
    pub fn moments(&self) -> (f32, f32) {
        if !self.enabled {
            return (0.0, 1.0);
        }
        let b = self.debias.max(Self::EPSILON);
        let mean = self.mean / b;
        let variance = (self.square / b - mean * mean).max(0.01);
        (mean as f32, variance.sqrt() as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_match_hand_computed_values() {
        // γ = 0.5, λ = 0.5, rewards 1, 2; values 1, 3, 4.
        let gae = Gae { gamma: 0.5, lambda: 0.5, bootstrap: true };
        let (mut a, mut r) = ([0.0; 2], [0.0; 2]);
        gae.run((&[1.0, 2.0], &[1.0, 3.0, 4.0], &[]), 1, &mut a, &mut r);
        // δ_1 = 2 + 2 − 3 = 1; δ_0 = 1 + 1.5 − 1 = 1.5; A_0 = 1.5 + 0.25·1.
        assert_eq!((a, r), ([1.75, 1.0], [2.75, 4.0]));
        Gae { bootstrap: false, ..gae }.run((&[1.0, 2.0], &[1.0, 3.0, 4.0], &[]), 1, &mut a, &mut r);
        assert_eq!(a[1], -1.0);
    }

    #[test]
    fn an_end_has_no_future_and_a_cut_has_the_value_of_its_last_state() {
        let gae = Gae { gamma: 0.5, lambda: 0.5, bootstrap: true };
        let (mut a, mut r) = ([0.0; 4], [0.0; 4]);
        // Step 0 ends (or is cut) in state 1, in which no agent acts; states 2 and 3 are of the next episode.
        for (ending, first) in [(mark::TERMINATED, 1.0 - 1.0), (mark::TRUNCATED, 1.0 + 0.5 * 3.0 - 1.0)] {
            let marks = [mark::ACTIVE | mark::FIRST, ending, mark::ACTIVE | mark::FIRST, mark::ACTIVE, mark::ACTIVE];
            gae.run((&[1.0, 0.0, 2.0, 4.0], &[1.0, 3.0, 5.0, 6.0, 8.0], &marks), 1, &mut a, &mut r);
            assert_eq!((a[0], a[3], a[2]), (first, 4.0 + 4.0 - 6.0, 2.0 + 3.0 - 5.0 + 0.25 * 2.0));
        }
    }

    #[test]
    fn lambda_one_is_the_discounted_return_and_strides_interleave() {
        let gae = Gae { gamma: 0.9, lambda: 1.0, bootstrap: true };
        let (mut a, mut r) = ([0.0; 6], [0.0; 6]);
        let rewards = [1.0, 10.0, 2.0, 20.0, 3.0, 30.0];
        let values = [0.5, 5.0, 0.1, 1.0, 0.2, 2.0, 4.0, 40.0];
        for agent in 0..2 {
            gae.run((&rewards[agent..], &values[agent..], &[]), 2, &mut a[agent..], &mut r[agent..]);
        }
        let expected = 1.0 + 0.9 * 2.0 + 0.81 * 3.0 + 0.729 * 4.0;
        assert!((r[0] - expected).abs() < 1e-5 && (r[1] - 10.0 * expected).abs() < 1e-4);
    }

    #[test]
    fn a_return_that_is_not_finite_does_not_reach_the_statistics() {
        let mut norm = ValueNorm::new(true);
        norm.update([1.0, 3.0].into_iter());
        let before = norm;
        for bad in [f32::NAN, f32::INFINITY] {
            norm.update([1.0, bad].into_iter());
            assert_eq!(norm, before);
        }
    }

    #[test]
    fn value_norm_is_debiased_and_has_a_floor() {
        let mut norm = ValueNorm::new(true);
        assert_eq!(norm.moments(), (0.0, 0.1));
        norm.update([1.0, 3.0].into_iter());
        let (mean, deviation) = norm.moments();
        assert!((mean - 2.0).abs() < 1e-4 && (deviation - 1.0).abs() < 1e-4);
        norm.update([5.0, 7.0].into_iter());
        // After two updates the plain average of the minibatch means.
        assert!((norm.moments().0 - 4.0).abs() < 1e-3);
        assert_eq!(ValueNorm::new(false).moments(), (0.0, 1.0));
    }
}
