//! Keyed random streams: the only source of randomness in MAGE-X.
//!
//! A stream is named by what it is for and by where it is used: (run seed, purpose, five indices). Two streams with
//! different keys are independent, and a stream does not depend on what was drawn before it anywhere else, so a shard
//! gives the same numbers on whichever actor it runs. Indices are part of the ChaCha key itself: no hashing, no
//! "seed + i", no collisions.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// What a stream is for. The number is part of the key: never reuse or reorder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum Purpose {
    /// Spawn positions of a training episode; indices: iteration, episode.
    Spawn = 1,
    /// Executor actions of a training episode; indices: iteration, episode.
    Action = 2,
    /// Gumbel noise of the executor's graph; indices: iteration, episode.
    Graph = 3,
    /// Goal sampling by the commander; indices: iteration, episode.
    Commander = 4,
    /// Initial weights; indices: network.
    Init = 5,
    /// Order of the minibatches; indices: iteration, epoch.
    Shuffle = 6,
    /// Spawn positions of an evaluation episode; indices: set, episode.
    EvalSpawn = 7,
    /// Sampled actions of an evaluation episode; indices: set, episode.
    EvalAction = 8,
    /// Goal sampling in evaluation; indices: set, episode.
    EvalCommander = 9,
    /// Synthetic assignment instances; indices: free.
    Instances = 10,
    /// Benchmarks; indices: free.
    Bench = 11,
    /// Requests from outside clients; indices: free.
    Request = 12,
    /// Gumbel noise of the executor's graph in sampled evaluation; indices: set, episode.
    EvalGraph = 13,
    /// Whether a training episode's goals are a random matching, and which; indices: iteration, episode.
    RandomGoals = 14,
    /// Randomness of a controller without weights (noise, random actions); indices: set or iteration, episode, 1 in evaluation.
    Controller = 15,
    /// Which episodes of the replay buffer a gradient step takes; indices: iteration, gradient step.
    Replay = 16,
    /// Which shards are computed a second time; keyed by a secret of the learner's process, because no number of a run depends
    /// on it; indices: iteration, shard, kind, evaluation set.
    Recompute = 17,
    /// Resamples of the bootstrap; indices: resample, system, task.
    Bootstrap = 31,
}

/// The name of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Key {
    /// Seed of the run.
    pub seed: u64,
    /// What the stream is for.
    pub purpose: Purpose,
    /// Where it is used; the meaning belongs to the purpose, unused places are zero.
    pub index: [u32; 5],
}

impl Key {
    /// A key with up to five indices; missing ones are zero.
    pub fn new(seed: u64, purpose: Purpose, indices: &[u32]) -> Self {
        debug_assert!(indices.len() <= 5, "a key has five indices");
        let mut index = [0; 5];
        for (slot, &value) in index.iter_mut().zip(indices) {
            *slot = value;
        }
        Self { seed, purpose, index }
    }

    /// Opens the stream from its start.
    pub fn stream(&self) -> Stream {
        let mut bytes = [0u8; 32];
        bytes[..8].copy_from_slice(&self.seed.to_le_bytes());
        bytes[8..12].copy_from_slice(&(self.purpose as u32).to_le_bytes());
        for (slot, value) in bytes[12..].chunks_exact_mut(4).zip(self.index) {
            slot.copy_from_slice(&value.to_le_bytes());
        }
        Stream { rng: ChaCha8Rng::from_seed(bytes) }
    }
}

/// A stream of random numbers. The algorithms below are part of the product's reproducibility: changing one changes
/// every run, and golden tests notice.
#[derive(Debug, Clone)]
pub struct Stream {
    rng: ChaCha8Rng,
}

impl Stream {
    /// 32 random bits.
    pub fn bits32(&mut self) -> u32 {
        self.rng.next_u32()
    }

    /// 64 random bits.
    pub fn bits64(&mut self) -> u64 {
        self.rng.next_u64()
    }

