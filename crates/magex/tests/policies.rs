//! A trained policy outside of training: traces, actions on standard input, actions over gRPC, and weights files that must not pass.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_proto::v1;
use magex_proto::v1::act_stream_response::Result as Answer;
use magex_proto::v1::policy_service_client::PolicyServiceClient;
use magex_runtime::client;
use serde_json::Value;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use tonic::Code;
use tonic::transport::Channel;
use tonic_types::StatusExt as _;

struct Run {
    _place: tempfile::TempDir,
    folder: PathBuf,
}

const CONFIG: &str = "\
[run]\nmax_steps = 600\ntarget_success = 2.0\neval_every = 1000\neval_episodes = 1\nfinal_episodes = 1\n\
[task]\nname = 'push-ball'\nagents = 4\nspawn = 'uniform'\nhorizon = 30\n\
[commander]\nkind = 'exact'\n[collect]\nepisodes_per_iteration = 4\n";

/// A run that has hardly begun: its policy is as good as any to be ported.
fn run() -> &'static Run {
    static RUN: OnceLock<Run> = OnceLock::new();
    RUN.get_or_init(|| {
        let place = tempfile::tempdir().unwrap();
        let config = place.path().join("config.toml");
        std::fs::write(&config, CONFIG).unwrap();
        let folder = place.path().join("run");
        let out = folder.display().to_string();
        good(&["train", &config.display().to_string(), "--out", &out, "--in-process", "--http", "off"], "");
        Run { _place: place, folder }
    })
}

fn magex(arguments: &[&str], input: &str) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_magex"))
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut stdin, input) = (child.stdin.take().unwrap(), input.to_owned());
    // A command that refuses its options does not read.
    let writing = std::thread::spawn(move || drop(stdin.write_all(input.as_bytes())));
    let output = child.wait_with_output().unwrap();
    writing.join().unwrap();
    output
}

