//! The commander's command line.

use crate::run_scheduler::load_scheduler;
use crate::service::{ServiceConfig, run_and_tell as serve};
use crate::weights_file::WeightsFile;
use clap::Args;
use magex_dispatch::Limits;
use magex_dispatch::mission::MissionLimits;
use magex_dispatch::missions::Bounds;
use magex_runtime::exit::{self, Failure};
use magex_runtime::health::probe;
use magex_runtime::http;
use magex_runtime::metrics::Metrics;
use magex_runtime::options;
use magex_runtime::process;
use magex_runtime::security::{ClientArgs, ServerArgs};
use magex_runtime::service::{self, ServiceArgs};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Options of a commander.
#[derive(Debug, Clone, Args, Serialize)]
pub struct CommanderArgs {
    /// Address to listen on; port 0 is any free one
    #[arg(long, env = "MAGEX_COMMANDER_LISTEN", default_value = "127.0.0.1:7100", value_name = "HOST:PORT")]
    pub listen: String,
    /// Learner whose weights are used; without it and without --weights only exact, makespan, greedy and random answer
    #[arg(long, env = "MAGEX_LEARNER", value_name = "URL")]
    pub learner: Option<String>,
    /// Weights of a finished run: its folder, or a weights file; reloaded when the file is replaced
    #[arg(long, env = "MAGEX_WEIGHTS", value_name = "RUN|FILE")]
    pub weights: Option<PathBuf>,
    /// Configuration of that run [default: config.toml beside the weights]
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE", requires = "weights")]
    pub config: Option<PathBuf>,
    /// Folder in which missions are stored; without it they are lost when the process ends
    #[arg(long, env = "MAGEX_DATA", value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Security of the port
    #[command(flatten)]
    #[serde(flatten)]
    pub security: ServerArgs,
    /// Credentials for the learner
    #[command(flatten)]
    #[serde(flatten)]
    pub client: ClientArgs,
    /// Maximum number of agents, and of goals, of a team; a matrix, where one is needed, has at most 100,000,000 pairs
    #[arg(long, default_value_t = 5000, value_name = "N", value_parser = options::whole::<u32>(1, 100_000), help_heading = "Limits")]
    pub max_agents: u32,
    /// Maximum message size, MiB
    #[arg(long, default_value_t = 32, value_name = "MIB", value_parser = options::whole::<u32>(1, 1024), help_heading = "Limits")]
    pub max_message: u32,
    /// Maximum number of calls in flight per client
    #[arg(long, default_value_t = 64, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub calls_per_client: u32,
    /// Maximum number of open streams per client
    #[arg(long, default_value_t = 16, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub streams_per_client: u32,
    /// Maximum number of missions of all clients
    #[arg(long, default_value_t = 1000, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub max_missions: u32,
    /// Maximum number of missions per client
    #[arg(long, default_value_t = 100, value_name = "K", value_parser = options::whole::<u32>(1, 1_000_000), help_heading = "Limits")]
    pub missions_per_client: u32,
    /// Maximum number of agents, and of goals, of a mission
    #[arg(long, default_value_t = 1000, value_name = "N", value_parser = options::whole::<u32>(1, 2000), help_heading = "Limits")]
    pub mission_agents: u32,
    /// Hours after its last update at which a mission expires
    #[arg(long, default_value_t = 24, value_name = "H", value_parser = options::whole::<u32>(1, 8760), help_heading = "Limits")]
    pub mission_hours: u32,
    /// Maximum number of agents, all teams together, of a call that asks for actions
    #[arg(long, default_value_t = 2000, value_name = "N", value_parser = options::whole::<u32>(1, 10_000), help_heading = "Limits")]
    pub act_agents: u32,
    /// Milliseconds for which a stopping service rejects calls with UNAVAILABLE before it closes its port
    #[arg(long, default_value_t = 500, value_name = "MS", value_parser = options::whole::<u32>(0, 5000))]
    pub drain: u32,
    /// Options of every service
    #[command(flatten)]
    #[serde(flatten)]
    pub service: ServiceArgs,
}

impl CommanderArgs {
    /// Validates the options and reads the files that they name.
    fn config(&self) -> Result<ServiceConfig, Failure> {
        let find = |path: &PathBuf| WeightsFile::find(path, self.config.as_deref());
        let weights = self.weights.as_ref().map(find).transpose()?;
        let security = self.security.read(&self.listen)?;
        let client = self.client.read(self.security.own(), self.security.insecure)?;
        self.learner.as_deref().map_or(Ok(()), |url| client.check("--learner", url))?;
        let each = MissionLimits {
            members: self.mission_agents as usize,
            lifetime_ms: i64::from(self.mission_hours) * 3_600_000,
        };
        Ok(ServiceConfig {
            learner_url: self.learner.clone(),
            client,
            weights,
            data: self.data.clone(),
            security,
            limits: Limits { members: self.max_agents as usize, ..Limits::default() },
            message_bytes: (self.max_message as usize) << 20,
            calls: self.calls_per_client as usize,
            streams: self.streams_per_client as usize,
            missions: Bounds {
                total: self.max_missions as usize,
                per_owner: self.missions_per_client as usize,
                each,
                ..Bounds::default()
            },
            act_agents: self.act_agents as usize,
            drain: Duration::from_millis(u64::from(self.drain)),
            heartbeat: self.security.heartbeat(),
            metrics: Arc::new(Metrics::new()),
        })
    }
}

/// Serves until stopped by a signal. Returns the exit code.
pub fn run(args: CommanderArgs) -> Result<u8, Failure> {
    if args.service.health_check {
        return probe::own(&args.listen, args.security.tls_cert.is_some());
    }
    if args.service.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let config = args.config()?;
    service::main("commander", 2, &args.service, async |mut context| {
        let (incoming, address) = context.listen(&args.listen, args.security.connections()).await?;
        context.serve_page(http::routes(config.metrics.clone()));
        let sources = config.security.sources().into_iter().chain(config.client.sources());
        context.reload(sources.collect(), &config.metrics);
        tracing::info!(%address, "listening");
        let stop = context.stop.clone();
        serve(config, load_scheduler, incoming, stop, move || context.announce()).await
    })?;
    Ok(exit::OK)
}
