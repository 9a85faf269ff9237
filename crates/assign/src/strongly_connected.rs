//! Strongly connected components of a directed graph.

/// Of a node that was not met, or is in no component yet.
const NONE: u32 = u32::MAX;

/// The component of every node, and the nodes of every component (Tarjan 1972, with a stack of its own). `to` gives the target of
/// the k-th arc of a node: `Some(None)` for an arc that does not count, `None` behind the last one.
pub(crate) fn strongly_connected(nodes: usize, to: impl Fn(u32, usize) -> Option<Option<u32>>) -> (Vec<u32>, Vec<u32>) {
    // Order in which nodes were met, and the first one met of those that can be reached back.
    let (mut of, mut met, mut low) = (vec![NONE; nodes], vec![NONE; nodes], vec![0u32; nodes]);
    let (mut size, mut open, mut path, mut count) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for root in 0..nodes as u32 {
        if met[root as usize] != NONE {
            continue;
        }
        path.push((root, 0));
        while let Some(&mut (node, ref mut next)) = path.last_mut() {
            let at = node as usize;
            if *next == 0 {
                (met[at], low[at]) = (count, count);
                count += 1;
                open.push(node);
            }
            if let Some(target) = to(node, *next) {
                *next += 1;
                let Some(target) = target else { continue };
                if met[target as usize] == NONE {
                    path.push((target, 0));
                } else if of[target as usize] == NONE {
                    low[at] = low[at].min(met[target as usize]);
                }
                continue;
            }
            path.pop();
            if let Some(&(parent, _)) = path.last() {
                low[parent as usize] = low[parent as usize].min(low[at]);
            }
            if low[at] == met[at] {
                let component = size.len() as u32;
                size.push(0);
                while let Some(member) = open.pop() {
                    of[member as usize] = component;
                    size[component as usize] += 1;
                    if member == node {
                        break;
                    }
                }
            }
        }
    }
    (of, size)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_are_components_and_arcs_that_do_not_count_close_none() {
        // 0 → 1 → 2 → 0, 2 → 3, 3 → 4, 4 → 3 does not count, 5 alone.
        let arcs: [&[Option<u32>]; 6] = [&[Some(1)], &[Some(2)], &[Some(3), Some(0)], &[Some(4)], &[None, None], &[]];
        let (of, size) = strongly_connected(6, |node, at| arcs[node as usize].get(at).copied());
        assert!(of[0] == of[1] && of[1] == of[2]);
        let mut distinct = of[2..].to_vec();
        distinct.sort_unstable();
        distinct.dedup();
        assert_eq!((distinct.len(), size.len()), (4, 4));
        assert_eq!((size[of[0] as usize], size[of[3] as usize], size[of[5] as usize]), (3, 1, 1));
    }
}
