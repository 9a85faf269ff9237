//! Decoding agent by agent with kept keys and values: what agents 0..=i have contributed does not change when agent i + 1 decides.
//! Plain slices, because a tensor operation costs more than the few rows that it would work on here.

use super::{Decoder, DecoderBlock, Head, Mat, Mlp, SelfAttention};
use crate::executor::memory::Norm;
use crate::executor::{Chooser, Layer};
use crate::ops::{Activation, Keys, Packed, attend, gelu_in_place, layer_norm_in_place, matmul, with_values};
use candle_core::{Result, Tensor};

/// A layer's weights as the product wants them.
struct Dense {
    weight: Packed,
    bias: Vec<f32>,
}

impl Dense {
    fn new(weight: &Tensor, bias: Option<&Tensor>) -> Result<Self> {
        let (inputs, outputs) = weight.dims2()?;
        Ok(Self {
            weight: with_values(weight, |w| Packed::new(w, inputs, outputs))?,
            bias: bias.map_or(Ok(vec![0.0; outputs]), Tensor::to_vec1)?,
        })
    }

    fn of(layer: &Layer) -> Result<Self> {
        Self::new(&layer.w, Some(&layer.b))
    }

    /// [C, inputs] → [C, outputs].
    fn forward(&self, x: &[f32], rows: usize) -> Vec<f32> {
        let mut y = vec![0.0; rows * self.bias.len()];
        matmul(x, &self.weight, Some(&self.bias), Activation::Identity, &mut y);
        y
    }
}

/// Scale and shift of a layer normalisation.
struct Scales(Vec<f32>, Vec<f32>);

impl Scales {
    fn of(norm: &Norm) -> Result<Self> {
        Ok(Self(norm.scale.to_vec1()?, norm.shift.to_vec1()?))
    }

    fn forward(&self, mut x: Vec<f32>) -> Vec<f32> {
        layer_norm_in_place(&mut x, &self.0, &self.1);
        x
    }
}

/// Keys and values of the agents that have decided, in C joint states.
struct Kept {
    /// [C, heads]
    keys: Vec<Keys>,
    /// [C, N, d]
    values: Vec<f32>,
}

/// One attention with what it keeps.
struct CachedAttention {
    query: Dense,
    key: Dense,
    value: Dense,
    out: Dense,
    heads: usize,
    scale: f32,
    kept: Kept,
}

impl CachedAttention {
    fn of(attention: &SelfAttention) -> Result<Self> {
        Ok(Self {
            query: Dense::of(&attention.query)?,
            key: Dense::of(&attention.key)?,
            value: Dense::of(&attention.value)?,
            out: Dense::of(&attention.out)?,
            heads: attention.shape.heads,
            scale: attention.shape.scale,
            kept: Kept { keys: Vec::new(), values: Vec::new() },
        })
    }

    fn reset(&mut self, states: usize, agents: usize, width: usize) {
        self.kept.keys = vec![Keys::new(agents, width / self.heads); states * self.heads];
        self.kept.values = vec![0.0; states * agents * width];
    }

    /// Agent i asks with `asking` [C, d]; `asked` [C, d] is what it adds to the keys and values.
    fn forward(&mut self, i: usize, agents: usize, asking: &[f32], asked: &[f32], states: usize) -> Vec<f32> {
        let (query, key) = (self.query.forward(asking, states), self.key.forward(asked, states));
        let value = self.value.forward(asked, states);
        let (width, part) = (value.len() / states, value.len() / states / self.heads);
        let mut mixed = vec![0.0; states * width];
        let mut weights = vec![0.0; agents.next_multiple_of(crate::ops::LANES)];
        for c in 0..states {
            let own = c * width..(c + 1) * width;
            let at = (c * agents + i) * width;
            self.kept.values[at..at + width].copy_from_slice(&value[own.clone()]);
            for h in 0..self.heads {
                let keys = &mut self.kept.keys[c * self.heads + h];
                let head = own.start + h * part..own.start + (h + 1) * part;
                keys.set(i, &key[head.clone()]);
                let values = &self.kept.values;
                let value = |j: usize| &values[(c * agents + j) * width + h * part..][..part];
                attend(&query[head.clone()], keys, i + 1, self.scale, value, &mut weights, &mut mixed[head]);
            }
        }
        self.out.forward(&mixed, states)
    }
}

