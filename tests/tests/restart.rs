//! A learner under a restart policy: one command begins a run, continues it after any death, and serves it when it is
//! complete.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_tests::sandbox::{Process, binary, wait_until};
use magex_tests::{small, train};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

/// A run folder, and the command that a restart policy would repeat.
struct Policy {
    folder: tempfile::TempDir,
    address: String,
}

impl Policy {
    fn new(config: &RunConfig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("given.toml"), config.to_toml().unwrap()).unwrap();
        Self { folder, address: "127.0.0.1:0".to_owned() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn run(&self) -> PathBuf {
        self.path("run")
    }

    fn process(&self, line: &str) -> Process {
        let arguments: Vec<&str> = line.split(' ').collect();
        Process::start(&arguments, &self.path(&format!("{}.log", arguments[0])))
    }

    fn command(&self) -> String {
        let (given, run) = (self.path("given.toml"), self.run());
        let (given, run) = (given.display(), run.display());
        let listen = &self.address;
        format!("learner --config {given} --out {run} --listen {listen} --threads 1 --resume-or-create --stay")
    }

    /// The learner, on the address that it had before.
    fn learner(&mut self) -> Process {
        let mut learner = self.process(&self.command());
        self.address = learner.ready();
        learner
    }

    fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    fn iterations(&self) -> usize {
        fs::read_to_string(self.run().join("metrics.jsonl")).unwrap_or_default().lines().count()
    }

    fn complete(&self) -> bool {
        self.run().join("summary.json").exists()
    }

    /// Everything in the run folder.
    fn files(&self) -> Vec<(PathBuf, Vec<u8>)> {
        fn below(folder: &Path, files: &mut Vec<(PathBuf, Vec<u8>)>) {
            for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
                match entry.path() {
                    path if path.is_dir() => below(&path, files),
                    path => files.push((path.clone(), fs::read(path).unwrap())),
                }
            }
        }
        let mut files = Vec::new();
        below(&self.run(), &mut files);
        // It says which process writes, or did.
        files.retain(|(path, _)| !path.ends_with(".lock"));
        files.sort();
        files
    }
}

fn magex(line: &str) -> Output {
    Command::new(binary()).args(line.split(' ')).output().unwrap()
}

fn healthy(url: &str) -> bool {
    magex(&format!("health {url}")).status.success()
}

fn sha256(run: &Path) -> String {
    let summary: serde_json::Value = serde_json::from_slice(&fs::read(run.join("summary.json")).unwrap()).unwrap();
    summary["weights_sha256"].as_str().unwrap().to_owned()
}

#[test]
fn one_command_begins_continues_and_serves_a_run() {
    let config = small(ExecutorKind::Local, 5, 24);
    let mut policy = Policy::new(&config);
    let mut learner = policy.learner();
    let url = policy.url();
    let mut commander = policy.process(&format!("commander --learner {url} --listen 127.0.0.1:0"));
    let commander_url = format!("http://{}", commander.ready());
    let actor = format!("actor --learner {url} --commander {commander_url} --threads 1");
    let mut stays = policy.process(&format!("{actor} --stay"));

    for round in 1..=2 {
        wait_until("iterations", || policy.iterations() >= 6 * round);
        learner.kill();
        assert_eq!(magex(&format!("health {url}")).status.code(), Some(69), "a learner that is gone is not well");
        learner = policy.learner();
    }
    wait_until("the end of the run", || policy.complete());
    wait_until("the learner to be well", || healthy(&url));
    let expected = train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256;
    assert_eq!(sha256(&policy.run()), expected);

    // It serves: an actor that stays waits, one that does not is told that there is nothing to do, and a commander that
    // comes late gets its weights. The same after another death.
    let left = policy.files();
    for death in 0..2 {
        assert!(policy.process(&actor).wait().success(), "an actor that comes late ends well");
        let mut late = policy.process(&format!("commander --learner {url} --listen 127.0.0.1:0"));
        let late_url = format!("http://{}", late.ready());
        wait_until("a late commander to have weights", || healthy(&late_url));
        assert!(learner.running() && stays.running());
        if death == 0 {
            learner.kill();
            learner = policy.learner();
            wait_until("the learner to be well again", || healthy(&url));
        }
    }
    learner.signal("TERM");
    assert_eq!(learner.wait().code(), Some(0), "a complete run that is told to stop is done");
    stays.signal("TERM");
    assert!(stays.wait().success());
    // A resume of a complete run leaves it as it was.
    let resumed = magex(&format!("train --resume --out {} --in-process --json", policy.run().display()));
    assert!(resumed.status.success(), "{}", String::from_utf8_lossy(&resumed.stderr));
    let pictures = |name: &Path| name.extension().is_some_and(|e| e == "svg" || e == "html");
    let now: Vec<_> = policy.files().into_iter().filter(|(name, _)| !pictures(name)).collect();
    let names = |files: &[(PathBuf, Vec<u8>)]| files.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&now), names(&left));
    assert!(now == left, "a complete run is never written to again");
}

