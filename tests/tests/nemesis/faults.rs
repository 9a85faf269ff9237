//! What can go wrong, and the services that it goes wrong with.

use crate::watch::{Gaps, Logs, Memory};
use magex_core::config::RunConfig;
use magex_core::rng::Stream;
use magex_proto::v1;
use magex_runtime::client;
use magex_tests::proxy::Faults;
use magex_tests::raw::Raw;
use magex_tests::sandbox::{Cluster, Process, Setup, wait_until};
use magex_tests::small_disk::SmallDisk;
use magex_tests::wall::Wall;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A fault; it is over when it returns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    KillActor,
    KillLearner,
    KillCommander,
    KillAll,
    KillSupervisor,
    FreezeActor,
    FreezeLearner,
    FreezeCommander,
    FreezeThread,
    Partition,
    Weather,
    Clock,
    SlowProcessor,
    FullDisk,
    ReadOnlyDisk,
    MoveRun,
    RemoveMissions,
    LargeMessages,
}

impl Fault {
    pub(crate) const ALL: [Self; 18] = [
        Self::KillActor,
        Self::KillLearner,
        Self::KillCommander,
        Self::KillAll,
        Self::KillSupervisor,
        Self::FreezeActor,
        Self::FreezeLearner,
        Self::FreezeCommander,
        Self::FreezeThread,
        Self::Partition,
        Self::Weather,
        Self::Clock,
        Self::SlowProcessor,
        Self::FullDisk,
        Self::ReadOnlyDisk,
        Self::MoveRun,
        Self::RemoveMissions,
        Self::LargeMessages,
    ];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::KillActor => "an actor killed",
            Self::KillLearner => "the learner killed",
            Self::KillCommander => "the commander killed",
            Self::KillAll => "all killed",
            Self::KillSupervisor => "a supervisor killed",
            Self::FreezeActor => "an actor frozen",
            Self::FreezeLearner => "the learner frozen",
            Self::FreezeCommander => "the commander frozen",
            Self::FreezeThread => "a rollout thread frozen",
            Self::Partition => "one wire cut",
            Self::Weather => "bytes lost, flipped, delayed",
            Self::Clock => "a clock step",
            Self::SlowProcessor => "a slow processor",
            Self::FullDisk => "full disks",
            Self::ReadOnlyDisk => "a read-only disk",
            Self::MoveRun => "the run folder moved away",
            Self::RemoveMissions => "the missions' folder removed",
            Self::LargeMessages => "messages of 31 MiB",
        }
    }

    /// Whether a service of the training ends by it.
    pub(crate) fn kills(self) -> bool {
        use Fault::{KillActor, KillAll, KillCommander, KillLearner, ReadOnlyDisk};
        [KillActor, KillLearner, KillCommander, KillAll, ReadOnlyDisk].contains(&self)
    }
}

/// Every message takes this long, so that iterations do not pass faster than they can be verified.
const PACE: Faults = Faults {
    delay: Duration::from_millis(20),
    bytes_per_second: None,
    mute: false,
    corrupt_every: None,
    drop_every: None,
};

/// Stops one thread of another process for a while: what a hang looks like from outside.
const FREEZE: &str = "import ctypes, sys, time; c = ctypes.CDLL(None); t = int(sys.argv[1]); \
    c.ptrace(0x4206, t, 0, 0); c.ptrace(0x4207, t, 0, 0); time.sleep(float(sys.argv[2]))";

/// A training with three actors, a commander with missions, and what watches them.
pub(crate) struct Target {
    pub(crate) cluster: Cluster,
    wall: Wall,
    place: tempfile::TempDir,
    /// Disks of the run and of the missions, where they can be mounted.
    disks: Option<[SmallDisk; 2]>,
    python: bool,
    logs: Logs,
    gaps: Gaps,
    memory: BTreeMap<&'static str, Memory>,
    start: Instant,
}

