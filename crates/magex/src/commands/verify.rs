//! `magex verify`

use crate::failure::usage;
use crate::options::CommonOptions;
use magex_runtime::exit;
use magex_verify::{Check, FileReport, Outcome, verify_dir};
use serde_json::{Value, json};
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex verify crates/verify/testdata     every recording below the folder
  magex verify recordings/mpe-n50.json    one file
  magex verify DIR --json

Recordings of the original particle simulator (mpe-golden-1: Simple Spread and \
    Push Ball) and of the original drone simulator (drone-golden-1) are replayed \
    step by step, the drones by the exact model and by the task's rigid-body \
    engine. Calls of its controller (drone-controller-golden-1) and its forces \
    (drone-forces-golden-1) are recomputed. Assignment problems \
    (assignment-golden-1) are solved. Each file is listed with its worst difference \
    and the largest difference that passes. Other JSON files are skipped.

Exit codes: 0 everything agrees, 1 a recording disagrees or nothing could be \
    checked, 64 no such folder";

/// Check simulators, controller and solver against recordings of other programs.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct VerifyArgs {
    /// Folder with recordings, or one file.
    #[arg(value_name = "DIR")]
    pub(crate) dir: PathBuf,
}

pub(crate) fn run(args: &VerifyArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let report = verify_dir(&args.dir).map_err(usage)?;
    let output = options.output();
    output.say(report.to_string().trim_end());
    output.result(&json!({
        "passed": report.passed(),
        "agreeing": report.agreeing(),
        "failing": report.failing(),
        "skipped": report.skipped(),
        "files": report.files.iter().map(value).collect::<Vec<_>>(),
    }));
    Ok(if report.passed() { exit::OK } else { exit::FAILURE })
}

fn value(file: &FileReport) -> Value {
    let (outcome, reasons) = match &file.outcome {
        Outcome::Agrees => ("agrees", Vec::new()),
        Outcome::Fails(reasons) => ("fails", reasons.clone()),
        Outcome::Skipped(reason) => ("skipped", vec![reason.clone()]),
    };
    let check = |c: &Check| json!({ "what": c.what, "worst": c.worst, "limit": c.limit, "words": c.words });
    json!({
        "path": file.path,
        "format": file.format,
        "content": file.content,
        "outcome": outcome,
        "reasons": reasons,
        "checks": file.checks.iter().map(check).collect::<Vec<_>>(),
    })
}
