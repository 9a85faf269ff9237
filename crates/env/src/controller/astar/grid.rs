//! Cells of a rectangle, and where they are in the world.

use magex_core::error::FieldError;

/// Side of a cell in world units: the diameter of an agent, and its way in one step at full speed.
pub(super) const CELL: f64 = 0.2;
/// Room around starts and goals, world units.
const MARGIN: f64 = 1.0;
/// Limit of the cells: what the reservations of a plan may cost in memory (about 100 bytes each).
const CELLS_MAX: f64 = 4e6;

/// W × H cells; cell x + W · y has its centre at (x + X, y + Y) · [`CELL`].
#[derive(Debug, Clone)]
pub(super) struct Grid {
    width: u32,
    height: u32,
    /// X and Y.
    first: [f64; 2],
    /// Cells that no agent may enter; none in the tasks so far.
    blocked: Vec<bool>,
}

impl Grid {
    /// Covers all points and a margin around them, which is wider where there would be fewer cells than two per point.
    pub(super) fn around(points: &[[f64; 2]]) -> Result<Self, FieldError> {
        let least = |d: usize| points.iter().map(|point| point[d]).fold(f64::INFINITY, f64::min);
        let most = |d: usize| points.iter().map(|point| point[d]).fold(f64::NEG_INFINITY, f64::max);
        let mut margin = MARGIN;
        loop {
            let first = [0, 1].map(|d| ((least(d) - margin) / CELL).floor());
            let [width, height] = [0, 1].map(|d| ((most(d) + margin) / CELL).ceil() - first[d] + 1.0);
            let cells = width * height;
            if cells.is_nan() || cells > CELLS_MAX {
                let problem = format!(
                    "the map has {width} x {height} cells of {CELL} for astar, which plans on up to {CELLS_MAX}; \
                     use a smaller map, or the controller orca or scripted"
                );
                return Err(FieldError::new("task.side", problem));
            }
            if cells >= 2.0 * points.len() as f64 {
                let (width, height) = (width as u32, height as u32);
                return Ok(Self { width, height, first, blocked: vec![false; width as usize * height as usize] });
            }
            margin *= 2.0;
        }
    }

    pub(super) fn cells(&self) -> usize {
        self.blocked.len()
    }

    /// The centre of a cell.
    pub(super) fn centre(&self, cell: u32) -> [f64; 2] {
        let [x, y] = self.place(cell);
        [(f64::from(x) + self.first[0]) * CELL, (f64::from(y) + self.first[1]) * CELL]
    }

    /// Manhattan distance of two cells.
    pub(super) fn manhattan(&self, a: u32, b: u32) -> u32 {
        let ([ax, ay], [bx, by]) = (self.place(a), self.place(b));
        ax.abs_diff(bx) + ay.abs_diff(by)
    }

    /// How far a cell is from the line through two others, times the distance of these.
    pub(super) fn aside(&self, cell: u32, start: u32, goal: u32) -> u64 {
        let [place, start, goal] = [cell, start, goal].map(|cell| self.place(cell).map(i64::from));
        let [way, own] = [goal, place].map(|to| [to[0] - start[0], to[1] - start[1]]);
        (way[0] * own[1] - way[1] * own[0]).unsigned_abs()
    }

    /// The open cells to the right, left, above and below.
    pub(super) fn neighbours(&self, cell: u32) -> [Option<u32>; 4] {
        let [x, y] = self.place(cell);
        [
            (x + 1 < self.width).then(|| cell + 1),
            (x > 0).then(|| cell.wrapping_sub(1)),
            (y + 1 < self.height).then(|| cell + self.width),
            (y > 0).then(|| cell.wrapping_sub(self.width)),
        ]
        .map(|next| next.filter(|&next| !self.blocked[next as usize]))
    }

    /// A cell of its own for every point: the nearest one that no point before it got, ties by the lower index.
    pub(super) fn distinct_cells(&self, points: &[[f64; 2]]) -> Vec<u32> {
        let mut taken = self.blocked.clone();
        let mut cells = Vec::with_capacity(points.len());
        for point in points {
            let cell = self.nearest(point, &taken);
            taken[cell as usize] = true;
            cells.push(cell);
        }
        cells
    }

    /// The nearest cell that is not taken, found ring by ring: beyond a ring of radius r every centre is at least
    /// r + 1/2 cells away.
    fn nearest(&self, point: &[f64; 2], taken: &[bool]) -> u32 {
        let own = [0, 1].map(|d| (point[d] / CELL - self.first[d] + 0.5).floor() as i64);
        let (width, height) = (i64::from(self.width), i64::from(self.height));
        let mut best = (f64::INFINITY, 0);
        for radius in 0..width.max(height) {
            let away = (radius as f64 - 0.5) * CELL;
            if away > 0.0 && away * away > best.0 {
                break;
            }
            for y in (own[1] - radius).max(0)..=(own[1] + radius).min(height - 1) {
                for x in (own[0] - radius).max(0)..=(own[0] + radius).min(width - 1) {
                    let cell = (x + width * y) as u32;
                    if (x - own[0]).abs().max((y - own[1]).abs()) != radius || taken[cell as usize] {
                        continue;
                    }
                    let centre = self.centre(cell);
                    let way = [centre[0] - point[0], centre[1] - point[1]];
                    let distance = way[0].mul_add(way[0], way[1] * way[1]);
                    if distance < best.0 || (distance == best.0 && cell < best.1) {
                        best = (distance, cell);
                    }
                }
            }
        }
        best.1
    }

    fn place(&self, cell: u32) -> [u32; 2] {
        [cell % self.width, cell / self.width]
    }
}

#[cfg(test)]
impl Grid {
    /// From a drawing: `#` is blocked, the first line is the highest.
    pub(super) fn drawn(lines: &[&str]) -> Self {
        let (width, height) = (lines[0].len() as u32, lines.len() as u32);
        let blocked = lines.iter().rev().flat_map(|line| line.bytes().map(|byte| byte == b'#')).collect();
        Self { width, height, first: [0.0; 2], blocked }
    }

    pub(super) fn cell(&self, x: u32, y: u32) -> u32 {
        x + self.width * y
    }
}
