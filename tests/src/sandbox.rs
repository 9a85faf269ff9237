//! A cluster of real processes on loopback: one learner, one commander, any number of actors, each of which can be killed,
//! stopped and started again.

use crate::proxy::Proxy;
use magex_core::config::RunConfig;
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_runtime::client;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Longer than anything takes that is going to happen at all.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// The `magex` program of this build; built first if only this package was. `MAGEX_BINARY` names another one, such as that of an
/// earlier commit: what a test asks for can be seen to be missing there.
pub fn binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| {
        if let Some(other) = std::env::var_os("MAGEX_BINARY") {
            return other.into();
        }
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
    /// Starts the program with these arguments; what it writes to standard error is added to `log`.
    pub fn start(arguments: &[&str], log: &Path) -> Self {
        Self::start_in(arguments, &[], log)
    }

    /// The same with these variables in its environment.
    pub fn start_in(arguments: &[&str], environment: &[(String, PathBuf)], log: &Path) -> Self {
        Self::start_program(binary(), arguments, environment, log)
    }

    /// The same with another program, such as that of an earlier commit.
    pub fn start_program(program: &Path, arguments: &[&str], environment: &[(String, PathBuf)], log: &Path) -> Self {
        let file = std::fs::OpenOptions::new().create(true).append(true).open(log).expect("a log file");
        let child = Command::new(program)
            .args(arguments)
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(file)
            .spawn()
            .expect("the program starts");
        Self { child, log: log.to_owned() }
    }

    /// Reads the line that says which address a service listens on.
    pub fn ready(&mut self) -> String {
        let ready = self.ready_line();
        ready["address"].as_str().unwrap_or_else(|| panic!("no address in '{ready}'")).to_owned()
    }

    /// The whole of that line.
    pub fn ready_line(&mut self) -> serde_json::Value {
        let mut line = String::new();
        let out = self.child.stdout.take().expect("standard output is piped");
        BufReader::new(out).read_line(&mut line).expect("standard output can be read");
        serde_json::from_str(&line).unwrap_or_else(|e| panic!("ready line '{line}': {e}\n{}", self.log()))
    }

    /// Everything that it has written to standard output; for a process that has ended.
    pub fn output(&mut self) -> String {
        let mut text = String::new();
        let mut out = self.child.stdout.take().expect("standard output is piped");
        std::io::Read::read_to_string(&mut out, &mut text).expect("standard output can be read");
        text
    }

    /// What it has written to standard error.
    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// What the kernel says of it under this name in `/proc/PID/status`.
    pub fn told(&self, name: &str) -> String {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("the process runs");
        let value = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
        value.unwrap_or_else(|| panic!("no {name} in {status}")).trim().to_owned()
    }

    /// Whether its environment has a variable of this name.
    pub fn has_variable(&self, name: &str) -> bool {
        let environment = std::fs::read(format!("/proc/{}/environ", self.child.id())).expect("the process runs");
        environment
            .split(|byte| *byte == 0)
            .any(|line| line.split(|byte| *byte == b'=').next() == Some(name.as_bytes()))
    }

    /// Its number.
    pub fn id(&self) -> u32 {
        self.child.id()
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

    /// Waits for it to end by itself within this time, by the clock; how long it took.
    pub fn wait_within(&mut self, limit: Duration) -> (ExitStatus, Duration) {
        let start = Instant::now();
        let status = self.wait();
        let took = start.elapsed();
        assert!(took <= limit, "the process took {took:?} to end, {limit:?} are allowed:\n{}", self.log());
        (status, took)
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
    /// Where services show their metrics, by name of the service; only of those that were asked to.
    pub pages: Vec<(String, String)>,
    /// Options that all services get, and variables of their environments.
    extra: Vec<String>,
    environment: Vec<(String, PathBuf)>,
    learner_address: String,
    commander_address: String,
    started: usize,
    run: PathBuf,
    lease: String,
    wires: Option<Wires>,
    data: Option<PathBuf>,
    /// The program of the services that are started next.
    pub program: PathBuf,
}

/// What is between the processes of a cluster.
#[derive(Debug)]
pub struct Wires {
    /// From actors to the learner.
    pub actors_learner: Proxy,
    /// From actors to the commander.
    pub actors_commander: Proxy,
    /// From the commander to the learner.
    pub commander_learner: Proxy,
}

impl Wires {
    /// All of them.
    pub fn all(&self) -> [&Proxy; 3] {
        [&self.actors_learner, &self.actors_commander, &self.commander_learner]
    }
}

/// How a cluster is set up.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Seconds of a lease.
    pub lease: f64,
    /// The run folder, unless it is to be a temporary one.
    pub run: Option<PathBuf>,
    /// Everything goes through proxies that draw from this seed.
    pub wires: Option<u64>,
    /// Options that the learner, the commander and the actors get, too.
    pub options: Vec<String>,
    /// Variables in the environment of all of them.
    pub environment: Vec<(String, PathBuf)>,
    /// The folder of the commander's missions.
    pub data: Option<PathBuf>,
    /// The program of all of them.
    pub program: PathBuf,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            lease: 2.0,
            run: None,
            wires: None,
            options: Vec::new(),
            environment: Vec::new(),
            data: None,
            program: binary().to_owned(),
        }
    }
}

