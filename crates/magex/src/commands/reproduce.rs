//! `magex reproduce`

use super::train::prepare_process;
use crate::artifacts;
use crate::failure::{cannot_create, usage};
use crate::options::CommonOptions;
use crate::output::{Output, note, program, seconds, thousands};
use crate::reproduce::budget::{Budget, BudgetName, Cell};
use crate::reproduce::cell::{Place, check_folder, configuration, measure, other};
use crate::reproduce::record::{self, Record};
use crate::reproduce::summary::Measured;
use crate::reproduce::systems::{PaperTable, TABLES};
use crate::reproduce::{figure, marl_eval, tables};
use crate::settings;
use magex_core::config::{SEED_MAX, STEPS_MAX};
use magex_core::metrics_table::share;
use magex_runtime::process::processors;
use magex_runtime::{exit, options as parse};
use magex_stats::aggregate::average;
use serde_json::json;
use std::path::{Path, PathBuf};

const AFTER_HELP: &str = "\
Examples:
  magex reproduce                              every table, one seed, minutes
  magex reproduce --budget smoke               everything once, in small: for CI
  magex reproduce --table spread,drones --budget paper --out results/paper
  magex reproduce --systems mage-x --agents 5,20 --seeds 1,2,3,4,5
  magex reproduce --tables-only --out results/paper --budget paper    nothing is trained

OUT gets tables.md, tables.csv, <table>.svg and runs.json (marl-eval), from OUT/results/<table>/<system>-<N>-seed-<s>.json; \
    the run folders are in OUT/runs. What has a result is not trained again, unless it ended early for want of minutes and may have \
    more now. The first Ctrl-C stops after the iteration, and \
    the same command continues.

Exit codes: 0 success, 1 training or evaluation failed, 64 wrong usage, or --out has results of another configuration, \
    73 --out cannot be written or a run in it is written by another process, 75 stopped before the end (the same command \
    continues), 130 interrupted twice";

/// Train and measure the paper's tables anew.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct ReproduceArgs {
    /// Tables: spread, push-ball, drones, ablation, planner or all; several with commas.
    #[arg(long, value_name = "TABLE,…", value_delimiter = ',', default_value = "all", value_parser = table)]
    table: Vec<String>,
    /// How long it may take.
    #[arg(long, value_enum, value_name = "BUDGET", default_value_t)]
    budget: BudgetName,
    /// Folder of results, tables and runs [default: runs/reproduce-BUDGET].
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Training seeds [default: 1; with --budget paper 1,2,3].
    #[arg(long, value_name = "S,…", value_delimiter = ',', value_parser = parse::whole::<u64>(0, SEED_MAX))]
    seeds: Vec<u64>,
    /// Only these systems, by the names of their folders, such as mage-x [default: all].
    #[arg(long, value_name = "SYSTEM,…", value_delimiter = ',', value_parser = system)]
    systems: Vec<String>,
    /// Only these team sizes [default: all of a table].
    #[arg(long, value_name = "N,…", value_delimiter = ',', value_parser = team)]
    agents: Vec<usize>,
    /// Joint environment steps of every training, in place of the budget's.
    #[arg(long, value_name = "M", value_parser = parse::whole::<u64>(1, STEPS_MAX))]
    max_steps: Option<u64>,
    /// Minutes of every training, in place of the budget's; it then stops with what it has learned.
    #[arg(long, value_name = "MINUTES", value_parser = parse::number::<f32>(0.001, 1e6))]
    max_minutes: Option<f32>,
    /// Episodes per seed and mode, in place of the budget's.
    #[arg(long, value_name = "K", value_parser = settings::count)]
    episodes: Option<u32>,
    /// Write tables and curves from the results that are there, whatever their configuration; train nothing.
    #[arg(long)]
    tables_only: bool,
    /// Training and rollout threads [default: the cores of this machine].
    #[arg(long, value_name = "T", value_parser = settings::threads)]
    threads: Option<usize>,
}

fn table(text: &str) -> Result<String, String> {
    let names: Vec<&str> = TABLES.iter().map(|table| table.name).chain(["all"]).collect();
    known(text, &names)
}

fn system(text: &str) -> Result<String, String> {
    let mut names: Vec<&str> = TABLES.iter().flat_map(|table| table.systems).map(|system| system.id).collect();
    names.sort_unstable();
    names.dedup();
    known(text, &names)
}

