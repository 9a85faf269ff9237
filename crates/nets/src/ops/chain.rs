//! A chain of dense layers as one operation. A tile of rows stays in the cache from the first layer to the last, and back; nothing
//! but the result and the gradient of the weights passes through the tensor library.
//!
//! A chain begins with branches side by side (layers of features, a pool of neighbours, another operation's result) and goes on
//! with layers one behind the other.

mod gradients;
mod run;

use super::buffer::Buffer;
use super::matmul::{Activation, Packed};
use super::operation::{Arg, Operation, apply1, apply2};
use super::pool::PoolWeights;
use crate::features::Features;
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Result, Shape, Tensor, bail};
use std::ops::Range;
use std::sync::{Arc, OnceLock};

pub(super) use gradients::slopes;

/// Rows of a tile: a multiple of what the products hold in registers, few enough for the first two cache levels.
pub(super) const TILE: usize = 96;

/// Which numbers of the features a branch reads.
pub type Field = fn(&Features) -> &[f32];

/// Where a dense layer's weights stand: w [k, n] at `w`, b `[n]` at `b`.
#[derive(Debug, Clone, Copy)]
struct Dense {
    k: usize,
    n: usize,
    w: usize,
    b: usize,
    act: Activation,
}

impl Dense {
    fn weights(&self) -> Range<usize> {
        self.w..self.w + self.k * self.n
    }

    fn bias(&self) -> Range<usize> {
        self.b..self.b + self.n
    }
}

/// What stands side by side in the first rows.
#[derive(Debug, Clone, Copy)]
enum Branch {
    /// act(features [R, k] · w + b), and for some the state of the team [R / N, s] times weights [s, n] at `.1`.
    Features(Dense, Field, Option<(usize, usize, Field)>),
    /// Pool of `.1` neighbours, [k, n] a layer of one neighbour.
    Neighbours(Dense, usize),
    /// The operation's input [R, n].
    Input(usize),
}

impl Branch {
    fn width(&self) -> usize {
        match self {
            Self::Features(dense, ..) | Self::Neighbours(dense, _) => dense.n,
            Self::Input(width) => *width,
        }
    }
}

/// What follows.
#[derive(Debug, Clone, Copy)]
enum Layer {
    Dense(Dense),
    /// Layer normalisation of n numbers, scale at `.1`, shift right behind it.
    Norm(usize, usize),
}

#[derive(Debug, Clone, Default)]
struct Layout {
    branches: Vec<Branch>,
    layers: Vec<Layer>,
}

impl Layout {
    /// Width of the first rows.
    fn first(&self) -> usize {
        self.branches.iter().map(Branch::width).sum()
    }

    /// Widths of the first rows and of what each layer gives.
    fn widths(&self) -> Vec<usize> {
        let layer = |layer: &Layer| match layer {
            Layer::Dense(dense) => dense.n,
            Layer::Norm(n, _) => *n,
        };
        [self.first()].into_iter().chain(self.layers.iter().map(layer)).collect()
    }

    /// The first rows are the operation's input as it is.
    fn input_only(&self) -> bool {
        matches!(self.branches[..], [Branch::Input(_)])
    }
}

/// Weights as the kernels want them; made once for all uses of a chain.
#[derive(Default)]
struct Packs {
    forward: OnceLock<Vec<Pack>>,
    backward: OnceLock<Vec<Option<Packed>>>,
}

enum Pack {
    Dense(Packed),
    /// Weights of features, and of the state of the team.
    Two(Packed, Packed),
    Pool(PoolWeights),
    None,
}

/// A chain with its parameters.
#[derive(Clone)]
pub struct Chain {
    layout: Arc<Layout>,
    packs: Arc<Packs>,
    parameters: Tensor,
}

/// Collects the branches and layers of a chain, and the names of its parameters.
#[derive(Default)]
pub struct ChainBuilder {
    layout: Layout,
    members: Vec<(String, Vec<usize>, Init)>,
    count: usize,
}

impl ChainBuilder {
    /// Without a branch.
    pub fn new() -> Self {
        Self::default()
    }

