//! Damaged copies of good examples, the same ones every time.

use magex_core::rng::{Key, Purpose, Stream};

/// Bytes that mean something in lengths, tags and numbers.
const TELLING: [u8; 10] = [0, 1, 0x7f, 0x80, 0xff, 0x08, 0x12, 0xc0, b'"', b'}'];

/// An endless stream of damaged copies.
#[derive(Debug)]
pub struct Mutations {
    examples: Vec<Vec<u8>>,
    chance: Stream,
}

impl Mutations {
    /// Copies of these examples, drawn with this seed.
    pub fn new(examples: Vec<Vec<u8>>, seed: u64) -> Self {
        Self { examples, chance: Key::new(seed, Purpose::Bench, &[]).stream() }
    }

    fn below(&mut self, bound: usize) -> usize {
        self.chance.below(bound.max(1) as u32) as usize
    }

    /// The next copy.
    pub fn draw(&mut self) -> Vec<u8> {
        let which = self.below(self.examples.len());
        let mut bytes = self.examples[which].clone();
        for _ in 0..=self.below(4) {
            let (at, count) = (self.below(bytes.len()), 1 + self.below(8));
            let end = bytes.len().min(at + count);
            match self.below(8) {
                _ if bytes.is_empty() => bytes.push(self.below(256) as u8),
                0 => bytes[at] ^= 1 << self.below(8),
                1 => bytes[at] = TELLING[self.below(TELLING.len())],
                2 => bytes[at] = self.below(256) as u8,
                3 => drop(bytes.drain(at..end)),
                4 => {
                    let again = bytes[at..end].to_vec();
                    bytes.splice(at..at, again).for_each(drop);
                }
                5 => bytes.truncate(at),
                6 => {
                    let other = self.below(self.examples.len());
                    let from = self.below(self.examples[other].len());
                    bytes.truncate(at);
                    bytes.extend_from_slice(&self.examples[other][from..]);
                }
                _ => {
                    for byte in &mut bytes[at..end] {
                        *byte = TELLING[usize::from(*byte) % TELLING.len()];
                    }
                }
            }
        }
        bytes
    }
}
