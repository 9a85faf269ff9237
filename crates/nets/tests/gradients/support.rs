//! Numbers, and gradients against finite differences.

use candle_core::{Device, Tensor, Var};
use magex_core::rng::{Key, Purpose};

pub(crate) fn normal(n: usize, tag: u32) -> Vec<f32> {
    let mut s = Key::new(11, Purpose::Bench, &[tag]).stream();
    (0..n).map(|_| s.normal() as f32).collect()
}

pub(crate) fn var(shape: &[usize], tag: u32) -> Var {
    Var::from_tensor(&Tensor::from_vec(normal(shape.iter().product(), tag), shape, &Device::Cpu).unwrap()).unwrap()
}

/// A fixed random projection to a scalar, so that every output matters differently.
pub(crate) fn probe(y: &Tensor) -> Tensor {
    let weights = Tensor::from_vec(normal(y.elem_count(), 99), y.shape(), &Device::Cpu).unwrap();
    (y * weights).unwrap().sum_all().unwrap()
}

pub(crate) fn check(vars: &[&Var], f: &dyn Fn() -> Tensor) {
    let grads = probe(&f()).backward().unwrap();
    for (index, v) in vars.iter().enumerate() {
        let grad = grads.get(v).unwrap_or_else(|| panic!("variable {index} has no gradient"));
        let grad = grad.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let start = v.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let step = 1e-2;
        let (mut worst, mut scale) = (0.0f32, 1e-3f32);
        for place in 0..start.len().min(40) {
            let at = (place * 37) % start.len();
            let value = |delta: f32| {
                let mut moved = start.clone();
                moved[at] += delta;
                v.set(&Tensor::from_vec(moved, v.shape(), &Device::Cpu).unwrap()).unwrap();
                probe(&f()).to_scalar::<f32>().unwrap()
            };
            let numeric = (value(step) - value(-step)) / (2.0 * step);
            worst = worst.max((numeric - grad[at]).abs());
            scale = scale.max(grad[at].abs());
        }
        v.set(&Tensor::from_vec(start, v.shape(), &Device::Cpu).unwrap()).unwrap();
        assert!(worst < 0.03 * scale, "variable {index}: off by {worst} at scale {scale}");
    }
}