/// The usual set-up with these options for every process.
pub fn options(options: &[&str]) -> Setup {
    Setup { options: options.iter().map(|&option| option.to_owned()).collect(), ..Setup::default() }
}

impl Cluster {
    /// Starts a learner and a commander.
    pub fn start(config: &RunConfig) -> Self {
        Self::start_with(config, Setup::default())
    }

    /// The same, set up as asked for.
    pub fn start_with(config: &RunConfig, setup: Setup) -> Self {
        let lease = setup.lease.to_string();
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("given.toml");
        std::fs::write(&file, config.to_toml().expect("toml")).expect("the configuration can be written");
        let run = setup.run.unwrap_or_else(|| folder.path().join("run"));
        let (given, out) = (text(&file), text(&run));
        let mut arguments = vec!["learner", "--config", &given, "--out", &out, "--listen", "127.0.0.1:0"];
        arguments.extend(["--threads", "1", "--lease-seconds", &lease]);
        arguments.extend(setup.options.iter().map(String::as_str));
        let log = folder.path().join("learner.log");
        let mut learner = Process::start_program(&setup.program, &arguments, &setup.environment, &log);
        let ready = learner.ready_line();
        let learner_address = ready["address"].as_str().expect("the learner's address").to_owned();
        // The commander's address must be known before it starts.
        let commander_address = match setup.wires {
            Some(_) => free_address(),
            None => "127.0.0.1:0".into(),
        };
        let wires = setup.wires.map(|seed| Wires {
            actors_learner: Proxy::start(&learner_address, seed),
            actors_commander: Proxy::start(&commander_address, seed + 1),
            commander_learner: Proxy::start(&learner_address, seed + 2),
        });
        let mut cluster = Self {
            folder,
            learner,
            commander: None,
            actors: Vec::new(),
            pages: Vec::new(),
            extra: setup.options,
            environment: setup.environment,
            learner_address,
            commander_address,
            started: 0,
            run,
            lease,
            wires,
            data: setup.data,
            program: setup.program,
        };
        cluster.note_page("learner", &ready);
        cluster.start_commander();
        cluster
    }

    fn note_page(&mut self, service: &str, ready: &serde_json::Value) {
        if let Some(address) = ready["http"].as_str() {
            self.pages.push((service.to_owned(), address.to_owned()));
        }
    }

    /// Starts the commander, on its old address if it had one.
    pub fn start_commander(&mut self) {
        let learner =
            self.wires.as_ref().map_or(self.learner_address.clone(), |wires| wires.commander_learner.address());
        let learner = format!("http://{learner}");
        let mut arguments = vec!["commander", "--learner", &learner, "--listen", &self.commander_address];
        arguments.extend(self.extra.iter().map(String::as_str));
        let data = self.data.as_deref().map(text);
        arguments.extend(data.iter().flat_map(|data| ["--data", data]));
        let log = self.folder.path().join("commander.log");
        let mut commander = Process::start_program(&self.program, &arguments, &self.environment, &log);
        let ready = commander.ready_line();
        self.commander_address = ready["address"].as_str().expect("the commander's address").to_owned();
        self.commander = Some(commander);
        self.note_page("commander", &ready);
    }

