//! Variables of the environment, and standard error in the JSON format, as a shell or a collector of logs sees them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_tests::sandbox::binary;
use serde_json::Value;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Output, Stdio};

/// The program in an environment without variables of its own.
fn magex(line: &str, variables: &[(&str, &str)]) -> Command {
    let mut command = Command::new(binary());
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("MAGEX_")) {
        command.env_remove(name);
    }
    command.env_remove("RUST_LOG").envs(variables.iter().copied()).args(line.split_whitespace()).stdin(Stdio::null());
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn stdout(line: &str, variables: &[(&str, &str)]) -> String {
    let output = magex(line, variables).output().unwrap();
    assert!(output.status.success(), "{line} {variables:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Every line of standard error as an object; the last one has the exit code if there was an error.
fn objects(output: &Output) -> Vec<Value> {
    let stderr = text(&output.stderr);
    let parse = |line: &str| {
        let object: Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
        assert!(
            object["timestamp"].is_string() && object["level"].is_string() && object["message"].is_string(),
            "{line}"
        );
        object
    };
    stderr.lines().map(parse).collect()
}

#[test]
fn an_empty_variable_is_not_set() {
    let mut definition = magex::cli::definition();
    definition.build();
    for name in ["learner", "actor", "commander"] {
        let command = definition.find_subcommand(name).unwrap();
        let variables = command.get_arguments().filter_map(|argument| argument.get_env()?.to_str());
        let mut empty: Vec<(&str, &str)> = variables.map(|variable| (variable, "")).collect();
        assert!(empty.len() > 10, "{empty:?}");
        empty.extend(["RUST_LOG", "MAGEX_TOKEN", "OTEL_EXPORTER_OTLP_HEADERS"].map(|variable| (variable, "")));
        // A fixed name, because the name of an actor has the number of its process.
        let line = format!("{name} --print-config{}", if name == "actor" { " --name a" } else { "" });
        assert_eq!(stdout(&line, &empty), stdout(&line, &[]), "{name}");
    }
    // Outside of the command line's own variables: the certificates of a client, its token, the filter of the log.
    let output = magex("health https://127.0.0.1:9", &[("MAGEX_TLS_CA", "")]).output().unwrap();
    assert!(text(&output.stderr).contains("set MAGEX_TLS_CA"), "{}", text(&output.stderr));
    let variables = [("MAGEX_TOKEN", ""), ("MAGEX_COMMANDER", ""), ("MAGEX_INSECURE", ""), ("RUST_LOG", "")];
    let output = magex("assign --random 2", &variables).output().unwrap();
    assert!(text(&output.stderr).contains("http://127.0.0.1:7100"), "{}", text(&output.stderr));
}

#[test]
fn switches_take_the_usual_words_in_any_case() {
    for (word, on) in [("1", true), ("TRUE", true), ("yes", true), ("On", true), ("0", false), ("No", false)] {
        let config = stdout("actor --print-config", &[("MAGEX_ACTOR_STAY", word), ("MAGEX_INSECURE", word)]);
        for key in ["stay", "insecure"] {
            assert!(config.contains(&format!("{key} = {on}\n")), "{word}: {config}");
        }
    }
    // One of two that exclude each other may be off.
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("run").display().to_string();
    stdout("learner --print-config", &[("MAGEX_RESUME", "no"), ("MAGEX_RESUME_OR_CREATE", "yes"), ("MAGEX_OUT", &out)]);
}

#[test]
fn numbers_in_variables_are_written_as_in_options() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("run").display().to_string();
    let config = stdout("learner --print-config", &[("MAGEX_SEED", "1e3"), ("MAGEX_OUT", &out)]);
    assert!(config.contains("seed = 1000\n"), "{config}");
    let file = place.path().join("numbers.toml");
    std::fs::write(&file, "[run]\nmax_steps = 1e12\nseed = 5000.0\neval_episodes = 1_0\n[mappo]\ngamma = 1").unwrap();
    let config = stdout(&format!("train {} --print-config --json", file.display()), &[]);
    let config: Value = serde_json::from_str(config.lines().last().unwrap()).unwrap();
    let run = &config["run"];
    assert_eq!((&run["max_steps"], &run["seed"]), (&1_000_000_000_000_u64.into(), &5000.into()));
    // Single precision prints as it is written.
    assert_eq!(
        (run["target_success"].to_string(), config["mappo"]["gae_lambda"].to_string()),
        ("0.995".into(), "0.95".into())
    );
    let seed = "9223372036854775807";
    assert!(stdout(&format!("train --seed {seed} --print-config"), &[]).contains(&format!("seed = {seed}\n")));
}

const JSON: (&str, &str) = ("MAGEX_LOG_FORMAT", "Json");

#[test]
fn with_json_every_line_of_standard_error_is_an_object_and_the_fatal_one_has_the_code() {
    let folder = tempfile::tempdir().unwrap();
    for (line, code) in [
        ("commander --listen 127.0.0.1:0 --data /proc/nope", 73),
        ("learner --listen 127.0.0.1:0 --out /proc/nope", 73),
        ("learner --listen nowhere", 64),
        ("actor --learner nowhere", 64),
        ("actor --threads five", 64),
        ("", 64),
        ("trian", 64),
        ("train --out /proc/nope --in-process --http off", 73),
        ("train --frobnicate", 64),
        ("eval nowhere", 64),
        ("assign --random 2 --connect http://127.0.0.1:9", 69),
        ("health http://127.0.0.1:9", 69),
        ("bench env", 64),
    ] {
        let output = magex(line, &[JSON]).current_dir(folder.path()).output().unwrap();
        let objects = objects(&output);
        let last = objects.last().unwrap_or_else(|| panic!("{line}: nothing is said"));
        assert_eq!((output.status.code(), &last["level"]), (Some(code), &"ERROR".into()), "{line}: {last}");
        assert_eq!(last["exit_code"], code, "{line}: {last}");
    }
}

#[test]
fn a_training_that_is_interrupted_writes_objects_only() {
    let folder = tempfile::tempdir().unwrap();
    let config = "[run]\nmax_steps = 1e9\neval_episodes = 4\n[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'\n\
        [executor]\nkind = 'local'\n[collect]\nepisodes_per_iteration = 4\n[mappo]\nepochs = 1";
    std::fs::write(folder.path().join("long.toml"), config).unwrap();
    for how in ["--in-process", "--actors 1"] {
        let line = format!("train long.toml {how} --whole-budget --json --http off --out run{}", how.len());
        let mut command = magex(&line, &[JSON]);
        let mut child =
            command.current_dir(folder.path()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        let mut said = String::new();
        for line in lines.by_ref() {
            said += &format!("{line}\n");
            if line.contains("success_rate") {
                break;
            }
        }
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        said.extend(lines.map(|line| line + "\n"));
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(75), "{how}: {said}");
        let objects = objects(&Output { stderr: said.into_bytes(), ..output });
        let finishing = |object: &Value| object["message"].as_str().unwrap().contains("finishing the iteration");
        assert!(objects.iter().any(finishing), "{how}: {objects:?}");
    }
}
