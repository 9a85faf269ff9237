//! Exact assignment, so that the yardsticks do not depend on a solver that is tested elsewhere.

/// The goal of each point `[N, 2]` among the points `[N, 2]`, at the least sum of distances.
pub(crate) fn exact(from: &[f32], to: &[f32]) -> Vec<u32> {
    let distance = |a: &[f32], b: &[f32]| f64::from(a[0] - b[0]).hypot(f64::from(a[1] - b[1]));
    let cost: Vec<f64> = from.chunks_exact(2).flat_map(|a| to.chunks_exact(2).map(move |b| distance(a, b))).collect();
    assign(&cost, from.len() / 2)
}

/// Exact assignment by shortest augmenting paths; `cost` is [n, n], the result maps rows to columns.
fn assign(cost: &[f64], n: usize) -> Vec<u32> {
    // One-based potentials and matching with column 0 as the root of each search.
    let (mut u, mut v) = (vec![0.0; n + 1], vec![0.0; n + 1]);
    let (mut row_of, mut way) = (vec![0; n + 1], vec![0; n + 1]);
    for row in 1..=n {
        row_of[0] = row;
        let mut column = 0;
        let (mut slack, mut used) = (vec![f64::INFINITY; n + 1], vec![false; n + 1]);
        while row_of[column] != 0 {
            used[column] = true;
            let (i, mut delta, mut next) = (row_of[column], f64::INFINITY, 0);
            for j in (1..=n).filter(|&j| !used[j]) {
                let reduced = cost[(i - 1) * n + j - 1] - u[i] - v[j];
                if reduced < slack[j] {
                    (slack[j], way[j]) = (reduced, column);
                }
                if slack[j] < delta {
                    (delta, next) = (slack[j], j);
                }
            }
            for j in 0..=n {
                if used[j] {
                    u[row_of[j]] += delta;
                    v[j] -= delta;
                } else {
                    slack[j] -= delta;
                }
            }
            column = next;
        }
        while column != 0 {
            row_of[column] = row_of[way[column]];
            column = way[column];
        }
    }
    let mut columns = vec![0; n];
    (1..=n).for_each(|j| columns[row_of[j] - 1] = j as u32 - 1);
    columns
}
