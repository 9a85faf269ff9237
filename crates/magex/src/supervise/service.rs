//! One service as a child process: start, watch, restart, stop.

use crate::failure::coded;
use crate::parent_watch;
use anyhow::{Context as _, anyhow};
use magex_runtime::backoff::Backoff;
use magex_runtime::exit;
use magex_runtime::limits;
use magex_runtime::sync::lock;
use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{Pid, Signal, kill_process};
use std::fs::OpenOptions;
use std::os::fd::BorrowedFd;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, ChildStdin, Command};
use tokio_util::sync::CancellationToken;

/// A service must print its ready line within this time.
const START: Duration = Duration::from_secs(30);
/// A service that does not stop within this time is killed.
const GRACE: Duration = Duration::from_secs(10);
/// A service that dies this often, each time within [`STABLE`] of its start, is not restarted again.
const LIVES: u32 = 5;
/// A service that ran for this time gets all its lives back.
const STABLE: Duration = Duration::from_secs(20);

/// How to start a service.
#[derive(Debug, Clone)]
pub struct Service<'a> {
    name: String,
    arguments: Vec<String>,
    log: PathBuf,
    inherit: Option<BorrowedFd<'a>>,
    awaited: bool,
    /// Variables of ours that it gets, too.
    variables: &'static [&'static str],
}

/// One child is started at a time: an inherited descriptor is open to every child that is started meanwhile.
static START_ONE: Mutex<()> = Mutex::new(());

/// A running service.
#[derive(Debug)]
pub struct Running {
    name: String,
    child: Child,
    /// The service stops when this closes. Kept outside of `child`, because waiting for a child closes its own stdin.
    _stdin: Option<ChildStdin>,
    log: PathBuf,
    /// Length of the log before this process wrote to it.
    log_start: u64,
    /// Address it listens on; empty if it does not listen.
    pub address: String,
    pub(crate) http: Option<String>,
}

impl<'a> Service<'a> {
    /// The command line `magex <arguments>`; standard error is appended to `<name>.log` in `logs`.
    pub fn new(name: &str, arguments: &[&str], logs: &Path) -> Self {
        let arguments = arguments.iter().map(|&argument| argument.to_owned()).collect();
        Self {
            name: name.to_owned(),
            arguments,
            log: logs.join(format!("{name}.log")),
            inherit: None,
            awaited: true,
            variables: &[],
        }
    }

    /// The service gets this open file under the same number.
    pub fn inherit(self, descriptor: BorrowedFd<'a>) -> Self {
        Self { inherit: Some(descriptor), ..self }
    }

    /// It gets these variables of the environment, which are otherwise for services that run alone.
    pub(crate) fn with_variables(self, variables: &'static [&'static str]) -> Self {
        Self { variables, ..self }
    }

    fn spawn(&self, command: &mut Command) -> std::io::Result<Child> {
        let _one = lock(&START_ONE);
        let Some(descriptor) = self.inherit else { return command.spawn() };
        fcntl_setfd(descriptor, FdFlags::empty())?;
        let child = command.spawn();
        fcntl_setfd(descriptor, FdFlags::CLOEXEC)?;
        child
    }

    /// Its start does not wait for the ready line: an actor's comes when a learner has accepted it.
    #[must_use]
    pub(crate) fn unawaited(self) -> Self {
        Self { awaited: false, ..self }
    }

    /// Starts it and waits until it is ready, unless it is not awaited.
    pub async fn start(&self) -> anyhow::Result<Running> {
        let open = || OpenOptions::new().create(true).append(true).open(&self.log);
        let log = open().with_context(|| self.log.display().to_string())?;
        let log_start = log.metadata().map_or(0, |meta| meta.len());
        let mut command = Command::new(std::env::current_exe()?);
        // Options in the environment are meant for services that run alone.
        let own = |name: &str| name.starts_with("MAGEX_") && !self.variables.contains(&name);
        for (name, _) in std::env::vars_os().filter(|(name, _)| own(&name.to_string_lossy())) {
            command.env_remove(name);
        }
        command
            // An executable that embeds `magex` recognises the command line by this name.
            .arg0("magex")
            .args(&self.arguments)
            .arg(format!("--{}", parent_watch::OPTION))
            // Standard input ends when this process does. The service has a process group of its own, so that a terminal's
            // Ctrl-C reaches only this process.
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true);
        let mut child = self.spawn(&mut command).with_context(|| format!("starting the {}", self.name))?;
        let (stdout, stdin) = (child.stdout.take(), child.stdin.take());
        let (name, log) = (self.name.clone(), self.log.clone());
        let mut running = Running { name, child, _stdin: stdin, log, log_start, address: String::new(), http: None };
        if !self.awaited {
            return Ok(running);
        }
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
                let code = code_of(status).filter(|&code| code != exit::OK);
                let message = format!("the {} could not be started: {}", self.name, running.failure(status));
                Err(coded(code.unwrap_or(exit::FAILURE), message))
            }
            Err(_) => Err(anyhow!("the {} was not ready within {} s", self.name, START.as_secs())),
        }
    }

    /// Starts it again after a wait. A start that fails (killed again, the port still in use) costs one of the lives.
    pub(crate) async fn restart(&self, lives: &mut u32, mut wait: impl FnMut() -> Duration) -> anyhow::Result<Running> {
        loop {
            tokio::time::sleep(wait()).await;
            match self.start().await {
                Err(error) if *lives > 1 => {
                    *lives -= 1;
                    tracing::warn!(service = self.name, %error, "the service could not be started; trying again");
                }
                started => return started,
            }
        }
    }

    pub(crate) fn gave_up(&self, code: Option<u8>, reason: &str) -> anyhow::Error {
        let message = format!("the {} failed: {reason} (log: {})", self.name, self.log.display());
        coded(code.unwrap_or(exit::FAILURE), message)
    }
}

