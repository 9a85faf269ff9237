//! Folders that are removed, moved or replaced below running services, and disks that take no writes: nothing is acknowledged that
//! is not there, nothing ends that could wait, and what is missing is said.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_learner::checkpoint;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use magex_tests::sandbox::{Cluster, Process, Setup, binary, wait_until};
use magex_tests::small_disk::SmallDisk;
use magex_tests::{small, train};
use std::fs;
use std::path::Path;
use std::process::Command;
use tonic::transport::Channel;

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

fn lines(run: &Path) -> Vec<u64> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    text.lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["iteration"].as_u64().unwrap())
        .collect()
}

#[test]
fn a_run_goes_on_while_its_folder_is_away_or_replaced_and_is_whole_when_it_is_back() {
    // Many more iterations than are needed: what is waited for is what the learner says.
    let iterations = 300;
    let config = small(ExecutorKind::Local, 5, iterations);
    let place = tempfile::tempdir().unwrap();
    let (run, away) = (place.path().join("run"), place.path().join("away"));
    let mut cluster = Cluster::start_with(&config, Setup { run: Some(run.clone()), ..Setup::default() });
    cluster.start_actor();
    cluster.wait_for_iteration(6);
    let said = |cluster: &Cluster, words: &str| cluster.learner.log().matches(words).count();
    fs::rename(&run, &away).unwrap();
    wait_until("it is noticed", || said(&cluster, "the run folder was removed or moved") > 1);
    cluster.wait_for_iteration(cluster.status().unwrap().iteration + 3);
    assert!(!run.exists(), "half a run was begun in its place");
    // Another folder in its place gets nothing.
    fs::create_dir(&run).unwrap();
    wait_until("it is noticed", || said(&cluster, "the run folder was replaced") > 0);
    assert_eq!(fs::read_dir(&run).unwrap().count(), 0);
    fs::remove_dir(&run).unwrap();
    fs::rename(&away, &run).unwrap();
    wait_until("checkpoints again", || said(&cluster, "checkpoints can be written again") > 0);
    assert_eq!(cluster.finish(), undisturbed(&config));
    assert_eq!(lines(&run), (0..=iterations).collect::<Vec<_>>());
    assert!(run.join("config.toml").exists());
    let events = fs::read_dir(run.join("tensorboard")).unwrap().count();
    assert!(events >= 2, "TensorBoard's files go on in a new one: {events}");
}

#[test]
fn a_resume_says_which_lines_are_missing() {
    let config = small(ExecutorKind::Local, 5, 8);
    let place = tempfile::tempdir().unwrap();
    let run = place.path().join("run");
    train_until_complete(&config, &run);
    fs::remove_file(run.join("summary.json")).unwrap();
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let kept = text.lines().enumerate().filter(|(number, _)| ![1, 2, 5].contains(number));
    fs::write(run.join("metrics.jsonl"), kept.map(|(_, line)| format!("{line}\n")).collect::<String>()).unwrap();
    let out = run.display().to_string();
    let resume = ["train", "--resume", "--out", &out, "--in-process", "--http", "off"];
    let output = Command::new(binary()).args(resume).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("metrics.jsonl has no lines of these iterations") && said.contains("1–2, 5"), "{said}");
    assert_eq!(lines(&run), [0, 3, 4, 6, 7, 8]);
}

fn train_until_complete(config: &RunConfig, run: &Path) {
    fs::create_dir(run).unwrap();
    fs::write(run.join("config.toml"), config.to_toml().unwrap()).unwrap();
    train(config, run, 1, 1);
}

#[test]
fn a_learner_that_was_killed_on_a_read_only_disk_waits_for_it() {
    let Some(disk) = SmallDisk::mount("16m") else { return };
    let config = small(ExecutorKind::Local, 5, 100);
    let run = disk.path().join("run");
    let mut cluster = Cluster::start_with(&config, Setup { run: Some(run.clone()), ..Setup::default() });
    cluster.start_actor();
    wait_until("a checkpoint", || checkpoint::list(&run).len() > 1);
    cluster.learner.kill();
    disk.set_read_only(true);
    let place = tempfile::tempdir().unwrap();
    let (out, log) = (run.display().to_string(), place.path().join("log"));
    let arguments = ["learner", "--resume", "--out", &out, "--listen", "127.0.0.1:0", "--threads", "1"];
    // A stop is obeyed while it waits.
    let mut stopped = Process::start(&arguments, &log);
    let waits = |process: &Process| process.log().contains("the run folder cannot be written; waiting until it can");
    wait_until("it says that it waits", || waits(&stopped));
    stopped.signal("TERM");
    assert_eq!(stopped.wait().code(), Some(75), "{}", stopped.log());
    cluster.resume_learner_while(|learner| {
        wait_until("it says that it waits", || waits(learner));
        std::thread::sleep(std::time::Duration::from_secs(2));
        assert!(learner.running(), "{}", learner.log());
        disk.set_read_only(false);
    });
    assert!(cluster.learner.log().contains("the run folder can be written again"), "{}", cluster.learner.log());
    assert_eq!(cluster.finish(), undisturbed(&config));
    assert_eq!(lines(&run), (0..=100).collect::<Vec<_>>());
}

struct Commander {
    process: Process,
    client: CommanderServiceClient<Channel>,
}

impl Commander {
    async fn start(data: &Path, log: &Path) -> Self {
        let data = data.display().to_string();
        let mut process = Process::start(&["commander", "--listen", "127.0.0.1:0", "--data", &data], log);
        let url = format!("http://{}", process.ready());
        let client = CommanderServiceClient::new(client::endpoint(&url).unwrap().connect().await.unwrap());
        Self { process, client }
    }

    async fn create(&mut self, id: String) {
        let member = |id: &str| v1::Member { id: id.into(), position: vec![0.0, 1.0], ..Default::default() };
        let (agents, goals) = (vec![member("a")], vec![member("g")]);
        let request = v1::CreateMissionRequest { mission_id: id, agents, goals, ..Default::default() };
        self.client.create_mission(request).await.unwrap();
    }

    async fn count(&mut self) -> usize {
        let request = v1::ListAssignmentsRequest { page_size: 500, ..Default::default() };
        self.client.list_assignments(request).await.unwrap().into_inner().assignments.len()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn missions_outlive_the_removal_and_the_move_of_their_folder() {
    let place = tempfile::tempdir().unwrap();
    let (data, log) = (place.path().join("data"), place.path().join("log"));
    let mut commander = Commander::start(&data, &log).await;
    let mut made = 0;
    let ways: [&dyn Fn(); 3] = [
        &|| fs::remove_dir_all(&data).unwrap(),
        &|| fs::rename(&data, place.path().join("moved")).unwrap(),
        // A backup of another time in its place.
        &|| {
            fs::remove_dir_all(&data).unwrap();
            fs::rename(place.path().join("moved"), &data).unwrap();
        },
    ];
    for way in ways {
        for _ in 0..10 {
            made += 1;
            commander.create(format!("m{made}")).await;
        }
        way();
        for _ in 0..10 {
            made += 1;
            commander.create(format!("m{made}")).await;
        }
        commander.process.kill();
        commander = Commander::start(&data, &log).await;
        assert_eq!(commander.count().await, made);
    }
    assert!(commander.process.log().contains("was removed, moved or replaced"), "{}", commander.process.log());
    // Without another change, the next sweep notices.
    fs::remove_dir_all(&data).unwrap();
    wait_until("the file is there again", || data.join("missions.redb").exists());
    commander.process.kill();
    assert_eq!(Commander::start(&data, &log).await.count().await, made);
}
