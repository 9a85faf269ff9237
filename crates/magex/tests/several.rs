//! Several runs: settings of keys, seeds, comparison, and the paper's tables.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use serde_json::Value;
use std::fs;
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

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
/// Longer than anything takes that is going to happen at all.
const PATIENCE: Duration = Duration::from_secs(120);

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

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
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

    /// What a command that succeeds prints.
    fn says(&self, line: &str) -> String {
        let output = self.run(line);
        assert!(output.status.success(), "{line}: {}", text(&output.stderr));
        text(&output.stdout)
    }

    /// The JSON object on the last line of a command that succeeds.
    fn json(&self, line: &str) -> Value {
        serde_json::from_str(self.says(&format!("{line} --json")).lines().last().unwrap()).unwrap()
    }

    /// A command that fails with this code and these words on standard error.
    fn fails(&self, line: &str, code: i32, words: &[&str]) {
        let output = self.run(line);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{line}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{line}: '{word}' is missing in: {stderr}");
        }
    }

    /// Starts a command, and kills it as soon as this file exists.
    fn killed_at(&self, line: &str, file: &str) {
        let mut child = self.command(line).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        self.wait_for(file, &mut child);
        child.kill().unwrap();
        child.wait().unwrap();
    }

    fn wait_for(&self, file: &str, child: &mut Child) {
        let start = Instant::now();
        while !self.path(file).exists() {
            assert!(start.elapsed() < PATIENCE, "{file} does not appear");
            assert_eq!(child.try_wait().unwrap(), None, "it ended before {file} was there");
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn narrow(text: &str) {
    for line in text.lines() {
        assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
    }
}

#[test]
fn a_setting_wins_over_the_file_and_an_option_over_the_setting() {
    let place = Place::new();
    let config = |more: &str| place.json(&format!("train tiny.toml --print-config {more}"));
    assert_eq!(config("")["run"]["max_steps"], 720);
    let set = "--set run.max_steps=1e4 --set mappo.gamma=0.5 --set executor.kind=mlp --set run.seed=4";
    let changed = config(set);
    assert_eq!((&changed["run"]["max_steps"], &changed["mappo"]["gamma"]), (&10_000.into(), &0.5.into()));
    assert_eq!((&changed["executor"]["kind"], &changed["run"]["seed"]), (&"mlp".into(), &4.into()));
    assert_eq!(config(&format!("{set} --max-steps 99 --seed 7"))["run"]["max_steps"], 99);
    assert_eq!(config(&format!("{set} --seed 7"))["run"]["seed"], 7);
    // Without a file it changes the first run, and what follows the team size follows it.
    let without = place.json("train --print-config --set task.agents=20 --set mappo.epochs=1");
    let option = place.json("train --print-config --agents 20");
    assert_eq!(without["task"], option["task"]);
    assert_eq!((&without["collect"], &without["mappo"]["epochs"]), (&option["collect"], &1.into()));
    // A run that continues keeps what it was set to.
    let first = place.json("train tiny.toml --in-process --http off --out run --set mappo.gamma=0.5");
    assert!(place.read("run/config.toml").contains("gamma = 0.5"));
    let more = place.json("train --resume --out run --in-process --http off --set run.max_steps=960");
    assert!(more["joint_env_steps"].as_u64() > first["joint_env_steps"].as_u64());
    place.fails("train --resume --out run --in-process --http off --set mappo.gamma=0.6", 64, &["mappo.gamma"]);
    place.fails("train --set mappo.gama=1 --out x", 64, &["--set", "mappo.gama", "unknown key", "gamma"]);
    // What is wrong with the settings is told, though the file alone would be wrong, too.
    fs::write(place.path("half.toml"), "[executor]\nkind = 'flat'\n[mappo]\nepochs = 2").unwrap();
    place.fails("train half.toml --out x", 64, &["half.toml", "task.reward_target"]);
    let set = "--set task.reward_target=team --set executor.recurrent=true --set run.algorithm=qmix";
    place.fails(
        &format!("train half.toml --out x {set}"),
        64,
        &["--set", "mappo.epochs", "belongs to the algorithm mappo"],
    );
    place.fails("train half.toml --out x --set mappo.gamma=0.5", 64, &["half.toml", "task.reward_target"]);
    assert!(!place.path("x").exists());
}

#[test]
fn seeds_train_one_after_the_other_and_go_on_after_a_kill() {
    let place = Place::new();
    let line = "train tiny.toml --in-process --http off --set run.max_steps=4800 --seeds 3,1 --out group";
    place.killed_at(line, "group/seed-1/checkpoints/000002/manifest.json");
    assert!(place.path("group/seed-3/summary.json").exists(), "the first seed is complete");
    assert!(!place.path("group/seed-1/summary.json").exists(), "the second one is not");
    place.fails(line, 73, &["--out group/seed-3", "--resume"]);
    place.fails("train --resume --out group", 64, &["not a run folder", "group/seed-1"]);
    let group = place.json(&format!("{line} --resume"));
    for (run, seed) in group["runs"].as_array().unwrap().iter().zip([3, 1]) {
        let line = format!("train tiny.toml --in-process --http off --set run.max_steps=4800 --seed {seed}");
        let alone = place.json(&format!("{line} --out alone-{seed}"));
        assert_eq!(run["weights_sha256"], alone["weights_sha256"], "seed {seed}");
    }
    // Complete runs are not trained again.
    let said = place.says(&format!("{line} --resume"));
    narrow(&said);
    assert!(said.contains("2 runs") && said.contains("mean") && said.contains("compare group"), "{said}");
    place.fails("train --seeds 1,2 --seed 3", 64, &["--seeds", "--seed"]);
    place.fails("train --seeds 2,2", 64, &["--seeds", "2 is named twice"]);
    // Nothing is trained if a folder is in the way.
    fs::create_dir_all(place.path("other/seed-2")).unwrap();
    fs::write(place.path("other/seed-2/thesis.tex"), "").unwrap();
    place.fails("train tiny.toml --http off --seeds 1,2 --out other", 73, &["other/seed-2", "not a run folder"]);
    assert!(!place.path("other/seed-1").exists());
}

#[test]
fn runs_are_compared_by_settings_success_and_curves() {
    let place = Place::new();
    let train = |more: &str| place.json(&format!("train tiny.toml --in-process --http off {more}"));
    train("--seeds 1,2,3 --out three");
    train("--set mappo.gamma=0.5 --set executor.kind=mlp --out mlp");
    place.killed_at(
        "train tiny.toml --in-process --http off --set run.max_steps=1e6 --out cut",
        "cut/checkpoints/000002/manifest.json",
    );
    let said = place.says("compare three mlp cut --csv all.csv --svg all.svg");
    narrow(&said);
    for words in
        ["A  three, seeds 1, 2, 3", "B  mlp, seed 1", "seed 1 is unfinished", "of 1,000,000 steps", "95 % interval"]
    {
        assert!(said.contains(words), "'{words}' is missing in:\n{said}");
    }
    let row = |key: &str| said.lines().find(|line| line.trim().starts_with(key)).unwrap().to_owned();
    assert_eq!(row("mappo.gamma").split_whitespace().collect::<Vec<_>>(), ["mappo.gamma", "0.99", "0.5", "0.99"]);
    assert!(row("executor.kind").contains("mlp") && said.matches("unfinished").count() == 2, "{said}");
    assert!(!said.contains("run.seed") && !said.contains("mappo.epochs"), "what is equal is left out:\n{said}");
    let csv = place.read("all.csv");
    assert_eq!((csv.lines().count(), csv.matches(",false,").count()), (6, 1), "{csv}");
    assert!(csv.lines().next().unwrap().ends_with("executor.kind,mappo.gamma,run.max_steps"), "{csv}");
    let svg = place.read("all.svg");
    assert!(svg.contains("three") && svg.contains("<polygon") && !svg.contains("NaN"));

    let value = place.json("compare three --target 0");
    let system = &value["systems"][0];
    let scores: Vec<f64> =
        system["runs"].as_array().unwrap().iter().map(|run| run["success_rate"].as_f64().unwrap()).collect();
    let mean = scores.iter().sum::<f64>() / 3.0;
    assert!((system["iqm"].as_f64().unwrap() - mean).abs() < 1e-12, "below four numbers it is the mean");
    assert_eq!(system["steps_to_target"], 0.0);
    assert!(system["interval"][0].as_f64() <= system["iqm"].as_f64());
    assert!(place.json("compare mlp")["systems"][0]["interval"].is_null(), "one seed has no interval");

    train("--set task.name=push-ball --out ball");
    place.fails("compare three ball", 64, &["ball is of push-ball", "three of simple-spread"]);
    place.fails("compare three none", 64, &["none", "does not exist"]);
    place.fails("compare .", 64, &["not a run folder"]);
    place.fails("compare three three/", 64, &["named twice"]);
    fs::rename(place.path("mlp"), place.path("three/seed-9")).unwrap();
    place.fails("compare three", 64, &["three/seed-9", "executor.kind"]);
}

/// A record without what depends on the clock.
fn record(place: &Place, name: &str) -> Value {
    let mut value: Value = serde_json::from_str(&place.read(name)).unwrap();
    (value["wall_s"], value["planning_ms"]) = (Value::Null, Value::Null);
    value
}

const REPRODUCE: &str = "reproduce --budget smoke --table push-ball,planner --systems mage-x,scripted,astar --max-steps 24000 --episodes 4 --threads 1";

#[test]
fn tables_are_reproduced_interrupted_and_made_again_without_training() {
    let place = Place::new();
    let line = format!("{REPRODUCE} --out cut");
    place.killed_at(&line, "cut/runs/push-ball/mage-x-5/seed-1/checkpoints/000005/manifest.json");
    assert!(!place.path("cut/results").exists() && !place.path("cut/tables.md").exists());
    let said = place.says(&line);
    narrow(&said);
    place.says(&format!("{REPRODUCE} --out whole"));
    for name in ["push-ball/mage-x-5-seed-1.json", "planner/mage-x-5-seed-1.json", "planner/astar-5-seed-1.json"] {
        let (own, other) =
            (record(&place, &format!("cut/results/{name}")), record(&place, &format!("whole/results/{name}")));
        assert_eq!(own, other, "{name}: an interruption changes nothing");
        assert_eq!(own["greedy"]["success_rate"].as_array().unwrap().len(), 4);
    }
    let ball = record(&place, "cut/results/push-ball/mage-x-5-seed-1.json");
    assert_eq!((&ball["joint_env_steps"], &ball["ended_by"]), (&22_400.into(), &"steps".into()));
    assert_eq!(ball["curve"].as_array().unwrap().len(), 3, "before iterations 0 and 6, and at the end");
    let summary: Value = serde_json::from_str(&place.read("cut/runs/push-ball/mage-x-5/seed-1/summary.json")).unwrap();
    assert_eq!(ball["weights_sha256"], summary["weights_sha256"], "what the run ended with is what was evaluated");

    let files = ["tables.md", "tables.csv", "runs.json", "push-ball.svg", "planner.svg"];
    let before: Vec<String> = files.iter().map(|file| place.read(&format!("cut/{file}"))).collect();
    assert!(before[0].contains("| MAGE-X | 5 |") && before[0].contains("| 1.00 (0.01) |"), "{}", before[0]);
    assert!(before[0].contains("## Planners") && before[0].contains("Performance profile"));
    fs::remove_dir_all(place.path("cut/runs")).unwrap();
    for (again, file) in [(line.clone(), files[0]), (format!("{line} --tables-only"), files[2])] {
        fs::remove_file(place.path("cut").join(file)).unwrap();
        place.says(&again);
        let after: Vec<String> = files.iter().map(|file| place.read(&format!("cut/{file}"))).collect();
        assert!(before == after && !place.path("cut/runs").exists(), "the same files, and nothing trained");
    }

    // Another configuration is refused, for results and for run folders.
    let other = line.replace("24000", "9600");
    place.fails(
        &other,
        64,
        &["cut/results/push-ball/mage-x-5-seed-1.json", "run.max_steps is 24000, not 9600", "--out"],
    );
    fs::remove_dir_all(place.path("whole/results")).unwrap();
    place.fails(
        &other.replace("cut", "whole"),
        64,
        &["whole/runs/push-ball/mage-x-5/seed-1", "run.max_steps is 24000, not 9600"],
    );
    place.says(&format!("{other} --tables-only"));
    place.fails("reproduce --table drones --agents 50", 64, &["--systems, --agents", "leave one out"]);
    place.fails("reproduce --agents 7", 64, &["--agents", "'7' is unknown; use 2, 4, 5, 20, 50"]);
    fs::write(place.path("cut/results/push-ball/mage-x-5-seed-1.json"), "{}").unwrap();
    place.fails(&line, 1, &["cut/results/push-ball/mage-x-5-seed-1.json", "remove it"]);
}

#[test]
fn runs_have_the_layout_of_marl_eval() {
    let place = Place::new();
    place.says("reproduce --budget smoke --table drones,planner --systems mage-x,scripted,astar --agents 2,4,5 --max-steps 240 --episodes 3 --seeds 1,2 --out out");
    let runs: Value = serde_json::from_str(&place.read("out/runs.json")).unwrap();
    let object = |value: &Value| value.as_object().unwrap().clone();
    assert_eq!(object(&runs).keys().collect::<Vec<_>>(), ["drones", "planner"]);
    assert_eq!(object(&runs["drones"]).keys().collect::<Vec<_>>(), ["n_2", "n_4"]);
    assert_eq!(object(&runs["planner"]["n_5"]).keys().collect::<Vec<_>>(), ["astar", "mage_x", "scripted"]);
    for (environment, task, metrics) in [("drones", "n_4", 2), ("planner", "n_5", 1)] {
        let mut counts = Vec::new();
        for (name, algorithm) in object(&runs[environment][task]) {
            assert_eq!(object(&algorithm).keys().collect::<Vec<_>>(), ["seed_1", "seed_2"], "{name}");
            for run in object(&algorithm).values() {
                assert_eq!(run["absolute_metrics"]["success_rate"].as_array().unwrap().len(), 3);
                assert!(run["absolute_metrics"]["step_count"].is_null());
                assert_eq!(object(run).len(), 21, "twenty steps and the absolute metrics");
                let steps: Vec<u64> =
                    (0..20).map(|k| run[format!("step_{k}")]["step_count"].as_u64().unwrap()).collect();
                assert!(steps[0] > 0 && steps.windows(2).all(|pair| pair[0] < pair[1]));
                counts.push(steps);
                for k in 0..20 {
                    assert_eq!(object(&run[format!("step_{k}")]).len(), 1 + metrics);
                }
            }
        }
        counts.dedup();
        assert_eq!(counts.len(), 1, "every run has the same steps");
    }
    // Two seeds have an interval, and drones have collisions beside the paper's.
    let tables = place.read("out/tables.md");
    assert!(tables.contains("| paper, collisions |") && tables.contains("| 0.12 (0.01) |"), "{tables}");
    let csv = place.read("out/tables.csv");
    let row = csv.lines().find(|row| row.starts_with("drones,MAGE-X,4,1 2,6,")).unwrap_or_else(|| panic!("{csv}"));
    assert!(row.contains(",0.79,0.07,0.12,0.01,"), "{row}");
}

#[test]
fn wall_time_ends_a_training_and_is_told() {
    let place = Place::new();
    let line = "reproduce --budget smoke --table spread --max-steps 1e9 --episodes 2 --max-minutes 0.02 --out out";
    let value = place.json(line);
    let cell = &value["cells"][0];
    assert_eq!(cell["ended_by"], "time");
    assert!((1..1_000_000_000).contains(&(cell["joint_env_steps"].as_f64().unwrap() as u64)), "{value}");
    assert!(place.read("out/tables.md").contains("| time |"));
    // The same command trains nothing; one with more time goes on from the folder of the run.
    let systems = "--systems mage-x,random";
    let steps = |line: &str| place.json(&format!("{line} {systems}"))["cells"][0]["joint_env_steps"].as_f64().unwrap();
    let first = steps(line);
    let before = place.read("out/runs/spread/mage-x-5/seed-1/metrics.jsonl");
    assert_eq!(steps(line), first);
    let more = line.replace("0.02", "0.1");
    assert!(steps(&format!("{more} --tables-only")) == first && steps(&more) > first);
    assert!(place.read("out/runs/spread/mage-x-5/seed-1/metrics.jsonl").starts_with(&before));
}

#[test]
fn ctrl_c_stops_a_reproduction_and_the_same_command_continues() {
    let place = Place::new();
    let line = "reproduce --budget smoke --table spread --systems mage-x,mappo --max-steps 1e9 --episodes 2 --max-minutes 0.1 --out out";
    let mut child = place.command(line).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    place.wait_for("out/runs/spread/mage-x-5/seed-1/metrics.jsonl", &mut child);
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(75));
    assert!(text(&output.stdout).contains(line), "{}", text(&output.stdout));
    assert!(!place.path("out/tables.md").exists());
    assert_eq!(place.json(line)["missing"], 0);
}
