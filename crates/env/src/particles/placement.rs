//! Random points that keep their distance from one another.

use magex_core::rng::Stream;

/// Draws after which random placement gives up and uses a lattice.
const PATIENCE: usize = 1000;

/// n uniform points `[n, 2]` in the centred square, `spacing` apart. A task that validates has room; if luck runs out all the
/// same, the points go on a lattice.
pub(crate) fn uniform(n: usize, side: f32, spacing: f64, stream: &mut Stream) -> Vec<f32> {
    scatter(n, side, spacing, None, stream).unwrap_or_else(|| lattice(n, side, spacing, stream))
}

/// n uniform points in the centred square, `spacing` apart and as far as asked from the points to `avoid` `[M, 2]`: one after
/// the other, each drawn again while it is too close to an earlier one. None if luck runs out.
pub(crate) fn scatter(
    n: usize,
    side: f32,
    spacing: f64,
    avoid: Option<(&[f32], f64)>,
    stream: &mut Stream,
) -> Option<Vec<f32>> {
    let (points, clearance) = avoid.unwrap_or_default();
    let mut draw = || side * (stream.uniform32() - 0.5);
    let mut out: Vec<f32> = Vec::with_capacity(2 * n);
    for _ in 0..n {
        let free = |&(x, y): &(f32, f32)| !near(&out, x, y, spacing) && !near(points, x, y, clearance);
        let (x, y) = (0..PATIENCE).map(|_| (draw(), draw())).find(free)?;
        out.extend([x, y]);
    }
    Some(out)
}

/// Whether (x, y) is closer than `distance` to any of the points `[M, 2]`.
pub(crate) fn near(points: &[f32], x: f32, y: f32, distance: f64) -> bool {
    let distance2 = (distance * distance) as f32;
    let mut near = false;
    for other in points.chunks_exact(2) {
        let (dx, dy) = (other[0] - x, other[1] - y);
        near |= dx.mul_add(dx, dy * dy) < distance2;
    }
    near
}

/// n points in random cells of the smallest square lattice that holds them, moved as far as the spacing allows.
pub(crate) fn lattice(n: usize, side: f32, spacing: f64, stream: &mut Stream) -> Vec<f32> {
    let columns = (1..).find(|c| c * c >= n).unwrap_or(1);
    let cell = f64::from(side) / columns as f64;
    let slack = (cell - spacing).max(0.0);
    let mut order = stream.permutation(columns * columns);
    order.truncate(n);
    let mut coordinate = |k: usize| cell * (k as f64 + 0.5) - 0.5 * f64::from(side) + slack * (stream.uniform() - 0.5);
    let mut place = |k: &u32| [coordinate(*k as usize % columns), coordinate(*k as usize / columns)];
    flatten(order.iter().map(&mut place))
}

/// Points as coordinates `[n, 2]`.
pub(crate) fn flatten(points: impl Iterator<Item = [f64; 2]>) -> Vec<f32> {
    points.flatten().map(|c| c as f32).collect()
}
