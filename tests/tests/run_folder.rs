//! A run folder has one writer, whatever is started on it, and a run that is killed and resumed at once, or continued with a
//! larger budget, or begun from the weights of another run, learns what it would have learned undisturbed.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_tests::sandbox::{Process, binary, wait_until};
use magex_tests::{small, train};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

/// A folder with a configuration.
struct Place(tempfile::TempDir);

impl Place {
    fn new(config: &RunConfig) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        place.write("given.toml", config);
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, config: &RunConfig) {
        fs::write(self.path(name), config.to_toml().unwrap()).unwrap();
    }

    /// `@` is this folder.
    fn words(&self, line: &str) -> Vec<String> {
        line.split(' ').map(|word| word.replace('@', &self.0.path().display().to_string())).collect()
    }

    fn start(&self, line: &str) -> Process {
        let words = self.words(line);
        Process::start(&words.iter().map(String::as_str).collect::<Vec<_>>(), &self.path("log"))
    }

    fn run(&self, line: &str) -> Output {
        Command::new(binary()).args(self.words(line)).output().unwrap()
    }

    fn refused(&self, line: &str, code: i32, words: &[&str]) {
        let output = self.run(line);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{line}: {text}");
        for word in words {
            assert!(text.contains(word), "{line}: '{word}' is missing in: {text}");
        }
    }

    fn succeeds(&self, line: &str) -> serde_json::Value {
        let output = self.run(&format!("{line} --json"));
        assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_str(String::from_utf8_lossy(&output.stdout).lines().last().unwrap()).unwrap()
    }

    fn iterations(&self, run: &str) -> Vec<u64> {
        iterations(&self.path(run))
    }
}

/// In the order of the file. The last line of a complete run, which only evaluates, has a number of its own.
fn iterations(run: &Path) -> Vec<u64> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let lines = text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    lines.map(|line| line["iteration"].as_u64().unwrap()).collect()
}

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

#[test]
fn a_second_writer_is_refused_and_names_the_first() {
    let place = Place::new(&small(ExecutorKind::Local, 5, 100_000));
    let mut first = place.start("train @/given.toml --out @/run --http off --actors 1");
    wait_until("iterations", || place.iterations("run").len() > 2);
    let learner = "learner --out @/run --config @/given.toml --listen 127.0.0.1:0";
    let second = [
        "train --resume --out @/run --http off --in-process".to_owned(),
        "train --resume --out @/run --http off".to_owned(),
        format!("{learner} --resume"),
        format!("{learner} --resume-or-create"),
    ];
    std::thread::scope(|scope| {
        for line in &second {
            scope.spawn(|| place.refused(line, 73, &["(magex train) writes to this run folder", "/run"]));
        }
        scope.spawn(|| place.refused("train-commander --out @/run", 73, &["/run exists"]));
    });
    assert!(first.running());
    first.signal("TERM");
    // The next one waits for it.
    let mut next = place.start("train --resume --out @/run --http off --in-process");
    assert_eq!(first.wait().code(), Some(75));
    let before = place.iterations("run").len();
    wait_until("more iterations", || place.iterations("run").len() > before);
    next.signal("TERM");
    assert_eq!(next.wait().code(), Some(75), "{}", next.log());
    let all = place.iterations("run");
    assert_eq!(all, (0..all.len() as u64).collect::<Vec<_>>());
}

/// Kills a training with SIGKILL and resumes it at once, again and again; then lets it end.
fn kill_and_resume(rounds: u32, most: Duration, iterations: u64) {
    let config = small(ExecutorKind::Local, 5, iterations);
    let place = Place::new(&config);
    let mut line = "train @/given.toml --out @/run".to_owned();
    let mut delays = Key::new(17, Purpose::Spawn, &[]).stream();
    for round in 0..rounds {
        let in_process = if round % 3 == 2 { " --in-process" } else { " --actors 1" };
        let mut training = place.start(&format!("{line} --http off{in_process}"));
        std::thread::sleep(most.mul_f64(delays.uniform()));
        training.kill();
        // Killed before it began anything, the same command begins.
        if place.path("run/config.toml").exists() {
            line = "train --resume --out @/run".to_owned();
        }
    }
    let summary = place.succeeds(&format!("{line} --http off --actors 1"));
    assert_eq!(place.iterations("run"), (0..=iterations).collect::<Vec<_>>());
    assert_eq!(summary["weights_sha256"], undisturbed(&config).as_str());
}