impl Target {
    pub(crate) fn start(config: &RunConfig, minutes: u64) -> Self {
        let (wall, place) = (Wall::new(), tempfile::tempdir().unwrap());
        wall.set(0);
        // Room for what the run writes, which is about half a mebibyte a minute: disks are full when a fault fills them.
        let size = format!("{}m", 24 + 2 * minutes);
        let disks = SmallDisk::mount(&size).and_then(|run| Some([run, SmallDisk::mount(&size)?]));
        let folder =
            |number: usize, name: &str| disks.as_ref().map_or(place.path(), |disks| disks[number].path()).join(name);
        let (run, data) = (folder(0, "run"), folder(1, "data"));
        let environment = wall.environment().to_vec();
        let setup =
            Setup { lease: 1.0, run: Some(run), wires: Some(7), data: Some(data), environment, ..Setup::default() };
        let mut cluster = Cluster::start_with(config, setup);
        std::fs::write(place.path().join("given.toml"), config.to_toml().unwrap()).unwrap();
        cluster.wires().all().iter().for_each(|wire| wire.set(PACE));
        (0..3).for_each(|_| cluster.start_actor());
        let python = Command::new("python3").arg("--version").output().is_ok_and(|output| output.status.success());
        if !python {
            eprintln!("NOT CHECKED: frozen threads; there is no python3 to stop one with");
        }
        cluster.wait_for_iteration(2);
        let (logs, gaps, memory) = (Logs::default(), Gaps::default(), BTreeMap::new());
        Self { cluster, wall, place, disks, python, logs, gaps, memory, start: Instant::now() }
    }

    /// Whether a fault is possible on this machine.
    pub(crate) fn can(&self, fault: &Fault) -> bool {
        match fault {
            Fault::FullDisk | Fault::ReadOnlyDisk => self.disks.is_some(),
            Fault::FreezeThread => self.python,
            _ => true,
        }
    }

    /// The folder of the training that a supervisor runs.
    pub(crate) fn supervised(&self) -> PathBuf {
        self.place.path().join("supervised")
    }

    /// Lets it go on for a while, and looks.
    pub(crate) fn live(&mut self, time: Duration) {
        let until = Instant::now() + time;
        loop {
            self.logs.look(&self.cluster.logs());
            // The answer has a ledger that balances, or this panics.
            let iteration = self.cluster.status().map(|status| status.iteration);
            self.gaps.look(iteration, self.logs.warnings);
            if Instant::now() >= until {
                return;
            }
            std::thread::sleep(Duration::from_millis(150).min(until.saturating_duration_since(Instant::now())));
        }
    }

    pub(crate) fn watch_memory(&mut self) {
        let commander = self.cluster.commander.as_ref().unwrap().id();
        for (name, pid) in
            [("learner", self.cluster.learner.id()), ("commander", commander), ("actor", self.cluster.actors[0].id())]
        {
            self.memory.entry(name).or_default().look(pid, self.start);
        }
    }

    pub(crate) fn check_memory(&self, most: f64) {
        for (name, memory) in &self.memory {
            assert!(memory.slope() <= most, "{name} grows by {:.2} MiB/h", memory.slope());
        }
    }

    /// Ends the training with a checkpoint of its last iteration.
    pub(crate) fn finish(&mut self) -> String {
        self.cluster.learner.signal("TERM");
        assert_eq!(self.cluster.learner.wait().code(), Some(75), "{}", self.cluster.learner.log());
        let log = self.cluster.learner.log();
        let closing: Vec<&str> = log.lines().filter_map(|line| line.split("residual=").nth(1)).collect();
        assert!(!closing.is_empty() && closing.iter().all(|residual| residual.trim() == "0"), "{closing:?}");
        let memory: Vec<String> = self
            .memory
            .iter()
            .map(|(name, memory)| format!("{name} {} MiB, {:+.2} MiB/h", memory.course(), memory.slope()))
            .collect();
        let Gaps { longest, explained, .. } = &self.gaps;
        format!(
            "ledgers: residual 0 at {} ends of learners; longest gap {:.1} s, {explained} beyond {:.0} s, each with a warning; memory in \
             the second half: {}",
            closing.len() / 2,
            longest.as_secs_f64(),
            crate::watch::GAP.as_secs_f64(),
            memory.join("; ")
        )
    }

