//! Wrong inputs, by the hundred: every option of every command and every variable (from the command line's own definition),
//! every configuration key (from the configurations of all tasks), and rows by hand. A refusal has the documented exit code,
//! names what is wrong, comes at once, speaks no parser's language and leaves nothing behind.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

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
    for name in TaskName::ALL {
        let config = RunConfig { task: TaskConfig::of(name, 5, Spawn::Uniform), ..RunConfig::default() };
        let table: Table = config.to_toml().unwrap().parse().unwrap();
        let mut own = Vec::new();
        leaves("", &table, &mut own);
        // The keys that all tasks share are tried once.
        let first = name == TaskName::ALL[0];
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

/// Rows that no table knows.
fn by_hand() -> Vec<Row> {
    let mut rows: Vec<Row> = [
        ("trian", 64, &["trian", "is train meant"] as &[&str]),
        ("train {f}/none.toml", 64, &["{f}/none.toml", "no such file"]),
        ("train {f}/folder", 64, &["{f}/folder", "is a folder"]),
        ("train {f}/noise", 64, &["{f}/noise", "not a text file"]),
        ("train {f}/noise/below", 64, &["{f}/noise/below", "is a file"]),
        ("train {f}/ring.toml", 64, &["task.spawn", "'ring'", "use uniform"]),
        ("train {f}/agents-only.toml", 64, &["task.name", "simple-spread"]),
        ("train {f}/open-table.toml", 64, &["open-table.toml", "line 2"]),
        ("train {f}/no-section.toml", 64, &["run", "[section]"]),
        ("train {f}/twice.toml", 64, &["twice.toml", "line 3"]),
        ("train {f}/huge.toml", 64, &["huge.toml", "line 2", "9223372036854775807"]),
        ("train {f}/beyond.toml", 64, &["beyond.toml", "line 2", "9223372036854775807"]),
        ("train {f}/renamed.toml", 64, &["mappo.clip", "mappo.clip_epsilon"]),
        ("train {f}/other-section.toml", 64, &["task.drones", "push-ball"]),
        ("train {f}/strange.toml", 64, &["strange", "use run"]),
        ("train {f}/shards.toml", 64, &["collect.shards_per_iteration", "divide"]),
        ("train {f}/chunk.toml", 64, &["mappo.chunk_length", "divide"]),
        ("train --seed 9223372036854775808", 64, &["--seed", "0 to 9223372036854775807"]),
        ("train --max-steps 99999999999999999999", 64, &["--max-steps", "1 to 1000000000000"]),
        ("train --set run.seed", 64, &["--set", "KEY=VALUE"]),
        ("train --set run.sed=1 --print-config", 64, &["--set", "run.sed", "use algorithm, seed"]),
        ("train --set run.seed=five --print-config", 64, &["--set", "run.seed", "a whole number"]),
        ("train {f}/ring.toml --set run.seed=1", 64, &["ring.toml", "task.spawn"]),
        ("train --seeds 1,2 --seed 3", 64, &["--seeds", "--seed", "leave one out"]),
        ("train --seeds 1,2,1", 64, &["--seeds", "1 is named twice"]),
        ("train --seeds 1 --resume --out {f}/none", 64, &["{f}/none", "does not exist"]),
        ("train --name ../up", 64, &["--name", "../up"]),
        ("train --name ''", 64, &["--name"]),
        ("train --name a --out b", 64, &["--name", "--out"]),
        ("train --whole-budget --target-success 1", 64, &["--whole-budget", "--target-success"]),
        ("train --resume", 64, &["--resume", "--out"]),
        ("train --resume --name none", 64, &["runs/none", "does not exist"]),
        ("train --resume --out {f}/folder", 64, &["{f}/folder", "config.toml"]),
        ("train --out {f}/run --in-process", 73, &["--out {f}/run", "--resume"]),
        ("train --out {f}/noise --in-process", 73, &["--out {f}/noise"]),
        ("train --out {f}/noise/below --in-process", 73, &["--out {f}/noise/below"]),
        ("train --out /proc/new --in-process", 73, &["--out /proc/new"]),
        ("train --http off --actors 1000", 64, &["--actors", "1 to 256"]),
        ("train --http nowhere", 64, &["--http nowhere"]),
        ("train-commander --imitation 0 --ppo 0", 64, &["--imitation", "--ppo"]),
        ("train-commander {f}/ranking.toml", 64, &["commander.kind"]),
        ("train-commander --out {f}/run", 73, &["--out {f}/run"]),
        ("train-commander --out /proc/new", 73, &["--out /proc/new"]),
        ("eval", 64, &["<RUN>"]),
        ("eval {f}/none", 64, &["{f}/none", "does not exist"]),
        ("eval {f}/noise", 64, &["{f}/noise", "--config"]),
        ("eval {f}/folder", 64, &["{f}/folder", "not a run folder"]),
        ("eval {f}/noise --config {f}/run/config.toml", 1, &["{f}/noise"]),
        ("eval {f}/empty --config {f}/run/config.toml", 1, &["{f}/empty"]),
        ("eval {f}/run --config {f}/run/config.toml", 64, &["--config"]),
        ("eval {f}/run --eval-set 2", 64, &["--eval-set", "3 or more"]),
        ("eval {f}/run --horizon 0", 64, &["--horizon", "1 to 100000"]),
        ("eval {f}/run --agents 5001", 64, &["--agents", "1 to 5000"]),
        ("eval {f}/run --per-layout", 64, &["--per-layout", "--spawn lines"]),
        ("eval {f}/run --scheduler ranking", 64, &["--scheduler ranking"]),
        ("eval {f}/run --seeds 1", 64, &["--seeds", "--episode-seeds"]),
        ("eval {f}/run --episodes 1 --record {f}/folder", 73, &["{f}/folder"]),
        ("eval {f}/run --episodes 1 --record {f}/noise/x.html", 73, &["{f}/noise"]),
        ("eval {f}/broken --episodes 1", 1, &["none of the", "weights.safetensors"]),
        ("eval {f}/headless --episodes 1", 64, &["config.toml"]),
        ("replay {f}/run --episodes 101", 64, &["--episodes", "1 to 100"]),
        ("replay {f}/run --episodes 1 --out /proc/new.html", 73, &["/proc/new.html"]),
        ("replay {f}/run --episodes 1 --out {f}/noise/below/x.html", 73, &["{f}/noise/below"]),
        ("compare", 64, &["<RUN>"]),
        ("compare {f}/none", 64, &["{f}/none", "does not exist"]),
        ("compare {f}/noise", 64, &["{f}/noise"]),
        ("compare {f}/folder", 64, &["{f}/folder", "not a run folder"]),
        ("compare {f}/run {f}/run", 64, &["{f}/run", "named twice"]),
        ("compare {f}/run --svg {f}/folder", 73, &["{f}/folder"]),
        ("compare {f}/run --csv /proc/new.csv", 73, &["/proc/new.csv"]),
        ("reproduce --table none", 64, &["--table", "spread"]),
        ("reproduce --systems none", 64, &["--systems", "mage-x"]),
        ("reproduce --seeds 1,1", 64, &["--seeds", "1 is named twice"]),
        ("reproduce --max-minutes 0", 64, &["--max-minutes", "0.001"]),
        ("reproduce --tables-only --out {f}/none", 64, &["{f}/none", "does not exist"]),
        ("reproduce --tables-only --out {f}/folder", 64, &["{f}/folder", "no results"]),
        ("reproduce --out {f}/noise", 73, &["{f}/noise"]),
        ("reproduce --out /proc/new", 73, &["/proc/new"]),
        ("assign", 64, &["--agents"]),
        ("assign --agents five", 64, &["--agents five", "no such file"]),
        ("assign --agents ''", 64, &["--agents"]),
        ("assign --agents {f}/folder", 64, &["--agents {f}/folder", "is a folder"]),
        ("assign --agents {f}/noise", 64, &["--agents {f}/noise", "not a text file"]),
        ("assign --agents {f}/empty", 64, &["--agents", "JSON"]),
        ("assign --agents -", 64, &["--agents", "JSON"]),
        ("assign --agents [[0,0]]", 64, &["--agents", "goals"]),
        ("assign --agents [[0,0] --goals [[0,1]]", 64, &["--agents", "line 1, column"]),
        ("assign --agents [[0,0]] --goals [[0,1],5]", 64, &["--goals[1]", "5"]),
        ("assign --agents [[0,0]] --goals [[0,\"a\"]]", 64, &["--goals[0][1]", "\"a\""]),
        ("assign --agents [[0,1e39]] --goals [[0,1]]", 64, &["--agents[0][1]", "1e+39"]),
        ("assign --agents [[0,null]] --goals [[0,1]]", 64, &["--agents[0][1]", "null"]),
        ("assign --agents [[0]] --goals [[0,1]]", 64, &["agents", "2 or 3"]),
        ("assign --agents [[0,0],[1,1,1]] --goals [[0,1]]", 64, &["agents[1]"]),
        ("assign --agents {\"agents\":5} --goals [[0,1]]", 64, &["--agents"]),
        ("assign --agents {\"agents\":[[0,0]]}", 64, &["goals", "missing"]),
        ("assign --agents {\"robots\":[[0,0]]}", 64, &["robots"]),
        ("assign --random 2 --agents [[0,0]]", 64, &["--random", "--agents"]),
        ("assign --random 5001", 64, &["--random", "1 to 5000"]),
        ("assign --random 2 --connect http://127.0.0.1:9", 69, &["127.0.0.1:9"]),
        ("assign --random 2 --connect http://no.such.host.invalid:9", 69, &["no.such.host.invalid"]),
        ("assign --random 2 --connect https://127.0.0.1:9", 64, &["--connect", "--tls-ca"]),
        ("health nowhere", 64, &["nowhere"]),
        ("health http://127.0.0.1:9 --timeout 5M", 64, &["--timeout", "1 to 3600"]),
        ("health http://127.0.0.1:9", 69, &["127.0.0.1:9"]),
        ("verify {f}/none", 64, &["{f}/none"]),
        ("verify {f}/folder", 1, &[]),
        ("bench env", 64, &["magex-bench -- env"]),
        ("learner --resume --resume-or-create", 64, &["--resume", "--resume-or-create"]),
        ("learner --resume --out {f}/none --listen 127.0.0.1:0", 64, &["{f}/none"]),
        ("learner --out {f}/run --listen 127.0.0.1:0", 73, &["{f}/run", "--resume"]),
        ("learner --out /proc/new --listen 127.0.0.1:0", 73, &["/proc/new"]),
        ("learner --out new --listen 0.0.0.0:0", 64, &["--listen 0.0.0.0:0", "--insecure"]),
        ("learner --out new --listen 127.0.0.1:0 --http nowhere", 64, &["--http"]),
        ("learner --tls-cert {f}/noise", 64, &["--tls-key"]),
        ("learner --client-ca {f}/noise", 64, &["--tls-cert"]),
        ("learner --identities {f}/no-identity.toml", 64, &["identity"]),
        ("learner --identities {f}/half-identity.toml", 64, &["--identities", "line 1", "role"]),
        ("learner --identities {f}/role.toml", 64, &["--identities", "line 3", "boss"]),
        ("actor --token-file {f}/empty", 64, &["--token-file {f}/empty"]),
        ("actor --token-file {f}/token --learner http://10.1.2.3:1", 64, &["--learner", "unencrypted"]),
        ("actor --threads 100000", 64, &["--threads", "1 to 4096"]),
        ("actor --threads 0", 64, &["--threads"]),
        ("actor --learner ''", 64, &["--learner"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/none", 64, &["{f}/none"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/text", 64, &["{f}/text", "not a weights file"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/empty", 64, &["{f}/empty", "not a weights file"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/folder", 64, &["{f}/folder"]),
        ("commander --listen 127.0.0.1:0 --weights {f}/run --config {f}/agents-only.toml", 64, &["task.name"]),
        ("commander --config {f}/run/config.toml", 64, &["--weights"]),
        ("commander --model {f}/none", 64, &["{f}/none"]),
        ("commander --mission-hours 9000", 64, &["--mission-hours", "1 to 8760"]),
        ("commander --listen 127.0.0.1:0 --data {f}/noise", 73, &["--data {f}/noise"]),
        ("commander --listen 127.0.0.1:0 --data /proc/new", 73, &["--data /proc/new"]),
        ("commander --listen 127.0.0.1:0 --otlp nowhere", 64, &["--otlp"]),
    ]
    .iter()
    .map(|(line, code, names)| row(line, *code, names))
    .collect();
    rows.extend([
        with("RUST_LOG", "a=loud", row("actor", 64, &["RUST_LOG", "a=loud"])),
        with("RUST_LOG", "=,=", row("eval {f}/run --episodes 1", 64, &["RUST_LOG"])),
        with("MAGEX_TOKEN", "two words", row("actor --learner http://127.0.0.1:9", 64, &["MAGEX_TOKEN"])),
        with("MAGEX_TLS_CERT", "{f}/noise", row("commander", 64, &["MAGEX_TLS_CERT", "--tls-key"])),
        with("MAGEX_TLS_CA", "{f}/none", row("health https://127.0.0.1:9", 64, &["{f}/none"])),
        with("MAGEX_RESUME", "true", row("learner --resume-or-create", 64, &["MAGEX_RESUME", "--resume-or-create"])),
        with("MAGEX_LOG_FORMAT", "json", row("train --agents five", 64, &["\"exit_code\":64", "--agents"])),
        with(
            "MAGEX_LOG_FORMAT",
            "json",
            row("assign --random 2 --connect http://127.0.0.1:9", 69, &["\"level\":\"ERROR\""]),
        ),
    ]);
    rows
}

fn prepare(folder: &Path) {
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).unwrap();
    std::fs::create_dir(folder.join("folder")).unwrap();
    std::fs::write(folder.join("noise"), [0xff, 0xfe, 0x00, 0x80, b'x']).unwrap();
    for (name, text) in [
        ("empty", ""),
        ("text", "# A text that is no weights file.\n"),
        ("token", "secret"),
        ("agents-only.toml", "[task]\nagents = 5"),
        ("ring.toml", "[task]\nname = 'drones'\nagents = 5\nspawn = 'ring'"),
        ("open-table.toml", "\n[run"),
        ("no-section.toml", "run = 5"),
        ("twice.toml", "[run]\nseed = 1\nseed = 2"),
        ("huge.toml", "[run]\nseed = 9223372036854775808"),
        ("beyond.toml", "[run]\nseed = 99999999999999999999999999999999999999999999"),
        ("renamed.toml", "[mappo]\nclip = 0.1"),
        ("other-section.toml", "[task]\nname = 'push-ball'\nagents = 5\nspawn = 'uniform'\n[task.drones]\ntilt = 1"),
        ("strange.toml", "[strange]\nkey = 1"),
        ("shards.toml", "[collect]\nepisodes_per_iteration = 4\nshards_per_iteration = 3"),
        ("chunk.toml", "[mappo]\nchunk_length = 7"),
        ("ranking.toml", "[commander]\nkind = 'ranking'"),
        ("no-identity.toml", ""),
        ("half-identity.toml", "[[identity]]\nname = 'a'"),
        ("role.toml", "[[identity]]\nname = 'a'\nrole = 'boss'\ntoken_sha256 = 'a'"),
        (
            "tiny.toml",
            "[run]\nmax_steps = 240\neval_episodes = 4\nfinal_episodes = 4\n[task]\nname = 'simple-spread'\nagents = 5\n\
             spawn = 'uniform'\n[executor]\nkind = 'local'\n[collect]\nepisodes_per_iteration = 4\n[mappo]\nepochs = 1",
        ),
    ] {
        write(name, text);
    }
    let own = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    write("cert.pem", &own.cert.pem());
    write("key.pem", &own.signing_key.serialize_pem());
    let train = ["train", "tiny.toml", "--in-process", "--http", "off", "--out", "run"];
    let trained = Command::new(binary()).args(train).current_dir(folder).output().unwrap();
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    for copy in ["broken", "headless"] {
        let copied = Command::new("cp").args(["-r", "run", copy]).current_dir(folder).status();
        assert!(copied.unwrap().success());
    }
    std::fs::remove_file(folder.join("headless/config.toml")).unwrap();
    std::fs::remove_file(folder.join("broken/summary.json")).unwrap();
    for checkpoint in std::fs::read_dir(folder.join("broken/checkpoints")).unwrap() {
        std::fs::write(checkpoint.unwrap().path().join("weights.safetensors"), "x").unwrap();
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
    prepare(&files);
    let rows: Vec<Row> = [options(), keys(&files), by_hand()].concat();
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
