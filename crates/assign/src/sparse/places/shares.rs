//! A largest matching of places up to a threshold, for the bottleneck: rows have shares of columns.

use super::{Counted, Places};
use crate::sparse::NONE;
use crate::sparse::costs::Metric;
use crate::sparse::growing::{Growing, Seeker};
use crate::{AssignError, GoOn, Result};

/// The side of more places are the rows: ways are found sooner from many places to few.
pub(in crate::sparse) struct Shares<const D: usize> {
    seeker: Seeker<D>,
    /// Points of the shorter side, and of the rows.
    whole: usize,
    all: usize,
    /// Points of each row that have no column.
    left_over: Vec<usize>,
    /// Points of each column that have no row.
    room: Vec<usize>,
    /// Of each column, the rows that have some of it, and how much.
    holders: Vec<Vec<(u32, usize)>>,
    reached: Vec<u32>,
    /// The round in which a row was met last.
    met: Vec<u32>,
    round: u32,
}

/// A row on the way, the column that it would take, and how many of that column's holders were asked.
struct Step {
    row: u32,
    col: u32,
    asked: usize,
}

impl<const D: usize> Shares<D> {
    pub(in crate::sparse) fn new(counted: &Counted<D>, metric: Metric) -> Self {
        let Counted { short_at, long_at, .. } = counted;
        let turned = short_at.points.len() < long_at.points.len();
        let (rows_at, cols_at) = if turned { (long_at, short_at) } else { (short_at, long_at) };
        let own = if turned { &counted.own.turned(rows_at.points.len()) } else { &counted.own };
        let (seeker, order) = Seeker::new(&rows_at.points, &cols_at.points, metric, own);
        let count = |at: &Places<D>, places: &[u32]| -> Vec<usize> {
            places.iter().map(|&place| at.members(place).len()).collect()
        };
        Self {
            seeker,
            whole: short_at.members.len(),
            all: rows_at.members.len(),
            left_over: count(rows_at, &order.row_at),
            room: count(cols_at, &order.col_at),
            holders: vec![Vec::new(); order.col_at.len()],
            reached: Vec::new(),
            met: vec![0; order.row_at.len()],
            round: 0,
        }
    }

    /// Takes back the shares that are dearer than the limit.
    fn drop_dearer(&mut self, limit: f64) {
        let Self { seeker, left_over, room, holders, .. } = self;
        for (col, holders) in holders.iter_mut().enumerate() {
            holders.retain(|&(row, share)| {
                let kept = seeker.cost(row, col as u32) <= limit;
                if !kept {
                    left_over[row as usize] += share;
                    room[col] += share;
                }
                kept
            });
        }
    }

    /// Looks for a way from a row to a column that has room.
    fn find(&mut self, row: u32, limit: f64, way: &mut Vec<Step>) -> bool {
        way.clear();
        way.push(Step { row, col: NONE, asked: 0 });
        self.met[row as usize] = self.round;
        while let Some(step) = way.last_mut() {
            if step.col == NONE {
                let Some(col) = self.seeker.reach(step.row, limit) else {
                    self.reached.push(step.row);
                    way.pop();
                    continue;
                };
                (step.col, step.asked) = (col, 0);
                if self.room[col as usize] > 0 {
                    return true;
                }
            }
            let Some(&(holder, _)) = self.holders[step.col as usize].get(step.asked) else {
                step.col = NONE;
                continue;
            };
            step.asked += 1;
            if self.met[holder as usize] != self.round {
                self.met[holder as usize] = self.round;
                way.push(Step { row: holder, col: NONE, asked: 0 });
            }
        }
        false
    }

    /// Moves as much along a way as it allows; returns how much that is.
    fn move_along(&mut self, way: &[Step]) -> usize {
        let (Some(first), Some(last)) = (way.first(), way.last()) else {
            return 0;
        };
        let held = |step: &Step| (step.col as usize, step.asked - 1);
        let mut moved = self.left_over[first.row as usize].min(self.room[last.col as usize]);
        for step in &way[..way.len() - 1] {
            let (col, place) = held(step);
            moved = moved.min(self.holders[col][place].1);
        }
        self.left_over[first.row as usize] -= moved;
        self.room[last.col as usize] -= moved;
        for step in &way[..way.len() - 1] {
            let (col, place) = held(step);
            self.holders[col][place].1 -= moved;
        }
        for step in way {
            let holders = &mut self.holders[step.col as usize];
            match holders.iter_mut().find(|holder| holder.0 == step.row) {
                Some(holder) => holder.1 += moved,
                None => holders.push((step.row, moved)),
            }
            holders.retain(|holder| holder.1 > 0);
        }
        moved
    }
}

impl<const D: usize> Growing<D> for Shares<D> {
    fn seeker(&mut self) -> &mut Seeker<D> {
        &mut self.seeker
    }

    fn whole(&self) -> usize {
        self.whole
    }

    fn rows_are_shorter(&self) -> bool {
        self.all == self.whole
    }

    fn reached(&mut self) -> &mut Vec<u32> {
        &mut self.reached
    }

    fn grow(&mut self, limit: f64, go_on: GoOn<'_>) -> Result<usize> {
        self.drop_dearer(limit);
        let mut way = Vec::new();
        loop {
            self.seeker.left.restore();
            self.seeker.free.restore();
            for (col, _) in (0u32..).zip(&self.room).filter(|(_, room)| **room == 0) {
                self.seeker.free.close(col);
            }
            self.reached.clear();
            self.round += 1;
            let before: usize = self.left_over.iter().sum();
            for row in 0..self.left_over.len() as u32 {
                if row % 1024 == 0 && !go_on() {
                    return Err(AssignError::Interrupted);
                }
                while self.left_over[row as usize] > 0 && self.met[row as usize] != self.round {
                    if !self.find(row, limit, &mut way) {
                        break;
                    }
                    self.move_along(&way);
                    // What is on a way that led somewhere may be met again.
                    for step in &way {
                        self.met[step.row as usize] = 0;
                        self.seeker.left.reopen(step.col);
                        if self.room[step.col as usize] > 0 {
                            self.seeker.free.reopen(step.col);
                        }
                    }
                }
            }
            let after: usize = self.left_over.iter().sum();
            if after == 0 || after == before {
                return Ok(self.all - after);
            }
        }
    }

    fn largest(&mut self) -> f64 {
        let mut largest = f64::NEG_INFINITY;
        for (col, holders) in (0u32..).zip(&self.holders) {
            for &(row, _) in holders {
                largest = largest.max(self.seeker.cost(row, col));
            }
        }
        largest
    }
}
