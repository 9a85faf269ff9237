//! The command as a user calls it: what it prints, what it leaves, and how it ends.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use serde_json::Value;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

const TINY: &str = "
[run]
max_steps = 720
eval_episodes = 4
final_episodes = 6
checkpoint_every = 1
[task]
name = 'simple-spread'
agents = 5
spawn = 'uniform'
[executor]
kind = 'local'
[collect]
episodes_per_iteration = 4
[mappo]
epochs = 2
";

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::write(place.path("tiny.toml"), TINY).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, line: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_magex"));
        command.args(line.split_whitespace()).current_dir(self.0.path()).stdin(Stdio::null());
        command.env_remove("RUST_LOG").env_remove("CARGO_MANIFEST_DIR");
        command
    }

    fn run(&self, line: &str) -> Output {
        self.command(line).output().unwrap()
    }

    /// The JSON object on the last line of a command that succeeds.
    fn json(&self, line: &str) -> Value {
        let output = self.run(&format!("{line} --json"));
        assert!(output.status.success(), "{line}: {}", text(&output.stderr));
        last_line(&output)
    }

    /// A command that fails with this code and these words on standard error.
    fn fails(&self, line: &str, code: i32, words: &[&str]) {
        let output = self.run(line);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{line}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{line}: '{word}' is missing in: {stderr}");
        }
        assert!(!stderr.contains("panicked"), "{line}: {stderr}");
    }

    fn trained(&self, out: &str) -> Value {
        self.json(&format!("train tiny.toml --in-process --out {out}"))
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn last_line(output: &Output) -> Value {
    serde_json::from_str(text(&output.stdout).lines().last().unwrap()).unwrap()
}

fn repository(path: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path).display().to_string()
}

#[test]
fn a_run_leaves_its_folder_and_can_be_evaluated_and_replayed() {
    let place = Place::new();
    let summary = place.json("train tiny.toml --in-process --seed 3");
    for key in [
        "success_rate",
        "sampled_success_rate",
        "all_covered_rate",
        "arrival_step",
        "collisions_per_agent_step",
        "cost_ratio",
        "joint_env_steps",
        "agent_steps",
        "wall_s",
        "command_wall_s",
        "iterations",
    ] {
        assert!(summary[key].is_number(), "{key}: {summary}");
    }
    assert_eq!((&summary["iterations"], &summary["agent_steps"]), (&3.into(), &3600.into()));
    let out = "runs/simple-spread-5-local-s3";
    assert_eq!(summary["out"], out);
    for file in [
        "config.toml",
        "metrics.jsonl",
        "weights.safetensors",
        "summary.json",
        "curve.svg",
        "replay.html",
        "checkpoints",
        "tensorboard/events.out.tfevents.0001",
    ] {
        assert!(place.path(out).join(file).exists(), "{file}");
    }
    assert_eq!(fs::read_to_string(place.path(out).join("metrics.jsonl")).unwrap().lines().count(), 4);

    assert!(summary["page"].as_str().unwrap().starts_with("http://127.0.0.1:"), "{summary}");

    // The name is taken: the next run of the same kind gets another, with the same weights.
    let again = place.json("train tiny.toml --in-process --seed 3 --threads 1 --http off");
    assert_eq!(again["out"], format!("{out}-2"));
    assert!(again["page"].is_null());
    assert_eq!(again["weights_sha256"], summary["weights_sha256"]);

    let eval = place.json(&format!("eval {out} --episodes 20 --episode-seeds 1,2 --threads 1 --strict"));
    assert_eq!((&eval["weights_final"], &eval["warnings"]), (&true.into(), &Value::Array(Vec::new())));
    assert_eq!((eval["rows"].as_array().unwrap().len(), &eval["mean"]["greedy"]["episodes"]), (4, &40.into()));
    assert_eq!(eval["weights_sha256"], summary["weights_sha256"]);
    // The cut into shards and threads does not change a number.
    let same = place.json(&format!("eval {out} --episodes 20 --episode-seeds 1,2 --threads 2 --record look.html"));
    assert_eq!(eval["mean"], same["mean"]);
    assert!(place.path("look.html").exists());
    let scripted = place.json(&format!("eval {out} --controller scripted --episodes 8"));
    assert_eq!(scripted["mean"]["greedy"]["success_rate"], 1.0);
    let larger =
        place.json(&format!("eval {out} --agents 12 --scheduler exact --mode greedy --episodes 2 --spawn lines"));
    assert_eq!((&larger["agents"], &larger["mean"]["greedy"]["cost_ratio"]), (&12.into(), &1.0.into()));

    let replay = place.json(&format!("replay {out} --episodes 3 --mode both --out new/folders/page.html"));
    assert_eq!(replay["episodes"], 6);
    assert!(fs::read_to_string(place.path("new/folders/page.html")).unwrap().contains("<html"));

    // A weights file from elsewhere.
    let file = place
        .json(&format!("eval {out}/weights.safetensors --config {out}/config.toml --episodes 20 --episode-seeds 1,2"));
    assert_eq!(file["mean"], eval["mean"]);
}

