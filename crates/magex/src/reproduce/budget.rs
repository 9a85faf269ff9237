//! How long cells are trained and how often they are evaluated.

use super::systems::{By, LARGE, PaperTable, System};
use anyhow::Context as _;
use magex_core::config::{RunConfig, Setting};

/// The paper trains every learner for this many joint environment steps.
const PAPER_STEPS: u64 = 3_000_000;
/// In the smoke test a team has at most this many agents.
const SMALL: usize = 5;

/// A budget by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub(crate) enum BudgetName {
    /// A few thousand steps, small teams: checks that everything works; the numbers mean nothing.
    Smoke,
    /// One seed, each learner's own budget, at most 40 seconds per training.
    #[default]
    Quick,
    /// Three seeds, 3,000,000 joint steps, at most two hours per training beyond five agents.
    Paper,
}

/// What a budget allows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Budget {
    pub(crate) name: BudgetName,
    pub(crate) seeds: Vec<u64>,
    /// Joint steps of every training; `None`: those of its configuration.
    pub(crate) max_steps: Option<u64>,
    /// Seconds of a training; `None` without limit.
    pub(crate) wall_s: Option<f64>,
    /// Episodes of an evaluation.
    pub(crate) episodes: u32,
}

impl BudgetName {
    pub(crate) fn budget(self) -> Budget {
        let (seeds, max_steps, wall_s, episodes) = match self {
            Self::Smoke => (vec![1], Some(3_000), None, 20),
            Self::Quick => (vec![1], None, Some(40.0), 100),
            Self::Paper => (vec![1, 2, 3], Some(PAPER_STEPS), Some(7_200.0), 100),
        };
        Budget { name: self, seeds, max_steps, wall_s, episodes }
    }
}

/// A system on a task, under a budget.
#[derive(Debug, Clone)]
pub(crate) struct Cell {
    pub(crate) table: &'static PaperTable,
    pub(crate) system: &'static System,
    /// Place of the task in the table.
    pub(crate) task: usize,
    /// Without the seed.
    pub(crate) config: RunConfig,
    /// Seconds of a training.
    pub(crate) wall_s: Option<f64>,
}

impl Cell {
    /// N.
    pub(crate) fn agents(&self) -> usize {
        self.config.task.agents
    }

    /// Whether both are the same training or controller on the same task: tables share cells.
    pub(crate) fn same(&self, other: &Self) -> bool {
        let by = match (&self.system.by, &other.system.by) {
            (By::Learner { .. }, By::Learner { .. }) => true,
            (own, other) => own == other,
        };
        by && self.config == other.config && self.wall_s == other.wall_s
    }

    /// `<system>-<N>`, the name of folders and files.
    pub(crate) fn id(&self) -> String {
        format!("{}-{}", self.system.id, self.agents())
    }
}

impl Budget {
    /// The cells of a table, task by task. The smoke test has small teams only: tasks of up to five agents, or the first task
    /// with five.
    pub(crate) fn cells(&self, table: &'static PaperTable) -> anyhow::Result<Vec<Cell>> {
        let small = self.name == BudgetName::Smoke;
        let fits = |place: &usize| !small || table.tasks[*place].agents <= SMALL;
        let mut tasks: Vec<usize> = (0..table.tasks.len()).filter(fits).collect();
        if tasks.is_empty() {
            tasks.push(0);
        }
        let mut cells = Vec::new();
        for task in tasks {
            for system in table.systems {
                let large = table.tasks[task].agents >= LARGE;
                let (text, set): (&str, Vec<&str>) = match &system.by {
                    By::Learner { configs, set, set_large } => {
                        let more = if large { set_large } else { &[] as &[&str] };
                        (configs.get(task).unwrap_or(&configs[0]), [set, more].concat())
                    }
                    By::Controller(..) => (table.tasks[task].config, Vec::new()),
                };
                let own = RunConfig::from_toml(table.tasks[task].config)?.task;
                let task_keys =
                    [format!("name={}", own.name), format!("agents={}", own.agents), format!("spawn={}", own.spawn)];
                let all = set.iter().map(|key| (*key).to_owned()).chain(task_keys.map(|key| format!("task.{key}")));
                let settings: Result<Vec<Setting>, String> = all.map(|setting| setting.parse()).collect();
                let settings = settings.map_err(anyhow::Error::msg)?;
                let named = || format!("{}, {} with {} agents", table.name, system.name, table.tasks[task].agents);
                let mut config = RunConfig::from_toml_with(text, &settings).with_context(named)?;
                if small && config.task.agents > SMALL {
                    config = config.resized(SMALL);
                }
                config.run.max_steps = self.max_steps.unwrap_or(config.run.max_steps);
                config.run.final_episodes = self.episodes;
                let config = config.validated().with_context(named)?;
                // The paper's protocol in full where it takes hours, not days.
                let whole = self.name == BudgetName::Paper && config.task.agents <= SMALL;
                let wall_s = self.wall_s.filter(|_| !whole);
                cells.push(Cell { table, system, task, config, wall_s });
            }
        }
        Ok(cells)
    }
}

#[cfg(test)]
mod tests {
    use super::super::systems::TABLES;
    use super::*;

    #[test]
    fn every_budget_has_cells_of_every_table() {
        for name in [BudgetName::Smoke, BudgetName::Quick, BudgetName::Paper] {
            for table in TABLES {
                let cells = name.budget().cells(table).unwrap();
                assert!(!cells.is_empty(), "{name:?}, {}", table.name);
                for cell in cells {
                    let agents = cell.agents();
                    assert!(name != BudgetName::Smoke || agents <= SMALL);
                    assert_eq!(
                        cell.wall_s.is_none(),
                        name == BudgetName::Smoke || (name == BudgetName::Paper && agents <= SMALL)
                    );
                    assert!(name != BudgetName::Paper || cell.config.run.max_steps == PAPER_STEPS);
                }
            }
        }
    }
}
