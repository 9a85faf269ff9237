//! One service as a child process: started, watched, started again, stopped.

use crate::commands::roles::LEASH;
use crate::failure::coded;
use anyhow::{Context as _, anyhow};
use magex_runtime::backoff::Backoff;
use magex_runtime::exit;
use rustix::process::{Pid, Signal, kill_process};
use std::fs::OpenOptions;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::{Duration, Instant};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, ChildStdin, Command};
use tokio_util::sync::CancellationToken;

/// A service says that it is ready within this time.
const START: Duration = Duration::from_secs(30);
/// A service that was told to stop is killed after this time.
const GRACE: Duration = Duration::from_secs(10);
/// A helper that dies this often, each time soon after it was started, is given up.
const LIVES: u32 = 5;
/// Not soon.
const LONG: Duration = Duration::from_secs(20);

/// How to start a service.
#[derive(Debug, Clone)]
pub(crate) struct Service {
    name: String,
    arguments: Vec<String>,
    log: PathBuf,
}

/// A service that runs.
#[derive(Debug)]
pub(crate) struct Running {
    name: String,
    child: Child,
    /// Open for as long as the service shall run. Held apart: waiting for a child closes what it still has.
    _stdin: Option<ChildStdin>,
    log: PathBuf,
    /// Where the log of this process begins.
    log_start: u64,
    /// Where it listens; empty if it does not.
    pub(crate) address: String,
    /// Where it shows its pages, if it does.
    pub(crate) http: Option<String>,
}

impl Service {
    pub(crate) fn new(name: &str, arguments: &[&str], logs: &Path) -> anyhow::Result<Self> {
        let arguments = arguments.iter().map(|&argument| argument.to_owned()).collect();
        Ok(Self { name: name.to_owned(), arguments, log: logs.join(format!("{name}.log")) })
    }

    /// Starts it and waits until it is ready.
    pub(crate) async fn start(&self) -> anyhow::Result<Running> {
        let open = || OpenOptions::new().create(true).append(true).open(&self.log);
        let log = open().with_context(|| self.log.display().to_string())?;
        let log_start = log.metadata().map_or(0, |meta| meta.len());
        let mut command = Command::new(std::env::current_exe()?);
        // Only what is said here counts, not what the environment says to services that run alone.
        for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("MAGEX_")) {
            command.env_remove(name);
        }
        command
            .args(&self.arguments)
            .arg(format!("--{LEASH}"))
            // Its standard input ends when this process does. A terminal's Ctrl-C does not reach it: it has a group of its own.
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true);
        let mut child = command.spawn().with_context(|| format!("starting the {}", self.name))?;
        let (stdout, stdin) = (child.stdout.take(), child.stdin.take());
        let (name, log) = (self.name.clone(), self.log.clone());
        let mut running = Running { name, child, _stdin: stdin, log, log_start, address: String::new(), http: None };
        let ready = async {
            let mut lines = BufReader::new(stdout?).lines();
            let line = lines.next_line().await.ok()??;
            let value: serde_json::Value = serde_json::from_str(&line).ok()?;
            let text = |key: &str| value[key].as_str().map(str::to_owned);
            Some((text("address").unwrap_or_default(), text("http")))
        };
        match tokio::time::timeout(START, ready).await {
            Ok(Some((address, http))) => {
                (running.address, running.http) = (address, http);
                Ok(running)
            }
            Ok(None) => {
                let status = running.wait().await?;
                let code = status.code().and_then(|code| u8::try_from(code).ok()).filter(|&c| c != exit::OK);
                let words = format!("the {} could not be started: {}", self.name, running.last_words(status));
                Err(coded(code.unwrap_or(exit::FAILURE), words))
            }
            Err(_) => Err(anyhow!("the {} was not ready within {} s", self.name, START.as_secs())),
        }
    }
}

impl Running {
    /// Until it ends.
    pub(crate) async fn wait(&mut self) -> std::io::Result<ExitStatus> {
        self.child.wait().await
    }

    /// Its process; 0 once it has ended.
    pub(crate) fn id(&self) -> u32 {
        self.child.id().unwrap_or_default()
    }

    /// SIGKILL.
    pub(crate) async fn kill(&mut self) -> std::io::Result<()> {
        self.child.kill().await
    }

    /// Asks it to stop.
    pub(crate) fn terminate(&self) {
        if let Some(pid) = self.child.id().and_then(|id| Pid::from_raw(id as i32)) {
            // It may be gone already.
            let _ = kill_process(pid, Signal::TERM);
        }
    }

    /// Asks it to stop, waits, and kills it if it does not.
    pub(crate) async fn stop(&mut self) {
        self.terminate();
        if tokio::time::timeout(GRACE, self.wait()).await.is_err() {
            tracing::warn!(service = self.name, "does not stop; killing it");
            let _ = self.child.kill().await;
        }
    }

    /// Why it ended: the signal, or the last line of its log.
    pub(crate) fn last_words(&self, status: ExitStatus) -> String {
        if let Some(signal) = status.signal() {
            return format!("killed by signal {signal}");
        }
        let bytes = std::fs::read(&self.log).unwrap_or_default();
        let own = bytes.get(self.log_start as usize..).unwrap_or_default();
        let text = String::from_utf8_lossy(own);
        let line = text.lines().rev().find(|line| !line.trim().is_empty());
        line.map_or_else(|| status.to_string(), |line| line.trim_start_matches("error: ").to_owned())
    }
}

/// Keeps a helper running until `stop`, or until it has done its work.
pub(crate) async fn keep(service: Service, first: Running, stop: CancellationToken) -> anyhow::Result<()> {
    let mut running = first;
    let (mut lives, mut backoff) = (LIVES, Backoff::default());
    loop {
        let started = Instant::now();
        let status = tokio::select! {
            status = running.wait() => status?,
            () = stop.cancelled() => {
                running.stop().await;
                return Ok(());
            }
        };
        // A helper ends well when the run does; without that it was told to stop from outside, and is needed.
        if status.success() && tokio::time::timeout(std::time::Duration::from_secs(2), stop.cancelled()).await.is_ok() {
            return Ok(());
        }
        if started.elapsed() >= LONG {
            (lives, backoff) = (LIVES, Backoff::default());
        }
        lives -= 1;
        let reason = running.last_words(status);
        let code = status.code().and_then(|code| u8::try_from(code).ok());
        if lives == 0 || code.is_some_and(|code| code == exit::USAGE || code == exit::UNAVAILABLE) {
            let log = service.log.display();
            return Err(coded(
                code.unwrap_or(exit::FAILURE),
                format!("the {} failed: {reason} (log: {log})", service.name),
            ));
        }
        tracing::warn!(service = service.name, reason, "died; starting it again");
        running = loop {
            if stop.run_until_cancelled(tokio::time::sleep(backoff.next_wait())).await.is_none() {
                return Ok(());
            }
            match service.start().await {
                Ok(running) => break running,
                Err(error) if lives <= 1 => return Err(error),
                Err(error) => {
                    lives -= 1;
                    tracing::warn!(service = service.name, %error, "could not be started; trying again");
                }
            }
        };
    }
}
