//! The policy of a rollout: its memory, its noise, and the keyed choice of actions.

use magex_core::ids::{Mode, Shard};
use magex_core::rng::{Key, Stream, sequence};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{Act, Chooser, Input, Model};
use magex_nets::features::Features;
use magex_nets::ops::GraphNoise;
use std::sync::Arc;

/// Chooses each episode's actions from that episode's own stream, or the most likely ones.
pub(super) struct KeyedChooser<'a> {
    heads: &'a ActionHeads,
    /// `[B]`; `None` takes the most likely actions.
    streams: Option<Vec<Stream>>,
    agents: usize,
    /// ε of action values; `None` samples from a policy's distribution.
    pub(super) epsilon: Option<f32>,
    /// [B·N, H]
    pub(super) actions: Vec<u8>,
    /// [B·N, C]
    pub(super) moves: Vec<f32>,
    /// `[B·N]`
    pub(super) log_probs: Vec<f32>,
    /// Place in the logits [B·N, A] of one that is not finite.
    pub(super) not_finite: Option<usize>,
}

impl<'a> KeyedChooser<'a> {
    /// `keys` `[B]` name the episodes' streams.
    pub(super) fn new(heads: &'a ActionHeads, agents: usize, mode: Mode, keys: impl Iterator<Item = Key>) -> Self {
        let streams: Vec<Stream> = keys.map(|key| key.stream()).collect();
        let rows = streams.len() * agents;
        Self {
            heads,
            streams: (mode == Mode::Sampled).then_some(streams),
            agents,
            epsilon: None,
            actions: vec![0; rows * heads.count()],
            moves: vec![0.0; rows * heads.moves()],
            log_probs: vec![0.0; rows],
            not_finite: None,
        }
    }
}

impl KeyedChooser<'_> {
    /// Sets an agent's action to zeros.
    pub(super) fn forget(&mut self, row: usize) {
        let (components, moves) = (self.heads.count(), self.heads.moves());
        self.actions[row * components..(row + 1) * components].fill(0);
        self.moves[row * moves..(row + 1) * moves].fill(0.0);
        self.log_probs[row] = 0.0;
    }
}

impl Chooser for KeyedChooser<'_> {
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8] {
        if let Some(place) = logits.iter().position(|x| !x.is_finite()) {
            self.not_finite.get_or_insert(row * logits.len() + place);
        }
        let (components, moves) = (self.heads.count(), self.heads.moves());
        if moves > 0 {
            let stream = self.streams.as_mut().map(|streams| &mut streams[row / self.agents]);
            let drawn = &mut self.moves[row * moves..(row + 1) * moves];
            self.log_probs[row] = self.heads.draw(logits, stream, drawn);
            return &[];
        }
        let action = &mut self.actions[row * components..(row + 1) * components];
        let stream = self.streams.as_mut().map(|streams| &mut streams[row / self.agents]);
        self.log_probs[row] = match self.epsilon {
            Some(epsilon) => self.heads.choose_epsilon_greedy(logits, epsilon, stream, action),
            None => self.heads.choose(logits, stream, action),
        };
        action
    }
}

/// What a policy carries through a batch of episodes.
pub(super) struct Carried {
    /// [B·N, H]
    hidden: Vec<f32>,
    /// `[B]` bases of the keys of the graph's noise; `None` acts without noise.
    noise: Option<Vec<u64>>,
    episodes: usize,
    agents: usize,
}

impl Carried {
    pub(super) fn new(model: &Model, shard: &Shard, agents: usize, graph: impl Iterator<Item = Key>) -> Self {
        let episodes = shard.episodes as usize;
        let noise = (shard.mode == Mode::Sampled).then(|| graph.map(|key| key.stream().bits64()).collect());
        Self { hidden: vec![0.0; episodes * agents * model.memory()], noise, episodes, agents }
    }

    /// Acts in one joint step; the memory moves on.
    pub(super) fn act(
        &mut self,
        policy: &dyn Act,
        features: &Arc<Features>,
        step: usize,
        choose: &mut dyn Chooser,
    ) -> candle_core::Result<()> {
        let noise = match &self.noise {
            Some(bases) => GraphNoise::Keyed(Arc::new(bases.iter().map(|&base| sequence(base, step as u32)).collect())),
            None => GraphNoise::Off,
        };
        let input = Input {
            steps: 1,
            sequences: self.episodes,
            agents: self.agents,
            features,
            hidden: std::mem::take(&mut self.hidden),
            noise,
        };
        if let Some(states) = policy.act(&input, choose)? {
            self.hidden = states.flatten_all()?.to_vec1()?;
        }
        Ok(())
    }
}
