//! Passes over a row of the matrix, eight columns at a time.

use crate::ties::NONE;

/// Columns are padded to whole groups of this size; each scan keeps this many independent minima.
pub(super) const LANES: usize = 8;

/// Appends the columns whose cost − price is up to `own` + `tolerance`, ascending, and raises `beaten` to what others are
/// below `own`.
pub(super) fn nearly_tight(
    costs: &[f64],
    price: &[f64],
    own: f64,
    tolerance: f64,
    beaten: &mut [f64; LANES],
    near: &mut Vec<u32>,
) {
    let limit = own + tolerance;
    let chunks = costs.as_chunks::<LANES>().0.iter().zip(price.as_chunks::<LANES>().0);
    for (chunk, (costs, price)) in chunks.enumerate() {
        let (mut reduced, mut hit) = ([0.0; LANES], [false; LANES]);
        for lane in 0..LANES {
            reduced[lane] = costs[lane] - price[lane];
            beaten[lane] = higher(own - reduced[lane], beaten[lane]);
            hit[lane] = reduced[lane] <= limit;
        }
        // Few chunks have one; a branch per entry would take longer than all of the above.
        let mut hits = (0..LANES).fold(0u32, |hits, lane| hits | u32::from(hit[lane]) << lane);
        if hits == 0xff {
            let first = (chunk * LANES) as u32;
            near.extend_from_slice(&[0, 1, 2, 3, 4, 5, 6, 7].map(|lane| first + lane));
            continue;
        }
        while hits > 0 {
            near.push((chunk * LANES) as u32 + hits.trailing_zeros());
            hits &= hits - 1;
        }
    }
}

/// The two smallest cost − price of a row, equal if the smallest occurs twice.
pub(super) fn two_least(costs: &[f64], price: &[f64]) -> (f64, f64) {
    let (mut least, mut second) = ([f64::INFINITY; LANES], [f64::INFINITY; LANES]);
    for (costs, price) in costs.as_chunks::<LANES>().0.iter().zip(price.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            let reduced = costs[lane] - price[lane];
            let larger = if reduced < least[lane] { least[lane] } else { reduced };
            least[lane] = lower(reduced, least[lane]);
            second[lane] = lower(larger, second[lane]);
        }
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            let (a, b) = (least[lane], least[lane + width]);
            second[lane] = lower(lower(second[lane], second[lane + width]), if a < b { b } else { a });
            least[lane] = lower(a, b);
        }
        width /= 2;
    }
    (least[0], second[0])
}

/// First column at or after `from` whose cost − price is `value`, which the caller has seen there.
pub(super) fn find(costs: &[f64], price: &[f64], value: f64, from: usize) -> usize {
    let aligned = from.next_multiple_of(LANES).min(costs.len());
    for col in from..aligned {
        if costs[col] - price[col] == value {
            return col;
        }
    }
    let chunks = costs[aligned..].as_chunks::<LANES>().0.iter().zip(price[aligned..].as_chunks::<LANES>().0);
    for (chunk, (costs, price)) in chunks.enumerate() {
        let mut hit = [false; LANES];
        for lane in 0..LANES {
            hit[lane] = costs[lane] - price[lane] == value;
        }
        if hit.iter().fold(false, |any, &hit| any | hit) {
            let lane = hit.iter().position(|&hit| hit).unwrap_or_default();
            return aligned + chunk * LANES + lane;
        }
    }
    debug_assert!(false, "the value was seen in this row");
    0
}

/// Shortens the paths through a row and returns the length of the shortest path to a column outside the tree.
pub(super) fn relax(costs: &[f64], open_price: &[f64], offset: f64, distance: &mut [f64]) -> f64 {
    let mut nearest = [f64::INFINITY; LANES];
    let columns = costs.as_chunks::<LANES>().0.iter().zip(open_price.as_chunks::<LANES>().0);
    for ((costs, price), distance) in columns.zip(distance.as_chunks_mut::<LANES>().0) {
        for lane in 0..LANES {
            distance[lane] = lower(costs[lane] - price[lane] - offset, distance[lane]);
            nearest[lane] = lower(distance[lane], nearest[lane]);
        }
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            nearest[lane] = lower(nearest[lane], nearest[lane + width]);
        }
        width /= 2;
    }
    nearest[0]
}

/// The least length.
pub(super) fn least(distance: &[f64]) -> f64 {
    let mut nearest = [f64::INFINITY; LANES];
    for distance in distance.as_chunks::<LANES>().0 {
        for lane in 0..LANES {
            nearest[lane] = lower(distance[lane], nearest[lane]);
        }
    }
    nearest.into_iter().fold(f64::INFINITY, lower)
}

/// The smaller one, as one instruction (f64::min would also look for NaN, which cannot occur here).
#[inline(always)]
pub(super) fn lower(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// The larger one.
#[inline(always)]
pub(super) fn higher(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// The column at this distance: the first one without an owner, which ends the search, else the first one.
pub(super) fn nearest_column(distance: &[f64], nearest: f64, row_of_col: &[u32]) -> usize {
    let mut first = usize::MAX;
    for (chunk, lengths) in distance.as_chunks::<LANES>().0.iter().enumerate() {
        if lengths.iter().fold(false, |any, &length| any | (length == nearest)) {
            for (lane, &length) in lengths.iter().enumerate() {
                let col = chunk * LANES + lane;
                if length == nearest && row_of_col[col] == NONE {
                    return col;
                }
                if length == nearest && first == usize::MAX {
                    first = col;
                }
            }
        }
    }
    debug_assert!(first != usize::MAX, "the nearest column was seen");
    first
}
