use super::*;
use candle_core::Device;
use magex_nets::distribution::ActionHeads;

/// The gradient of a scalar against finite differences, entry by entry.
fn check(start: &[f32], shape: &[usize], f: &dyn Fn(&Tensor) -> Tensor) {
    let v = Var::from_tensor(&Tensor::from_slice(start, shape, &Device::Cpu).unwrap()).unwrap();
    let grads = f(v.as_tensor()).backward().unwrap();
    let grad = grads.get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for i in 0..start.len() {
        let value = |delta: f32| {
            let mut moved = start.to_vec();
            moved[i] += delta;
            let x = Tensor::from_slice(&moved, shape, &Device::Cpu).unwrap();
            f64::from(f(&x).to_scalar::<f32>().unwrap())
        };
        let numeric = (value(2e-3) - value(-2e-3)) / 4e-3;
        assert!((numeric - f64::from(grad[i])).abs() < 2e-3, "entry {i}: {numeric} against {}", grad[i]);
    }
}

fn vector(values: &[f32]) -> Tensor {
    column(values.to_vec()).unwrap()
}

#[test]
fn the_gradient_of_the_policy_loss_is_its_slope_inside_and_outside_the_clip_range() {
    let heads = ActionHeads::new(vec![3, 2]).unwrap();
    let logits = [0.3, -0.2, 0.5, 0.1, 0.9, 1.0, 0.0, -1.0, 0.4, 0.2, 0.0, 0.7, 0.1, -0.3, 0.3];
    check(&logits, &[3, 5], &|x| {
        let now = ops::action_log_probs(x, vec![0, 1, 2, 0, 1, 1], &heads).unwrap();
        let old = vector(&[-1.5, -2.9, -1.2]);
        let ratio = ops::exp(&(now.get(0).unwrap() - old).unwrap()).unwrap();
        let surrogate = clipped_surrogate(&ratio, &vector(&[1.3, -0.7, -2.0]), 0.2).unwrap();
        let entropy = (now.get(1).unwrap() * 0.05).unwrap();
        ((surrogate + entropy).unwrap().sum_all().unwrap() * -0.5).unwrap()
    });
}

#[test]
fn the_clipped_surrogate_matches_hand_computed_values_and_has_no_gradient_beyond_the_clip_range() {
    // A > 0: min(1.5·2, 1.2·2); A < 0: min(0.5·−1, 0.8·−1); inside the range and at ρ = 1 nothing is clipped.
    let ratio = Var::from_tensor(&vector(&[1.5, 0.5, 1.5, 1.1, 1.0])).unwrap();
    let surrogate = clipped_surrogate(&ratio, &vector(&[2.0, -1.0, -1.0, 3.0, 4.0]), 0.2).unwrap();
    let expected: [f32; 5] = [2.4, -0.8, -1.5, 3.3, 4.0];
    for (a, b) in surrogate.to_vec1::<f32>().unwrap().into_iter().zip(expected) {
        assert!((a - b).abs() < 1e-6, "{a} and {b}");
    }
    let grads = surrogate.sum_all().unwrap().backward().unwrap();
    assert_eq!(grads.get(&ratio).unwrap().to_vec1::<f32>().unwrap(), [0.0, 0.0, -1.0, 3.0, 4.0]);
}

#[test]
fn the_gradient_of_the_value_loss_is_its_slope_and_the_loss_is_linear_beyond_delta() {
    let (old, targets) = (vector(&[0.0, 0.0, 1.0, 0.5]), vector(&[1.0, -1.0, 1.05, 30.0]));
    check(&[0.1, 0.5, 0.9, 0.4], &[4], &|x| {
        (clipped_value_loss(x, &old, &targets, 0.2, 10.0).unwrap().sum_all().unwrap() * 0.25).unwrap()
    });
    let loss = clipped_value_loss(&vector(&[0.4]), &vector(&[0.4]), &vector(&[30.4]), 0.2, 10.0).unwrap();
    assert!((loss.to_vec1::<f32>().unwrap()[0] - 250.0).abs() < 1e-3);
}
