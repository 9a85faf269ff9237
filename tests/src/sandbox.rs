//! A cluster of real processes on loopback: one learner, one commander, any number of actors, each of which can be killed,
//! stopped and started again.

use magex_core::config::RunConfig;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Longer than anything takes that is going to happen at all.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// The `magex` program of this build; built first if only this package was.
pub fn binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| {
        let own = std::env::current_exe().expect("this test's own path");
        let folder = own.parent().and_then(Path::parent).expect("target/<profile>/deps/<test>");
        let path = folder.join("magex");
        if !path.exists() {
            let mut cargo = Command::new(std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned()));
            cargo.args(["build", "-p", "magex", "--bin", "magex"]);
            if folder.ends_with("release") {
                cargo.arg("--release");
            }
            assert!(cargo.status().expect("cargo runs").success(), "the magex program could not be built");
        }
        path
    })
}

/// Waits until `done`, for at most [`PATIENCE`].
pub fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited too long for: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// One running program; killed when dropped.
#[derive(Debug)]
pub struct Process {
    child: Child,
    log: PathBuf,
}

impl Process {
    fn start(arguments: &[&str], log: &Path) -> Self {
        let file = std::fs::OpenOptions::new().create(true).append(true).open(log).expect("a log file");
        let child = Command::new(binary())
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(file)
            .spawn()
            .expect("the program starts");
        Self { child, log: log.to_owned() }
    }

    /// Reads the line that says which address a service listens on.
    fn ready(&mut self) -> String {
        let mut line = String::new();
        let out = self.child.stdout.take().expect("standard output is piped");
        BufReader::new(out).read_line(&mut line).expect("standard output can be read");
        let ready: serde_json::Value =
            serde_json::from_str(&line).unwrap_or_else(|e| panic!("ready line '{line}': {e}\n{}", self.log()));
        ready["address"].as_str().unwrap_or_else(|| panic!("no address in '{line}'")).to_owned()
    }

    /// What it has written to standard error.
    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// SIGKILL.
    pub fn kill(&mut self) {
        self.child.kill().expect("the process can be killed");
        self.child.wait().expect("the process can be waited for");
    }

    /// Any other signal, by name.
    pub fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status();
        assert!(sent.expect("kill runs").success());
    }

    /// Waits for it to end by itself.
    pub fn wait(&mut self) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("the process can be waited for") {
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "the process does not end:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Whether it still runs.
    pub fn running(&mut self) -> bool {
        self.child.try_wait().expect("the process can be asked").is_none()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended; then there is nothing to do.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A run and its processes.
#[derive(Debug)]
pub struct Cluster {
    folder: tempfile::TempDir,
    /// The learner.
    pub learner: Process,
    /// The commander, if it runs.
    pub commander: Option<Process>,
    /// The actors.
    pub actors: Vec<Process>,
    learner_address: String,
    commander_address: String,
    started: usize,
}

const LEASE: &str = "2";

impl Cluster {
    /// Starts a learner and a commander.
    pub fn start(config: &RunConfig) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("given.toml");
        std::fs::write(&file, config.to_toml().expect("toml")).expect("the configuration can be written");
        let run = folder.path().join("run");
        let mut learner = Process::start(
            &[
                "learner",
                "--config",
                &text(&file),
                "--out",
                &text(&run),
                "--listen",
                "127.0.0.1:0",
                "--threads",
                "1",
                "--lease-seconds",
                LEASE,
            ],
            &folder.path().join("learner.log"),
        );
        let learner_address = learner.ready();
        let mut cluster = Self {
            folder,
            learner,
            commander: None,
            actors: Vec::new(),
            learner_address,
            commander_address: "127.0.0.1:0".into(),
            started: 0,
        };
        cluster.start_commander();
        cluster
    }

    /// Starts the commander, on its old address if it had one.
    pub fn start_commander(&mut self) {
        let learner = format!("http://{}", self.learner_address);
        let mut commander = Process::start(
            &["commander", "--learner", &learner, "--listen", &self.commander_address],
            &self.folder.path().join("commander.log"),
        );
        self.commander_address = commander.ready();
        self.commander = Some(commander);
    }

    /// Starts one more actor.
    pub fn start_actor(&mut self) {
        self.start_actor_with(&[]);
    }

    /// Starts one more actor with extra options.
    pub fn start_actor_with(&mut self, extra: &[&str]) {
        self.started += 1;
        let (learner, commander) =
            (format!("http://{}", self.learner_address), format!("http://{}", self.commander_address));
        let name = format!("actor-{}", self.started);
        let mut arguments =
            vec!["actor", "--learner", &learner, "--commander", &commander, "--threads", "1", "--name", &name];
        arguments.extend(extra);
        self.actors.push(Process::start(&arguments, &self.folder.path().join(format!("{name}.log"))));
    }

    /// Starts the learner again from its checkpoint, on its old address.
    pub fn resume_learner(&mut self) {
        let run = self.run();
        let mut learner = Process::start(
            &[
                "learner",
                "--resume",
                "--out",
                &text(&run),
                "--listen",
                &self.learner_address,
                "--threads",
                "1",
                "--lease-seconds",
                LEASE,
            ],
            &self.folder.path().join("learner.log"),
        );
        learner.ready();
        self.learner = learner;
    }

    /// The run folder.
    pub fn run(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    /// Where the commander listens.
    pub fn commander_address(&self) -> &str {
        &self.commander_address
    }

    /// Iterations that metrics.jsonl shows as done.
    pub fn iterations(&self) -> usize {
        std::fs::read_to_string(self.run().join("metrics.jsonl")).unwrap_or_default().lines().count()
    }

    /// Waits for the end of the run; returns the SHA-256 of what was learned.
    pub fn finish(&mut self) -> String {
        let status = self.learner.wait();
        assert!(status.success(), "the learner ended with {status}:\n{}", self.learner.log());
        let summary = std::fs::read_to_string(self.run().join("summary.json")).expect("a summary");
        let summary: serde_json::Value = serde_json::from_str(&summary).expect("a summary in JSON");
        summary["weights_sha256"].as_str().expect("a hash").to_owned()
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}
