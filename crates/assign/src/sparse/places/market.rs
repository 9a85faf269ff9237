//! Places with supplies and places with demands: a cheapest flow between them, and the arcs of all cheapest ones.

use super::simplex::{Arc, Simplex, Tree};
use crate::fixed::{Fixed, Scale};
use crate::sparse::MOST_NEAR;
use crate::sparse::candidates::Candidates;
use crate::sparse::points::Points;
use crate::ties;
use crate::{AssignError, GoOn, Result};

/// Pairs of places up to which all of them are arcs from the beginning.
const FEW: usize = 1 << 18;
/// Otherwise the cheapest ones of each row.
const NEAREST: usize = 8;
/// Every look at all pairs adds at most this number of them for each row, those that are cheaper than their values.
const CHEAPER: usize = 4;

/// No fewer rows than columns.
pub(super) struct Market<const D: usize> {
    pub(super) source: Points<D>,
    /// `[rows]`, and one more for what stands for no row, if some columns may have none.
    pub(super) supply: Vec<u64>,
    pub(super) demand: Vec<u64>,
    /// What a column without a row costs, and a row without a column.
    pub(super) no_row: f64,
    pub(super) no_col: f64,
    /// No cost has a larger magnitude.
    pub(super) magnitude: f64,
}

/// The pairs of places that cheapest flows use, with the flow of one of them.
pub(super) struct Flows {
    /// (row, column, flow)
    pub(super) arcs: Vec<(u32, u32, u64)>,
}

impl<const D: usize> Market<D> {
    /// A cheapest flow in exact arithmetic and the arcs of all of them; where there are too many, a flow that is cheapest as
    /// far as doubles can tell, and its own arcs. Nothing if doubles are not enough to find one.
    pub(super) fn solve(&mut self, go_on: GoOn<'_>) -> Result<Option<Flows>> {
        let Some((simplex, penalty)) = self.rounded(go_on)? else {
            return Ok(None);
        };
        let Some(near) = self.near(&simplex, go_on)? else {
            return Ok(Some(Flows { arcs: flowing(&simplex.tree) }));
        };
        let (mut scale, mut switches) = (Scale::default(), 0usize);
        scale.include(penalty);
        for &(row, col) in &near {
            let (terms, current) = self.terms(row, col);
            terms.into_iter().for_each(|term| scale.include(term));
            switches += usize::from(current);
        }
        let switches = (usize::BITS - switches.leading_zeros()) + 1;
        // Room for the sum of two terms along a path through all nodes, for the sum of three of those, and the sign.
        let bits = scale.bits() + switches + 1 + (usize::BITS - simplex.value.len().leading_zeros()) + 2 + 1;
        let input = Input { near: &near, penalty, unit: scale.unit(), switches };
        match bits {
            ..=128 => self.exact::<2>(&input, simplex.tree, go_on),
            129..=256 => self.exact::<4>(&input, simplex.tree, go_on),
            257..=640 => self.exact::<10>(&input, simplex.tree, go_on),
            // All doubles there are.
            _ => self.exact::<36>(&input, simplex.tree, go_on),
        }
    }

    fn terms(&self, row: u32, col: u32) -> ([f64; 2], bool) {
        match ((row as usize) < self.source.rows(), (col as usize) < self.source.cols()) {
            (true, true) => self.source.terms(row, col),
            (true, false) => ([self.no_col, 0.0], false),
            (false, true) => ([self.no_row, 0.0], false),
            (false, false) => ([0.0, 0.0], false),
        }
    }

    fn arc(&self, row: u32, col: u32) -> Arc<f64> {
        let ([first, second], _) = self.terms(row, col);
        Arc { row, col, cost: first + second }
    }

    /// A cheapest flow in doubles, and the penalty that it was found with.
    pub(super) fn rounded(&mut self, go_on: GoOn<'_>) -> Result<Option<(Simplex<f64>, f64)>> {
        let mut penalty = if self.magnitude > 0.0 { 2.0 * self.magnitude } else { 1.0 };
        let most = penalty * 16.0 * (self.supply.len() + self.demand.len()) as f64;
        let mut simplex = Simplex::new(&self.supply, &self.demand, penalty);
        let tolerance = |penalty: f64| penalty / (1u64 << 44) as f64;
        simplex.tolerance = tolerance(penalty);
        self.first_arcs(&mut simplex.arcs, go_on)?;
        loop {
            simplex.run(|tolerance| 4.0 * tolerance, go_on)?;
            if self.add_cheaper(&mut simplex, go_on)? {
                continue;
            }
            if !simplex.tree.unserved() {
                return Ok(Some((simplex, penalty)));
            }
            // Where pairs are forbidden, the way to serve all can be long.
            penalty *= 16.0;
            if penalty > most || penalty > 1e304 {
                return Ok(None);
            }
            simplex.tolerance = tolerance(penalty).max(simplex.tolerance);
            simplex.set_penalty(penalty);
        }
    }

    /// The arcs to begin with.
    fn first_arcs(&mut self, arcs: &mut Vec<Arc<f64>>, go_on: GoOn<'_>) -> Result<()> {
        let (rows, cols) = (self.source.rows() as u32, self.source.cols() as u32);
        let all = self.supply.len() * self.demand.len() <= FEW;
        let price = vec![0.0; cols as usize];
        let mut found = Vec::new();
        for row in 0..self.supply.len() as u32 {
            if row % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            if all || row >= rows {
                let every = (0..self.demand.len() as u32).map(|col| self.arc(row, col));
                arcs.extend(every.filter(|arc| arc.cost < f64::INFINITY));
                continue;
            }
            self.source.nearest(row, NEAREST, &price, &mut found);
            arcs.extend(found.iter().map(|found| Arc { row, col: found.col, cost: found.cost }));
            arcs.extend((cols..self.demand.len() as u32).map(|col| self.arc(row, col)));
        }
        Ok(())
    }

