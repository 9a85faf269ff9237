//! Environments of other people: one hash however the work is spread and whatever is killed, learning, and faults by name.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::RunConfig;
use magex_tests::sandbox::{Cluster, Process, binary, wait_until};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// The corridor's program.
const CORRIDOR: &str = env!("CARGO_BIN_EXE_magex-corridor");

/// A run in the corridor as a user writes it.
fn written(iterations: u32, more: &str) -> String {
    let steps = iterations * 16 * 20;
    format!(
        "[run]\nseed = 5\nmax_steps = {steps}\neval_every = 2\neval_episodes = 8\nfinal_episodes = 20\ncheckpoint_every = 2\n\
         target_success = 2\n[task]\nname = 'external'\nhorizon = 20\n[collect]\nepisodes_per_iteration = 16\n\
         shards_per_iteration = 4\n[mappo]\nminibatch_size = 320\nepochs = 4\nactor_learning_rate = 3e-3\n\
         critic_learning_rate = 3e-3\n{more}"
    )
}

const RECURRENT: &str = "chunk_length = 5\n[executor]\nhidden = 32\nrecurrent = true\n";

struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new(text: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("given.toml"), text).unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn magex(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(binary());
        command.current_dir(self.folder.path()).args(arguments).stdin(Stdio::null());
        command.output().unwrap()
    }

    /// Trains in this process; what it printed as JSON.
    fn train(&self, environment: &str, out: &str, more: &[&str]) -> Value {
        let fixed = ["train", "given.toml", "--in-process", "--http", "off", "--json", "--out", out];
        let output = self.magex(&[&fixed[..], &["--environment", environment], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(output.stdout.split(|byte| *byte == b'\n').rfind(|line| !line.is_empty()).unwrap())
            .unwrap()
    }

    /// Standard error and the exit code of a command that fails.
    fn refused(&self, arguments: &[&str]) -> (String, i32) {
        let output = self.magex(arguments);
        assert!(!output.status.success(), "{arguments:?}");
        (String::from_utf8_lossy(&output.stderr).into_owned(), output.status.code().unwrap())
    }
}

fn config(folder: &Path) -> RunConfig {
    RunConfig::from_toml(&std::fs::read_to_string(folder.join("config.toml")).unwrap()).unwrap()
}

/// The processes that this command line is of.
fn processes(command: &str) -> Vec<u32> {
    let of = |entry: std::fs::DirEntry| {
        let id = entry.file_name().to_string_lossy().parse().ok()?;
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        (line.trim() == command).then_some(id)
    };
    std::fs::read_dir("/proc").unwrap().filter_map(Result::ok).filter_map(of).collect()
}

#[test]
fn one_hash_however_the_work_is_spread_and_whatever_is_killed() {
    for (words, more) in [("masks", RECURRENT), ("continuous", "")] {
        let place = Place::new(&written(6, more));
        // A name of its own, so that its processes can be found.
        let mark = place.path("mark");
        let environment = format!("{CORRIDOR} {words} {}", mark.display());
        let one = place.train(&environment, "one", &["--threads", "1"])["weights_sha256"].clone();
        let two = place.train(&environment, "two", &["--threads", "2"])["weights_sha256"].clone();
        assert_eq!(one, two, "{words}: two threads");
        let run = config(&place.path("one"));
        let mut cluster = Cluster::start(&run);
        cluster.start_actor_with(&["--environment", &environment]);
        assert_eq!(cluster.finish(), one, "{words}: one actor");

        let mut cluster = Cluster::start(&run);
        cluster.start_actor_with(&["--environment", &environment]);
        cluster.start_actor_with(&["--environment", &environment]);
        cluster.wait_for_iteration(1);
        processes(&environment).into_iter().take(1).for_each(kill);
        cluster.wait_for_iteration(2);
        cluster.actors[0].kill();
        cluster.start_actor_with(&["--environment", &environment]);
        cluster.wait_for_iteration(3);
        cluster.learner.kill();
        cluster.resume_learner();
        assert_eq!(cluster.finish(), one, "{words}: two actors, one killed, an environment killed, the learner killed");
        drop(cluster);
        // What was killed hard leaves nothing behind.
        wait_until("the end of all environments", || processes(&environment).is_empty());
    }
}

fn kill(process: u32) {
    // It may have ended by itself.
    let _ = Command::new("kill").args(["-9", &process.to_string()]).status();
}

#[test]
fn agents_learn_with_masks_and_memory_and_with_real_numbers() {
    for (words, more) in [("masks", RECURRENT), ("continuous", ""), ("", "[executor]\ncentralised_critic = false\n")] {
        let place = Place::new(&written(40, more));
        let environment = format!("{CORRIDOR} {words}");
        let summary = place.train(&environment, "run", &[]);
        let success = summary["success_rate"].as_f64().unwrap();
        assert!(success >= 0.95, "{words}: {summary}");
        let length = summary["episode_length"].as_f64().unwrap();
        assert!((2.0..6.0).contains(&length) && summary["cost_ratio"].is_null(), "{words}: {summary}");
        // What acts is what is trained: the first ratio is 1, to the bit.
        let lines = std::fs::read_to_string(place.path("run/metrics.jsonl")).unwrap();
        let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let errors = lines.iter().filter_map(|line| line["executor"]["first_ratio_error"].as_f64());
        assert_eq!(errors.clone().count(), 40);
        assert!(errors.clone().all(|error| error == 0.0), "{words}");
        // Its pictures are the replay.
        assert!(std::fs::read_to_string(place.path("run/replay.html")).unwrap().contains("iVBOR"));
        let evaluated = place.magex(&["eval", "run", "--environment", &environment, "--json", "--mode", "greedy"]);
        assert!(evaluated.status.success(), "{}", String::from_utf8_lossy(&evaluated.stderr));
    }
}

#[test]
fn an_environment_that_fails_once_costs_time_and_no_bit() {
    let place = Place::new(&written(2, ""));
    let undisturbed = place.train(CORRIDOR, "undisturbed", &[])["weights_sha256"].clone();
    for (fault, words) in [
        ("raise", "the floor is lava"),
        ("nan", "rewards: world 0, agent left: NaN is not finite"),
        ("shape", "observations"),
        ("hang", "did not answer a step within 1 s"),
        ("exit", "its process ended (exit status: 3)"),
    ] {
        let environment = format!("{CORRIDOR} {fault} {}", place.path(&format!("{fault}.once")).display());
        let fixed = ["train", "given.toml", "--in-process", "--http", "off", "--json", "--out", fault];
        let more = ["--environment", &environment, "--environment-timeout", "1", "--threads", "1"];
        let output = place.magex(&[&fixed[..], &more].concat());
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success() && told.contains(words), "{fault}: {told}");
        let summary = std::fs::read_to_string(place.path(fault).join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&summary).unwrap();
        assert_eq!(summary["weights_sha256"], undisturbed, "{fault}");
    }
}