    /// Lets a fault happen, for a while if it is one that lasts.
    pub(crate) fn afflict(&mut self, fault: &Fault, stream: &mut Stream, runtime: &tokio::runtime::Runtime) {
        let time = Duration::from_millis(500 + u64::from(stream.below(4500)));
        let which = stream.below(3) as usize;
        match fault {
            Fault::KillActor => self.kill_actor(which),
            Fault::KillLearner => self.kill_learner(time / 4),
            Fault::KillCommander => self.kill_commander(time / 4),
            Fault::KillAll => {
                (0..3).for_each(|_| self.kill_actor(0));
                self.cluster.commander.as_mut().unwrap().kill();
                self.kill_learner(time / 4);
                self.cluster.start_commander();
            }
            Fault::KillSupervisor => self.kill_supervisor(time / 2),
            Fault::FreezeActor => self.freeze(self.cluster.actors[which].id(), time),
            Fault::FreezeLearner => self.freeze(self.cluster.learner.id(), time),
            Fault::FreezeCommander => self.freeze(self.cluster.commander.as_ref().unwrap().id(), time),
            Fault::FreezeThread => self.freeze_thread(which, time),
            Fault::Partition => {
                self.cluster.wires().all()[which].set(Faults { mute: true, ..PACE });
                self.live(time);
                self.cluster.wires().all()[which].set(PACE);
            }
            Fault::Weather => {
                let every = Some(60_000);
                let faults = [
                    Faults { corrupt_every: every, ..PACE },
                    Faults { drop_every: every, ..PACE },
                    Faults { delay: Duration::from_millis(120), ..PACE },
                ];
                self.cluster.wires().all().iter().for_each(|wire| wire.set(faults[which]));
                self.live(time);
                self.cluster.wires().all().iter().for_each(|wire| {
                    wire.reset();
                    wire.set(PACE);
                });
            }
            Fault::Clock => {
                let offsets = [0, 25 * 3600, -400 * 86_400, 10 * 365 * 86_400, Wall::boot_without_battery()];
                self.wall.set(offsets[stream.below(5) as usize]);
            }
            Fault::SlowProcessor => {
                let commander = self.cluster.commander.as_ref().unwrap().id();
                let pid = [self.cluster.learner.id(), commander, self.cluster.actors[0].id()][which];
                let until = Instant::now() + time;
                // A tenth of a processor.
                while Instant::now() < until {
                    self.freeze(pid, Duration::from_millis(90));
                    std::thread::sleep(Duration::from_millis(10));
                }
            }
            Fault::FullDisk => {
                self.disks.iter().flatten().for_each(SmallDisk::fill);
                self.live(time);
                self.disks.iter().flatten().for_each(SmallDisk::make_room);
            }
            Fault::ReadOnlyDisk => {
                self.cluster.learner.kill();
                let Some([disk, _]) = &self.disks else { return };
                disk.set_read_only(true);
                self.cluster.resume_learner_while(|_| {
                    std::thread::sleep(time);
                    disk.set_read_only(false);
                });
            }
            Fault::MoveRun => {
                let (run, away) = (self.cluster.run(), self.cluster.run().with_extension("away"));
                std::fs::rename(&run, &away).unwrap();
                self.live(time);
                std::fs::rename(&away, &run).unwrap();
            }
            Fault::RemoveMissions => {
                let folder = self.disks.as_ref().map_or(self.place.path(), |disks| disks[1].path()).join("data");
                std::fs::remove_dir_all(&folder).unwrap();
                // A kill before the next change, or sweep, would lose what was in it.
                wait_until("the missions to be written again", || folder.join("missions.redb").exists());
                self.live(Duration::from_secs(1));
            }
            Fault::LargeMessages => self.large_messages(time, runtime),
        }
    }

