//! The actor's command line.

use crate::environment::{EnvironmentSource, TIMEOUT_SECONDS};
use crate::run::{self, ActorConfig, ActorError, ActorReport};
use crate::worker::PolicyWorker;
use clap::Args;
use magex_core::config::RunConfig;
use magex_runtime::exit::{self, Failure};
use magex_runtime::health::probe;
use magex_runtime::http;
use magex_runtime::metrics::Metrics;
use magex_runtime::options;
use magex_runtime::process;
use magex_runtime::security::CallerArgs;
use magex_runtime::service::{self, ServiceArgs};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// Options of an actor. None of them can change a number of the run.
#[derive(Debug, Clone, Args, Serialize)]
pub struct ActorArgs {
    /// Learner to work for
    #[arg(long, env = "MAGEX_LEARNER", default_value = "http://127.0.0.1:7000", value_name = "URL")]
    pub learner: String,
    /// Commander to ask for goals
    #[arg(long, env = "MAGEX_COMMANDER", default_value = "http://127.0.0.1:7100", value_name = "URL")]
    pub commander: String,
    /// Name of this actor in logs and status [default: host and process number]
    #[arg(long, env = "MAGEX_ACTOR_NAME", default_value_t = process::default_name(), hide_default_value = true)]
    pub name: String,
    /// Rollout threads [default: one per processor]
    #[arg(long, env = "MAGEX_ACTOR_THREADS", default_value_t = process::processors(), hide_default_value = true, value_name = "T", value_parser = options::whole::<usize>(1, options::THREADS_MAX))]
    pub threads: usize,
    /// Work only for a run with the task of this configuration file
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Wait for another run when this one is complete
    #[arg(long, env = "MAGEX_ACTOR_STAY", value_parser = options::switch)]
    pub stay: bool,
    /// Program that is the environment of a run with an external task: a command, which is started once for every rollout
    /// thread, or the address of one that runs (http://, https://, unix:PATH)
    #[arg(long, env = "MAGEX_ENVIRONMENT", value_name = "COMMAND")]
    pub environment: Option<String>,
    /// Seconds that this program has for its start and for each step
    #[arg(long, env = "MAGEX_ENVIRONMENT_TIMEOUT", default_value_t = TIMEOUT_SECONDS, value_name = "SECONDS", value_parser = options::whole::<u64>(1, 86_400))]
    pub environment_timeout: u64,
    /// Credentials for learner and commander.
    #[command(flatten)]
    #[serde(flatten)]
    pub security: CallerArgs,
    /// Options of every service
    #[command(flatten)]
    #[serde(flatten)]
    pub service: ServiceArgs,
}

/// Runs an actor until shutdown or the end of the run. Returns the exit code.
pub fn run(args: ActorArgs) -> Result<u8, Failure> {
    if args.service.health_check {
        return probe::own_page(args.service.http.http.as_deref());
    }
    if args.service.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let config = configure(&args)?;
    let environment = args
        .environment
        .as_deref()
        .map(|text| EnvironmentSource::new(text, &config.client, Duration::from_secs(args.environment_timeout)));
    let environment = environment.transpose()?;
    let report = service::main("actor", 1, &args.service, async |mut context| {
        let metrics = Arc::new(Metrics::new());
        context.serve_page(http::routes(metrics.clone()));
        context.reload(config.client.sources(), &metrics);
        let (accepted, stop) = (config.accepted.clone(), context.stop.clone());
        tokio::spawn(async move {
            accepted.cancelled().await;
            context.announce();
        });
        run::run(config, PolicyWorker::maker(environment), metrics, stop).await.map_err(|error| match &error {
            ActorError::Url(_) | ActorError::NoThreads => Failure::usage(&error),
            // A restarted process may succeed.
            ActorError::Evicted(..) | ActorError::Stuck { .. } => Failure::new(exit::INTERNAL, &error),
            ActorError::Refused(..) | ActorError::Unusable(_) | ActorError::Worker(..) => {
                Failure::new(exit::UNAVAILABLE, &error)
            }
        })
    })?;
    let ActorReport { sessions, accepted, duplicate, rejected, failed } = report;
    tracing::info!(sessions, accepted, duplicate, rejected, failed, "stopped");
    Ok(exit::OK)
}

fn configure(args: &ActorArgs) -> Result<ActorConfig, Failure> {
    let fingerprint = |path: &PathBuf| {
        let text = options::text_file("--config", path)?;
        let config = RunConfig::from_toml(&text);
        let named = |error| Failure::usage(format!("--config {}: {error}", path.display()));
        Ok(config.map_err(named)?.task.fingerprint())
    };
    let client = args.security.read()?;
    client.check("--learner", &args.learner)?;
    client.check("--commander", &args.commander)?;
    Ok(ActorConfig {
        learner_url: args.learner.clone(),
        commander_url: args.commander.clone(),
        client,
        actor_id: args.name.clone(),
        threads: args.threads,
        expected_task: args.config.as_ref().map(fingerprint).transpose()?,
        stay: args.stay,
        accepted: CancellationToken::new(),
    })
}