#[test]
fn what_cannot_be_is_named() {
    let place = Place::new(&written(2, ""));
    let train =
        |more: &[&str]| place.refused(&[&["train", "given.toml", "--in-process", "--http", "off"], more].concat());
    let (told, code) = train(&["--environment", &format!("{CORRIDOR} broken"), "--out", "a"]);
    assert!(told.contains("No module named 'corridor'") && code == 69, "{told}");
    assert!(!place.path("a").exists(), "nothing was started");
    let (told, code) = train(&[]);
    assert!(told.contains("task.external: missing") && told.contains("--environment") && code == 64, "{told}");
    let (told, code) = train(&["--environment", CORRIDOR, "--set", "executor.kind=\"magex\""]);
    assert!(told.contains("executor.kind: ") && told.contains("flat") && code == 64, "{told}");
    let (told, _) = train(&["--environment", CORRIDOR, "--set", "task.agents=3"]);
    assert!(told.contains("task.agents: 3 where the environment has 2 agents"), "{told}");
    let (told, code) = place.refused(&["train", "--environment", CORRIDOR, "--set", "task.name=\"simple-spread\""]);
    assert!(told.contains("spawn") && code == 64, "{told}");

    place.train(CORRIDOR, "run", &[]);
    let (told, code) = place.refused(&["eval", "run"]);
    assert!(told.contains("--environment") && told.contains("corridor") && code == 64, "{told}");
    let (told, _) = place.refused(&["eval", "run", "--environment", &format!("{CORRIDOR} continuous")]);
    assert!(told.contains("task.external.choices is []"), "{told}");
    let (told, _) = place.refused(&["eval", "run", "--environment", CORRIDOR, "--controller", "astar"]);
    assert!(told.contains("random"), "{told}");
    let random = place.magex(&["eval", "given.toml", "--environment", CORRIDOR, "--controller", "random", "--json"]);
    assert!(random.status.success(), "{}", String::from_utf8_lossy(&random.stderr));
}