fn team(text: &str) -> Result<usize, String> {
    let mut sizes: Vec<usize> = TABLES.iter().flat_map(|table| table.tasks).map(|task| task.agents).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let names: Vec<String> = sizes.iter().map(usize::to_string).collect();
    known(text, &names.iter().map(String::as_str).collect::<Vec<_>>())?;
    text.parse().map_err(|error| format!("'{text}': {error}"))
}

fn known(text: &str, names: &[&str]) -> Result<String, String> {
    match names.contains(&text) {
        true => Ok(text.to_owned()),
        false => Err(format!("'{text}' is unknown; use {}", names.join(", "))),
    }
}

/// A cell and seed that has no result yet, or its result.
struct Job {
    cell: Cell,
    seed: u64,
    record: Option<Record>,
}

pub(crate) fn run(args: &ReproduceArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    let budget = budget(args)?;
    let name = format!("{:?}", args.budget).to_lowercase();
    let out = args.out.clone().unwrap_or_else(|| Path::new(crate::folder::RUNS).join(format!("reproduce-{name}")));
    if args.tables_only && !out.is_dir() {
        return Err(usage(format!(
            "--out {} does not exist: there are no results to write tables from",
            out.display()
        )));
    }
    if out.exists() && !out.is_dir() {
        return Err(cannot_create(format!("--out {} is a file; name a folder", out.display())));
    }
    artifacts::check(&out.join("tables.md"))?;
    let wanted = |table: &&PaperTable| args.table.iter().any(|name| name == table.name || name == "all");
    let chosen: Vec<&'static PaperTable> = TABLES.iter().filter(wanted).collect();
    let mut jobs = jobs(args, &budget, &chosen, &out)?;
    if jobs.is_empty() {
        return Err(usage("--systems, --agents: none of the tables has such systems with such teams; leave one out"));
    }
    let missing = jobs.iter().filter(|job| job.record.is_none()).count();
    if missing > 0 && !args.tables_only {
        note(format!(
            "{} of {} trainings and evaluations have results; {missing} follow",
            jobs.len() - missing,
            jobs.len()
        ));
        if !measure_missing(args, &budget, &out, &mut jobs)? {
            return Ok(say_stopped(&out, output));
        }
    }
    write(&budget, &chosen, jobs, &out, output)
}

fn budget(args: &ReproduceArgs) -> anyhow::Result<Budget> {
    let mut budget = args.budget.budget();
    if !args.seeds.is_empty() {
        budget.seeds.clone_from(&args.seeds);
    }
    if let Some((_, twice)) = budget.seeds.iter().enumerate().find(|(k, seed)| budget.seeds[..*k].contains(seed)) {
        return Err(usage(format!("--seeds: {twice} is named twice; name every seed once")));
    }
    budget.max_steps = args.max_steps.or(budget.max_steps);
    budget.wall_s = args.max_minutes.map(|minutes| 60.0 * f64::from(minutes)).or(budget.wall_s);
    budget.episodes = args.episodes.unwrap_or(budget.episodes);
    Ok(budget)
}

