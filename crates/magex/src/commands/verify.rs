//! `magex verify`

use crate::cli::Global;
use crate::failure::usage;
use crate::verify::{FileReport, Outcome, verify_dir};
use magex_runtime::exit;
use serde_json::{Value, json};
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex verify crates/env/testdata           every recording below the folder
  magex verify recordings/mpe-n50.json       one file
  magex verify DIR --json

Recordings of the original simulator (format mpe-golden-1) are replayed step by step; recordings of
assignment problems are solved. The worst difference per file is printed beside the largest one that
passes. Other JSON files are skipped.

Exit codes: 0 everything agrees, 1 something does not or nothing could be checked, 64 no such folder";

/// Check the simulator and the solver against recordings.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct VerifyArgs {
    /// Folder with recordings, or one file.
    #[arg(value_name = "DIR")]
    pub(crate) dir: PathBuf,
}

pub(crate) fn run(args: &VerifyArgs, global: &Global) -> anyhow::Result<u8> {
    let report = verify_dir(&args.dir).map_err(usage)?;
    let output = global.output();
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
    let checks = file.checks.iter().map(|c| json!({ "what": c.what, "worst": c.worst, "limit": c.limit }));
    json!({
        "path": file.path,
        "format": file.format,
        "content": file.content,
        "outcome": outcome,
        "reasons": reasons,
        "checks": checks.collect::<Vec<_>>(),
    })
}
