//! The commander's command line.

use crate::service::{CommanderConfig, ServeError, run as serve};
use crate::run_scheduler::load_scheduler;
use crate::weights_file::WeightsFile;
use clap::Args;
use magex_dispatch::Limits;
use magex_dispatch::mission::MissionLimits;
use magex_dispatch::missions::Bounds;
use magex_runtime::exit::{self, Failure};
use magex_runtime::health::probe;
use magex_runtime::http::{self, HttpArgs, Page};
use magex_runtime::metrics::Metrics;
use magex_runtime::security::{ClientArgs, ServerArgs};
use magex_runtime::telemetry::{self, LogFormat, TraceArgs};
use magex_runtime::{process, server, shutdown};
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
    /// Learner whose weights are followed; without it and without --weights only the classical schedulers answer
    #[arg(long, env = "MAGEX_LEARNER", value_name = "URL")]
    pub learner: Option<String>,
    /// Weights of a finished run: its folder, or a weights file; loaded again when the file is replaced
    #[arg(long, env = "MAGEX_WEIGHTS", value_name = "RUN|FILE")]
    pub weights: Option<PathBuf>,
    /// Configuration of that run, if it is not beside the weights
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE", requires = "weights")]
    pub config: Option<PathBuf>,
    /// Folder in which missions are kept; without it they end with the process
    #[arg(long, env = "MAGEX_DATA", value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// How the port is guarded.
    #[command(flatten)]
    #[serde(flatten)]
    pub security: ServerArgs,
    /// What the learner is shown.
    #[command(flatten)]
    #[serde(flatten)]
    pub client: ClientArgs,
    /// Most agents, and most goals, of one team
    #[arg(long, default_value_t = 5000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000), help_heading = "Limits")]
    pub max_agents: u32,
    /// Longest message, mebibytes
    #[arg(long, default_value_t = 32, value_name = "MIB", value_parser = clap::value_parser!(u32).range(1..=1024), help_heading = "Limits")]
    pub max_message: u32,
    /// Calls in flight of one client
    #[arg(long, default_value_t = 64, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub calls_per_client: u32,
    /// Open streams of one client
    #[arg(long, default_value_t = 16, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub streams_per_client: u32,
    /// Missions of all clients
    #[arg(long, default_value_t = 1000, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub max_missions: u32,
    /// Missions of one client
    #[arg(long, default_value_t = 100, value_name = "K", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Limits")]
    pub missions_per_client: u32,
    /// Most agents, and most goals, of one mission
    #[arg(long, default_value_t = 1000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=2000), help_heading = "Limits")]
    pub mission_agents: u32,
    /// Hours after its last update at which a mission is forgotten
    #[arg(long, default_value_t = 24, value_name = "H", value_parser = clap::value_parser!(u32).range(1..=8760), help_heading = "Limits")]
    pub mission_hours: u32,
    /// Milliseconds for which a service that was told to stop still answers, saying so, before it closes its doors
    #[arg(long, default_value_t = 500, value_name = "MS", value_parser = clap::value_parser!(u32).range(..=5000))]
    pub drain: u32,
    /// What operators look at
    #[command(flatten)]
    #[serde(flatten)]
    pub http: HttpArgs,
    /// Where traces go
    #[command(flatten)]
    #[serde(flatten)]
    pub traces: TraceArgs,
    /// How log lines look
    #[arg(long, env = "MAGEX_LOG_FORMAT", value_enum, default_value_t)]
    #[serde(skip)]
    pub log_format: LogFormat,
    /// Print the options in effect and exit
    #[arg(long)]
    #[serde(skip)]
    pub print_config: bool,
    /// Ask the commander that listens on --listen whether it serves, and exit: 0 it does, 1 it does not
    #[arg(long)]
    #[serde(skip)]
    pub health_check: bool,
}

impl CommanderArgs {
    /// Reads the files that the options name.
    fn config(&self) -> Result<CommanderConfig, Failure> {
        let weights = match &self.weights {
            Some(path) => Some(WeightsFile::find(path, self.config.as_deref()).map_err(Failure::usage)?),
            None => None,
        };
        let security = self.security.read(&self.listen)?;
        let client = self.client.read(self.security.own(), self.security.insecure)?;
        let each = MissionLimits {
            members: self.mission_agents as usize,
            lifetime_ms: i64::from(self.mission_hours) * 3_600_000,
        };
        Ok(CommanderConfig {
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
            drain: Duration::from_millis(u64::from(self.drain)),
            metrics: Arc::new(Metrics::new()),
        })
    }
}

/// Serves until told to stop. The exit code, or why it failed.
pub fn run(args: CommanderArgs) -> Result<u8, Failure> {
    if args.health_check {
        return probe::own(&args.listen, args.security.tls_cert.is_some());
    }
    if args.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let config = args.config()?;
    process::allow_open_files();
    process::refuse_huge_pages();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("magex-net")
        .enable_all()
        .build()
        .map_err(|error| Failure::new(exit::INTERNAL, error))?;
    let telemetry = {
        let _runtime = runtime.enter();
        telemetry::init("magex-commander", args.log_format, &args.traces).map_err(Failure::usage)?
    };
    let end = runtime.block_on(async {
        let stop = shutdown::on_signal().map_err(|error| Failure::new(exit::INTERNAL, error))?;
        let (incoming, address) =
            server::bind(&args.listen).await.map_err(|error| Failure::new(exit::UNAVAILABLE, error))?;
        let incoming = incoming.within(args.security.connections());
        let page = args.http.bind().await.map_err(|error| Failure::new(exit::UNAVAILABLE, error))?;
        process::announce_ready("commander", Some(address), page.as_ref().map(Page::address));
        if let Some(page) = page {
            page.serve(http::routes(config.metrics.clone()), stop.clone());
        }
        serve(config, load_scheduler, incoming, stop).await.map_err(|error| match &error {
            ServeError::Url(_) | ServeError::Weights(_) | ServeError::Tls(_) => Failure::usage(&error),
            ServeError::Missions { .. } | ServeError::Data { .. } => Failure::new(exit::CANNOT_CREATE, &error),
            ServeError::Transport(_) | ServeError::Reflection(_) => Failure::new(exit::INTERNAL, &error),
        })
    });
    telemetry.flush();
    runtime.shutdown_background();
    end.map(|()| exit::OK)
}