#[test]
fn killed_and_resumed_at_once_no_iteration_is_missing_doubled_or_out_of_order() {
    kill_and_resume(6, Duration::from_millis(1500), 150);
}

#[test]
#[ignore = "takes minutes; .ci/long"]
fn killed_and_resumed_at_once_thirty_times() {
    kill_and_resume(30, Duration::from_secs(5), 3000);
}

#[test]
fn a_larger_budget_learns_as_if_it_had_been_the_first() {
    let config = small(ExecutorKind::Local, 5, 8);
    let place = Place::new(&small(ExecutorKind::Local, 5, 3));
    place.succeeds("train @/given.toml --out @/run --in-process --http off");
    assert_eq!(place.iterations("run"), [0, 1, 2, 3]);
    // Up to here, what the longer run is on the way: intervals may change, too.
    place.write("longer.toml", &{
        let mut longer = config.clone();
        (longer.run.max_steps, longer.run.eval_every, longer.run.keep_checkpoints) = (5 * 8 * 20, 1, 5);
        longer
    });
    place.succeeds("train @/longer.toml --resume --out @/run --http off --actors 1");
    let own = RunConfig::from_toml(&fs::read_to_string(place.path("run/config.toml")).unwrap()).unwrap();
    assert_eq!((own.run.max_steps, own.run.eval_every), (800, 1));
    let steps = config.run.max_steps;
    let summary = place.succeeds(&format!("train --resume --out @/run --in-process --http off --max-steps {steps}"));
    assert_eq!(place.iterations("run"), (0..=8).collect::<Vec<_>>());
    assert_eq!(summary["weights_sha256"], undisturbed(&config).as_str());
    // Not less than what was done, and nothing that decides what is learned.
    let resume = "train --resume --out @/run --in-process --http off";
    place.refused(&format!("{resume} --max-steps 300"), 64, &["run.max_steps", "1280"]);
    place.refused(&format!("{resume} --seed 9"), 64, &["run.seed was 5 and is 9", "--from"]);
    place.refused("learner --resume --out @/run --seed 9 --listen 127.0.0.1:0", 64, &["run.seed was 5 and is 9"]);
    let edited = fs::read_to_string(place.path("run/config.toml")).unwrap().replace("hidden = 32\nn", "hidden = 16\nn");
    fs::write(place.path("run/config.toml"), edited).unwrap();
    place.refused(resume, 64, &["executor.hidden was 32 and is 16", "config.toml"]);
}

