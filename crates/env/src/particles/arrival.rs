//! When an episode's landmarks were first covered, without counting the covered ones at every step.
//!
//! An uncovered landmark is a witness that not all are covered. Each world remembers one and looks for another only
//! when it is covered itself, so the usual cost of a step is one landmark instead of N. With N ≥ 100, where 99 % are
//! enough, ⌊N / 100⌋ + 1 uncovered landmarks are the proof, found by a scan that starts at the witness.

use super::cells::Cells;

/// The arrival steps of a batch.
#[derive(Debug, Clone)]
pub(crate) struct Arrivals<const W: usize> {
    /// Landmarks that may stay uncovered.
    allowed: usize,
    radius2: f32,
    /// `[blocks][W]` step of arrival, 0 while it has not happened.
    steps: Vec<[u32; W]>,
    /// `[blocks]` worlds still waiting for it.
    waiting: Vec<u32>,
    /// `[blocks][W]` an uncovered landmark and where it is.
    witness: Vec<[u32; W]>,
    wx: Vec<[f32; W]>,
    wy: Vec<[f32; W]>,
}

/// The worlds of one block as the arrival test sees them.
pub(crate) struct View<'a, const W: usize> {
    /// `[N][W]`
    pub(crate) x: &'a [[f32; W]],
    pub(crate) y: &'a [[f32; W]],
    /// `[worlds of the block, N, 2]`
    pub(crate) landmarks: &'a [f32],
    /// The block's only world, sorted.
    pub(crate) cells: Option<&'a Cells<f32>>,
}

impl<const W: usize> Arrivals<W> {
    /// `landmarks` is `[B, N, 2]`.
    pub(crate) fn new(worlds: usize, agents: usize, radius2: f32, landmarks: &[f32]) -> Self {
        let blocks = worlds.div_ceil(W);
        let mut new = Self {
            allowed: agents / 100,
            radius2,
            steps: vec![[0; W]; blocks],
            waiting: vec![0; blocks],
            witness: vec![[0; W]; blocks],
            wx: vec![[0.0; W]; blocks],
            wy: vec![[0.0; W]; blocks],
        };
        for (world, points) in landmarks.chunks_exact(2 * agents).enumerate() {
            let (block, w) = (world / W, world % W);
            new.waiting[block] += 1;
            (new.wx[block][w], new.wy[block][w]) = (points[0], points[1]);
        }
        new
    }

    /// Step of arrival of a world, if it has arrived.
    pub(crate) fn step(&self, world: usize) -> Option<u32> {
        Some(self.steps[world / W][world % W]).filter(|&step| step > 0)
    }

    /// Looks at a block after step number `step` (from 1).
    pub(crate) fn observe(&mut self, block: usize, step: u32, view: &View<'_, W>) {
        if self.waiting[block] == 0 {
            return;
        }
        // Squared distance of the witness to the nearest agent; one witness is no proof if others may be uncovered.
        let mut nearest = [if self.allowed == 0 { f32::INFINITY } else { 0.0 }; W];
        if self.allowed == 0 {
            let (wx, wy) = (self.wx[block], self.wy[block]);
            for (x, y) in view.x.iter().zip(view.y) {
                for w in 0..W {
                    let (dx, dy) = (x[w] - wx[w], y[w] - wy[w]);
                    let d2 = dx.mul_add(dx, dy * dy);
                    nearest[w] = if d2 < nearest[w] { d2 } else { nearest[w] };
                }
            }
        }
        let worlds = view.landmarks.len() / (2 * view.x.len());
        for (w, &nearest) in nearest.iter().enumerate().take(worlds) {
            let doubt = nearest <= self.radius2 && self.steps[block][w] == 0;
            if doubt && !self.find_witness(block, w, view) {
                self.steps[block][w] = step;
                self.waiting[block] -= 1;
            }
        }
    }

    /// Finds more than `allowed` uncovered landmarks and remembers the first; false if there are fewer.
    fn find_witness(&mut self, block: usize, w: usize, view: &View<'_, W>) -> bool {
        let n = view.x.len();
        let landmarks = &view.landmarks[2 * n * w..2 * n * (w + 1)];
        let start = self.witness[block][w] as usize;
        let mut uncovered = 0;
        for landmark in (start..n).chain(0..start) {
            let (lx, ly) = (landmarks[2 * landmark], landmarks[2 * landmark + 1]);
            let covered = match view.cells {
                Some(cells) => cells.any_within(lx, ly, self.radius2),
                None => view.x.iter().zip(view.y).any(|(x, y)| {
                    let (dx, dy) = (x[w] - lx, y[w] - ly);
                    dx.mul_add(dx, dy * dy) <= self.radius2
                }),
            };
            if !covered {
                if uncovered == 0 {
                    self.witness[block][w] = landmark as u32;
                    (self.wx[block][w], self.wy[block][w]) = (lx, ly);
                }
                uncovered += 1;
                if uncovered > self.allowed {
                    return true;
                }
            }
        }
        false
    }
}
