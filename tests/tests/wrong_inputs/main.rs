//! Wrong inputs, by the hundred: every option of every command and every variable (from the command line's own definition),
//! every configuration key (from the configurations of all tasks), and rows by hand. A refusal has the documented exit code,
//! names what is wrong, comes at once, speaks no parser's language and leaves nothing behind.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod by_hand;

use magex_core::config::RunConfig;
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_tests::sandbox::{PATIENCE, binary};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use toml::{Table, Value};

/// What the parsers of Rust and its libraries say, which is not for people.
const PARSERS: [&str; 16] = [
    "invalid digit",
    "number too large",
    "number too small",
    "invalid float",
    "invalid type",
    "invalid value",
    "expected u64",
    "expected a sequence",
    "missing field",
    "unknown field",
    "unknown variant",
    "valid UTF-8",
    "value was too large",
    "..=",
    "panicked",
    "unwrap",
];

/// A command, the exit code, and what the message must name. `{f}` is the folder of the prepared files.
#[derive(Debug, Clone)]
struct Row {
    arguments: Vec<String>,
    variables: Vec<(String, String)>,
    code: i32,
    names: Vec<String>,
}

/// `line` is split at spaces; `''` is an empty argument.
fn row(line: &str, code: i32, names: &[&str]) -> Row {
    let argument = |word: &str| if word == "''" { String::new() } else { word.to_owned() };
    let names = names.iter().map(|&name| name.to_owned()).collect();
    Row { arguments: line.split_whitespace().map(argument).collect(), variables: Vec::new(), code, names }
}

fn with(variable: &str, value: &str, mut row: Row) -> Row {
    row.variables.push((variable.to_owned(), value.to_owned()));
    row
}

/// Arguments that let a wrong option of a command be the first thing that is wrong.
fn base(command: &str) -> &'static str {
    match command {
        "learner" => "learner --listen 127.0.0.1:0 --out new",
        "commander" => "commander --listen 127.0.0.1:0",
        "actor" => "actor --learner http://127.0.0.1:9",
        "train" => "train --in-process --http off --out new",
        "train-commander" => "train-commander --out new",
        "eval" => "eval {f}/run --episodes 1",
        "replay" => "replay {f}/run --episodes 1 --out new.html",
        "compare" => "compare {f}/run",
        "act" => "act {f}/run",
        "trace" => "trace {f}/run --out new.jsonl",
        "export" => "export {f}/run --format onnx --out new",
        "reproduce" => "reproduce --tables-only --out {f}/none",
        "assign" => "assign --random 2 --connect http://127.0.0.1:9",
        "health" => "health http://127.0.0.1:9",
        _ => "verify {f}/run",
    }
}

/// Options whose values are free texts.
const TEXTS: [&str; 2] = ["service", "name"];

/// Values that an option or variable of this kind cannot have.
fn wrong_values(argument: &str, kind: &str, choices: bool) -> &'static [&'static str] {
    match kind {
        _ if choices => &["nonsense", "-1"],
        "X" | "SECONDS" if argument != "timeout" => &["five", "90%", "-1", "1e300", "nan", "inf"],
        "S" | "S,…" => &["five", "-1", "0.5", "1e300", "99999999999999999999999", "0x10"],
        "S…" | "M" | "N" | "K" | "T" | "MIB" | "H" | "SET" | "SECONDS" => &["five", "-1", "0.5", "1e300", "5 5"],
        "MS" => &["five", "-1", "0.5", "1e300"],
        "HOST:PORT" => &["nowhere", "127.0.0.1", "127.0.0.1:99999", "http://127.0.0.1:1", ":"],
        "URL" => &["nowhere", "127.0.0.1:1", "ftp://127.0.0.1:1", "http://"],
        // An empty file is a configuration: every key has its default.
        "FILE" if argument == "config" => &["{f}/none", "{f}/folder", "{f}/noise"],
        "FILE" => &["{f}/none", "{f}/folder", "{f}/noise", "{f}/empty"],
        "KIND" | "MODE" => &["nonsense", "-1"],
        _ => &[],
    }
}

