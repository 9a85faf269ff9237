//! Cycles of the graph in which a row points at the owners of its nearly tight columns.

use super::{Graph, Memory, NONE, Solution};
use crate::strongly_connected::strongly_connected;

/// Whether the solution is the only optimum. The pool, which owns the columns without a row, points at the rows whose columns
/// may stay alone.
pub(super) fn has_no_cycle(near: &Graph, tolerance: f64, solution: &Solution<'_>, memory: &mut Memory) -> bool {
    let rows = near.rows();
    let pooled = pooled(tolerance, solution);
    if near.cols.len() == rows {
        // Every row has its own column alone.
        return true;
    }
    let pool = rows;
    let owner = |col: u32| solution.row_of_col[col as usize];
    let Memory { degree, ready } = memory;
    degree.clear();
    degree.resize(rows + 1, 0);
    for (row, _) in solution.col_of_row.iter().enumerate() {
        for &col in near.of(row) {
            let owner = owner(col);
            if owner != row as u32 {
                degree[if owner == NONE { pool } else { owner as usize }] += 1;
            }
        }
    }
    pooled.iter().for_each(|&row| degree[row as usize] += 1);
    // Takes away what nothing points at, until nothing is left or only cycles are.
    ready.clear();
    ready.extend((0..=pool as u32).filter(|&node| degree[node as usize] == 0));
    let mut taken = 0;
    while let Some(node) = ready.pop() {
        taken += 1;
        let mut free = |next: u32| {
            degree[next as usize] -= 1;
            if degree[next as usize] == 0 {
                ready.push(next);
            }
        };
        if node as usize == pool {
            pooled.iter().for_each(|&row| free(row));
            continue;
        }
        for &col in near.of(node as usize) {
            let owner = owner(col);
            if owner != node {
                free(if owner == NONE { pool as u32 } else { owner });
            }
        }
    }
    taken == rows + 1
}

/// Rows whose columns may stay alone, if there are more columns than rows.
pub(super) fn pooled(tolerance: f64, solution: &Solution<'_>) -> Vec<u32> {
    if solution.col_price.len() == solution.row_price.len() {
        return Vec::new();
    }
    let spare = |(_, col): &(u32, &u32)| -solution.col_price[**col as usize] <= tolerance;
    (0..).zip(solution.col_of_row.iter()).filter(spare).map(|(row, _)| row).collect()
}

/// The strongly connected components: only inside them there are cycles.
pub(super) struct Components {
    /// `[rows + 1]` component of each row and, last, of the pool.
    of_node: Vec<u32>,
    /// `[cols]` owner, the pool's number for columns without a row.
    owner: Vec<u32>,
    /// Rows per component.
    size: Vec<u32>,
}

impl Components {
    /// `pooled` are the rows whose columns may stay alone.
    pub(super) fn of(near: &Graph, row_of_col: &[u32], pooled: &[u32]) -> Self {
        let rows = near.rows();
        let pool = rows as u32;
        let owner: Vec<u32> = row_of_col.iter().map(|&row| if row == NONE { pool } else { row }).collect();
        let (of_node, size) = strongly_connected(rows + 1, |node, at| {
            let target = if node == pool {
                pooled.get(at).copied()
            } else {
                near.of(node as usize).get(at).map(|&col| owner[col as usize])
            };
            target.map(Some)
        });
        Self { of_node, owner, size }
    }

    /// Whether the row is in a cycle.
    pub(super) fn cyclic(&self, row: usize) -> bool {
        self.size[self.of_node[row] as usize] > 1
    }

    /// Whether the row's component holds the pool: its columns may stay alone.
    pub(super) fn pooled(&self, row: usize) -> bool {
        self.of_node[row] == self.of_node[self.of_node.len() - 1]
    }

    /// The pairs that a cycle can use: those inside a component. A row that is in no cycle has none.
    pub(super) fn inner(&self, near: &Graph) -> Graph {
        let mut inner = Graph::default();
        inner.clear();
        for row in 0..near.rows() {
            if self.cyclic(row) {
                let same = |col: &&u32| self.of_node[self.owner[**col as usize] as usize] == self.of_node[row];
                inner.cols.extend(near.of(row).iter().filter(same));
            }
            inner.end_row();
        }
        inner
    }
}