/// Every cell and seed with its result, if there is one. All are checked before the first one is trained.
fn jobs(args: &ReproduceArgs, budget: &Budget, chosen: &[&'static PaperTable], out: &Path) -> anyhow::Result<Vec<Job>> {
    let mut jobs = Vec::new();
    for table in chosen {
        for mut cell in budget.cells(table)? {
            let wanted = args.systems.is_empty() || args.systems.iter().any(|id| id == cell.system.id);
            if !wanted || !(args.agents.is_empty() || args.agents.contains(&table.tasks[cell.task].agents)) {
                continue;
            }
            if args.max_minutes.is_some() {
                cell.wall_s = budget.wall_s;
            }
            for &seed in &budget.seeds {
                let path = record::path(out, &cell, seed);
                let mut record = record::read(&path)?;
                if !args.tables_only {
                    if let Some(record) = &record {
                        let differing = record.differs(&configuration(&cell, seed))?;
                        if !differing.is_empty() {
                            return Err(other(&path, &differing));
                        }
                    }
                    // More time than it had: its run goes on, or begins again where the folder is gone.
                    record = record.filter(|record| !record.is_cut_short(cell.wall_s));
                    if record.is_none() {
                        check_folder(out, &cell, seed)?;
                    }
                }
                jobs.push(Job { cell: cell.clone(), seed, record });
            }
        }
    }
    Ok(jobs)
}

/// Measures what has no result; false if it was interrupted.
fn measure_missing(args: &ReproduceArgs, budget: &Budget, out: &Path, jobs: &mut [Job]) -> anyhow::Result<bool> {
    let (runtime, interrupted) = prepare_process()?;
    let threads = args.threads.unwrap_or_else(processors);
    let place = Place { out, threads, episodes: budget.episodes, runtime: &runtime, interrupted: &interrupted };
    let count = jobs.len();
    let mut complete = true;
    for k in (0..count).filter(|&k| jobs[k].record.is_none()).collect::<Vec<_>>() {
        let Job { cell, seed, .. } = &jobs[k];
        let what = format!("{} · {} · N = {} · seed {seed}", cell.table.name, cell.system.name, cell.agents());
        note(format!("{what} ({} of {count})", k + 1));
        let known =
            jobs.iter().find_map(|job| job.record.as_ref().filter(|_| job.seed == *seed && job.cell.same(cell)));
        let measured = match known {
            Some(record) => Some(record.in_table(cell)),
            None if interrupted.is_cancelled() => None,
            None => measure(&place, cell, *seed)?,
        };
        let Some(record) = measured else {
            complete = false;
            break;
        };
        let again = known.map(|record| format!(", as in {}", record.table)).unwrap_or_default();
        note(format!(
            "  success {} greedy, {} sampled; {} steps in {}, ended by {}{again}",
            share(average(&record.greedy.success_rate)),
            share(average(&record.sampled.success_rate)),
            thousands(record.joint_env_steps as f64),
            seconds(record.wall_s),
            record.ended_by.words()
        ));
        record::write(&record::path(out, cell, *seed), &record)?;
        jobs[k].record = Some(record);
    }
    runtime.shutdown_background();
    Ok(complete)
}

/// Writes every file and prints the table.
fn write(
    budget: &Budget,
    chosen: &[&'static PaperTable],
    jobs: Vec<Job>,
    out: &Path,
    output: Output,
) -> anyhow::Result<u8> {
    let missing = jobs.iter().filter(|job| job.record.is_none()).count();
    if missing == jobs.len() {
        return Err(usage(format!("--out {}: there are no results of these tables and systems in it", out.display())));
    }
    let mut tables: Vec<(&'static PaperTable, Vec<Measured>)> =
        chosen.iter().map(|table| (*table, Vec::new())).collect();
    for job in jobs {
        let Some(record) = job.record else { continue };
        let Some((_, measured)) = tables.iter_mut().find(|(table, _)| table.name == job.cell.table.name) else {
            continue;
        };
        match measured.last_mut().filter(|last: &&mut Measured| last.cell.id() == job.cell.id()) {
            Some(last) => last.records.push(record),
            None => measured.push(Measured { cell: job.cell, records: vec![record] }),
        }
    }
    artifacts::write(&out.join("tables.md"), tables::markdown(budget, &tables, missing).as_bytes())?;
    artifacts::write(&out.join("tables.csv"), tables::csv(&tables).as_bytes())?;
    for (table, measured) in &tables {
        if let Some(svg) = figure::svg(table, measured)? {
            artifacts::write(&out.join(format!("{}.svg", table.name)), svg.as_bytes())?;
        }
    }
    let runs = serde_json::to_string_pretty(&marl_eval::runs(&tables))?;
    artifacts::write(&out.join("runs.json"), format!("{runs}\n").as_bytes())?;

    let all: Vec<Measured> = tables.into_iter().flat_map(|(_, measured)| measured).collect();
    output.say(format!("\nSuccess rates, means over the seeds:\n\n{}", tables::printed(&all)));
    if missing > 0 {
        output.say(format!("\n{missing} trainings are not measured and left out."));
    }
    output.say(format!("\nStatistics, curves and everything else:\n  {}/tables.md", out.display()));
    let value = |one: &Measured| {
        json!({
            "table": one.cell.table.name,
            "system": one.cell.system.id,
            "agents": one.cell.agents(),
            "success_rate": one.greedy().map(|value| value.mean),
            "sampled_success_rate": one.sampled().map(|value| value.mean),
            "joint_env_steps": one.steps(),
            "ended_by": one.ended_by(),
            "converged": one.converged(),
            "seeds": one.records.len(),
        })
    };
    let cells: Vec<_> = all.iter().map(value).collect();
    output.result(&json!({ "out": out, "cells": cells, "missing": missing }));
    Ok(exit::OK)
}

fn say_stopped(out: &Path, output: Output) -> u8 {
    let command: Vec<String> = std::env::args().skip(1).collect();
    let command = format!("{} {}", program(), command.join(" "));
    output.say(format!("\nStopped before the end. The same command continues:\n  {command}"));
    output.result(&json!({ "stopped": true, "out": out, "resume": command, "exit_code": exit::TEMPORARY }));
    exit::TEMPORARY
}