#[test]
fn controllers_and_schedulers_without_weights_need_no_run() {
    let place = Place::new();
    let eval = |options: &str| place.json(&format!("eval tiny.toml --episodes 20 {options}"));
    for (controller, success) in [
        ("scripted", 0.95..=1.0),
        ("astar", 0.99..=1.0),
        ("orca", 0.95..=1.0),
        ("nearest", 0.5..=0.9),
        ("random", 0.0..=0.2),
    ] {
        let result = eval(&format!("--controller {controller} --scheduler greedy"));
        assert_eq!((&result["controller"], &result["scheduler"]), (&controller.into(), &"greedy".into()));
        assert!(result["weights_sha256"].is_null() && result["weights_final"] == false);
        let mean = &result["mean"]["greedy"];
        assert!(success.contains(&mean["success_rate"].as_f64().unwrap()), "{controller}: {mean}");
        assert!(mean["planning_ms"].as_f64().unwrap() > 0.0 && result["rows"][0]["planning_ms"].is_number());
        // Neither shards nor threads change a number that is not a time.
        let again = eval(&format!("--controller {controller} --scheduler greedy --threads 1 --record look.html"));
        for metric in ["success_rate", "arrival_step", "collisions_per_agent_step", "reward"] {
            assert_eq!(again["mean"]["greedy"][metric], mean[metric], "{controller}");
        }
    }
    let cost = |scheduler: &str| {
        let result = eval(&format!("--controller scripted --scheduler {scheduler}"));
        result["mean"]["greedy"]["cost_ratio"].as_f64().unwrap()
    };
    let [exact, greedy, random] = ["exact", "greedy", "random"].map(cost);
    assert!(exact == 1.0 && exact < greedy && greedy < random, "{exact} {greedy} {random}");
    place.json("replay tiny.toml --controller astar --scheduler greedy --episodes 1 --out page.html");
    assert!(fs::read_to_string(place.path("page.html")).unwrap().contains("astar controller"));

    // Training and its services hand out greedy goals, too.
    fs::write(place.path("greedy.toml"), format!("{TINY}\n[commander]\nkind = 'greedy'")).unwrap();
    let alone = place.json("train greedy.toml --in-process --out alone");
    assert!(alone["cost_ratio"].as_f64().unwrap() > 1.0);
    let services = place.json("train greedy.toml --out services --actors 1");
    assert_eq!(alone["weights_sha256"], services["weights_sha256"]);
    let learned = place.json("eval alone --episodes 2");
    assert!(learned["mean"]["greedy"].get("planning_ms").is_none() && learned["scheduler"] == "greedy");
}

#[test]
fn services_give_the_weights_of_one_process() {
    let place = Place::new();
    let alone = place.trained("alone");
    let services = place.json("train tiny.toml --out services --actors 2");
    assert_eq!(alone["weights_sha256"], services["weights_sha256"]);
    assert_eq!(services["in_process"], false);
    assert!(services["page"].as_str().unwrap().starts_with("http://127.0.0.1:"), "{services}");
    for log in ["learner", "commander", "actor-0", "actor-1"] {
        assert!(place.path("services/logs").join(format!("{log}.log")).exists(), "{log}");
    }
    assert!(place.path("services/replay.html").exists());
}

#[test]
fn an_interrupted_run_resumes_to_the_same_weights() {
    let place = Place::new();
    let whole = place.json("train tiny.toml --in-process --out whole --max-steps 7200 --target-success 2");
    for how in ["--in-process", "--actors 1"] {
        let out = format!("cut{}", how.len());
        let line = format!("train tiny.toml {how} --out {out} --max-steps 7200 --target-success 2 --json");
        let mut child = place.command(&line).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut stderr = BufReader::new(child.stderr.take().unwrap()).lines();
        while !stderr.next().unwrap().unwrap().contains("iteration=2") {}
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        let said: Vec<String> = stderr.map_while(Result::ok).collect();
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(75), "{how}: {said:?}");
        let stopped = last_line(&output);
        assert_eq!(stopped["stopped"], true);
        assert!(stopped["resume"].as_str().unwrap().contains(&format!("train --resume --out {out}")));
        assert!(!place.path(&out).join("summary.json").exists());
        let resumed = place.json(&format!("train --resume --out {out} {how}"));
        assert_eq!(resumed["weights_sha256"], whole["weights_sha256"], "{how}");
    }
}

