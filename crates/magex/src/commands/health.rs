//! `magex health`

use crate::cli::Global;
use magex_runtime::exit;
use magex_runtime::health::probe;
use serde_json::json;
use std::time::Duration;

const AFTER_HELP: &str = "\
Examples:
  magex health http://127.0.0.1:7000                learner, over gRPC (grpc.health.v1)
  magex health https://commander:7100 --timeout 5   with MAGEX_TLS_CA (and MAGEX_TLS_CERT, MAGEX_TLS_KEY)
  magex health http://127.0.0.1:9102/healthz        a page, for actors: they serve no gRPC

magex-learner, magex-commander and magex-actor ask themselves with --health-check: the options and the
environment that they were started with say where.

Exit codes: 0 it serves, 1 it does not, or not within the time, 64 wrong usage";

/// Ask a service whether it is well: for orchestrators.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct HealthArgs {
    /// Who is asked.
    #[arg(value_name = "URL")]
    url: String,
    /// About which service, for example magex.v1.CommanderService; without it about the whole process.
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    service: String,
    /// Seconds for connection and answer.
    #[arg(long, value_name = "SECONDS", default_value_t = probe::DEADLINE.as_secs() as u32, value_parser = clap::value_parser!(u32).range(1..=3600))]
    timeout: u32,
}

pub(crate) fn run(args: &HealthArgs, global: &Global) -> anyhow::Result<u8> {
    probe::run(&args.url, &args.service, Duration::from_secs(args.timeout.into()))?;
    let output = global.output();
    output.say(format!("{} serves", args.url));
    output.result(&json!({ "url": args.url, "serving": true }));
    Ok(exit::OK)
}
