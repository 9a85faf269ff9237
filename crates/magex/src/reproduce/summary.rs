//! What the records of a table say.

use super::budget::Cell;
use super::record::{EndedBy, Record};
use super::systems::{Paper, PaperTable, System};
use magex_stats::aggregate::{average, iqm, mean, median, optimality_gap, standard_deviation};
use magex_stats::bootstrap::{RESAMPLES, interval, interval_of_two};
use magex_stats::distribution::{performance_profile, probability_of_improvement};
use magex_stats::{Interval, Scores};

/// The seed of every bootstrap: an interval is the same whenever it is computed.
const SEED: u64 = 1;
/// Thresholds of the performance profiles.
pub(crate) const THRESHOLDS: [f64; 8] = [0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999];

/// A cell with the records of its seeds, at least one.
#[derive(Debug, Clone)]
pub(crate) struct Measured {
    pub(crate) cell: Cell,
    pub(crate) records: Vec<Record>,
}

/// A number over the seeds of a cell: of each seed the mean of its episodes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct OverSeeds {
    pub(crate) mean: f64,
    /// `None` with a single seed.
    pub(crate) deviation: Option<f64>,
    pub(crate) iqm: f64,
    /// `None` with a single seed.
    pub(crate) interval: Option<Interval>,
}

impl OverSeeds {
    fn of(seeds: Vec<f64>) -> Option<Self> {
        let (mean, deviation) = (average(&seeds), standard_deviation(&seeds));
        let scores = Scores::new(vec![seeds]).ok()?;
        Some(Self { mean, deviation, iqm: iqm(&scores), interval: interval(&scores, SEED, RESAMPLES, iqm) })
    }
}

impl Measured {
    pub(crate) fn greedy(&self) -> Option<OverSeeds> {
        OverSeeds::of(self.scores())
    }

    pub(crate) fn sampled(&self) -> Option<OverSeeds> {
        OverSeeds::of(self.records.iter().map(|record| average(&record.sampled.success_rate)).collect())
    }

    /// Share of crashed agents, if they can crash.
    pub(crate) fn collisions(&self) -> Option<OverSeeds> {
        let crash = self.cell.config.task.definition().crashes;
        let rates = self.records.iter().map(|record| average(&record.greedy.collision_rate)).collect();
        crash.then(|| OverSeeds::of(rates)).flatten()
    }

    /// First step after which (almost) all landmarks were covered, mean over greedy episodes and seeds; the horizon + 1 counts where
    /// that never happened.
    pub(crate) fn arrival(&self) -> f64 {
        average(&self.records.iter().map(|record| average(&record.greedy.arrival_step)).collect::<Vec<_>>())
    }

    /// Milliseconds per episode in a controller without weights.
    pub(crate) fn planning_ms(&self) -> Option<f64> {
        let of_seeds: Option<Vec<f64>> = self.records.iter().map(|record| record.planning_ms).collect();
        of_seeds.map(|of_seeds| average(&of_seeds))
    }

    /// The greedy success of every seed.
    fn scores(&self) -> Vec<f64> {
        self.records.iter().map(|record| average(&record.greedy.success_rate)).collect()
    }

    /// What the paper reports for this team size.
    pub(crate) fn paper(&self) -> Option<Paper> {
        let same = self.cell.table.tasks[self.cell.task].agents == self.cell.agents();
        self.cell.system.paper.get(self.cell.task).copied().filter(|_| same)
    }

    /// Joint environment steps, mean over the seeds.
    pub(crate) fn steps(&self) -> f64 {
        average(&self.records.iter().map(|record| record.joint_env_steps as f64).collect::<Vec<_>>())
    }

    pub(crate) fn wall_s(&self) -> f64 {
        average(&self.records.iter().map(|record| record.wall_s).collect::<Vec<_>>())
    }

    /// Why the trainings ended, each reason once.
    pub(crate) fn ended_by(&self) -> String {
        let reasons = [EndedBy::Target, EndedBy::Steps, EndedBy::Time, EndedBy::NoTraining];
        let there = |reason: &EndedBy| self.records.iter().any(|record| record.ended_by == *reason);
        reasons.into_iter().filter(there).map(EndedBy::words).collect::<Vec<_>>().join(", ")
    }

    /// `2/3` of the seeds of which it is known, or a dash where it is known of none.
    pub(crate) fn converged(&self) -> String {
        let known: Vec<bool> = self.records.iter().filter_map(|record| record.converged).collect();
        let converged = known.iter().filter(|&&converged| converged).count();
        if known.is_empty() { "–".into() } else { format!("{converged}/{}", known.len()) }
    }
}

/// A system over all tasks of a table.
#[derive(Debug, Clone)]
pub(crate) struct Aggregate {
    pub(crate) system: &'static System,
    /// Numbers that it rests on: tasks × seeds.
    pub(crate) count: usize,
    pub(crate) iqm: f64,
    pub(crate) interval: Option<Interval>,
    pub(crate) median: f64,
    pub(crate) mean: f64,
    pub(crate) optimality_gap: f64,
    /// Share of the runs above each of [`THRESHOLDS`].
    pub(crate) profile: Vec<f64>,
    /// How likely a run of MAGE-X beats one of this system; `None` for itself.
    pub(crate) improvement: Option<(f64, Option<Interval>)>,
}

/// Every system that was measured on all tasks that MAGE-X was measured on.
pub(crate) fn aggregates(table: &'static PaperTable, measured: &[Measured]) -> Vec<Aggregate> {
    let scores_of = |system: &System| {
        let own = measured.iter().filter(|one| one.cell.system.id == system.id);
        let (tasks, scores): (Vec<usize>, Vec<_>) = own.map(|one| (one.cell.task, one.scores())).unzip();
        Some((tasks, Scores::new(scores).ok()?))
    };
    let Some((tasks, first)) = scores_of(&table.systems[0]) else { return Vec::new() };
    let aggregate = |system: &'static System| {
        let (_, scores) = scores_of(system).filter(|(own, _)| *own == tasks)?;
        let improves = |x: &Scores, y: &Scores| probability_of_improvement(x, y).unwrap_or(f64::NAN);
        let improvement = (system.id != table.systems[0].id)
            .then(|| (improves(&first, &scores), interval_of_two([&first, &scores], SEED, RESAMPLES, improves)));
        Some(Aggregate {
            system,
            count: scores.flat().count(),
            iqm: iqm(&scores),
            interval: interval(&scores, SEED, RESAMPLES, iqm),
            median: median(&scores),
            mean: mean(&scores),
            optimality_gap: optimality_gap(&scores, 1.0),
            profile: performance_profile(&scores, &THRESHOLDS),
            improvement,
        })
    };
    table.systems.iter().filter_map(aggregate).collect()
}
