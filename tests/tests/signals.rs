//! Signals of terminals, supervisors and batch systems: each ends a training with a checkpoint and code 75, and none counts
//! twice. Limits of resources that would kill a process.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::ExecutorKind;
use magex_tests::sandbox::{Process, binary, wait_until};
use magex_tests::small;
use std::fs;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

struct Place(tempfile::TempDir);

impl Place {
    fn new(iterations: u64) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let mut config = small(ExecutorKind::Local, 5, iterations);
        // Only the stop writes one.
        config.run.checkpoint_every = 1_000_000;
        fs::write(place.path("given.toml"), config.to_toml().unwrap()).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn lines(&self, run: &str) -> usize {
        fs::read_to_string(self.path(run).join("metrics.jsonl")).unwrap_or_default().lines().count()
    }

    /// A training in a process group of its own.
    fn train(&self, run: &str, more: &str) -> Child {
        let mut command = Command::new(binary());
        command.args(["train", "--http", "off"]).arg(self.path("given.toml")).arg("--out").arg(self.path(run));
        command.args(more.split(' ')).stdin(Stdio::null()).stdout(Stdio::null()).process_group(0);
        command.stderr(fs::File::create(self.path(&format!("{run}.log"))).unwrap()).spawn().unwrap()
    }

    /// Runs a shell's line with `ulimit`; `@` is this folder, `magex` the program.
    fn limited(&self, line: &str) -> (Option<i32>, String) {
        let line = line.replace('@', &self.0.path().display().to_string());
        let line = line.replace("magex ", &format!("exec {} ", binary().display()));
        let output = Command::new("bash").args(["-c", &line]).stdin(Stdio::null()).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    }
}

fn send(signal: &str, to: &str) {
    assert!(Command::new("kill").args([&format!("-{signal}"), "--", to]).status().unwrap().success());
}

fn newest(run: &Path) -> u64 {
    let entries = fs::read_dir(run.join("checkpoints")).unwrap().map(|entry| entry.unwrap().file_name());
    entries.filter_map(|name| name.to_str()?.parse().ok()).max().unwrap()
}

#[test]
fn each_signal_of_a_supervisor_ends_a_training_with_a_checkpoint() {
    let place = Place::new(1_000_000);
    let cases = ["TERM", "USR1", "HUP", "XCPU"].map(|signal| (signal, "--in-process"));
    std::thread::scope(|scope| {
        for (signal, how) in cases.into_iter().chain([("TERM", "--actors=1"), ("HUP", "--actors=1")]) {
            let place = &place;
            scope.spawn(move || {
                let run = format!("{signal}{how}");
                let mut training = place.train(&run, how);
                wait_until("iterations", || place.lines(&run) > 1);
                let id = training.id().to_string();
                // As `timeout` does: the process, and at once its group.
                send(signal, &id);
                send(signal, &format!("-{id}"));
                let log = || fs::read_to_string(place.path(&format!("{run}.log"))).unwrap();
                assert_eq!(training.wait().unwrap().code(), Some(75), "{run}: {}", log());
                assert!(newest(&place.path(&run)) > 0, "{run}: {}", log());
            });
        }
    });
}

#[test]
fn a_learner_ends_with_a_checkpoint_too() {
    for signal in ["TERM", "USR1"] {
        let place = Place::new(1_000_000);
        let (given, out) = (place.path("given.toml").display().to_string(), place.path("run").display().to_string());
        let line = ["learner", "--config", &given, "--out", &out, "--listen", "127.0.0.1:0"];
        let mut learner = Process::start(&line, &place.path("log"));
        learner.ready();
        learner.signal(signal);
        learner.signal(signal);
        assert_eq!(learner.wait().code(), Some(75), "{}", learner.log());
    }
}

#[test]
fn a_closing_terminal_leaves_a_training_alone_that_nohup_started() {
    let place = Place::new(1_000_000);
    let line = format!("nohup {} train --http off @/given.toml --in-process --out @/run", binary().display());
    let line = line.replace('@', &place.0.path().display().to_string());
    let words: Vec<&str> = line.split(' ').collect();
    let mut training = Command::new(words[0]).args(&words[1..]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_until("iterations", || place.lines("run") > 1);
    send("HUP", &training.id().to_string());
    let before = place.lines("run");
    wait_until("more iterations", || place.lines("run") > before + 2);
    send("TERM", &training.id().to_string());
    assert_eq!(training.wait().unwrap().code(), Some(75));
}

#[test]
fn a_limit_of_file_size_is_a_full_disk() {
    let place = Place::new(30);
    // Too small for the first checkpoint: the end, at once, with the limit, and nothing left behind.
    let (code, log) = place.limited("ulimit -f 4; magex train @/given.toml --out @/small --in-process --http off");
    assert_eq!(code, Some(73), "{log}");
    assert!(log.contains("limit of file size") && log.contains("4 KiB") && log.contains("ulimit -f"), "{log}");
    assert!(!place.path("small").exists());
    // Large enough for that, too small for metrics.jsonl: it trains, says what is missing, and continues when there is room.
    let mut config = fs::read_to_string(place.path("given.toml")).unwrap();
    config = config.replace("hidden = 32\nn", "hidden = 8\nn");
    fs::write(place.path("given.toml"), config).unwrap();
    let line = "ulimit -f 24; timeout -s TERM 20 magex train @/given.toml --out @/run --in-process --http off";
    let (_, log) = place.limited(&line.replace("timeout -s TERM 20 magex", &format!("exec timeout -s TERM 20 {}", binary().display())));
    assert!(log.contains("metrics.jsonl cannot be written") && log.contains("limit of file size"), "{log}");
    let (code, log) = place.limited("magex train --resume --out @/run --in-process --http off");
    assert_eq!(code, Some(0), "{log}");
    assert_eq!(place.lines("run"), 31);
}
