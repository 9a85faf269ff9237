//! The live page in a real browser (headless Chromium, driven over WebDriver), shown by a real learner with a real actor.
//!
//! Needs `chromium` and `chromedriver` (Debian: chromium, chromium-driver). Without them the tests of the browser are not
//! run, and say so; with MAGEX_CI_BROWSER set that is a failure.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

#[path = "page/axes.rs"]
mod axes;
#[path = "page/browser.rs"]
mod browser;

use browser::{Browser, Running, request};
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_core::task::TaskName;
use magex_learner::trainer::Trainer;
use magex_runtime::http;
use magex_tests::sandbox::{binary, wait_until};
use magex_tests::{drive, small, small_task, train};
use magex_viewer::page::{LivePage, RunInfo};
use serde_json::Value;
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use tokio_util::sync::CancellationToken;

/// Starts a service; it, and what its ready line says.
fn start(arguments: &[&str], log: &Path) -> (Running, Value) {
    let file = std::fs::OpenOptions::new().create(true).append(true).open(log).unwrap();
    let mut child = Command::new(binary())
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(file)
        .spawn()
        .unwrap();
    let mut line = String::new();
    // The actor is ready only when it has found its learner: the test does not wait for its line.
    if arguments[0] != "actor" {
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    }
    let ready = if line.is_empty() { Value::Null } else { serde_json::from_str(&line).unwrap() };
    (Running(child), ready)
}