#[test]
fn a_learner_that_dies_while_it_begins_begins_again() {
    let config = small(ExecutorKind::Local, 5, 2);
    let mut policy = Policy::new(&config);
    // Wherever it is by then.
    for milliseconds in [0, 2, 4, 8, 16, 24, 32, 48, 64, 96] {
        let mut learner = policy.process(&policy.command());
        std::thread::sleep(Duration::from_millis(milliseconds));
        learner.kill();
    }
    // And in the middle of writing both files that come first, whatever the rounds above hit.
    fs::remove_dir_all(policy.run()).ok();
    fs::create_dir_all(policy.run().join("checkpoints/.000000.tmp")).unwrap();
    fs::write(policy.run().join("config.toml"), "[run]\nmax_st").unwrap();
    fs::write(policy.run().join("checkpoints/.000000.tmp/weights.safetensors"), "half").unwrap();
    // Only where it was asked for.
    let (run, given) = (policy.run(), policy.path("given.toml"));
    let refused = magex(&format!("learner --config {} --out {} --listen 127.0.0.1:0", given.display(), run.display()));
    assert_eq!(refused.status.code(), Some(73), "{}", String::from_utf8_lossy(&refused.stderr));

    let mut learner = policy.learner();
    let url = policy.url();
    let mut commander = policy.process(&format!("commander --learner {url} --listen 127.0.0.1:0"));
    let commander_url = format!("http://{}", commander.ready());
    let mut actor = policy.process(&format!("actor --learner {url} --commander {commander_url} --threads 1"));
    wait_until("the end of the run", || policy.complete());
    assert!(actor.wait().success(), "{}", actor.log());
    assert_eq!(sha256(&run), train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256);
    assert_eq!(fs::read_to_string(run.join("config.toml")).unwrap(), config.to_toml().unwrap());
    learner.kill();

    // Another configuration is no reason to touch a run.
    let left = policy.files();
    let mut other = config.clone();
    other.run.seed += 1;
    fs::write(&given, other.to_toml().unwrap()).unwrap();
    let mut refused = policy.process(&policy.command());
    assert_eq!(refused.wait().code(), Some(64));
    assert!(refused.log().contains("run.seed was 5 and is 6"), "{}", refused.log());
    assert!(policy.files() == left);
}

#[test]
fn what_was_trained_is_not_begun_again_when_its_checkpoints_are_gone() {
    let policy = Policy::new(&small(ExecutorKind::Local, 5, 2));
    fs::create_dir(policy.run()).unwrap();
    fs::write(policy.run().join("config.toml"), "").unwrap();
    fs::write(policy.run().join("metrics.jsonl"), "{\"iteration\":1}\n").unwrap();
    let mut refused = policy.process(&policy.command());
    assert_eq!(refused.wait().code(), Some(73));
    assert!(refused.log().contains("its checkpoints are missing"), "{}", refused.log());
    assert_eq!(fs::read_to_string(policy.run().join("metrics.jsonl")).unwrap(), "{\"iteration\":1}\n");
}

#[test]
fn the_services_ask_themselves_by_their_own_names() {
    let folder = tempfile::tempdir().unwrap();
    let named = |name: &str| {
        let link = folder.path().join(name);
        std::os::unix::fs::symlink(binary(), &link).unwrap();
        // As a container starts it, or not: the program starts itself again without losing its name.
        let mut command = Command::new(link);
        command.env_remove("RAYON_NUM_THREADS").env_remove("CANDLE_NUM_THREADS");
        command
    };
    let mut commander = Process::start(&["commander", "--listen", "127.0.0.1:0"], &folder.path().join("log"));
    let address = commander.ready();
    let mut check = named("magex-commander");
    check.args(["--health-check"]).env("MAGEX_COMMANDER_LISTEN", &address);
    wait_until("the commander to be well", || check.status().unwrap().success());
    commander.kill();
    let gone = check.output().unwrap();
    assert_eq!(gone.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&gone.stderr).contains("nothing listens at"), "{gone:?}");
    let learner = named("magex-learner").args(["--health-check", "--listen", &address]).output().unwrap();
    assert_eq!(learner.status.code(), Some(1));
    let actor = named("magex-actor").arg("--health-check").env_remove("MAGEX_HTTP").output().unwrap();
    assert_eq!(actor.status.code(), Some(64));
    assert!(String::from_utf8_lossy(&actor.stderr).contains("--http"), "{actor:?}");
}
