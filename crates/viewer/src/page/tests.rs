//! The page over a real socket, as a browser would ask for it.

use super::*;
use magex_core::config::RunConfig;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{Kind, METRICS};
use magex_core::statics::Statics;
use magex_core::trajectory::{EvalOutcome, Recording, Shape};
use magex_proto::v1;
use magex_runtime::http;
use serde_json::{Value, json};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio_util::sync::CancellationToken;

fn page() -> Arc<LivePage> {
    let info =
        RunInfo { name: "test".into(), learner: Some("127.0.0.1:7000".into()), lease: Some(Duration::from_secs(15)) };
    Arc::new(LivePage::new(&RunConfig::default(), info))
}

/// One actor, and a ledger that does not balance.
fn status() -> v1::RunStatus {
    let actor = v1::ActorStatus {
        actor_id: "one".into(),
        address: "127.0.0.1:5000".into(),
        leases: 2,
        shards_done: 7,
        last_seen_ms: 12,
        threads: 4,
        weights_version: Some(3),
        ..Default::default()
    };
    let ledger = v1::LedgerStatus { leased: 10, trained: 6, outstanding: 2, ..Default::default() };
    v1::RunStatus {
        state: v1::RunState::WaitingForActors.into(),
        actors: vec![actor],
        ledger: Some(ledger),
        ..Default::default()
    }
}

#[test]
fn targets_are_shown_as_they_were_written_and_only_if_the_run_ends_with_them() {
    let mut config = RunConfig::default();
    let task = |config: &RunConfig| LivePage::new(config, RunInfo::default()).task;
    let told =
        |task: &Value| ["target_success", "target_sampled_success", "target_collisions"].map(|key| task[key].clone());
    assert_eq!(told(&task(&config)), [json!(0.999), json!(0.96), json!(0.04)]);
    config.run.target_sampled_success = 0.0;
    config.run.target_collisions = COLLISIONS_ANY;
    assert_eq!(told(&task(&config)), [json!(0.999), Value::Null, Value::Null]);
    config = RunConfig::default();
    config.run.target_success = 2.0;
    assert_eq!(told(&task(&config)), [Value::Null, Value::Null, Value::Null]);
}

async fn serve(page: &Arc<LivePage>) -> SocketAddr {
    let listening = http::bind("127.0.0.1:0").await.unwrap();
    let address = listening.address();
    listening.serve(page.routes(|| Some(status())), CancellationToken::new());
    address
}

/// Status line and headers, and body.
async fn get(address: SocketAddr, path: &str, more: &str) -> (String, String) {
    let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: test\r\nConnection: close\r\n{more}\r\n");
    socket.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).await.unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.to_owned(), body.to_owned())
}

async fn json_of(address: SocketAddr, path: &str) -> Value {
    let (head, body) = get(address, path, "").await;
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("content-type: application/json"), "{head}");
    serde_json::from_str(&body).unwrap()
}

fn line(iteration: u32) -> String {
    json!({ "iteration": iteration, "joint_env_steps": 160 * iteration, "reward": -0.5 }).to_string()
}

fn outcome(version: u32, record: bool) -> EvalOutcome {
    let shape = Shape {
        steps: 1,
        episodes: 1,
        agents: 2,
        bodies: 2,
        landmarks: 2,
        dims: 2,
        agent_state: 0,
        world_state: 0,
        moves: 0,
        masks: 0,
        marks: 0,
        goals_per_agent: 1,
        action_components: 1,
    };
    let shard = Shard {
        kind: ShardKind::Eval,
        iteration: Iteration(version),
        index: 0,
        episodes: 1,
        first_episode: 0,
        version: WeightsVersion(version),
        mode: Mode::Greedy,
        eval_set: 1,
        record,
    };
    let recording = Recording {
        shape,
        positions: vec![0.0, 0.0, 1.0, 1.0, 0.1, 0.0, 1.0, 0.9],
        agent_state: vec![],
        statics: Statics::landmarks(2, 2, vec![0.5, 0.0, 1.0, 0.0]),
        pictures: Vec::new(),
        goals: vec![0, 1],
    };
    EvalOutcome { shard, metrics: vec![], recording: record.then_some(recording) }
}

#[tokio::test]
async fn the_page_allows_only_its_own_script_and_style() {
    let address = serve(&page()).await;
    let (head, body) = get(address, "/", "").await;
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("text/html"), "{head}");
    for word in ["default-src 'none'", "script-src 'sha256-", "style-src 'sha256-", "connect-src 'self'", "nosniff"] {
        assert!(head.contains(word), "{word}: {head}");
    }
    assert!(!head.contains("unsafe-inline"));
    for place in ["@SCENE@", "@METRICS@", "@LIGHT@", "@DARK@"] {
        assert!(!body.contains(place), "{place}");
    }
    // What is asked for is relative; the only address in full is the name of SVG in the icon, which is not fetched.
    assert!(!body.contains("src=") && !body.contains("@import") && !body.contains(" style="));
    assert_eq!(body.matches("<script>").count(), 1);
    assert_eq!(body.replace("http://www.w3.org/2000/svg", "").matches("://").count(), 3, "shown to people only");
    assert!(get(address, "/nothing", "").await.0.starts_with("HTTP/1.1 404"));
    assert!(get(address, "/api/none", "").await.0.starts_with("HTTP/1.1 404"));
}