    fn member(&mut self, name: String, shape: &[usize], init: Init) -> usize {
        let at = self.count;
        self.count += shape.iter().product::<usize>();
        self.members.push((name, shape.to_vec(), init));
        at
    }

    fn weights(&mut self, name: &str, (k, n): (usize, usize), act: Activation, gain: f64) -> Dense {
        let w = self.member(format!("{name}.weight"), &[k, n], Init::Orthogonal(gain));
        let b = self.member(format!("{name}.bias"), &[n], Init::Constant(0.0));
        Dense { k, n, w, b, act }
    }

    /// A branch: a dense layer of features.
    pub fn features(mut self, name: &str, field: Field, sizes: (usize, usize), act: Activation, gain: f64) -> Self {
        let dense = self.weights(name, sizes, act, gain);
        self.layout.branches.push(Branch::Features(dense, field, None));
        self
    }

    /// A branch: a dense layer of features and of the state of the team, act(features · w + state · w' + b).
    pub fn features_and_team(
        mut self,
        (name, team): (&str, &str),
        (field, states): (Field, Field),
        ((k, s), n): ((usize, usize), usize),
        act: Activation,
        gain: f64,
    ) -> Self {
        let w = self.member(format!("{name}.weight"), &[k, n], Init::Orthogonal(gain));
        let shared = self.member(format!("{team}.weight"), &[s, n], Init::Orthogonal(gain));
        let b = self.member(format!("{name}.bias"), &[n], Init::Constant(0.0));
        self.layout.branches.push(Branch::Features(Dense { k, n, w, b, act }, field, Some((s, shared, states))));
        self
    }

    /// A branch: the sum over an agent's nearest neighbours of relu(neighbour → n).
    pub fn neighbours(mut self, name: &str, neighbours: usize, sizes: (usize, usize), gain: f64) -> Self {
        let dense = self.weights(name, sizes, Activation::Relu, gain);
        self.layout.branches.push(Branch::Neighbours(dense, neighbours));
        self
    }

    /// A branch: the operation's input [R, width] as it is.
    pub fn input(mut self, width: usize) -> Self {
        self.layout.branches.push(Branch::Input(width));
        self
    }

    /// A dense layer.
    pub fn dense(mut self, name: &str, outputs: usize, act: Activation, gain: f64) -> Self {
        let inputs = self.width();
        let dense = self.weights(name, (inputs, outputs), act, gain);
        self.layout.layers.push(Layer::Dense(dense));
        self
    }

    /// Layer normalisation.
    pub fn norm(mut self, name: &str) -> Self {
        let width = self.width();
        let at = self.member(format!("{name}.scale"), &[width], Init::Constant(1.0));
        self.member(format!("{name}.shift"), &[width], Init::Constant(0.0));
        self.layout.layers.push(Layer::Norm(width, at));
        self
    }

    /// Numbers of a row behind the last layer so far.
    pub fn width(&self) -> usize {
        self.layout.widths().last().copied().unwrap_or(0)
    }

    /// With the next parameters.
    pub fn build(self, params: &mut ParamBuilder) -> std::result::Result<Chain, ParamError> {
        let parameters = params.group(self.members)?;
        Ok(Chain { layout: Arc::new(self.layout), packs: Arc::default(), parameters })
    }
}

impl Chain {
    /// [R, n]. `input` is what the branch of that kind reads; R is its number of rows, or that of the features.
    pub fn forward(&self, input: Option<&Tensor>, features: &Arc<Features>) -> Result<Tensor> {
        let op = self.operation(features, input.is_some_and(Tensor::track_op));
        match input {
            None => apply1(op, &self.parameters),
            Some(input) => apply2(op, [input, &self.parameters]),
        }
    }

    /// The operation of one use; `keep` says whether what it reads has a gradient.
    pub(super) fn operation(&self, features: &Arc<Features>, keep: bool) -> Op {
        let (layout, packs, features) = (self.layout.clone(), self.packs.clone(), features.clone());
        Op { layout, packs, features, keep: keep || self.parameters.track_op(), saved: OnceLock::new() }
    }

    pub(super) fn parameters(&self) -> &Tensor {
        &self.parameters
    }
}