/// What belongs to an option that another one needs.
fn companion(command: &str, option: &str) -> &'static str {
    match (command, option) {
        ("learner" | "commander", "tls-cert") => " --tls-key {f}/key.pem",
        ("learner" | "commander", "tls-key") => " --tls-cert {f}/cert.pem",
        (_, "tls-cert") => " --tls-key {f}/key.pem --tls-ca {f}/cert.pem",
        (_, "tls-key") => " --tls-cert {f}/cert.pem --tls-ca {f}/cert.pem",
        (_, "client-ca") => " --tls-cert {f}/cert.pem --tls-key {f}/key.pem",
        ("commander", "config") => " --weights {f}/run",
        _ => "",
    }
}

/// Every option and every variable of every command.
fn options() -> Vec<Row> {
    let mut rows = Vec::new();
    let mut definition = magex::cli::definition();
    definition.build();
    for command in definition.get_subcommands().filter(|sub| !["help", "bench"].contains(&sub.get_name())) {
        let name = command.get_name();
        rows.push(row(&format!("{name} --no-such-option"), 64, &["--no-such-option", &format!("magex {name} --help")]));
        // It takes any number of runs.
        let too_many = if name == "compare" { "does not exist" } else { "one argument too many" };
        rows.push(row(&format!("{} too many arguments", base(name)), 64, &[too_many]));
        for argument in command.get_arguments().filter(|argument| !argument.is_hide_set()) {
            let Some(long) = argument.get_long().filter(|long| !["help", "version", "verbose"].contains(long)) else {
                continue;
            };
            let option = format!("--{long}");
            if !argument.get_action().takes_values() {
                rows.push(row(&format!("{name} {option}=five"), 64, &[&option]));
                if let Some(variable) = argument.get_env().and_then(|name| name.to_str()) {
                    rows.push(with(variable, "maybe", row(name, 64, &[variable, "'maybe'", "true or false"])));
                }
                continue;
            }
            rows.push(row(&format!("{name} {option}"), 64, &[&option]));
            let kind = argument.get_value_names().and_then(|names| names.first()).map_or("", |name| name.as_str());
            if !TEXTS.contains(&long) && kind != "FILE|JSON" {
                rows.push(row(&format!("{} {option} ''", without(base(name), &option)), 64, &[&option]));
            }
            let choices = !argument.get_possible_values().is_empty();
            // Only a weights file takes a configuration.
            let base = if long == "config" {
                base(name).replace("{f}/run", "{f}/noise")
            } else {
                without(base(name), &option)
            };
            for value in wrong_values(long, kind, choices) {
                let mut wrong = row(&format!("{base}{}", companion(name, long)), 64, &[&option]);
                wrong.arguments.extend([option.clone(), (*value).to_owned()]);
                if kind == "FILE" {
                    wrong.names.push((*value).to_owned());
                }
                rows.push(wrong);
                let Some(variable) = argument.get_env().and_then(|name| name.to_str()) else { continue };
                rows.push(with(variable, value, row(&format!("{base}{}", companion(name, long)), 64, &[variable])));
            }
        }
    }
    rows
}

/// A command line without an option and its value, so that the option can be given once.
fn without(line: &str, option: &str) -> String {
    let mut words: Vec<&str> = line.split(' ').collect();
    if let Some(at) = words.iter().position(|word| *word == option) {
        words.drain(at..at + 2);
    }
    words.join(" ")
}

/// Every configuration key of every task, with values of other types and out of range.
fn keys(folder: &Path) -> Vec<Row> {
    let mut rows = Vec::new();
    for name in TaskName::SIMULATED {
        let config = RunConfig { task: TaskConfig::of(name, 5, Spawn::Uniform), ..RunConfig::default() };
        let table: Table = config.to_toml().unwrap().parse().unwrap();
        let mut own = Vec::new();
        leaves("", &table, &mut own);
        // The keys that all tasks share are tried once.
        let first = name == TaskName::SIMULATED[0];
        for (key, value) in own.iter().filter(|(key, _)| first || key.matches('.').count() > 1) {
            let largest = Value::Integer(i64::MAX);
            let wrong = wrong_for(value).into_iter().filter(|wrong| key != "run.seed" || *wrong != largest);
            for (k, wrong) in wrong.enumerate() {
                let mut table = table.clone();
                set(&mut table, key, wrong);
                let file = folder.join(format!("{name}-{key}-{k}.toml"));
                std::fs::write(&file, table.to_string()).unwrap();
                rows.push(row(&format!("train {} --print-config", file.display()), 64, &[key]));
            }
            let mut table = table.clone();
            let (section, last) = key.rsplit_once('.').unwrap();
            set(&mut table, &format!("{section}.no_{last}"), Value::Integer(1));
            let file = folder.join(format!("{name}-{key}-unknown.toml"));
            std::fs::write(&file, table.to_string()).unwrap();
            rows.push(row(
                &format!("train {} --print-config", file.display()),
                64,
                &[&format!("{section}.no_{last}"), "use"],
            ));
        }
    }
    rows
}

