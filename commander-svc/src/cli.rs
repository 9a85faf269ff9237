//! The commander's command line.

use crate::access::Access;
use crate::service::{CommanderConfig, ServeError, run as serve};
use crate::trained::load_scheduler;
use crate::weights_file::WeightsFile;
use clap::Args;
use magex_dispatch::Limits;
use magex_dispatch::mission::MissionLimits;
use magex_dispatch::missions::Bounds;
use magex_runtime::exit::{self, Failure};
use magex_runtime::telemetry::{self, LogFormat};
use magex_runtime::tls::ServerTls;
use magex_runtime::{process, server, shutdown};
use serde::Serialize;
use std::path::PathBuf;
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
    /// Certificate chain of this server (PEM)
    #[arg(long, env = "MAGEX_TLS_CERT", value_name = "FILE", requires = "tls_key", help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// Key of that certificate (PEM)
    #[arg(long, env = "MAGEX_TLS_KEY", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// Authority (PEM) that must have signed the certificate that every client has to show
    #[arg(long, env = "MAGEX_CLIENT_CA", value_name = "FILE", requires = "tls_cert", help_heading = "Security")]
    pub client_ca: Option<PathBuf>,
    /// Who may call, with which role: a TOML file of `[[identity]]` entries with hashes of tokens and certificates
    #[arg(long, env = "MAGEX_IDENTITIES", value_name = "FILE", help_heading = "Security")]
    pub identities: Option<PathBuf>,
    /// Listen on an address that others can reach without encryption, or without asking who calls
    #[arg(long, env = "MAGEX_INSECURE", help_heading = "Security")]
    pub insecure: bool,
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
    /// How log lines look
    #[arg(long, env = "MAGEX_LOG_FORMAT", value_enum, default_value_t)]
    #[serde(skip)]
    pub log_format: LogFormat,
    /// Print the options in effect and exit
    #[arg(long)]
    #[serde(skip)]
    pub print_config: bool,
}

impl CommanderArgs {
    /// Reads the files that the options name.
    fn config(&self) -> Result<CommanderConfig, Failure> {
        let weights = match &self.weights {
            Some(path) => Some(WeightsFile::find(path, self.config.as_deref()).map_err(Failure::usage)?),
            None => None,
        };
        let access = self.identities.as_deref().map(Access::read).transpose().map_err(Failure::usage)?;
        let tls = match (&self.tls_cert, &self.tls_key) {
            (Some(certificate), Some(key)) => {
                Some(ServerTls::read(certificate, key, self.client_ca.as_deref()).map_err(Failure::usage)?)
            }
            _ => None,
        };
        let each = MissionLimits {
            members: self.mission_agents as usize,
            lifetime_ms: i64::from(self.mission_hours) * 3_600_000,
        };
        let config = CommanderConfig {
            learner_url: self.learner.clone(),
            weights,
            data: self.data.clone(),
            access: access.unwrap_or_default(),
            tls,
            limits: Limits { members: self.max_agents as usize, ..Limits::default() },
            message_bytes: (self.max_message as usize) << 20,
            calls: self.calls_per_client as usize,
            streams: self.streams_per_client as usize,
            missions: Bounds { total: self.max_missions as usize, per_owner: self.missions_per_client as usize, each },
            drain: Duration::from_millis(u64::from(self.drain)),
        };
        self.check_exposure(&config)?;
        Ok(config)
    }

    /// An address that others can reach needs encryption and callers that are known, unless that was given up by name.
    fn check_exposure(&self, config: &CommanderConfig) -> Result<(), Failure> {
        let address = server::resolve(&self.listen).map_err(Failure::usage)?;
        let known = config.access.restricted() || config.tls.as_ref().is_some_and(ServerTls::mutual);
        if address.ip().is_loopback() || self.insecure || (config.tls.is_some() && known) {
            return Ok(());
        }
        let missing = match (config.tls.is_some(), known) {
            (false, false) => "--tls-cert and --tls-key, and --identities or --client-ca",
            (false, true) => "--tls-cert and --tls-key",
            _ => "--identities or --client-ca",
        };
        Err(Failure::usage(format!(
            "--listen {}: others can reach this address; add {missing}, or --insecure to let anybody in",
            self.listen
        )))
    }
}

/// Serves until told to stop. The exit code, or why it failed.
pub fn run(args: CommanderArgs) -> Result<u8, Failure> {
    if args.print_config {
        process::print(&toml::to_string(&args).map_err(Failure::usage)?);
        return Ok(exit::OK);
    }
    let config = args.config()?;
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
            ServeError::Url(_) | ServeError::Weights(_) | ServeError::Tls(_) => Failure::usage(&error),
            ServeError::Missions { .. } | ServeError::Data { .. } => Failure::new(exit::CANNOT_CREATE, &error),
            ServeError::Transport(_) | ServeError::Reflection(_) => Failure::new(exit::INTERNAL, &error),
        })
    });
    runtime.shutdown_background();
    end.map(|()| exit::OK)
}