impl Running {
    pub(crate) async fn wait(&mut self) -> std::io::Result<ExitStatus> {
        self.child.wait().await
    }

    /// Its process id; 0 after it has ended.
    pub fn id(&self) -> u32 {
        self.child.id().unwrap_or_default()
    }

    /// Sends SIGKILL and waits until it has ended.
    ///
    /// # Errors
    /// The system refuses.
    pub async fn kill(&mut self) -> std::io::Result<()> {
        self.child.kill().await
    }

    pub(crate) fn terminate(&self) {
        if let Some(pid) = self.child.id().and_then(|id| Pid::from_raw(id as i32)) {
            // It may have ended already.
            let _ = kill_process(pid, Signal::TERM);
        }
    }

    /// Sends SIGTERM, waits, and kills it if it does not stop in time.
    pub async fn stop(&mut self) {
        self.terminate();
        if tokio::time::timeout(GRACE, self.wait()).await.is_err() {
            tracing::warn!(service = self.name, "the service does not stop; killing it");
            let _ = self.child.kill().await;
        }
    }

    /// Why it ended: the signal, or the tail of its standard error.
    pub(crate) fn failure(&self, status: ExitStatus) -> String {
        let bytes = std::fs::read(&self.log).unwrap_or_default();
        let own = bytes.get(self.log_start as usize..).unwrap_or_default();
        let text = String::from_utf8_lossy(own);
        let line = text.lines().rev().find(|line| !line.trim().is_empty());
        let line = line.map(|line| line.trim_start_matches("error: ").to_owned());
        match (status.signal(), limits::memory()) {
            (Some(9), Some((limit, name))) => {
                let limit = limit >> 20;
                format!(
                    "killed by signal 9, as the system does when memory runs out; the limit is {limit} MiB ({name})"
                )
            }
            (Some(6), _) => format!("aborted: {}", line.unwrap_or_default()),
            (Some(signal), _) => format!("killed by signal {signal}"),
            (None, _) => line.unwrap_or_else(|| status.to_string()),
        }
    }
}

/// Keeps a service running until `stop`, or until its work is done.
pub(crate) async fn keep(service: Service<'static>, first: Running, stop: CancellationToken) -> anyhow::Result<()> {
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
        // A service succeeds when the run ends. If the run continues, something else stopped the service: restart it.
        if status.success() && tokio::time::timeout(Duration::from_secs(2), stop.cancelled()).await.is_ok() {
            return Ok(());
        }
        if started.elapsed() >= STABLE {
            (lives, backoff) = (LIVES, Backoff::default());
        }
        lives -= 1;
        let (code, reason) = (code_of(status), running.failure(status));
        if lives == 0 || matches!(code, Some(exit::USAGE | exit::UNAVAILABLE)) {
            return Err(service.gave_up(code, &reason));
        }
        tracing::warn!(service = service.name, reason, "the service died; restarting it");
        let restart = service.restart(&mut lives, || backoff.next_wait());
        match stop.run_until_cancelled(restart).await {
            Some(restarted) => running = restarted?,
            None => return Ok(()),
        }
    }
}

/// The exit code, unless a signal killed the process.
pub(crate) fn code_of(status: ExitStatus) -> Option<u8> {
    status.code().and_then(|code| u8::try_from(code).ok())
}
