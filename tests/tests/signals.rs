//! Signals of terminals, supervisors and batch systems: each ends a training with a checkpoint and code 75, and none counts
//! twice. Limits of resources that would kill a process.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

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

    /// A training in one process within these limits, and its log.
    fn limited(&self, limits: &str, arguments: &str) -> (Child, PathBuf) {
        let log = self.path("limited.log");
        let line = format!("{limits}; exec {} {arguments} --in-process --http off", binary().display());
        let mut command = Command::new("bash");
        command.args(["-c", &line.replace('@', &self.0.path().display().to_string())]);
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(fs::File::create(&log).unwrap()).spawn();
        (child.unwrap(), log)
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
    let mut training =
        Command::new(words[0]).args(&words[1..]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_until("iterations", || place.lines("run") > 1);
    send("HUP", &training.id().to_string());
    let before = place.lines("run");
    wait_until("more iterations", || place.lines("run") > before + 2);
    send("TERM", &training.id().to_string());
    assert_eq!(training.wait().unwrap().code(), Some(75));
}

#[test]
fn a_log_that_nothing_reads_any_more_stops_no_training() {
    for how in ["--in-process", "--actors=1"] {
        let place = Place::new(1_000_000);
        let mut command = Command::new(binary());
        command.args(["train", "--http", "off", how]).arg(place.path("given.toml")).arg("--out").arg(place.path("run"));
        let mut training = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        // As when the terminal closes: writing fails from here on.
        drop(training.stderr.take());
        wait_until("iterations", || place.lines("run") > 20);
        send("HUP", &training.id().to_string());
        assert_eq!(training.wait().unwrap().code(), Some(75), "{how}");
        assert!(newest(&place.path("run")) > 0, "{how}");
    }
}

#[test]
fn a_limit_of_file_size_is_a_full_disk() {
    let place = Place::new(30);
    // Too small for the first checkpoint: the end, at once, with the limit, and nothing left behind.
    let (mut training, log) = place.limited("ulimit -f 4", "train @/given.toml --out @/small");
    let code = training.wait().unwrap().code();
    let text = fs::read_to_string(log).unwrap();
    assert_eq!(code, Some(73), "{text}");
    assert!(text.contains("limit of file size is 4 KiB (ulimit -f)"), "{text}");
    assert!(!place.path("small").exists());
    // Large enough for that, too small for metrics.jsonl: it trains, says what is missing, and continues when there is room.
    let config = fs::read_to_string(place.path("given.toml")).unwrap().replace("hidden = 32\nn", "hidden = 8\nn");
    fs::write(place.path("given.toml"), config).unwrap();
    let (mut training, log) = place.limited("ulimit -f 24", "train @/given.toml --out @/run");
    let text = || fs::read_to_string(&log).unwrap();
    let told = ["metrics.jsonl cannot be written", "limit of file size is 24 KiB"];
    wait_until("the limit to be named", || told.iter().all(|words| text().contains(words)));
    send("TERM", &training.id().to_string());
    assert_eq!(training.wait().unwrap().code(), Some(75), "{}", text());
    let (mut training, _) = place.limited("true", "train --resume --out @/run");
    assert!(training.wait().unwrap().success(), "{}", text());
    assert_eq!(place.lines("run"), 31);
}

#[test]
fn few_open_files_are_enough_for_a_training_or_named_at_the_start() {
    let place = Place::new(3);
    let out = place.path("run").display().to_string();
    let line = |limit: u32| {
        let (program, given) = (binary().display(), place.path("given.toml"));
        let line = format!("ulimit -n {limit}; exec {program} train {} --out {out} --http off", given.display());
        Command::new("bash").args(["-c", &line]).stdin(Stdio::null()).output().unwrap()
    };
    let refused = line(24);
    let text = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(64), "{text}");
    assert!(text.contains("open files is 24 (ulimit -n); 32 are needed"), "{text}");
    assert!(!place.path("run").exists());
    for limit in [32, 64, 128] {
        let trained = line(limit);
        assert!(trained.status.success(), "{limit}: {}", String::from_utf8_lossy(&trained.stderr));
        fs::remove_dir_all(&out).unwrap();
    }
}