#[test]
fn a_corrupt_checkpoint_is_named_and_the_one_before_it_is_used() {
    let place = Place::new();
    let whole = place.trained("run");
    let checkpoints = place.path("run/checkpoints");
    let mut names: Vec<_> = fs::read_dir(&checkpoints).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["000001", "000002", "000003"]);
    fs::remove_file(place.path("run/summary.json")).unwrap();
    fs::write(checkpoints.join("000003/weights.safetensors"), b"nonsense").unwrap();
    place.fails("eval run --episodes 1 --strict", 1, &["--strict", "the run is not finished"]);
    let output = place.run("eval run --episodes 1 --json");
    assert_eq!(last_line(&output)["weights_final"], false);
    let stderr = text(&output.stderr);
    assert!(stderr.contains("checkpoint 000003 is corrupt") && stderr.contains("using checkpoint 000002"), "{stderr}");
    let output = place.run("train --resume --out run --in-process --json");
    let stderr = text(&output.stderr);
    let words = "checkpoint 000003 is corrupt (weights.safetensors: its checksum differs from the manifest); continuing from 000002";
    assert!(stderr.contains(words), "{stderr}");
    assert_eq!(last_line(&output)["weights_sha256"], whole["weights_sha256"]);
    for name in ["000001", "000002", "000003"] {
        fs::remove_file(checkpoints.join(name).join("manifest.json")).unwrap();
    }
    place.fails("train --resume --out run", 1, &["none of the 3 checkpoints is usable"]);
}

#[test]
fn bad_input_is_refused_with_the_field_and_the_remedy() {
    let place = Place::new();
    fs::write(place.path("unknown.toml"), "[mappo]\ngama = 0.9").unwrap();
    fs::write(place.path("range.toml"), "[mappo]\ngamma = 1.5").unwrap();
    place.trained("run");
    fs::create_dir(place.path("full")).unwrap();
    fs::write(place.path("full/notes.txt"), "").unwrap();
    fs::write(place.path("token"), "secret").unwrap();
    fs::write(place.path("push.toml"), "[task]\nname = 'push-ball'\nagents = 5\nspawn = 'uniform'").unwrap();
    for (line, code, words) in [
        ("", 64, &["Usage"] as &[&str]),
        ("train --frobnicate", 64, &["--frobnicate"]),
        ("train nowhere.toml", 64, &["nowhere.toml"]),
        ("train unknown.toml", 64, &["unknown.toml", "gama", "gamma"]),
        ("train range.toml", 64, &["mappo.gamma", "0 to 1"]),
        ("train --agents 0", 64, &["--agents", "1 to 5000"]),
        ("train --spawn ring", 64, &["ring", "uniform"]),
        ("train --executor best", 64, &["best", "local"]),
        ("train --actors 0", 64, &["1 to 256"]),
        ("train --max-steps 0", 64, &["--max-steps", "1 to 1000000000000"]),
        ("train --http here", 64, &["--http here", "HOST:PORT", "off"]),
        ("train tiny.toml --out run", 73, &["run exists", "--resume"]),
        ("train tiny.toml --out full", 73, &["full exists", "another folder"]),
        ("train --resume", 64, &["--out"]),
        ("train --resume --out nowhere", 64, &["nowhere does not exist", "leave out --resume"]),
        ("train --resume --out full", 64, &["not a run folder"]),
        ("train --resume --out run --seed 9", 64, &["run.seed was 1 and is 9", "--from run"]),
        ("eval nowhere", 64, &["nowhere does not exist"]),
        ("eval full", 64, &["not a run folder"]),
        ("eval run --eval-set 2", 64, &["3 or more"]),
        ("eval run --seeds 1,2", 64, &["--seeds", "--episode-seeds"]),
        ("bench env --json", 64, &["cargo run --release -p magex-bench -- env --json"]),
        ("eval run --episodes 0", 64, &["--episodes"]),
        ("eval run --scheduler ranking", 64, &["use pairwise, exact, makespan, greedy or random"]),
        ("eval run --per-layout", 64, &["--spawn lines"]),
        ("eval run --controller fastest", 64, &["fastest", "astar", "orca"]),
        ("eval run --scheduler nearest", 64, &["nearest", "greedy"]),
        ("eval tiny.toml --scheduler exact", 64, &["tiny.toml", "not weights", "--controller learned", "orca"]),
        (
            "eval tiny.toml --controller astar",
            64,
            &["tiny.toml", "pairwise scheduler", "--scheduler exact, makespan, greedy"],
        ),
        ("eval tiny.toml --controller astar --scheduler exact --strict", 64, &["--strict", "no weights"]),
        ("eval range.toml --controller astar --scheduler exact", 64, &["range.toml", "mappo.gamma"]),
        ("eval none.toml --controller astar --scheduler exact", 64, &["none.toml does not exist"]),
        ("eval push.toml --controller astar --scheduler exact", 64, &["--controller", "push-ball", "use scripted"]),
        ("replay push.toml --controller orca --scheduler exact", 64, &["--controller", "push-ball", "use scripted"]),
        ("eval run/weights.safetensors", 64, &["--config"]),
        ("replay run --out full/notes.txt/page.html --episodes 1", 73, &["full/notes.txt is not a folder"]),
        ("eval run --record full --episodes 1", 73, &["full is a folder"]),
        ("verify nowhere", 64, &["nowhere"]),
        ("verify full", 1, &[]),
        ("assign --agents [[0,0]] --goals [[0]]", 64, &["goals"]),
        ("assign --agents [[0,0]] --goals [[0,1]] --connect localhost:1", 64, &["http://host:port"]),
        ("assign --agents [[0,0]] --goals [[0,1]] --connect http://127.0.0.1:1", 69, &["127.0.0.1:1"]),
        ("assign --random 2 --token-file token --connect http://10.1.2.3:1", 64, &["unencrypted", "--insecure"]),
        ("assign --random 2 --token-file none", 64, &["--token-file none", "no such file"]),
        ("assign --random 2 --connect https://127.0.0.1:1", 64, &["--tls-ca"]),
        ("actor --token-file token --learner http://10.1.2.3:1", 64, &["unencrypted", "--insecure"]),
        ("commander --token-file token --learner http://10.1.2.3:1", 64, &["unencrypted", "--insecure"]),
        ("learner --listen 0.0.0.0:0", 64, &["--tls-cert and --tls-key, and --identities", "--insecure"]),
        ("learner --tls-cert token", 64, &["--tls-key"]),
        ("learner --tls-cert token --tls-key token", 64, &["--tls-cert"]),
        ("learner --identities token", 64, &["token"]),
    ] {
        place.fails(line, code, words);
    }
    assert!(!place.path("runs").exists(), "nothing was started");
    let output = place.run("train range.toml --json");
    assert_eq!(last_line(&output)["exit_code"], 64);
}