pub(super) struct Op {
    layout: Arc<Layout>,
    packs: Arc<Packs>,
    features: Arc<Features>,
    /// Whether there will be a gradient.
    keep: bool,
    /// Rows that enter each layer, all R of them.
    saved: OnceLock<Vec<Buffer>>,
}

impl Operation<1> for Op {
    const NAME: &'static str = "chain";

    fn forward(&self, [parameters]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        self.run(None, parameters.values)
    }

    fn backward(&self, [parameters]: [Arg<'_>; 1], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        Ok([Some(self.gradients((None, parameters.values), y, dy, &mut [])?)])
    }
}

impl Operation<2> for Op {
    const NAME: &'static str = "chain";

    fn forward(&self, [input, parameters]: [Arg<'_>; 2]) -> Result<(Vec<f32>, Shape)> {
        self.run(Some(input), parameters.values)
    }

    fn backward(&self, [input, parameters]: [Arg<'_>; 2], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 2]> {
        let mut d_input = vec![0.0; input.values.len()];
        let gradient = self.gradients((Some(input), parameters.values), y, dy, &mut d_input)?;
        Ok([Some(d_input), Some(gradient)])
    }
}

impl Op {
    fn packs(&self, p: &[f32]) -> &[Pack] {
        self.packs.forward.get_or_init(|| {
            let dense = |d: &Dense| Packed::new(&p[d.weights()], d.k, d.n);
            let branches = self.layout.branches.iter().map(|branch| match branch {
                Branch::Features(d, _, None) => Pack::Dense(dense(d)),
                Branch::Features(d, _, Some((s, at, _))) => {
                    Pack::Two(dense(d), Packed::new(&p[*at..at + s * d.n], *s, d.n))
                }
                Branch::Neighbours(d, count) => {
                    Pack::Pool(PoolWeights::new(&p[d.weights()], &p[d.bias()], count * d.k))
                }
                Branch::Input(_) => Pack::None,
            });
            let layers = self.layout.layers.iter().map(|layer| match layer {
                Layer::Dense(d) => Pack::Dense(dense(d)),
                Layer::Norm(..) => Pack::None,
            });
            branches.chain(layers).collect()
        })
    }

    fn transposed(&self, p: &[f32]) -> &[Option<Packed>] {
        self.packs.backward.get_or_init(|| {
            let layers = self.layout.layers.iter().map(|layer| match layer {
                Layer::Dense(d) => Some(Packed::transposed(&p[d.weights()], d.k, d.n)),
                Layer::Norm(..) => None,
            });
            layers.collect()
        })
    }

    /// R, after a look at every size.
    fn rows(&self, input: Option<Arg<'_>>) -> Result<usize> {
        let mut rows = input.map(|input| input.rows().0);
        let mut see = |found: usize, width: usize, len: usize| -> Result<()> {
            if width == 0 || len != found * width || rows.is_some_and(|rows| rows != found) {
                bail!("chain: {len} numbers of {width} a row do not fit {rows:?} rows");
            }
            rows = Some(found);
            Ok(())
        };
        for branch in &self.layout.branches {
            match branch {
                Branch::Features(d, field, _) => {
                    let len = field(&self.features).len();
                    see(len / d.k, d.k, len)?;
                }
                Branch::Neighbours(d, count) => {
                    see(self.features.counts.len(), d.k * count, self.features.neighbours.len())?;
                }
                Branch::Input(width) => {
                    let Some(input) = input else { bail!("chain: no input") };
                    see(input.rows().0, *width, input.values.len())?;
                }
            }
        }
        match rows {
            Some(rows) => Ok(rows),
            None => bail!("chain: no branch"),
        }
    }

    /// N: rows that share a state of the team.
    fn sharing(&self, rows: usize, states: &[f32], width: usize) -> Result<usize> {
        let states = states.len() / width.max(1);
        if states == 0 || !rows.is_multiple_of(states) {
            bail!("chain: {states} states do not fit {rows} rows");
        }
        Ok(rows / states)
    }
}

impl Layer {
    fn act(&self) -> Activation {
        match self {
            Self::Dense(dense) => dense.act,
            Self::Norm(..) => Activation::Identity,
        }
    }
}
