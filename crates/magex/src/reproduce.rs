//! `magex reproduce`: the paper's tables, trained and measured anew.
//!
//! | module | content |
//! |---|---|
//! | [`systems`] | the tables: tasks, systems, the paper's values; a new system is one entry there |
//! | [`budget`] | how long a cell is trained: smoke, quick, paper |
//! | [`cell`] | one cell and seed: training, evaluation |
//! | [`record`] | what is kept of it, from which every table can be made again |
//! | [`summary`] | mean, standard deviation, IQM, profile and probability of improvement |
//! | [`tables`], [`figure`], [`marl_eval`] | `tables.md`, `tables.csv`; `<table>.svg`; `runs.json` |

pub(crate) mod budget;
pub(crate) mod cell;
pub(crate) mod figure;
pub(crate) mod marl_eval;
pub(crate) mod record;
pub(crate) mod summary;
pub(crate) mod systems;
pub(crate) mod tables;