fn get(address: &str, path: &str) -> String {
    request(address, &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"))
}

/// The folder of a run, and its configuration in it.
fn prepare(config: &RunConfig) -> (tempfile::TempDir, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("given.toml");
    std::fs::write(&file, config.to_toml().unwrap()).unwrap();
    let (file, run) = (file.display().to_string(), folder.path().join("run").display().to_string());
    (folder, file, run)
}

fn text(value: &Value, key: &str) -> String {
    value[key].as_str().unwrap_or_else(|| panic!("{key} in {value}")).to_owned()
}

/// A commander and an actor of a learner.
fn crew(folder: &Path, learner: &str) -> [Running; 2] {
    let learner = format!("http://{learner}");
    let (commander, ready) =
        start(&["commander", "--learner", &learner, "--listen", "127.0.0.1:0"], &folder.join("commander.log"));
    let commander_url = format!("http://{}", text(&ready, "address"));
    let arguments =
        ["actor", "--learner", &learner, "--commander", &commander_url, "--threads", "1", "--name", "walker"];
    let (actor, _) = start(&arguments, &folder.join("actor.log"));
    [commander, actor]
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_shows_a_run_across_a_restart_of_its_learner() {
    let Some(browser) = Browser::start().await else { return };
    let (folder, config, run) = prepare(&small(ExecutorKind::Local, 5, 100_000));
    let log = folder.path().join("learner.log");
    let first = ["learner", "--config", &config, "--out", &run, "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"];
    let (learner, ready) = start(&first, &log);
    let (address, http) = (text(&ready, "address"), text(&ready, "http"));

    // Nothing yet.
    browser.client.goto(&format!("http://{http}/")).await.unwrap();
    browser
        .until("word of the missing actors", "document.getElementById('state').innerText === 'waiting for actors'")
        .await;
    let banner = browser.text("banner").await;
    assert!(banner.contains(&format!("magex actor --learner http://{address}")), "{banner}");
    assert_eq!(browser.points().await, 0);

    // A run.
    let crew = crew(folder.path(), &address);
    browser.until("points", "Number(document.getElementById('curve-success').dataset.points) >= 4").await;
    browser.until("points of the losses", "Number(document.getElementById('curve-value').dataset.points) >= 4").await;
    let actors = "document.querySelector('#actors tbody').innerText";
    browser.until("the actor", &format!("{actors}.includes('walker')")).await;
    browser
        .until("a ledger that balances", "document.getElementById('ledger-sum').innerText === 'balances to 0'")
        .await;
    browser.until("an episode", "document.getElementById('no-episode').hidden").await;
    let picture = "document.getElementById('map').toDataURL()";
    let before = browser.value(picture).await;
    browser.until("movement", &format!("{picture} !== {before}")).await;
    assert_eq!(browser.log().await, [""; 0], "the console");
    let requests = browser.value("performance.getEntriesByType('resource').map(entry => entry.name)").await;
    let own = format!("http://{http}/api/");
    for name in requests.as_array().unwrap() {
        assert!(name.as_str().unwrap().starts_with(&own), "{name}");
    }
    let before = browser.points().await;

    // The learner is killed, and started again.
    drop(learner);
    browser.until("word of the silence", "document.documentElement.classList.contains('stale')").await;
    assert!(browser.text("banner").await.starts_with("The learner does not answer"));
    let again = ["learner", "--resume", "--out", &run, "--listen", &address, "--http", &http];
    let (learner, _) = start(&again, &log);
    browser.until("its return", "!document.documentElement.classList.contains('stale')").await;
    browser
        .until("more points", &format!("Number(document.getElementById('curve-success').dataset.points) > {before}"))
        .await;
    let noise: Vec<_> = browser.log().await.into_iter().filter(|line| !line.contains("net::ERR_")).collect();
    assert_eq!(noise, [""; 0], "the console");

    // A viewer that comes now sees the curves from the start; a wrong path is not found.
    browser.client.refresh().await.unwrap();
    browser
        .until("all points", &format!("Number(document.getElementById('curve-success').dataset.points) > {before}"))
        .await;
    assert!(get(&http, "/").contains("content-security-policy: default-src 'none'"));
    for path in ["/nothing", "/api", "/index.html", "/../config.toml"] {
        assert!(get(&http, path).starts_with("HTTP/1.1 404"), "{path}");
    }
    browser.close().await;
    drop((learner, crew));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_says_that_a_run_is_complete_when_its_learner_has_ended() {
    let Some(browser) = Browser::start().await else { return };
    let (folder, config, run) = prepare(&small_task(TaskName::PushBall, ExecutorKind::Local, 4, 5));
    let log = folder.path().join("learner.log");
    let arguments = ["learner", "--config", &config, "--out", &run, "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"];
    let (mut learner, ready) = start(&arguments, &log);
    let http = text(&ready, "http");
    browser.client.goto(&format!("http://{http}/#theme=dark")).await.unwrap();
    browser.until("the page", "document.getElementById('state').innerText === 'waiting for actors'").await;
    assert_eq!(browser.value("document.documentElement.dataset.theme").await, "dark");
    let crew = crew(folder.path(), &text(&ready, "address"));
    wait_until("the end of the learner", || learner.0.try_wait().unwrap().is_some());
    assert!(learner.0.wait().unwrap().success());
    browser.until("word of the end", "document.getElementById('state').innerText === 'complete'").await;
    browser.until("word of the absence", "document.getElementById('banner').innerText.includes('has ended')").await;
    assert!(browser.text("banner").await.contains("The run is complete: budget spent"));
    assert_eq!(browser.value("document.documentElement.classList.contains('stale')").await, false);
    // Push Ball has balls, and no accusation of its own in the console.
    assert!(browser.text("legend").await.contains("ball"));
    let noise: Vec<_> = browser.log().await.into_iter().filter(|line| !line.contains("net::ERR_")).collect();
    assert_eq!(noise, [""; 0], "the console");
    browser.close().await;
    drop(crew);
}

#[test]
fn a_run_that_is_looked_at_learns_the_same_bits() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    for name in [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones] {
        let config = small_task(name, ExecutorKind::Magex, 4, 3);
        let alone = train(&config, tempfile::tempdir().unwrap().path(), 1, 1);
        let folder = tempfile::tempdir().unwrap();
        let page = Arc::new(LivePage::new(&config, RunInfo::default()));
        let address: SocketAddr = runtime.block_on(async {
            let listening = http::bind("127.0.0.1:0").await.unwrap();
            let address = listening.address();
            listening.serve(page.routes(|| None), CancellationToken::new());
            address
        });
        let mut trainer = Trainer::create(&config, RunId("test".into()), folder.path(), 1).unwrap();
        trainer.observe(page);
        let shown = drive(trainer, &config, 1, &Arc::new(AtomicBool::new(false)));
        assert_eq!(shown.sha256, alone.sha256, "{name}");
        let address = address.to_string();
        let episode = get(&address, "/api/episode");
        assert!(episode.starts_with("HTTP/1.1 200") && episode.contains("\"positions\""), "{name}: {episode}");
        let run = get(&address, "/api/run");
        assert!(run.contains("\"state\":\"finished\"") && run.contains(&alone.sha256), "{name}: {run}");
        // The event files say what metrics.jsonl says: a file, and something in it.
        let events = folder.path().join("tensorboard/events.out.tfevents.0001");
        assert!(std::fs::metadata(events).unwrap().len() > 1000);
    }
}