#[test]
fn a_run_begins_from_the_weights_of_another_and_records_which() {
    let mut config = small(ExecutorKind::Local, 5, 3);
    let place = Place::new(&config);
    let parent = place.succeeds("train @/given.toml --out @/parent --in-process --http off");
    let parent = parent["weights_sha256"].as_str().unwrap();
    let recorded = |run: &str| {
        let text = fs::read_to_string(place.path(run).join("config.toml")).unwrap();
        RunConfig::from_toml(&text).unwrap().run
    };
    // Another team size, reward and step size; in one process and with services.
    config.task.agents = 7;
    config.mappo.actor_learning_rate = 1e-3;
    config.run.target_success = 2.0;
    place.write("child.toml", &config);
    let child = "train @/child.toml --from @/parent --http off --out @/";
    let a = place.succeeds(&format!("{child}a --in-process"));
    let b = place.succeeds(&format!("{child}b --actors 1"));
    assert_eq!(a["weights_sha256"], b["weights_sha256"]);
    assert_ne!(a["weights_sha256"], undisturbed(&config).as_str(), "it did not begin anew");
    assert_eq!((recorded("a").initial_weights.as_str(), recorded("a").initial_optimiser), (parent, false));
    let kept = place.succeeds(&format!("{child}c --in-process --keep-optimiser"));
    assert_ne!(a["weights_sha256"], kept["weights_sha256"]);
    assert!(recorded("c").initial_optimiser);
    // The recorded configuration gives the same weights again, from the same run only.
    let again = place.succeeds("train @/c/config.toml --from @/parent --out @/d --in-process --http off");
    assert_eq!(again["weights_sha256"], kept["weights_sha256"]);
    place.refused("train @/c/config.toml --out @/e --in-process", 64, &["run.initial_weights", "--from RUN"]);
    place.refused("train @/c/config.toml --from @/a --out @/e --in-process", 64, &["--from", "run.initial_weights"]);
    // Shapes that do not fit are named with what decides them.
    config.executor.hidden = 48;
    place.write("wide.toml", &config);
    let words = ["--from", "actor.", "executor.hidden was 32 and is 48"];
    place.refused("train @/wide.toml --from @/parent --out @/e --in-process", 64, &words);
    place.refused("train --from @/nowhere --out @/e", 64, &["--from", "nowhere"]);
    assert!(!place.path("e").exists(), "a command that started nothing leaves nothing");
    // A learner alone, and a run that stopped before its first checkpoint.
    let learner = "learner --config @/child.toml --from @/parent --out @/f --listen 127.0.0.1:0";
    let mut learner = place.start(learner);
    learner.ready();
    learner.signal("TERM");
    assert_eq!(learner.wait().code(), Some(75), "{}", learner.log());
    fs::remove_dir_all(place.path("f/checkpoints")).unwrap();
    place.refused("train --resume --out @/f --in-process", 64, &["run.initial_weights"]);
    let f = place.succeeds("train --resume --from @/parent --out @/f --in-process --http off");
    assert_eq!(f["weights_sha256"], a["weights_sha256"]);
}

#[test]
fn a_command_that_started_nothing_leaves_nothing_behind() {
    let place = Place::new(&small(ExecutorKind::Local, 5, 2));
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap();
    for more in ["", " --in-process"] {
        let line = format!("train @/given.toml --out @/deep/run --http {port}{more}");
        place.refused(&line, 69, &["is in use"]);
        assert!(!place.path("deep").exists(), "{more}");
    }
    place.refused(&format!("learner --config @/given.toml --out @/deep/run --listen {port}"), 69, &["is in use"]);
    assert!(!place.path("deep").exists());
    std::os::unix::fs::symlink("nowhere", place.path("link")).unwrap();
    for command in ["train @/given.toml --in-process", "train-commander", "learner --listen 127.0.0.1:0"] {
        place.refused(&format!("{command} --out @/link"), 73, &["--out", "symbolic link to nowhere"]);
    }
    // What a kill leaves before the first checkpoint begins again, with its own configuration.
    fs::create_dir(place.path("run")).unwrap();
    fs::copy(place.path("given.toml"), place.path("run/config.toml")).unwrap();
    place.refused("train @/given.toml --out @/run --in-process", 73, &["add --resume"]);
    place.succeeds("train --resume --out @/run --in-process --http off");
    assert_eq!(place.iterations("run"), [0, 1, 2]);
}

#[test]
fn a_scheduler_training_that_is_stopped_leaves_nothing_and_one_that_is_killed_begins_again() {
    let place = Place::new(&small(ExecutorKind::Local, 5, 2));
    let long = "train-commander --out @/s --imitation 100000 --batch 1";
    let mut training = place.start(long);
    wait_until("the beginning", || place.path("s/config.toml").exists());
    training.kill();
    let mut training = place.start(long);
    std::thread::sleep(Duration::from_millis(200));
    training.signal("TERM");
    assert_eq!(training.wait().code(), Some(75), "{}", training.log());
    place.succeeds("train-commander --out @/s --imitation 1 --ppo 0 --batch 1");
    let mut training = place.start("train-commander --out @/t/u --imitation 100000 --batch 1");
    wait_until("the beginning", || place.path("t/u/config.toml").exists());
    training.signal("INT");
    assert_eq!(training.wait().code(), Some(75), "{}", training.log());
    assert!(!place.path("t").exists());
}
