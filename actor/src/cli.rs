//! The actor's command line.

use crate::policy::PolicyWorker;
use crate::run::{ActorConfig, ActorError, run as run_actor};
use clap::Args;
use magex_core::config::RunConfig;
use magex_runtime::exit::{self, Failure};
use magex_runtime::telemetry::{self, LogFormat};
use magex_runtime::{process, shutdown};
use serde::Serialize;
use std::path::PathBuf;

/// Options of an actor. None of them can change a number of the run.
#[derive(Debug, Clone, Args, Serialize)]
pub struct ActorArgs {
    /// Learner to work for
    #[arg(long, env = "MAGEX_LEARNER", default_value = "http://127.0.0.1:7000", value_name = "URL")]
    pub learner: String,
    /// Commander to ask for goals
    #[arg(long, env = "MAGEX_COMMANDER", default_value = "http://127.0.0.1:7100", value_name = "URL")]
    pub commander: String,
    /// Name of this actor, for people [default: host and process number]
    #[arg(long, env = "MAGEX_ACTOR_NAME", default_value_t = process::default_name(), hide_default_value = true)]
    pub name: String,
    /// Rollout threads [default: one per processor]
    #[arg(long, env = "MAGEX_ACTOR_THREADS", default_value_t = process::processors(), hide_default_value = true)]
    pub threads: usize,
    /// Work only for a run with the task of this configuration file
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Wait for another run when this one is complete
    #[arg(long, env = "MAGEX_ACTOR_STAY")]
    pub stay: bool,
    /// How log lines look
    #[arg(long, env = "MAGEX_LOG_FORMAT", value_enum, default_value_t)]
    #[serde(skip)]
    pub log_format: LogFormat,
    /// Print the options in effect and exit
    #[arg(long)]
    #[serde(skip)]
    pub print_config: bool,
}

/// Runs an actor until it is told to stop or the run is complete. The exit code, or why it failed.
pub fn run(args: ActorArgs) -> Result<u8, Failure> {
    if args.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let config = configure(&args)?;
    telemetry::init(args.log_format);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .thread_name("magex-net")
        .enable_all()
        .build()
        .map_err(|error| Failure::new(exit::INTERNAL, error))?;
    let end = runtime.block_on(async {
        let stop = shutdown::on_signal().map_err(|error| Failure::new(exit::INTERNAL, error))?;
        process::announce_ready("actor", None);
        run_actor(config, PolicyWorker::maker(), stop).await.map_err(|error| match &error {
            ActorError::Url(_) | ActorError::NoThreads => Failure::usage(&error),
            ActorError::Refused { .. } | ActorError::Worker { .. } => Failure::new(exit::UNAVAILABLE, &error),
        })
    });
    // A rollout thread may still be busy with a shard that nobody wants.
    runtime.shutdown_background();
    let report = end?;
    tracing::info!(?report, "stopped");
    Ok(exit::OK)
}

fn configure(args: &ActorArgs) -> Result<ActorConfig, Failure> {
    let expected_task = match &args.config {
        Some(path) => {
            let named = |error: &dyn std::fmt::Display| Failure::usage(format!("{}: {error}", path.display()));
            let text = std::fs::read_to_string(path).map_err(|error| named(&error))?;
            Some(RunConfig::from_toml(&text).map_err(|error| named(&error))?.task.fingerprint())
        }
        None => None,
    };
    Ok(ActorConfig {
        learner_url: args.learner.clone(),
        commander_url: args.commander.clone(),
        actor_id: args.name.clone(),
        threads: args.threads,
        expected_task,
        stay: args.stay,
    })
}