fn good(arguments: &[&str], input: &str) -> String {
    let output = magex(arguments, input);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The steps of the first evaluation episode, one JSON object each.
fn trace() -> (String, Vec<Value>) {
    let file = run().folder.with_file_name(format!("{:?}.jsonl", std::thread::current().id()));
    good(&["trace", &run().folder.display().to_string(), "--out", &file.display().to_string()], "");
    let text = std::fs::read_to_string(file).unwrap();
    let all = lines(&text);
    let (first, last) = (all.first().unwrap().clone(), all.last().unwrap().clone());
    assert_eq!((&first["kind"], &last["kind"]), (&Value::from("episode"), &Value::from("end")));
    let summary = std::fs::read_to_string(run().folder.join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(first["weights_sha256"], summary["weights_sha256"]);
    let evaluated =
        good(&["eval", &run().folder.display().to_string(), "--episodes", "1", "--mode", "greedy", "--json"], "");
    let evaluated: Value = serde_json::from_str(evaluated.lines().last().unwrap()).unwrap();
    let metric = |value: &Value| value["cost_ratio"].as_f64().map(|x| (x * 1e4).round());
    assert_eq!(metric(&last["metrics"]), metric(&evaluated["mean"]["greedy"]), "{evaluated}");
    let steps = all.into_iter().filter(|line| line["kind"] == "step").collect();
    (text, steps)
}

fn floats(value: &Value) -> Vec<f32> {
    let rows = value.as_array().unwrap();
    rows.iter().flat_map(|row| row.as_array().unwrap().iter().map(|x| x.as_f64().unwrap() as f32)).collect()
}

fn request(step: &Value) -> v1::ActRequest {
    v1::ActRequest {
        dims: 2,
        positions: floats(&step["positions"]),
        velocities: floats(&step["velocities"]),
        goals: floats(&step["goals"]),
        balls: floats(&step["balls"]),
        ball_velocities: floats(&step["ball_velocities"]),
        ..Default::default()
    }
}

fn actions(step: &Value) -> Vec<u32> {
    floats(&step["actions"]).into_iter().map(|x| x as u32).collect()
}

#[test]
fn actions_on_standard_input_are_those_of_the_trace() {
    let (text, steps) = trace();
    let answers = lines(&good(&["act", &run().folder.display().to_string()], &text));
    assert_eq!(answers.len(), steps.len());
    for (answer, step) in answers.iter().zip(&steps) {
        assert_eq!((&answer["actions"], &answer["logits"]), (&step["actions"], &step["logits"]));
    }
    let refused = magex(&["act", &run().folder.display().to_string()], "{\"positions\":[[0,0]]}\n");
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.status.code() == Some(64) && error.contains("line 1: velocities: 0 numbers"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn actions_over_grpc_are_those_of_the_trace_and_wrong_calls_are_named() {
    let (_, steps) = trace();
    let folder = run().folder.display().to_string();
    let service = Service::start(&["--weights", &folder, "--act-agents", "40"]);
    let channel = client::endpoint(&service.url).unwrap().connect().await.unwrap();
    let mut client: PolicyServiceClient<Channel> = PolicyServiceClient::new(channel);
    let mut memory = bytes::Bytes::new();
    for step in &steps {
        let answer = client.act(v1::ActRequest { memory, ..request(step) }).await.unwrap().into_inner();
        assert_eq!(answer.actions, actions(step));
        assert_eq!(answer.logits, floats(&step["logits"]));
        assert_eq!(answer.choices, [5]);
        memory = answer.memory;
    }
    // Two teams side by side, in a stream that keeps their memory; a wrong step in between changes nothing.
    let two = |step: &Value| {
        let one = request(step);
        let twice = |values: &[f32]| [values, values].concat();
        v1::ActRequest {
            teams: 2,
            positions: twice(&one.positions),
            velocities: twice(&one.velocities),
            goals: twice(&one.goals),
            balls: twice(&one.balls),
            ball_velocities: twice(&one.ball_velocities),
            ..one
        }
    };
    let mut messages: Vec<v1::ActStreamRequest> = Vec::new();
    for step in &steps {
        messages.push(v1::ActStreamRequest { sequence: 7, step: Some(two(step)), begin: false });
        messages.push(v1::ActStreamRequest {
            sequence: 8,
            step: Some(v1::ActRequest { dims: 3, ..two(step) }),
            begin: false,
        });
    }
    messages.push(v1::ActStreamRequest { sequence: 7, step: Some(two(&steps[0])), begin: true });
    let mut answers = client.act_stream(tokio_stream::iter(messages)).await.unwrap().into_inner();
    let mut expected = steps.iter().chain([&steps[0]]);
    while let Some(message) = answers.message().await.unwrap() {
        match message.result {
            Some(Answer::Answer(answer)) => {
                assert!(message.sequence == 7 && answer.memory.is_empty());
                assert_eq!(answer.actions, actions(expected.next().unwrap()).repeat(2));
            }
            Some(Answer::Problem(problem)) => {
                assert_eq!((message.sequence, &*problem.fields[0].field), (8, "step.dims"));
            }
            None => {}
        }
    }
    assert!(expected.next().is_none());
    let step = &steps[0];
    let mut damaged = memory.to_vec();
    damaged[40] ^= 1;
    let many = |n: usize| v1::ActRequest { positions: vec![0.5; 2 * n], ..request(step) };
    for (call, field) in [
        (v1::ActRequest { memory: damaged.into(), ..request(step) }, "memory"),
        (v1::ActRequest { memory: memory.clone(), ..two(step) }, "memory"),
        (v1::ActRequest { memory: bytes::Bytes::from_static(b"x"), ..request(step) }, "memory"),
        (v1::ActRequest { dims: 3, ..request(step) }, "dims"),
        (v1::ActRequest { goals: vec![0.0; 3], ..request(step) }, "goals"),
        (v1::ActRequest { velocities: vec![f32::INFINITY; 8], ..request(step) }, "velocities[0]"),
        (v1::ActRequest { balls: Vec::new(), ..request(step) }, "balls"),
        (v1::ActRequest { side: Some(-1.0), ..request(step) }, "side"),
        (v1::ActRequest::default(), "dims"),
        (many(41), "positions"),
        (many(5), "velocities"),
    ] {
        let status = client.act(call).await.unwrap_err();
        let named = status.get_details_bad_request().unwrap().field_violations[0].field.clone();
        assert_eq!((status.code(), &*named), (Code::InvalidArgument, field), "{}", status.message());
    }
    // Nothing to act with.
    let bare = Service::start(&[]);
    let channel = client::endpoint(&bare.url).unwrap().connect().await.unwrap();
    let status = PolicyServiceClient::new(channel).act(request(step)).await.unwrap_err();
    assert!(status.code() == Code::FailedPrecondition && status.message().contains("--weights"), "{status}");
}

/// A commander; killed when dropped.
struct Service {
    child: Child,
    url: String,
}

impl Service {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_magex"))
            .args(["commander", "--listen", "127.0.0.1:0"])
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let ready: Value = serde_json::from_str(&line).unwrap();
        Self { child, url: format!("http://{}", ready["address"].as_str().unwrap()) }
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The header of a safetensors file, and what stands behind it.
fn taken_apart(bytes: &[u8]) -> (Value, Vec<u8>) {
    let size = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[8..8 + size]).unwrap(), bytes[8 + size..].to_vec())
}

fn put_together(header: &Value, data: &[u8]) -> Vec<u8> {
    let text = header.to_string();
    [&(text.len() as u64).to_le_bytes()[..], text.as_bytes(), data].concat()
}

#[test]
fn weights_files_that_do_not_fit_are_refused_or_warned_about_by_name() {
    let folder = &run().folder;
    let (header, data) = taken_apart(&std::fs::read(folder.join("weights.safetensors")).unwrap());
    let place = tempfile::tempdir().unwrap();
    let config = std::fs::read_to_string(folder.join("config.toml")).unwrap();
    let evaluate = |name: &str, bytes: &[u8], config: &str, more: &[&str]| {
        let (file, toml) = (place.path().join(name), place.path().join(format!("{name}.toml")));
        std::fs::write(&file, bytes).unwrap();
        std::fs::write(&toml, config).unwrap();
        let (file, toml) = (file.display().to_string(), toml.display().to_string());
        let options = ["eval", &file, "--config", &toml, "--episodes", "1", "--mode", "greedy"];
        let output = magex(&[&options, more].concat(), "");
        (output.status.success(), String::from_utf8(output.stderr).unwrap())
    };
    let whole = put_together(&header, &data);
    let (ok, text) = evaluate("own", &whole, &config, &[]);
    assert!(ok && !text.contains("WARN"), "{text}");
    let note = |change: &dyn Fn(&mut Value)| {
        let mut header = header.clone();
        change(&mut header);
        put_together(&header, &data)
    };
    let metadata = |value: &str| value.to_owned();
    let own = header["__metadata__"]["magex"].as_str().unwrap().to_owned();
    let first = "actor.f_goal.weight";
    let shape = header[first]["shape"].clone();
    let commander_free = config.replace("kind = \"exact\"", "kind = \"pairwise\"");
    let cases: Vec<(&str, Vec<u8>, String, bool, &str)> = vec![
        (
            "format",
            note(&|h| h["__metadata__"]["magex"] = metadata("{\"format\":9}").into()),
            config.clone(),
            false,
            "format 9 is not known",
        ),
        (
            "older",
            note(&|h| h["__metadata__"]["magex"] = metadata("{\"format\":1}").into()),
            config.clone(),
            true,
            "format 1",
        ),
        (
            "none",
            note(&|h| drop(h.as_object_mut().unwrap().remove("__metadata__"))),
            config.clone(),
            true,
            "no metadata",
        ),
        (
            "task",
            note(&|h| {
                h["__metadata__"]["magex"] = own.replace("\"name\":\"push-ball\"", "\"name\":\"simple-spread\"").into()
            }),
            config.clone(),
            false,
            "task.name is \"simple-spread\"",
        ),
        (
            "features",
            note(&|h| h["__metadata__"]["magex"] = own.replace("\"speed\":2.0", "\"speed\":3.0").into()),
            config.clone(),
            false,
            "observation.speed is 3.0",
        ),
        (
            "norm",
            whole.clone(),
            config.replace("feature_norm = true", "feature_norm = false"),
            false,
            "executor.feature_norm is true",
        ),
        ("side", whole.clone(), config.replacen("side = ", "side = 1", 1), true, "task.side is"),
        ("half", note(&|h| h[first]["dtype"] = "F16".into()), config.clone(), false, ""),
        (
            "transposed",
            note(&|h| h[first]["shape"] = serde_json::json!([shape[1], shape[0]])),
            config.clone(),
            false,
            "stored [inputs, outputs]",
        ),
        ("truncated", whole[..whole.len() - 9].to_vec(), config.clone(), false, "truncated"),
        ("head", whole[..50].to_vec(), config.clone(), false, "truncated"),
        ("extra", note(&|h| h["actor.extra"] = h["actor.head.bias"].clone()), config.clone(), false, ""),
        ("actor", whole.clone(), commander_free, false, "add --scheduler exact"),
    ];
    for (name, bytes, config, passes, words) in cases {
        let (ok, text) = evaluate(name, &bytes, &config, &[]);
        assert!(ok == passes && text.contains(words), "{name}: {ok} {text}");
    }
    // Values, precision and further tensors, with a header that is in order.
    let mut other = data.clone();
    other[3] ^= 1;
    let (ok, text) = evaluate("changed", &put_together(&header, &other), &config, &[]);
    assert!(ok && text.contains("the file was changed since"), "{text}");
    let mut longer = header.clone();
    longer["actor.zzz"] =
        serde_json::json!({ "dtype": "F32", "shape": [1], "data_offsets": [data.len(), data.len() + 4] });
    let (ok, text) = evaluate("more", &put_together(&longer, &[&data[..], &[0; 4]].concat()), &config, &[]);
    assert!(ok && text.contains("does not read: actor.zzz"), "{text}");
    let mut double = header.clone();
    double["actor.f_goal.weight"]["dtype"] = "I32".into();
    let (ok, text) = evaluate("integers", &put_together(&double, &data), &config, &[]);
    assert!(!ok && text.contains("convert every tensor to F32"), "{text}");
    let run = Path::new(folder).display().to_string();
    let out = place.path().join("policy.onnx").display().to_string();
    let exported = good(&["export", &run, "--format", "onnx", "--out", &out, "--json"], "");
    assert!(exported.contains("policy_sha256") && std::fs::metadata(&out).unwrap().len() > 10_000);
    for name in ["episode.npz", "episode.mcap"] {
        let out = place.path().join(name).display().to_string();
        good(&["trace", &run, "--out", &out], "");
        assert!(std::fs::metadata(&out).unwrap().len() > 1000);
    }
}