#[test]
fn recordings_are_verified() {
    let place = Place::new();
    let report = place.json(&format!("verify {}", repository("crates/verify/testdata")));
    assert_eq!((&report["passed"], &report["failing"]), (&true.into(), &0.into()));
    fs::write(place.path("broken.json"), r#"{"format": "mpe-golden-1"}"#).unwrap();
    place.fails("verify broken.json", 1, &[]);
}

/// A commander of this executable.
struct Commander {
    child: std::process::Child,
    url: String,
}

impl Commander {
    fn start(place: &Place, arguments: &str) -> Self {
        let mut command = place.command(&format!("commander --listen 127.0.0.1:0 {arguments}"));
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let ready: Value = serde_json::from_str(&line).unwrap();
        Self { child, url: format!("http://{}", ready["address"].as_str().unwrap()) }
    }
}

impl Drop for Commander {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_commander_answers_the_command_line() {
    let place = Place::new();
    let commander = Commander::start(&place, "");
    let url = &commander.url;
    let answer =
        place.json(&format!("assign --connect {url} --agents [[0,0],[1,0]] --goals [[1,1],[0,1]] --scheduler exact"));
    assert_eq!(answer["pairs"][0]["goal"], 1);
    assert!((answer["cost"].as_f64().unwrap() - 2.0).abs() < 1e-9);
    fs::write(place.path("team.json"), r#"{"agents": [[0, 0], [3, 0]], "goals": [[1, 0]]}"#).unwrap();
    let answer = place.json(&format!("assign --connect {url} --agents team.json --scheduler greedy"));
    assert_eq!(answer["unassigned_agents"], serde_json::json!([1]));
    let table = place.run(&format!("assign --connect {url} --random 4 --scheduler exact"));
    assert!(text(&table.stdout).contains("answered by exact"));
    place.fails(&format!("assign --connect {url} --agents [[0,0]] --goals [[0,0,0]]"), 64, &["dimensions"]);

    let run = place.trained("run");
    let trained = Commander::start(&place, "--model run");
    let answer = place.json(&format!("assign --connect {} --random 12 --seed 1 --scheduler learned", trained.url));
    assert_eq!((&answer["scheduler"], &answer["weights_sha256"]), (&"learned".into(), &run["weights_sha256"]));
    assert!(answer["pairs"][3]["probability"].is_number());
    place.fails("commander --model nowhere", 64, &["nowhere"]);
}