    /// Uniform in [0, 1) with 24 bits.
    pub fn uniform32(&mut self) -> f32 {
        (self.bits32() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in [0, 1) with 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.bits64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Uniform in [low, high).
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Standard normal (Box–Muller, the cosine half; `libm`, so that the bits are the same on every machine).
    pub fn normal(&mut self) -> f64 {
        let radius = libm::sqrt(-2.0 * libm::log(1.0 - self.uniform()));
        radius * libm::cos(2.0 * std::f64::consts::PI * self.uniform())
    }

    /// A whole number below `bound`, without bias (rejection). `bound` = 0 gives 0.
    pub fn below(&mut self, bound: u32) -> u32 {
        if bound <= 1 {
            return 0;
        }
        let limit = u32::MAX - (u32::MAX - bound + 1) % bound;
        loop {
            let bits = self.bits32();
            if bits <= limit {
                return bits % bound;
            }
        }
    }

    /// Fisher–Yates shuffle in place.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            let j = self.below(i as u32 + 1) as usize;
            items.swap(i, j);
        }
    }

    /// The permutation 0..n, shuffled.
    pub fn permutation(&mut self, n: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..n as u32).collect();
        self.shuffle(&mut order);
        order
    }
}

/// The key of element `index` of a sequence of bulk-noise keys (SplitMix64's output function on a Weyl sequence).
#[inline]
pub fn sequence(base: u64, index: u32) -> u64 {
    let mut z = base.wrapping_add(u64::from(index).wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Mixes a 64-bit key and a counter into 32 random bits: a counter-based generator for bulk noise that must be
/// replayed in any order (the graph's Gumbel noise). Only 32-bit multiplies and shifts, so it vectorises.
#[inline(always)]
pub fn mix(key: u64, counter: u32) -> u32 {
    let (low, high) = (key as u32, (key >> 32) as u32);
    let mut x = counter.wrapping_mul(0x9e37_79b9) ^ low;
    x ^= x >> 16;
    x = x.wrapping_mul(0x21f0_aaad);
    x ^= x >> 15;
    x = x.wrapping_add(high).wrapping_mul(0xd35a_2d97);
    x ^= x >> 15;
    x = x.wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_pinned_and_independent() {
        let first: Vec<u32> = {
            let mut s = Key::new(7, Purpose::Spawn, &[1, 2, 3]).stream();
            (0..4).map(|_| s.bits32()).collect()
        };
        let again: Vec<u32> = {
            let mut s = Key::new(7, Purpose::Spawn, &[1, 2, 3]).stream();
            (0..4).map(|_| s.bits32()).collect()
        };
        let other: Vec<u32> = {
            let mut s = Key::new(7, Purpose::Action, &[1, 2, 3]).stream();
            (0..4).map(|_| s.bits32()).collect()
        };
        assert_eq!(first, again);
        assert_ne!(first, other);
    }

    #[test]
    fn below_is_in_range_and_covers() {
        let mut s = Key::new(1, Purpose::Bench, &[]).stream();
        let mut seen = [0u32; 7];
        for _ in 0..7000 {
            seen[s.below(7) as usize] += 1;
        }
        assert!(seen.iter().all(|&n| (800..1200).contains(&n)), "{seen:?}");
    }

    #[test]
    fn mix_is_uniform_in_every_bit_and_uncorrelated_with_its_neighbour() {
        let key = 0x0123_4567_89ab_cdef;
        let mut ones = [0i32; 32];
        let mut flips = [0i32; 32];
        let n = 1 << 16;
        for counter in 0..n {
            let (a, b) = (mix(key, counter), mix(key, counter + 1));
            for bit in 0..32 {
                ones[bit] += ((a >> bit) & 1) as i32;
                flips[bit] += (((a ^ b) >> bit) & 1) as i32;
            }
        }
        let bound = 6 * 128; // six standard deviations of a fair coin thrown 2^16 times
        for bit in 0..32 {
            assert!((ones[bit] - n as i32 / 2).abs() < bound, "bit {bit}: {}", ones[bit]);
            assert!((flips[bit] - n as i32 / 2).abs() < bound, "flip {bit}: {}", flips[bit]);
        }
    }

    #[test]
    fn a_shuffle_is_a_permutation() {
        let mut order = Key::new(3, Purpose::Shuffle, &[1]).stream().permutation(50);
        order.sort_unstable();
        assert_eq!(order, (0..50).collect::<Vec<_>>());
    }
}
