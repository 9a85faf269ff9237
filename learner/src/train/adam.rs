//! Adam (Kingma & Ba 2015) with global-norm clipping, on flat parameters. candle-nn's `AdamW` keeps its moments and its step
//! counter private, so a checkpoint could not hold them, and takes one gradient store where ours are sums over slices.

use crate::train::learned::Moments;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

impl Moments {
    /// Those of Adam, zero, for `count` parameters.
    pub fn adam(count: usize) -> Self {
        Self { first: vec![0.0; count], second: vec![0.0; count], steps: 0 }
    }

    /// One update by Adam. The gradient is scaled down to `max_norm` if its L2 norm over all parameters, summed in order, is
    /// larger. Returns the norm before clipping; a gradient that is not finite changes nothing and returns its norm.
    pub fn adam_step(&mut self, values: &mut [f32], gradient: &[f32], rate: f64, epsilon: f64, max_norm: f64) -> f64 {
        let norm = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>().sqrt();
        if !norm.is_finite() {
            return norm;
        }
        let scale = if norm > max_norm { max_norm / (norm + 1e-6) } else { 1.0 } as f32;
        self.steps += 1;
        let exponent = self.steps as f64;
        let (unbias1, unbias2) = (1.0 - libm::pow(BETA1, exponent), 1.0 - libm::pow(BETA2, exponent));
        let rate = (rate / unbias1) as f32;
        let (b1, b2) = (BETA1 as f32, BETA2 as f32);
        let (root, epsilon) = ((1.0 / unbias2.sqrt()) as f32, epsilon as f32);
        for (((p, &g), m), v) in values.iter_mut().zip(gradient).zip(&mut self.first).zip(&mut self.second) {
            let g = g * scale;
            *m = b1 * *m + (1.0 - b1) * g;
            *v = b2 * *v + (1.0 - b2) * g * g;
            *p -= rate * *m / (v.sqrt() * root + epsilon);
        }
        norm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_two_steps_match_hand_computed_values() {
        let (mut adam, mut p) = (Moments::adam(1), [1.0f32]);
        adam.adam_step(&mut p, &[0.5], 0.1, 1e-8, 10.0);
        // The first step is the rate times the sign.
        assert!((p[0] - 0.9).abs() < 1e-6);
        adam.adam_step(&mut p, &[-0.25], 0.1, 1e-8, 10.0);
        let m: f64 = (0.9 * 0.05 + 0.1 * -0.25) / (1.0 - 0.81);
        let v: f64 = (0.999 * 0.001 * 0.25 + 0.001 * 0.0625) / (1.0 - 0.999f64.powi(2));
        assert!((f64::from(p[0]) - (0.9 - 0.1 * m / v.sqrt())).abs() < 1e-5);
    }

    #[test]
    fn clipping_scales_the_whole_gradient_and_bad_gradients_change_nothing() {
        let (mut adam, mut p) = (Moments::adam(2), [0.0f32; 2]);
        assert_eq!(adam.adam_step(&mut p, &[30.0, 40.0], 0.1, 1e-8, 10.0), 50.0);
        assert!((adam.first[0] - 0.6).abs() < 1e-5 && (adam.first[1] - 0.8).abs() < 1e-5);
        let before = (adam.clone(), p);
        assert!(adam.adam_step(&mut p, &[f32::NAN, 0.0], 0.1, 1e-8, 10.0).is_nan());
        assert_eq!((adam, p), before);
    }
}
