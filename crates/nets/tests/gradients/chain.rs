//! A chain of layers as one operation against its layers one by one.

use crate::support::{check, normal, probe, var};
use candle_core::{Tensor, Var};
use magex_nets::features::Features;
use magex_nets::ops::{self, Activation, Field};
use magex_nets::params::ParamBuilder;
use std::sync::Arc;

/// The rows of a chain's parameters, in the order of its builder.
fn cut(parameters: &Tensor, sizes: &[&[usize]]) -> Vec<Tensor> {
    let mut at = 0;
    let part = |size: &&[usize]| {
        let count = size.iter().product();
        at += count;
        parameters.narrow(0, at - count, count).unwrap().reshape(*size).unwrap()
    };
    sizes.iter().map(part).collect()
}

/// More rows than a tile has, so that its end does not fall on theirs.
const CHAIN_ROWS: usize = 130;

fn chain_features() -> Arc<Features> {
    let counts: Vec<u8> = (0..CHAIN_ROWS).map(|row| [2, 0, 1, 3][row % 4]).collect();
    Arc::new(Features {
        goals: normal(CHAIN_ROWS * 5, 1),
        states: normal(CHAIN_ROWS / 5 * 7, 2),
        neighbours: normal(CHAIN_ROWS * 3 * 4, 3),
        counts,
        ..Features::default()
    })
}

#[test]
fn a_chain_is_what_its_layers_are_one_by_one() {
    let features = chain_features();
    let input = var(&[CHAIN_ROWS, 6], 4);
    let goals: Field = |features| &features.goals;
    let states: Field = |features| &features.states;
    for (act, outputs) in [(Activation::Tanh, 1), (Activation::Relu, 5), (Activation::Identity, 33)] {
        let builder = || {
            ops::ChainBuilder::new()
                .features_and_team(("own", "team"), (goals, states), ((5, 7), 20), act, 1.0)
                .input(6)
                .neighbours("near", 3, (4, 18), 1.0)
                .norm("norm")
                .dense("first", 32, act, 1.0)
                .dense("second", outputs, Activation::Identity, 1.0)
        };
        let sizes: [&[usize]; 11] =
            [&[5, 20], &[7, 20], &[20], &[4, 18], &[18], &[44], &[44], &[44, 32], &[32], &[32, outputs], &[outputs]];
        let count = sizes.iter().map(|size| size.iter().product::<usize>()).sum();
        let parameters = Var::from_tensor(&(var(&[count], 5).as_tensor() * 0.5).unwrap()).unwrap();
        let ours = || {
            let mut params = ParamBuilder::with(vec![parameters.as_tensor().clone()]);
            builder().build(&mut params).unwrap().forward(Some(&input), &features).unwrap()
        };
        let activate = |x: Tensor| match act {
            Activation::Identity => x,
            Activation::Relu => x.relu().unwrap(),
            Activation::Tanh => x.tanh().unwrap(),
        };
        let theirs = || {
            let p = cut(&parameters, &sizes);
            let plain = |values: &[f32], width: usize| ops::constant(values, width).unwrap();
            let dense = |x: &Tensor, w: &Tensor, b: &Tensor| x.matmul(w).unwrap().broadcast_add(b).unwrap();
            let team = plain(&features.states, 7).matmul(&p[1]).unwrap().unsqueeze(1).unwrap();
            let team = team.broadcast_as((CHAIN_ROWS / 5, 5, 20)).unwrap().reshape((CHAIN_ROWS, 20)).unwrap();
            let own = activate((dense(&plain(&features.goals, 5), &p[0], &p[2]) + team).unwrap());
            let real: Vec<f32> = features
                .counts
                .iter()
                .flat_map(|&count| (0..3u8).map(move |k| f32::from(u8::from(k < count))))
                .collect();
            let near = dense(&plain(&features.neighbours, 4), &p[3], &p[4]).relu().unwrap();
            let near =
                near.broadcast_mul(&plain(&real, 1)).unwrap().reshape((CHAIN_ROWS, 3, 18)).unwrap().sum(1).unwrap();
            let first = Tensor::cat(&[&own, input.as_tensor(), &near], 1).unwrap();
            let normal = ops::layer_norm(&first, &p[5], &p[6]).unwrap();
            dense(&activate(dense(&normal, &p[7], &p[8])), &p[9], &p[10])
        };
        let largest = |x: Tensor| x.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(largest((ours() - theirs()).unwrap()) < 1e-4, "{act:?}");
        let (a, b) = (probe(&ours()).backward().unwrap(), probe(&theirs()).backward().unwrap());
        for v in [&parameters, &input] {
            let (a, b) = (a.get(v).unwrap(), b.get(v).unwrap());
            let scale = largest(b.clone());
            assert!(largest((a - b).unwrap()) < 1e-4 * scale, "{act:?}");
        }
        if act != Activation::Relu {
            check(&[&parameters, &input], &ours);
        }
    }
}

#[test]
fn a_row_of_a_chain_has_the_same_bits_alone_and_with_and_without_a_gradient() {
    let features = chain_features();
    let goals: Field = |features| &features.goals;
    let builder = || ops::ChainBuilder::new().features("own", goals, (5, 40), Activation::Tanh, 1.0);
    let builder = || builder().dense("head", 5, Activation::Identity, 1.0);
    let parameters = var(&[5 * 40 + 40 + 40 * 5 + 5], 5);
    let run = |parameters: Tensor, features: &Arc<Features>| {
        let chain = builder().build(&mut ParamBuilder::with(vec![parameters])).unwrap();
        chain.forward(None, features).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    let all = run(parameters.as_tensor().clone(), &features);
    assert_eq!(all, run(parameters.as_tensor().detach(), &features));
    for (row, own) in all.chunks_exact(5).enumerate() {
        let goals = features.goals[row * 5..(row + 1) * 5].to_vec();
        assert_eq!(run(parameters.as_tensor().detach(), &Arc::new(Features { goals, ..Features::default() })), own);
    }
    let chain = builder().build(&mut ParamBuilder::with(vec![parameters.as_tensor().clone()])).unwrap();
    let wrong = Arc::new(Features { goals: vec![0.0; 11], ..Features::default() });
    assert!(chain.forward(None, &wrong).is_err());
}
