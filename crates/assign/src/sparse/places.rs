//! Points many of which are the same: agents and goals of the same place are alike.
//!
//! Where many points share a place, all pairs of two places cost the same, and an auction or a search would go through the
//! copies one by one. So the points of a place are counted instead: how many agents of each place go to each place of goals is a
//! transportation problem between places ([`market`]), and which agent gets which goal follows from the order of the answers
//! ([`lowest`]). Points that have costs of their own with some other, or are in force, are places of their own.

mod lowest;
mod market;
mod shares;
mod simplex;

use super::costs::{Metric, OwnCost, OwnCosts};
use super::points::Points;
use crate::{GoOn, Result};
use lowest::Tight;
use market::Market;

pub(super) use shares::Shares;

/// Points of each place, on average, from which on they are counted: on both sides together, or on one of them.
const BOTH: usize = 2;
const ONE: usize = 4;

/// Short side, long side, and what their pairs cost.
pub(super) struct Problem<'a, const D: usize> {
    pub(super) short: &'a [[f64; D]],
    pub(super) long: &'a [[f64; D]],
    pub(super) metric: Metric,
    pub(super) own: &'a OwnCosts,
    pub(super) largest_cost: f64,
    /// What a point of the short side costs without one of the long side, if that may be.
    pub(super) sink: Option<f64>,
    /// Whether the agents are the long side.
    pub(super) turned: bool,
}

/// Points by their places.
struct Places<const D: usize> {
    points: Vec<[f64; D]>,
    /// Of every point.
    place: Vec<u32>,
    /// Where each place begins in `members`.
    start: Vec<usize>,
    /// Points, ascending in each place.
    members: Vec<u32>,
}

impl<const D: usize> Places<D> {
    /// Points that are `alone` share no place.
    fn of(points: &[[f64; D]], alone: &[bool]) -> Self {
        // −0 is 0.
        let key = |point: &[f64; D]| point.map(|x| (x + 0.0).to_bits());
        let mut order: Vec<([u64; D], u32)> = points.iter().map(key).zip(0..).collect();
        order.sort_unstable();
        let mut places =
            Self { points: Vec::new(), place: vec![0; points.len()], start: Vec::new(), members: Vec::new() };
        let mut last = None;
        for (key, member) in order {
            let single = alone.get(member as usize).is_some_and(|alone| *alone);
            if single || last != Some(key) {
                places.start.push(places.members.len());
                places.points.push(points[member as usize]);
            }
            last = (!single).then_some(key);
            places.place[member as usize] = places.points.len() as u32 - 1;
            places.members.push(member);
        }
        places.start.push(places.members.len());
        places
    }

    fn members(&self, place: u32) -> &[u32] {
        &self.members[self.start[place as usize]..self.start[place as usize + 1]]
    }
}

/// Both sides by their places, and the pairs with costs of their own between those.
pub(super) struct Counted<const D: usize> {
    short_at: Places<D>,
    long_at: Places<D>,
    own: OwnCosts,
}

impl<const D: usize> Counted<D> {
    /// If places are worth counting.
    pub(super) fn new(short: &[[f64; D]], long: &[[f64; D]], own: &OwnCosts) -> Option<Self> {
        let (mut short_alone, mut long_alone) = (Vec::new(), Vec::new());
        if !own.is_empty() {
            (short_alone, long_alone) = (vec![false; short.len()], vec![false; long.len()]);
            for pair in &own.pairs {
                (short_alone[pair.row as usize], long_alone[pair.col as usize]) = (true, true);
            }
        }
        let (short_at, long_at) = (Places::of(short, &short_alone), Places::of(long, &long_alone));
        let most = (short.len() / short_at.points.len()).max(long.len() / long_at.points.len());
        if BOTH * (short_at.points.len() + long_at.points.len()) > short.len() + long.len() && most < ONE {
            return None;
        }
        let places = |pair: &OwnCost| {
            let (row, col) = (short_at.place[pair.row as usize], long_at.place[pair.col as usize]);
            OwnCost { row, col, ..*pair }
        };
        let own = OwnCosts::new(own.pairs.iter().map(places).collect(), short_at.points.len());
        Some(Self { short_at, long_at, own })
    }
}

/// The goal of every agent, if places are worth counting.
pub(super) fn solve<const D: usize>(problem: &Problem<'_, D>, go_on: GoOn<'_>) -> Result<Option<Vec<u32>>> {
    let &Problem { short, long, metric, own, largest_cost, sink, turned } = problem;
    let Some(Counted { short_at, long_at, own }) = Counted::new(short, long, own) else {
        return Ok(None);
    };
    // What looks for partners is the side of more places.
    let flipped = short_at.points.len() < long_at.points.len();
    let (rows_at, cols_at) = if flipped { (&long_at, &short_at) } else { (&short_at, &long_at) };
    let own_at = if flipped { own.turned(long_at.points.len()) } else { own };
    let (source, order) = Points::new(&rows_at.points, &cols_at.points, metric, &own_at, largest_cost, None);
    let count = |at: &Places<D>, places: &[u32]| -> Vec<u64> {
        places.iter().map(|&place| at.members(place).len() as u64).collect()
    };
    let (mut supply, mut demand) = (count(rows_at, &order.row_at), count(cols_at, &order.col_at));
    // What stands for none: for points of the long side without one of the short side, and the other way round.
    let for_short = if sink.is_some() { short.len() } else { 0 };
    let for_long = long.len() - short.len() + for_short;
    let (as_row, as_col) = if flipped { (for_short, for_long) } else { (for_long, for_short) };
    supply.extend((as_row > 0).then_some(as_row as u64));
    demand.extend((as_col > 0).then_some(as_col as u64));
    let without = sink.unwrap_or(0.0);
    let (no_row, no_col) = if flipped { (without, 0.0) } else { (0.0, without) };
    let finite = own_at.pairs.iter().map(OwnCost::cost).filter(|cost| *cost < f64::INFINITY);
    let magnitude = finite.fold(largest_cost.abs().max(without.abs()), |most, cost| most.max(cost.abs()));
    let mut market = Market { source, supply, demand, no_row, no_col, magnitude };
    let Some(flows) = market.solve(go_on)? else {
        return Ok(None);
    };
    let agents_are_rows = turned == flipped;
    let tight = |&(row, col, flow): &(u32, u32, u64)| {
        let (agents, goals) = if agents_are_rows { (row, col) } else { (col, row) };
        Tight { agents, goals, flow }
    };
    let arcs: Vec<Tight> = flows.arcs.iter().map(tight).collect();
    let (agents_at, goals_at) = if agents_are_rows { (rows_at, cols_at) } else { (cols_at, rows_at) };
    let (agent_order, goal_order) =
        if agents_are_rows { (&order.row_at, &order.col_at) } else { (&order.col_at, &order.row_at) };
    let mut solved = vec![0; agent_order.len()];
    (0u32..).zip(agent_order).for_each(|(number, &place)| solved[place as usize] = number);
    let agents: Vec<u32> = agents_at.place.iter().map(|&place| solved[place as usize]).collect();
    let goals: Vec<&[u32]> = goal_order.iter().map(|&place| goals_at.members(place)).collect();
    lowest::lowest(arcs, &agents, &goals, [agent_order.len() + 1, goal_order.len() + 1], go_on)
}

#[cfg(test)]
mod tests;
