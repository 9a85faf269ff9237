//! The start and the end of a service process, in one order for every service: process limits, runtime, telemetry, signals,
//! sockets, the ready line, the service itself, the last traces.

use crate::exit::{self, Failure};
use crate::http::{HttpArgs, Page, Router};
use crate::metrics::Metrics;
use crate::net::connections::ConnectionLimits;
use crate::reload::{self, Source};
use crate::server::{self, Incoming};
use crate::telemetry::{self, LogFormat, TraceArgs};
use crate::{limits, process, shutdown};
use clap::Args;
use serde::Serialize;
use std::net::SocketAddr;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Threads of a service besides those of the network: its work, and calls that block.
const OTHER_THREADS: usize = 4;

/// Options of every service.
#[derive(Debug, Clone, Default, Args, Serialize)]
pub struct ServiceArgs {
    /// Metrics and pages for operators
    #[command(flatten)]
    #[serde(flatten)]
    pub http: HttpArgs,
    /// Export of traces
    #[command(flatten)]
    #[serde(flatten)]
    pub traces: TraceArgs,
    /// Format of log lines
    #[arg(long, env = "MAGEX_LOG_FORMAT", value_enum, ignore_case = true, value_name = "FORMAT", default_value_t)]
    #[serde(skip)]
    pub log_format: LogFormat,
    /// Print the configuration in effect and exit
    #[arg(long)]
    #[serde(skip)]
    pub print_config: bool,
    /// Check the health of the running service with these options and exit: 0 healthy, 1 not (of an actor, at --http)
    #[arg(long)]
    #[serde(skip)]
    pub health_check: bool,
}

/// Tasks that a network thread runs between two looks at its sockets. Tasks that receive long messages take a millisecond each; with
/// tokio's 61 of them a short call waits for all.
const EVENT_INTERVAL: u32 = 4;

/// What a running service gets from [`main`].
#[derive(Debug)]
pub struct Context {
    /// Cancelled by the first SIGINT, SIGTERM, SIGUSR1 or SIGXCPU.
    pub stop: CancellationToken,
    name: &'static str,
    address: Option<SocketAddr>,
    page: Option<Page>,
    http: Option<SocketAddr>,
    /// Until [`Self::reload`] takes it. It exists from the start, so that a SIGHUP never ends a service.
    hangup: Option<Signal>,
}

impl Context {
    /// Binds the service's address.
    pub async fn listen(&mut self, listen: &str, limits: ConnectionLimits) -> Result<(Incoming, SocketAddr), Failure> {
        let (incoming, address) = server::bind(listen).await?;
        self.address = Some(address);
        Ok((incoming.within(limits), address))
    }

    /// Whether there is an HTTP server for operators.
    pub fn has_page(&self) -> bool {
        self.page.is_some()
    }

    /// Serves `routes` on the operators' address, if there is one.
    pub fn serve_page(&mut self, routes: Router) -> Option<JoinHandle<()>> {
        self.page.take().map(|page| page.serve(routes, self.stop.clone()))
    }

    /// Prints the ready line: everything that was asked for is open.
    pub fn announce(&self) {
        process::announce_ready(self.name, self.address, self.http);
    }

    /// Reads these files again on SIGHUP, and when they change, until the service ends.
    pub fn reload(&mut self, sources: Vec<Source>, metrics: &Metrics) {
        let help = "First end of a certificate in use, in seconds since unix epoch; +Inf without certificates.";
        let end = metrics.gauge("process_certificate_end_time_seconds", help);
        if let Some(hangup) = self.hangup.take() {
            tokio::spawn(reload::follow(sources, hangup, end));
        }
    }
}

/// Runs a service on `threads` network threads until `run` returns. `name` is its name in ready lines and traces.
pub fn main<T>(
    name: &'static str,
    threads: usize,
    args: &ServiceArgs,
    run: impl AsyncFnOnce(Context) -> Result<T, Failure>,
) -> Result<T, Failure> {
    process::allow_open_files();
    process::disable_huge_pages();
    let files = if name == "learner" { limits::FILES } else { limits::FEW_FILES };
    limits::require(files, threads + OTHER_THREADS)?;
    let internal = |error| Failure::new(exit::INTERNAL, error);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(threads)
        .event_interval(EVENT_INTERVAL)
        .thread_name("magex-net")
        .enable_all()
        .build()
        .map_err(internal)?;
    let telemetry = {
        let _runtime = runtime.enter();
        telemetry::init(&format!("magex-{name}"), args.log_format, &args.traces)?
    };
    process::log_environment();
    let result = runtime.block_on(async {
        let hangup = Some(signal(SignalKind::hangup()).map_err(internal)?);
        let stop = shutdown::on_signal().map_err(internal)?;
        let page = args.http.bind().await?;
        let http = page.as_ref().map(Page::address);
        run(Context { stop, name, address: None, page, http, hangup }).await
    });
    telemetry.flush();
    // A thread that still works must not delay the end.
    runtime.shutdown_background();
    result
}
