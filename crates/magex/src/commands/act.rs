//! `magex act`

use crate::failure::usage;
use crate::folder;
use crate::options::CommonOptions;
use anyhow::Context as _;
use magex_core::ids::Mode;
use magex_policy::acting::{ActError, Choice, Policies, Teams};
use magex_runtime::exit;
use serde::{Deserialize, Serialize};
use std::io::{BufRead as _, Write as _};
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex act RUN < states.jsonl                one line of actions per line
  magex trace RUN --out t.jsonl; magex act RUN < t.jsonl    the same actions again

A line is one step of one team: {\"positions\": [[x, y], ...], \"velocities\": \
    [[..], ..], \"goals\": [[..], ..]}, for Push Ball also \"balls\" and \
    \"ball_velocities\", for drones \"agent_state\"; row i is of agent i. What \
    agents remember goes on from line to line; \"begin\": true forgets it. Lines \
    without positions are skipped. The same over gRPC: docs/policy.md.

Exit codes: 0 success, 1 the policy failed, 64 wrong usage, configuration or line";

/// Choose the actions of a team from positions, velocities and goals on standard input.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct ActArgs {
    /// Run folder, or a weights file together with --config.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Configuration of a weights file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Side of the map, for policies that see absolute positions [default: as in the run, or of its density].
    #[arg(long, value_name = "LENGTH")]
    side: Option<f32>,
    /// Draw the actions instead of taking the most likely ones.
    #[arg(long)]
    sampled: bool,
    /// Seed of the draws; every line has its own.
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    seed: u64,
}

/// A line.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Line {
    positions: Vec<Vec<f32>>,
    velocities: Vec<Vec<f32>>,
    goals: Vec<Vec<f32>>,
    balls: Vec<Vec<f32>>,
    ball_velocities: Vec<Vec<f32>>,
    agent_state: Vec<Vec<f32>>,
    begin: bool,
}

/// An answer: one row per agent.
#[derive(Debug, Serialize)]
struct Answer<'a> {
    actions: Vec<&'a [u8]>,
    logits: Vec<&'a [f32]>,
    probabilities: Vec<&'a [f32]>,
}

pub(crate) fn run(args: &ActArgs, _options: &CommonOptions) -> anyhow::Result<u8> {
    let trained = folder::load(&args.run, args.config.as_deref())?;
    trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
    let policies = Policies::load(&trained.config, &trained.weights)?;
    let mut out = std::io::stdout().lock();
    let mut memory = None;
    for (number, line) in (1u64..).zip(std::io::stdin().lock().lines()) {
        let line = line.context("standard input")?;
        if line.trim().is_empty() {
            continue;
        }
        let wrong = |problem: String| usage(format!("line {number}: {problem}"));
        let line: Line = serde_json::from_str(&line).map_err(|error| wrong(error.to_string()))?;
        if line.positions.is_empty() {
            continue;
        }
        if line.begin {
            memory = None;
        }
        let mode = if args.sampled { Mode::Sampled } else { Mode::Greedy };
        let choice = Choice { mode, seed: args.seed.wrapping_add(number) };
        let teams = Teams {
            teams: 1,
            dims: line.positions[0].len(),
            side: args.side,
            positions: line.positions.concat(),
            velocities: line.velocities.concat(),
            goals: line.goals.concat(),
            balls: line.balls.concat(),
            ball_velocities: line.ball_velocities.concat(),
            agent_state: line.agent_state.concat(),
        };
        let decision = policies.act(&teams, memory.take(), choice).map_err(|error| match error {
            ActError::Invalid { .. } => wrong(error.to_string()),
            other => anyhow::Error::new(other).context(format!("line {number}")),
        })?;
        let n = teams.positions.len() / teams.dims;
        let answer = Answer {
            actions: decision.actions.chunks(decision.actions.len() / n).collect(),
            logits: decision.logits.chunks(decision.logits.len() / n).collect(),
            probabilities: decision.probabilities.chunks(decision.probabilities.len() / n).collect(),
        };
        let answer = serde_json::to_string(&answer)?;
        // A closed pipe is no error.
        if writeln!(out, "{answer}").and_then(|()| out.flush()).is_err() {
            break;
        }
        memory = Some(decision.memory);
    }
    Ok(exit::OK)
}