    /// Starts one more actor.
    pub fn start_actor(&mut self) {
        self.start_actor_with(&[]);
    }

    /// Starts one more actor with extra options.
    pub fn start_actor_with(&mut self, extra: &[&str]) {
        let learner = self.wires.as_ref().map_or(self.learner_address.clone(), |wires| wires.actors_learner.address());
        self.start_actor_at(&learner, extra);
    }

    /// Starts one more actor that takes this for the learner's address.
    pub fn start_actor_at(&mut self, learner: &str, extra: &[&str]) {
        self.started += 1;
        let learner = format!("http://{learner}");
        let commander =
            self.wires.as_ref().map_or(self.commander_address.clone(), |wires| wires.actors_commander.address());
        let commander = format!("http://{commander}");
        let name = format!("actor-{}", self.started);
        let mut arguments =
            vec!["actor", "--learner", &learner, "--commander", &commander, "--threads", "1", "--name", &name];
        arguments.extend(extra);
        arguments.extend(self.extra.iter().map(String::as_str));
        let log = self.folder.path().join(format!("{name}.log"));
        let mut actor = Process::start_program(&self.program, &arguments, &self.environment, &log);
        // An actor is ready when a learner has accepted it, which may be never; only its page is of interest here.
        let ready = self.extra.iter().any(|option| option == "--http").then(|| actor.ready_line());
        self.actors.push(actor);
        ready.iter().for_each(|ready| self.note_page("actor", ready));
    }

    /// Starts the learner again from its checkpoint, on its old address.
    pub fn resume_learner(&mut self) {
        self.resume_learner_while(|_| {});
    }

    /// The same, and does something before the learner can be ready.
    pub fn resume_learner_while(&mut self, meanwhile: impl FnOnce(&mut Process)) {
        let run = text(&self.run());
        let address = self.learner_address.clone();
        let arguments = ["learner", "--resume", "--out", &run, "--listen", &address, "--threads", "1"];
        let arguments: Vec<&str> = arguments.into_iter().chain(["--lease-seconds", &self.lease]).collect();
        let log = self.folder.path().join("learner.log");
        let mut learner = Process::start_program(&self.program, &arguments, &self.environment, &log);
        meanwhile(&mut learner);
        learner.ready();
        self.learner = learner;
    }

    /// The logs of its processes.
    pub fn logs(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.folder.path()).expect("the folder is there").filter_map(Result::ok);
        entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|end| end == "log")).collect()
    }

    /// The run folder.
    pub fn run(&self) -> PathBuf {
        self.run.clone()
    }

    /// What is between the processes.
    pub fn wires(&self) -> &Wires {
        self.wires.as_ref().expect("a cluster with proxies")
    }

    /// Where the learner listens.
    pub fn learner_address(&self) -> &str {
        &self.learner_address
    }

    /// How the learner says that the run stands, if it answers. Its ledger must balance, whenever one asks.
    pub fn status(&self) -> Option<v1::RunStatus> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let url = format!("http://{}", self.learner_address);
        let asking = async {
            let channel = client::endpoint(&url).expect("an address").connect().await.ok()?;
            let answer = LearnerServiceClient::new(channel).get_run(v1::GetRunRequest {}).await.ok()?;
            answer.into_inner().run
        };
        let status = runtime.block_on(async { tokio::time::timeout(Duration::from_secs(2), asking).await.ok()? })?;
        let l = status.ledger.expect("a learner has a ledger");
        let ended = l.trained + l.duplicate + l.expired + l.rejected + l.failed + l.outstanding;
        assert_eq!(l.leased, ended, "every lease ends in exactly one way: {l:?}");
        Some(status)
    }

    /// Waits until the learner is at this iteration.
    pub fn wait_for_iteration(&self, iteration: u32) {
        wait_until(&format!("iteration {iteration}"), || {
            std::thread::sleep(Duration::from_millis(20));
            self.status().is_some_and(|status| status.iteration >= iteration)
        });
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

/// A free address of this machine: no process listens on it for now.
fn free_address() -> String {
    let socket = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    socket.local_addr().expect("its address").to_string()
}

fn text(path: &Path) -> String {
    path.display().to_string()
}