/// d → d (GELU) → d.
struct CachedMlp(Dense, Dense);

impl CachedMlp {
    fn of(mlp: &Mlp) -> Result<Self> {
        Ok(Self(Dense::of(&mlp.wide)?, Dense::of(&mlp.narrow)?))
    }

    fn forward(&self, x: &[f32], rows: usize) -> Vec<f32> {
        let mut wide = self.0.forward(x, rows);
        gelu_in_place(&mut wide);
        self.1.forward(&wide, rows)
    }
}

struct CachedBlock {
    own: CachedAttention,
    cross: CachedAttention,
    norms: [Scales; 3],
    mlp: CachedMlp,
}

impl CachedBlock {
    fn of(block: &DecoderBlock) -> Result<Self> {
        let [a, b, c] = &block.norms;
        Ok(Self {
            own: CachedAttention::of(&block.own)?,
            cross: CachedAttention::of(&block.cross)?,
            norms: [Scales::of(a)?, Scales::of(b)?, Scales::of(c)?],
            mlp: CachedMlp::of(&block.mlp)?,
        })
    }
}

struct CachedHead(Dense, Scales, Dense);

impl CachedHead {
    fn of(head: &Head) -> Result<Self> {
        Ok(Self(Dense::of(&head.wide)?, Scales::of(&head.norm)?, Dense::of(&head.out)?))
    }

    fn forward(&self, x: &[f32], rows: usize) -> Vec<f32> {
        let mut wide = self.0.forward(x, rows);
        gelu_in_place(&mut wide);
        self.2.forward(&self.1.forward(wide), rows)
    }
}

/// The decoder of one joint step.
pub(super) struct Cache<'a> {
    mat: &'a Mat,
    embed: Dense,
    norm: Scales,
    blocks: Vec<CachedBlock>,
    logits: CachedHead,
}

impl<'a> Cache<'a> {
    pub(super) fn new(mat: &'a Mat, decoder: &Decoder) -> Result<Self> {
        Ok(Self {
            mat,
            embed: Dense::new(&decoder.embed, None)?,
            norm: Scales::of(&decoder.norm)?,
            blocks: decoder.blocks.iter().map(CachedBlock::of).collect::<Result<_>>()?,
            logits: CachedHead::of(&mat.logits)?,
        })
    }

    /// Chooses the actions of all agents of C joint states, given the encoder's features [C·N, d].
    pub(super) fn decode(mut self, encoded: &Tensor, agents: usize, choose: &mut dyn Chooser) -> Result<()> {
        let (width, components) = (self.mat.width, self.mat.heads.count());
        let encoded: Vec<f32> = encoded.flatten_all()?.to_vec1()?;
        let states = encoded.len() / (agents * width);
        for block in &mut self.blocks {
            block.own.reset(states, agents, width);
            block.cross.reset(states, agents, width);
        }
        let token_width = 1 + self.mat.heads.logits();
        // Each agent's token is what the agent before it did; the first one's starts the sequence.
        let mut tokens = vec![0.0; states * token_width];
        tokens.iter_mut().step_by(token_width).for_each(|start| *start = 1.0);
        let mut action = vec![0; components];
        for i in 0..agents {
            let own: Vec<f32> =
                (0..states).flat_map(|c| &encoded[(c * agents + i) * width..][..width]).copied().collect();
            let mut x = self.embed.forward(&tokens, states);
            gelu_in_place(&mut x);
            x = self.norm.forward(x);
            for block in &mut self.blocks {
                let heard = block.own.forward(i, agents, &x, &x, states);
                x = block.norms[0].forward(sum(&x, &heard));
                let heard = block.cross.forward(i, agents, &own, &x, states);
                x = block.norms[1].forward(sum(&own, &heard));
                let more = block.mlp.forward(&x, states);
                x = block.norms[2].forward(sum(&x, &more));
            }
            let logits = self.logits.forward(&x, states);
            tokens.fill(0.0);
            for (c, logits) in logits.chunks_exact(self.mat.heads.logits()).enumerate() {
                action.copy_from_slice(choose.choose(c * agents + i, logits));
                self.mat.heads.mark(&action, &mut tokens[c * token_width + 1..(c + 1) * token_width]);
            }
        }
        Ok(())
    }
}

fn sum(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}
