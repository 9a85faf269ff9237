//! `magex health`

use crate::options::CommonOptions;
use magex_runtime::exit;
use magex_runtime::health::probe;
use magex_runtime::options;
use serde_json::json;
use std::time::Duration;

const AFTER_HELP: &str = "\
Examples:
  magex health http://127.0.0.1:7000            gRPC (grpc.health.v1)
  magex health http://127.0.0.1:9102/healthz    HTTP, for actors
  magex health https://commander:7100 --timeout 5

https uses MAGEX_TLS_CA, MAGEX_TLS_CERT and MAGEX_TLS_KEY. magex-learner, \
    magex-commander and magex-actor check themselves with --health-check, at the \
    address in their own options and environment.

Exit codes: 0 serving, 1 not serving, 64 wrong usage, 69 no service answers
there, or another one";

/// Check the health of a service, for orchestrators.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct HealthArgs {
    /// Address of the service.
    #[arg(value_name = "URL")]
    url: String,
    /// gRPC service, for example magex.v1.CommanderService [default: the whole process].
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    service: String,
    /// Seconds for connection and response.
    #[arg(long, value_name = "SECONDS", default_value_t = probe::DEADLINE.as_secs() as u32, value_parser = options::whole::<u32>(1, 3600))]
    timeout: u32,
}

pub(crate) fn run(args: &HealthArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    probe::run(&args.url, &args.service, Duration::from_secs(args.timeout.into()))?;
    let output = options.output();
    output.say(format!("{} serves", args.url));
    output.result(&json!({ "url": args.url, "serving": true }));
    Ok(exit::OK)
}
