//! Synthetic assignment instances: teams that no simulation has seen, drawn from keyed streams, as many as are wanted.
//!
//! | layout | share | what |
//! |---|---|---|
//! | uniform | 3 / 8 | agents and goals uniform in a square |
//! | uneven | 1 / 8 | the same with up to twice as many goals as agents, or the other way round |
//! | lines | 1 / 4 | Simple Spread's four layouts on lines and circles |
//! | clusters | 1 / 4 | agents and goals around a few points each |
//!
//! Team sizes from 2 to 200, small ones as likely as large ones on a logarithmic scale. The scale of the map is not varied: the
//! scheduler sees lengths in units of the instance's own mean distance.

use magex_core::rng::Stream;
use magex_core::task::{Spawn, TaskConfig};
use magex_env::spawn::spawn;
use magex_nets::commander::Team;

pub(crate) const SIZES: [usize; 2] = [2, 200];

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Synthetic {
    /// `[N, 2]`
    pub(crate) agents: Vec<f32>,
    /// `[G, 2]`
    pub(crate) goals: Vec<f32>,
}

impl Synthetic {
    /// Draws layout, size and places.
    pub(crate) fn draw(stream: &mut Stream) -> Self {
        let [low, high] = SIZES.map(|n| libm::log(n as f64));
        let n = (libm::exp(stream.range(low, high)).round() as usize).clamp(SIZES[0], SIZES[1]);
        match stream.below(8) {
            0..3 => Self::starts(n, Spawn::Uniform, stream),
            3 => {
                let more = (n + stream.below(n as u32 + 1) as usize).min(SIZES[1]);
                let (agents, goals) = (square(n, stream), square(more, stream));
                if stream.below(2) == 0 { Self { agents, goals } } else { Self { agents: goals, goals: agents } }
            }
            4..6 => Self::starts(n, Spawn::Lines(None), stream),
            _ => Self { agents: clusters(n, stream), goals: clusters(n, stream) },
        }
    }

    pub(crate) fn starts(n: usize, layout: Spawn, stream: &mut Stream) -> Self {
        let start = spawn(&TaskConfig::simple_spread(n, layout), stream);
        Self { agents: start.agents, goals: start.landmarks }
    }

    pub(crate) fn team(&self) -> Team<'_> {
        Team { agents: &self.agents, goals: &self.goals, dims: 2 }
    }
}

fn square(n: usize, stream: &mut Stream) -> Vec<f32> {
    (0..2 * n).map(|_| stream.uniform32()).collect()
}

fn clusters(n: usize, stream: &mut Stream) -> Vec<f32> {
    let count = 1 + stream.below(4);
    let centres = square(count as usize, stream);
    let radius = stream.range(0.02, 0.3);
    let mut points = Vec::with_capacity(2 * n);
    for _ in 0..n {
        let centre = 2 * stream.below(count) as usize;
        points.extend((0..2).map(|k| centres[centre + k] + (radius * stream.normal()) as f32));
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    #[test]
    fn every_size_and_both_kinds_of_uneven_teams_are_drawn_and_all_is_finite() {
        let mut seen = [false; 4];
        for k in 0..400 {
            let team = Synthetic::draw(&mut Key::new(1, Purpose::Instances, &[9, k]).stream());
            let (n, g) = (team.agents.len() / 2, team.goals.len() / 2);
            assert!((SIZES[0]..=SIZES[1]).contains(&n) && (SIZES[0]..=SIZES[1]).contains(&g), "{n} {g}");
            assert!(team.agents.iter().chain(&team.goals).all(|x| x.is_finite()));
            [n < g, n > g, n <= 5, n >= 100].into_iter().zip(&mut seen).for_each(|(now, seen)| *seen |= now);
        }
        assert_eq!(seen, [true; 4]);
    }
}