    /// Adds pairs that are cheaper than their values; whether there are any.
    fn add_cheaper(&mut self, simplex: &mut Simplex<f64>, go_on: GoOn<'_>) -> Result<bool> {
        if self.supply.len() * self.demand.len() <= FEW {
            return Ok(false);
        }
        let price = &simplex.value[self.supply.len()..][..self.source.cols()];
        self.source.reprice_all(price);
        let before = simplex.arcs.len();
        let mut found = Vec::new();
        for row in 0..self.source.rows() as u32 {
            if row % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            self.source.nearest(row, CHEAPER, price, &mut found);
            let own = simplex.value[row as usize];
            let cheaper = found.iter().filter(|found| found.reduced - own < -simplex.tolerance);
            simplex.arcs.extend(cheaper.map(|found| Arc { row, col: found.col, cost: found.cost }));
        }
        Ok(simplex.arcs.len() > before)
    }

    /// The nearly tight pairs (see [`crate::ties`]), those of the tree among them; nothing if there are too many.
    fn near(&mut self, simplex: &Simplex<f64>, go_on: GoOn<'_>) -> Result<Option<Vec<(u32, u32)>>> {
        let (rows, cols) = (self.supply.len(), self.demand.len());
        let magnitude = |values: &[f64]| values.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
        let (row_value, col_value) = simplex.value.split_at(rows);
        let col_value = &col_value[..cols];
        let price = &col_value[..self.source.cols()];
        self.source.reprice_all(price);
        let mut tolerance = ties::tolerance(rows.min(cols), magnitude(row_value), magnitude(col_value));
        let mut of_tree = vec![Vec::new(); rows];
        for (row, col) in (0..simplex.tree.root).filter_map(|node| simplex.tree.arc(node)) {
            of_tree[row as usize].push(col);
        }
        loop {
            let (mut near, mut found, mut beaten) = (Vec::new(), Vec::new(), 0.0);
            for (row, &own) in (0u32..).zip(row_value) {
                if row % 1024 == 0 && !go_on() {
                    return Err(AssignError::Interrupted);
                }
                found.clear();
                let mut others = 0..cols as u32;
                if (row as usize) < self.source.rows() {
                    self.source.within(row, own + tolerance, price, &mut found);
                    others.start = self.source.cols() as u32;
                }
                let reduced = |col: u32| self.arc(row, col).cost - col_value[col as usize];
                found.extend(others.filter(|&col| reduced(col) <= own + tolerance));
                found.extend_from_slice(&of_tree[row as usize]);
                found.sort_unstable();
                found.dedup();
                let least = found.iter().map(|&col| reduced(col)).fold(own, f64::min);
                beaten += own - least;
                near.extend(found.iter().map(|&col| (row, col)));
                if near.len() > MOST_NEAR {
                    return Ok(None);
                }
            }
            if beaten <= 0.25 * tolerance {
                return Ok(Some(near));
            }
            tolerance += 8.0 * beaten;
        }
    }

    /// Goes on from the tree of the rounded solution without rounding.
    fn exact<const N: usize>(&self, input: &Input<'_>, tree: Tree, go_on: GoOn<'_>) -> Result<Option<Flows>> {
        let of = |value: f64| Fixed::<N>::of(value, input.unit).shifted(input.switches);
        let cost = |row: u32, col: u32| {
            let ([first, second], current) = self.terms(row, col);
            let cost = of(first).plus(of(second));
            // So that the fewest switches win among equal sums.
            if current { cost.minus(Fixed::of(1.0, 0)) } else { cost }
        };
        let of_tree = (0..=tree.root).map(|node| match tree.arc(node) {
            Some((row, col)) => cost(row, col),
            None => of(input.penalty),
        });
        let of_tree = of_tree.collect();
        let arcs = input.near.iter().map(|&(row, col)| Arc { row, col, cost: cost(row, col) }).collect();
        let mut simplex = Simplex::of(tree, of_tree, arcs);
        simplex.run(|none| none, go_on)?;
        let Simplex { tree, value, arcs, .. } = simplex;
        if tree.unserved() {
            return Ok(None);
        }
        let tight =
            |arc: &&Arc<Fixed<N>>| arc.cost.minus(value[arc.row as usize]) == value[(tree.rows + arc.col) as usize];
        let arcs = arcs.iter().filter(tight).map(|arc| (arc.row, arc.col, tree.flow_of(arc.row, arc.col)));
        Ok(Some(Flows { arcs: arcs.collect() }))
    }
}

struct Input<'a> {
    near: &'a [(u32, u32)],
    penalty: f64,
    unit: i32,
    /// Bits below the cost.
    switches: u32,
}

/// The arcs of the tree.
fn flowing(tree: &Tree) -> Vec<(u32, u32, u64)> {
    let arcs = (0..tree.root).filter_map(|node| tree.arc(node).map(|(row, col)| (row, col, tree.flow[node as usize])));
    arcs.filter(|arc| arc.2 > 0).collect()
}