#[test]
fn an_environment_that_is_not_a_function_of_its_seed_is_trained_and_said_to_be_none() {
    let place = Place::new(&written(3, ""));
    let environment = format!("{CORRIDOR} impure");
    place.train(&environment, "run", &[]);
    let run = config(&place.path("run"));
    assert!(!run.task.pure());
    let mut cluster = Cluster::start(&run);
    cluster.start_actor_with(&["--environment", &environment]);
    cluster.start_actor_with(&["--environment", &environment]);
    cluster.finish();
    let checked = place.magex(&["check-environment", "--environment", &environment, "--json"]);
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stdout));
    let liar = place.magex(&["check-environment", "--environment", &format!("{CORRIDOR} masks")]);
    let told = String::from_utf8_lossy(&liar.stdout).into_owned();
    assert!(liar.status.success() && told.contains("same bits in two processes"), "{told}");
}

#[test]
fn an_environment_that_only_says_that_it_is_a_function_of_its_seed_is_found_out() {
    let place = Place::new(&written(3, ""));
    let environment = format!("{CORRIDOR} impure liar");
    place.train(&environment, "run", &[]);
    let mut cluster = Cluster::start(&config(&place.path("run")));
    cluster.start_actor_with(&["--environment", &environment]);
    cluster.start_actor_with(&["--environment", &environment]);
    let (status, log) = (cluster.learner.wait(), cluster.learner.log());
    assert!(!status.success() && log.contains("serve(deterministic=False)"), "{log}");
    let checked = place.magex(&["check-environment", "--environment", &environment]);
    let told = String::from_utf8_lossy(&checked.stdout).into_owned();
    assert!(checked.status.code() == Some(1) && told.contains("in another process step"), "{told}");
}

#[test]
fn an_actor_without_the_environment_says_so() {
    let place = Place::new(&written(2, ""));
    place.train(CORRIDOR, "run", &[]);
    let mut cluster = Cluster::start(&config(&place.path("run")));
    for (options, reason) in [
        (vec![], "give --environment"),
        (vec!["--environment", "magex-corridor continuous"], "task.external.choices is []"),
    ] {
        let own = CORRIDOR.replace("magex-corridor", options.get(1).copied().unwrap_or_default());
        let options: Vec<&str> = if options.is_empty() { vec![] } else { vec![options[0], &own] };
        cluster.start_actor_with(&options);
        let actor: &mut Process = cluster.actors.last_mut().unwrap();
        let (status, log) = (actor.wait(), actor.log());
        assert!(!status.success() && log.contains(reason), "{log}");
    }
    assert_eq!(cluster.status().unwrap().ledger.unwrap().failed, 0, "no shard was lost to them");
    cluster.start_actor_with(&["--environment", CORRIDOR]);
    cluster.finish();
}
