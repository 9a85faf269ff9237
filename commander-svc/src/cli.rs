//! The commander's command line.

use crate::service::{CommanderConfig, ServeError, run as serve};
use crate::trained::load_scheduler;
use clap::Args;
use magex_core::ids::{RunId, WeightsVersion};
use magex_proto::weights::Weights;
use magex_runtime::exit::{self, Failure};
use magex_runtime::telemetry::{self, LogFormat};
use magex_runtime::{process, server, shutdown};
use serde::Serialize;
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Options of a commander.
#[derive(Debug, Clone, Args, Serialize)]
pub struct CommanderArgs {
    /// Address to listen on; port 0 is any free one
    #[arg(long, env = "MAGEX_COMMANDER_LISTEN", default_value = "127.0.0.1:7100", value_name = "HOST:PORT")]
    pub listen: String,
    /// Learner whose weights are followed; without it and without --weights only the classical schedulers answer
    #[arg(long, env = "MAGEX_LEARNER", value_name = "URL")]
    pub learner: Option<String>,
    /// Weights of a finished run
    #[arg(long, env = "MAGEX_WEIGHTS", value_name = "FILE", requires = "config")]
    pub weights: Option<PathBuf>,
    /// Configuration of that run
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// How log lines look
    #[arg(long, env = "MAGEX_LOG_FORMAT", value_enum, default_value_t)]
    #[serde(skip)]
    pub log_format: LogFormat,
    /// Print the options in effect and exit
    #[arg(long)]
    #[serde(skip)]
    pub print_config: bool,
}

/// Serves until told to stop. The exit code, or why it failed.
pub fn run(args: CommanderArgs) -> Result<u8, Failure> {
    if args.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let model = match (&args.weights, &args.config) {
        (Some(weights), Some(config)) => Some(read_model(weights, config)?),
        _ => None,
    };
    let config = CommanderConfig { learner_url: args.learner, model };
    telemetry::init(args.log_format);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("magex-net")
        .enable_all()
        .build()
        .map_err(|error| Failure::new(exit::INTERNAL, error))?;
    let end = runtime.block_on(async {
        let stop = shutdown::on_signal().map_err(|error| Failure::new(exit::INTERNAL, error))?;
        let (incoming, address) =
            server::bind(&args.listen).await.map_err(|error| Failure::new(exit::UNAVAILABLE, error))?;
        process::announce_ready("commander", Some(address));
        serve(config, load_scheduler, incoming, stop).await.map_err(|error| match &error {
            ServeError::Url(_) | ServeError::Weights(_) => Failure::usage(&error),
            ServeError::Transport(_) | ServeError::Reflection(_) => Failure::new(exit::INTERNAL, &error),
        })
    });
    runtime.shutdown_background();
    end.map(|()| exit::OK)
}

fn read_model(weights: &Path, config: &Path) -> Result<(Weights, String), Failure> {
    let named = |path: &Path, error: &dyn Display| Failure::usage(format!("{}: {error}", path.display()));
    let bytes = std::fs::read(weights).map_err(|error| named(weights, &error))?;
    let toml = std::fs::read_to_string(config).map_err(|error| named(config, &error))?;
    let name = weights.display().to_string();
    Ok((Weights::new(RunId(name), WeightsVersion(0), bytes.into()), toml))
}