fn leaves(path: &str, table: &Table, found: &mut Vec<(String, Value)>) {
    for (key, value) in table {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        match value {
            Value::Table(table) => leaves(&path, table, found),
            value => found.push((path, value.clone())),
        }
    }
}

fn set(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        Some((first, rest)) => set(table[first].as_table_mut().unwrap(), rest, value),
        None => {
            table.insert(key.to_owned(), value);
        }
    }
}

fn wrong_for(value: &Value) -> Vec<Value> {
    let text = || Value::String("five".to_owned());
    let list = || Value::Array(vec![Value::Integer(1)]);
    match value {
        Value::Integer(_) => {
            vec![text(), list(), Value::Boolean(true), (-1).into(), 1.5.into(), 1e300.into(), i64::MAX.into()]
        }
        Value::Float(_) => vec![text(), list(), Value::Boolean(true), (-1).into(), f64::NAN.into(), 1e300.into()],
        Value::Boolean(_) => vec![text(), list(), 1.into(), 0.5.into()],
        _ => vec![text(), list(), 1.into(), Value::Boolean(true)],
    }
}

/// What is wrong with what a row says, if something is.
fn trial(row: &Row, files: &str, place: &Path) -> Option<String> {
    let filled = |text: &String| text.replace("{f}", files);
    let (home, log) = (place.join("home"), place.join("log"));
    std::fs::create_dir_all(&home).unwrap();
    let stderr = std::fs::File::create(&log).unwrap();
    let output = std::fs::File::create(place.join("out")).unwrap();
    let mut command = Command::new(binary());
    command.args(row.arguments.iter().map(filled)).current_dir(&home);
    for (variable, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("MAGEX_")) {
        command.env_remove(variable);
    }
    command.env_remove("RUST_LOG").envs(row.variables.iter().map(|(name, value)| (name, filled(value))));
    let mut child = command.stdin(Stdio::null()).stdout(output).stderr(stderr).spawn().unwrap();
    let start = Instant::now();
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break Some(status),
            None if start.elapsed() > PATIENCE / 4 => {
                child.kill().unwrap();
                child.wait().unwrap();
                break None;
            }
            None => std::thread::sleep(Duration::from_millis(3)),
        }
    };
    let said = std::fs::read_to_string(&log).unwrap_or_default();
    let left: Vec<_> = std::fs::read_dir(&home).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    let problem = match status {
        None => "does not end".to_owned(),
        Some(status) if status.code() != Some(row.code) => format!("{status}, not {}", row.code),
        _ => match row.names.iter().map(filled).find(|name| !said.contains(name.as_str())) {
            Some(name) => format!("does not name {name}"),
            None => match PARSERS.iter().find(|words| said.contains(**words)) {
                Some(words) => format!("says '{words}'"),
                None if !left.is_empty() => format!("leaves {left:?}"),
                None => return None,
            },
        },
    };
    Some(format!("{} {:?}: {problem}:\n    {}", row.arguments.join(" "), row.variables, said.trim()))
}

#[test]
fn wrong_inputs_are_refused_with_the_code_and_the_name() {
    let place = tempfile::tempdir().unwrap();
    let files = place.path().join("files");
    std::fs::create_dir(&files).unwrap();
    by_hand::prepare(&files);
    let rows: Vec<Row> = [options(), keys(&files), by_hand::rows()].concat();
    assert!(rows.len() > 600, "{}", rows.len());
    let (next, problems) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                while let Some((k, row)) =
                    Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|k| Some((k, rows.get(k)?)))
                {
                    let home = place.path().join(k.to_string());
                    std::fs::create_dir(&home).unwrap();
                    if let Some(problem) = trial(row, files.to_str().unwrap(), &home) {
                        problems.lock().unwrap().push(problem);
                    }
                }
            });
        }
    });
    let problems = problems.into_inner().unwrap();
    assert!(problems.is_empty(), "{} of {}:\n{}", problems.len(), rows.len(), problems.join("\n"));
}