    fn kill_actor(&mut self, which: usize) {
        self.cluster.actors.remove(which).kill();
        self.cluster.start_actor();
    }

    fn kill_learner(&mut self, pause: Duration) {
        self.cluster.learner.kill();
        std::thread::sleep(pause);
        self.cluster.resume_learner();
    }

    fn kill_commander(&mut self, pause: Duration) {
        self.cluster.commander.as_mut().unwrap().kill();
        std::thread::sleep(pause);
        self.cluster.start_commander();
    }

    /// A training of its own, whose supervisor is killed and started again at once, and then told to stop.
    fn kill_supervisor(&mut self, time: Duration) {
        let (run, log) = (self.supervised().display().to_string(), self.place.path().join("supervisor.log"));
        let given = self.place.path().join("given.toml").display().to_string();
        let start = || {
            let begin = ["train", &given, "--out", &run, "--http", "off", "--actors", "1"];
            let resume = ["train", "--resume", "--out", &run, "--http", "off", "--actors", "1"];
            Process::start(if self.supervised().join("config.toml").exists() { &resume } else { &begin }, &log)
        };
        let mut training = start();
        std::thread::sleep(time);
        training.kill();
        let mut training = start();
        self.cluster.status();
        std::thread::sleep(Duration::from_secs(2));
        training.signal("TERM");
        assert_eq!(training.wait().code(), Some(75), "{}", training.log());
    }

    fn freeze(&mut self, pid: u32, time: Duration) {
        let send = |signal: &str| {
            let sent = Command::new("kill").args([signal, &pid.to_string()]).status();
            assert!(sent.unwrap().success());
        };
        send("-STOP");
        std::thread::sleep(time);
        send("-CONT");
    }

    fn freeze_thread(&mut self, actor: usize, time: Duration) {
        let tasks = PathBuf::from(format!("/proc/{}/task", self.cluster.actors[actor].id()));
        let rollout =
            |task: &PathBuf| std::fs::read_to_string(task.join("comm")).is_ok_and(|name| name.starts_with("rollout"));
        let mut threads = std::fs::read_dir(tasks).unwrap().filter_map(|task| Some(task.ok()?.path()));
        // An actor that waits for a learner has none yet.
        let Some(thread) = threads.find(rollout) else { return };
        let thread = thread.file_name().unwrap().to_string_lossy().into_owned();
        let seconds = time.as_secs_f64().to_string();
        let mut freezing: Child =
            Command::new("python3").args(["-c", FREEZE, &thread, &seconds]).stdin(Stdio::null()).spawn().unwrap();
        self.live(time);
        assert!(freezing.wait().unwrap().success());
    }

    /// Two clients that send the longest messages to the commander.
    fn large_messages(&mut self, time: Duration, runtime: &tokio::runtime::Runtime) {
        let costs = v1::CostMatrix { agents: 2000, goals: 2000, values: vec![1.0; 4_000_000] };
        let scheduler = v1::AssignmentMethod::Greedy.into();
        let request = v1::AssignRequest { costs: Some(costs), scheduler, ..Default::default() };
        let message = bytes::Bytes::from(prost::Message::encode_to_vec(&request));
        let url = format!("http://{}", self.cluster.commander_address());
        let senders: Vec<_> = (0..2)
            .map(|_| {
                let (url, message, until) = (url.clone(), message.clone(), Instant::now() + time);
                runtime.spawn(async move {
                    let channel = client::endpoint(&url).unwrap().connect().await.unwrap();
                    let mut client = tonic::client::Grpc::new(channel);
                    while Instant::now() < until {
                        client.ready().await.unwrap();
                        let path = "/magex.v1.CommanderService/Assign".parse().unwrap();
                        // Answered, or refused because others are in flight.
                        let _ = client.unary(tonic::Request::new(message.clone()), path, Raw).await;
                    }
                })
            })
            .collect();
        self.live(time);
        senders.into_iter().for_each(|sender| runtime.block_on(sender).unwrap());
    }
}
