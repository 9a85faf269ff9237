//! Largest one-to-one matching of landmarks to agents near them.

use std::collections::VecDeque;

/// Size of a maximum matching of the bipartite graph `near[landmark] = agents`, by augmenting paths found breadth
/// first (no recursion, so that long chains of thousands of agents are no danger to the stack).
pub(crate) fn maximum_matching(near: &[Vec<u32>], agents: usize) -> usize {
    const FREE: u32 = u32::MAX;
    let mut landmark_of = vec![FREE; agents];
    let mut agent_of = vec![FREE; near.len()];
    let mut size = 0;
    // `seen[agent]` = root of the last search that reached the agent; `via[agent]` = landmark it was reached from.
    let mut seen = vec![FREE; agents];
    let mut via = vec![FREE; agents];
    let mut queue = VecDeque::new();
    for root in 0..near.len() {
        queue.clear();
        queue.push_back(root as u32);
        let mut end = None;
        'search: while let Some(landmark) = queue.pop_front() {
            for &agent in &near[landmark as usize] {
                let a = agent as usize;
                if seen[a] == root as u32 {
                    continue;
                }
                (seen[a], via[a]) = (root as u32, landmark);
                if landmark_of[a] == FREE {
                    end = Some(agent);
                    break 'search;
                }
                queue.push_back(landmark_of[a]);
            }
        }
        let Some(mut agent) = end else { continue };
        size += 1;
        // Flip the path from the free agent back to the root.
        loop {
            let landmark = via[agent as usize];
            let previous = agent_of[landmark as usize];
            landmark_of[agent as usize] = landmark;
            agent_of[landmark as usize] = agent;
            if landmark as usize == root {
                break;
            }
            agent = previous;
        }
    }
    size
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    /// By trying everything.
    fn exhaustive(near: &[Vec<u32>], used: u32) -> usize {
        let Some((first, rest)) = near.split_first() else { return 0 };
        let skip = exhaustive(rest, used);
        first
            .iter()
            .filter(|&&a| used & (1 << a) == 0)
            .map(|&a| 1 + exhaustive(rest, used | (1 << a)))
            .fold(skip, usize::max)
    }

    #[test]
    fn agrees_with_exhaustive_search() {
        let mut stream = Key::new(1, Purpose::Instances, &[77]).stream();
        for _ in 0..500 {
            let n = 1 + stream.below(7);
            let near: Vec<Vec<u32>> = (0..n).map(|_| (0..n).filter(|_| stream.uniform() < 0.3).collect()).collect();
            assert_eq!(maximum_matching(&near, n as usize), exhaustive(&near, 0), "{near:?}");
        }
    }

    #[test]
    fn a_long_chain_is_matched_completely() {
        // Landmark k is near agents k and k + 1; the last one only near agent 0: every landmark must shift.
        let n = 20_000;
        let mut near: Vec<Vec<u32>> = (0..n - 1).map(|k| vec![k, k + 1]).collect();
        near.push(vec![0]);
        assert_eq!(maximum_matching(&near, n as usize), n as usize);
    }
}
