//! RMSprop (Tieleman & Hinton 2012) on flat parameters, without momentum and not centred, as PyTorch has it: candle-nn has none.

use crate::train::learned::Moments;

impl Moments {
    /// That of RMSprop, zero, for `count` parameters: the mean square of the gradient.
    pub fn rmsprop(count: usize) -> Self {
        Self { first: Vec::new(), second: vec![0.0; count], steps: 0 }
    }

    /// One update by RMSprop on `scale` times the gradient: v ← α v + (1 − α) g², θ ← θ − rate · g / (√v + ε).
    pub fn rmsprop_step(
        &mut self,
        parameters: &mut [f32],
        gradient: &[f32],
        scale: f32,
        rate: f64,
        (alpha, epsilon): (f64, f64),
    ) {
        self.steps += 1;
        let (keep, take, rate, epsilon) = (alpha as f32, (1.0 - alpha) as f32, rate as f32, epsilon as f32);
        for ((p, &g), v) in parameters.iter_mut().zip(gradient).zip(&mut self.second) {
            let g = g * scale;
            *v = keep * *v + take * g * g;
            *p -= rate * g / (v.sqrt() + epsilon);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_two_steps_match_hand_computed_values() {
        let (mut moments, mut p) = (Moments::rmsprop(1), [1.0f32]);
        moments.rmsprop_step(&mut p, &[1.0], 0.5, 0.01, (0.99, 1e-5));
        // v = 0.01 · 0.25 = 0.0025, √v = 0.05.
        let first = 1.0 - 0.01 * 0.5 / (0.05 + 1e-5);
        assert!((f64::from(p[0]) - first).abs() < 1e-6, "{p:?}");
        moments.rmsprop_step(&mut p, &[-2.0], 1.0, 0.01, (0.99, 1e-5));
        let v: f64 = 0.99 * 0.0025 + 0.01 * 4.0;
        assert!((f64::from(p[0]) - (first + 0.02 / (v.sqrt() + 1e-5))).abs() < 1e-6, "{p:?}");
        assert_eq!((moments.steps, moments.first.len()), (2, 0));
    }
}