#[tokio::test]
async fn names_and_colours_are_those_of_the_table() {
    let (_, body) = get(serve(&page()).await, "/", "").await;
    let (light, dark) = body.split_once(":root[data-theme=\"dark\"]").unwrap();
    let script = routes::PAGE.split_once("<script>").unwrap().1;
    for look in Kind::ALL.map(Kind::look) {
        assert!(light.contains(&format!("--{}: {};", look.class, look.light)), "{look:?}");
        assert!(dark.contains(&format!("--{}: {};", look.class, look.dark)), "{look:?}");
        // Where the script has a label or a colour of its own, the two drift apart.
        assert!(!script.contains(look.light) && !script.contains(look.dark), "{look:?}");
        assert!(!script.contains(look.label) || !look.label.contains(' '), "{look:?}");
    }
    for metric in METRICS.iter().filter(|metric| metric.plot.is_some()) {
        for (column, kind) in metric.series() {
            let look = kind.look();
            assert!(body.contains(&json!([column, look.label, look.class]).to_string()), "{column}");
        }
        assert!(body.contains(&format!("\"unit\":\"{}", metric.unit)), "{}", metric.name);
    }
}

#[tokio::test]
async fn the_state_contains_actors_and_ledger() {
    let page = page();
    let address = serve(&page).await;
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("metrics.jsonl"), format!("{}\n{}\nhalf a li", line(1), line(2))).unwrap();
    page.begin(&RunId("run".into()), folder.path());
    page.published(&magex_proto::weights::Weights::new(RunId("run".into()), WeightsVersion(5), vec![1, 2].into()));
    let run = json_of(address, "/api/run").await;
    assert_eq!((&run["state"], &run["version"], &run["points"]), (&json!("waiting_for_actors"), &json!(5), &json!(2)));
    assert_eq!(run["latest"]["iteration"], 2);
    assert_eq!((&run["run_id"], &run["folder"]), (&json!("run"), &json!(folder.path().display().to_string())));
    assert_eq!(run["task"]["steps_per_iteration"], RunConfig::default().steps_per_iteration());
    let actor = &run["actors"][0];
    assert_eq!((&actor["id"], &actor["leases"], &actor["lag"]), (&json!("one"), &json!(2), &json!(2)));
    assert_eq!(run["ledger"]["residual"], 2.0);
    // First the earlier lines, then only new ones.
    let process = run["process"].as_str().unwrap();
    let all = json_of(address, "/api/curve").await;
    assert_eq!((all["rows"].as_array().unwrap().len(), &all["last"]), (2, &json!(2)));
    page.line(&line(3));
    let news = json_of(address, &format!("/api/curve?process={process}&after=2")).await;
    assert_eq!((news["rows"].as_array().unwrap().len(), &news["after"]), (1, &json!(2)));
    // A client that knew another process gets all rows.
    let other = json_of(address, "/api/curve?process=other&after=2").await;
    assert_eq!((other["rows"].as_array().unwrap().len(), &other["after"]), (3, &json!(0)));
}

#[tokio::test]
async fn an_episode_is_sent_once() {
    let page = page();
    let address = serve(&page).await;
    assert!(get(address, "/api/episode", "").await.0.starts_with("HTTP/1.1 204"));
    page.evaluated(&[outcome(4, false)]);
    assert!(get(address, "/api/episode", "").await.0.starts_with("HTTP/1.1 204"), "nothing was recorded");
    page.evaluated(&[outcome(4, false), outcome(4, true)]);
    let tag = json_of(address, "/api/run").await["episode"].as_str().unwrap().to_owned();
    let episode = json_of(address, "/api/episode").await;
    assert_eq!((&episode["tag"], &episode["version"]), (&json!(tag), &json!(4)));
    assert_eq!(episode["episode"]["positions"], "AAAAAOgD6ANkAAAA6AOEAw==");
    assert_eq!(episode["scene"]["chain"], json!(["agents", "landmarks"]));
    let known = format!("If-None-Match: \"{tag}\"\r\n");
    assert!(get(address, "/api/episode", &known).await.0.starts_with("HTTP/1.1 304"));
    page.evaluated(&[outcome(6, true)]);
    assert!(get(address, "/api/episode", &known).await.0.starts_with("HTTP/1.1 200"));
}

#[tokio::test]
async fn the_end_of_the_run_answers_waiting_requests_at_once() {
    let page = page();
    let address = serve(&page).await;
    let revision = json_of(address, "/api/run").await["revision"].as_u64().unwrap();
    let waiting = tokio::spawn(async move { json_of(address, &format!("/api/run?after={revision}")).await });
    tokio::time::sleep(Duration::from_millis(20)).await;
    page.ended(RunEnd::Stopped("drain: test".into()));
    let run = waiting.await.unwrap();
    assert_eq!((&run["state"], &run["reason"]), (&json!("stopped"), &json!("drain: test")));
}

#[tokio::test]
async fn requests_beyond_the_limit_are_rejected_with_a_retry_delay() {
    let page = page();
    let address = serve(&page).await;
    let all = page.viewers.acquire_many(VIEWERS as u32).await.unwrap();
    let (head, _) = get(address, "/api/run", "").await;
    assert!(head.starts_with("HTTP/1.1 503") && head.contains("retry-after"), "{head}");
    // The training thread is not blocked.
    page.line(&line(1));
    drop(all);
    assert_eq!(json_of(address, "/api/run").await["points"], 1);
}

#[tokio::test]
async fn farewell_waits_only_for_recent_viewers() {
    let page = page();
    let address = serve(&page).await;
    let start = std::time::Instant::now();
    page.farewell().await;
    assert!(start.elapsed() < Duration::from_millis(400), "there are no viewers");
    json_of(address, "/api/run").await;
    let asked = std::time::Instant::now();
    page.farewell().await;
    assert!(asked.elapsed() > Duration::from_millis(200), "a viewer asked a moment ago");
}
