//! What earlier commits left, kept in `tests/golden/COMMIT`: a run folder, the file of the missions, and the bytes that clients and
//! actors send. Today's program reads each, or refuses it by name; it never misreads one.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use bytes::{BufMut as _, Bytes};
use magex_core::config::{ExecutorKind, RunConfig};
use magex_dispatch::disk::{Disk, DiskError};
use magex_learner::checkpoint;
use magex_learner::trainer::Trainer;
use magex_proto::parts::split;
use magex_proto::v1;
use magex_runtime::client;
use magex_tests::drive;
use magex_tests::raw::Raw;
use magex_tests::sandbox::{Cluster, Process, Setup, binary};
use magex_tests::small;
use prost::Message;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/3cfb71e")
}

/// Budget of the run that is kept, and of the one that it is continued to; the hash that its own program reached there.
const STEPS: [u64; 2] = [960, 1920];
const SHA256: &str = "789c52825c75913d9f0e3c03ed380714d6e9c35dc1d8882cd723e52f970a5ed2";

#[test]
fn a_run_folder_is_continued_with_the_same_bits_or_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    assert!(Command::new("cp").arg("-r").arg(golden().join("run")).arg(&run).status().unwrap().success());
    let refused = |text: String| {
        assert!(text.contains("magex") && text.contains("read"), "it does not say which release reads it: {text}");
        println!("refused: {text}");
    };
    if let Err(error) = checkpoint::check_format(&run) {
        return refused(error.to_string());
    }
    let text = fs::read_to_string(run.join("config.toml")).unwrap();
    let mut config = RunConfig::from_toml(&text).unwrap();
    assert_eq!(config.run.max_steps, STEPS[0]);
    config.run.max_steps = STEPS[1];
    let (trainer, skipped) = match Trainer::resume(&config, &run, 1) {
        Ok(resumed) => resumed,
        Err(error) => return refused(error.to_string()),
    };
    assert!(skipped.is_empty() && trainer.missing_lines().is_empty(), "{skipped:?}");
    let never = Arc::new(AtomicBool::new(false));
    assert_eq!(drive(trainer, &config, 1, &never).sha256, SHA256);
    assert_eq!(fs::read_to_string(run.join("metrics.jsonl")).unwrap().lines().count(), 13);
}

#[test]
fn missions_are_read_or_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missions.redb");
    let packed = fs::File::open(golden().join("missions.redb.gz")).unwrap();
    std::io::copy(&mut flate2::read::GzDecoder::new(packed), &mut fs::File::create(&path).unwrap()).unwrap();
    let expected = fs::read_to_string(golden().join("missions.txt")).unwrap();
    match Disk::open(&path) {
        Ok(disk) => {
            let told: String = disk.load().unwrap().iter().map(|mission| told(&mission.assignment)).collect();
            assert_eq!(told, expected);
        }
        Err(error @ DiskError::Format(_)) => {
            let text = error.to_string();
            assert!(text.contains("written by magex") && text.contains("which reads it"), "{text}");
        }
        Err(error) => panic!("neither read nor refused by name: {error}"),
    }
}

/// What must stay the same of an assignment, in a line.
fn told(a: &v1::Assignment) -> String {
    let pairs: Vec<String> = a.pairs.iter().map(|pair| format!("{}→{}", pair.agent_id, pair.goal_id)).collect();
    format!(
        "{} revision {} of {} agents and {} goals: {} at {:.3}\n",
        a.mission_id,
        a.revision,
        a.agents.len(),
        a.goals.len(),
        pairs.join(" "),
        a.cost
    )
}

fn told_pairs(a: &v1::AssignResponse) -> String {
    let pairs: Vec<String> = a.pairs.iter().map(|pair| format!("{}→{}", pair.agent_index, pair.goal_index)).collect();
    format!("{} at {:.3}\n", pairs.join(" "), a.cost)
}

async fn call(channel: &Channel, method: &str, message: Bytes) -> Result<Bytes, Status> {
    let mut client = tonic::client::Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let path = format!("/magex.v1.{method}").parse().unwrap();
    Ok(client.unary(Request::new(message), path, Raw).await?.into_inner())
}

/// The calls of a client, in order: name of the file, method, and what of the answer must stay the same.
type Told = fn(Bytes) -> String;
const CALLS: [(&str, &str, Told); 9] = [
    ("1-assign", "CommanderService/Assign", |b| told_pairs(&v1::AssignResponse::decode(b).unwrap())),
    ("2-costs", "CommanderService/Assign", |b| told_pairs(&v1::AssignResponse::decode(b).unwrap())),
    ("3-many", "CommanderService/AssignMany", |b| {
        v1::AssignManyResponse::decode(b).unwrap().answers.iter().map(told_pairs).collect()
    }),
    ("4-create", "CommanderService/CreateMission", |b| {
        told(&v1::CreateMissionResponse::decode(b).unwrap().assignment.unwrap())
    }),
    ("5-update", "CommanderService/UpdateMission", |b| {
        told(&v1::UpdateMissionResponse::decode(b).unwrap().assignment.unwrap())
    }),
    ("6-get", "CommanderService/GetAssignment", |b| {
        told(&v1::GetAssignmentResponse::decode(b).unwrap().assignment.unwrap())
    }),
    ("7-list", "CommanderService/ListAssignments", |b| {
        v1::ListAssignmentsResponse::decode(b).unwrap().assignments.iter().map(told).collect()
    }),
    ("8-delete", "CommanderService/DeleteMission", |b| {
        format!("{:?}\n", v1::DeleteMissionResponse::decode(b).unwrap())
    }),
    ("9-model", "CommanderService/GetModel", |b| format!("ready {}\n", v1::GetModelResponse::decode(b).unwrap().ready)),
];

async fn commander(program: &Path, folder: &Path) -> (Process, Channel) {
    let data = folder.join("data").display().to_string();
    let arguments = ["commander", "--listen", "127.0.0.1:0", "--data", &data];
    let mut process = Process::start_program(program, &arguments, &[], &folder.join("log"));
    let channel = client::endpoint(&format!("http://{}", process.ready())).unwrap().connect().await.unwrap();
    (process, channel)
}

#[tokio::test(flavor = "multi_thread")]
async fn what_clients_send_is_answered_as_before_or_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let (_commander, channel) = commander(binary(), folder.path()).await;
    let mut mission_is_there = true;
    for (name, method, told) in CALLS {
        let message = fs::read(golden().join("calls").join(name)).unwrap();
        let mut expected = fs::read_to_string(golden().join("calls").join(format!("{name}.txt"))).unwrap();
        // What was refused is in no list.
        if name == "7-list" && !mission_is_there {
            expected.clear();
        }
        match call(&channel, method, message.into()).await {
            Ok(answer) => assert_eq!(told(answer), expected, "{name}"),
            // Later calls may be about a mission that was not made.
            Err(status) => {
                let named = [Code::InvalidArgument, Code::FailedPrecondition, Code::NotFound, Code::Unimplemented];
                assert!(named.contains(&status.code()) && !status.message().is_empty(), "{name}: {status:?}");
                println!("{name} is refused: {}", status.message());
                mission_is_there &= name != "4-create";
            }
        }
    }
}

/// Services of two releases, replaced one after the other under load, forwards and back, in every order of learner, commander and
/// actors. Between releases of one protocol version the run goes on all the time; otherwise what does not fit says so, and it goes on
/// once all are replaced. `MAGEX_OLD` is the program of the earlier release.
#[test]
#[ignore = "needs the program of an earlier release in MAGEX_OLD; .ci/long"]
fn rolling_replacement_under_load() {
    let old = PathBuf::from(std::env::var_os("MAGEX_OLD").expect("MAGEX_OLD: the program of an earlier release"));
    let config = small(ExecutorKind::Local, 5, 1_000_000);
    let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    for (direction, from, to) in [("forwards", old.as_path(), binary()), ("back", binary(), old.as_path())] {
        for order in orders {
            let mut cluster = Cluster::start_with(&config, Setup { program: from.to_owned(), ..Setup::default() });
            (0..2).for_each(|_| cluster.start_actor());
            cluster.wait_for_iteration(4);
            let load = Load::start(cluster.commander_address());
            cluster.program = to.to_owned();
            let mut stalls = 0;
            for service in order {
                replace(&mut cluster, service);
                let reached = cluster.status().map_or(0, |status| status.iteration);
                let start = Instant::now();
                let goes_on =
                    |cluster: &Cluster| cluster.status().is_some_and(|status| status.iteration >= reached + 2);
                while !goes_on(&cluster) && start.elapsed() < Duration::from_secs(10) {
                    std::thread::sleep(Duration::from_millis(50));
                }
                if !goes_on(&cluster) {
                    let logs: String = cluster.logs().iter().filter_map(|log| fs::read_to_string(log).ok()).collect();
                    assert!(logs.contains("protocol"), "it stands still, and no log says why: {logs}");
                    stalls += 1;
                }
            }
            cluster.wait_for_iteration(cluster.status().unwrap().iteration + 3);
            let (answered, failed) = load.stop();
            cluster.learner.signal("TERM");
            assert_eq!(cluster.learner.wait().code(), Some(75), "{}", cluster.learner.log());
            let text = fs::read_to_string(cluster.run().join("metrics.jsonl")).unwrap();
            let number =
                |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["iteration"].as_u64().unwrap();
            let lines: Vec<u64> = text.lines().map(number).collect();
            assert_eq!(lines, (0..lines.len() as u64).collect::<Vec<_>>());
            println!(
                "{direction} {order:?}: {} iterations, {stalls} stalls, {answered} assignments, {failed} UNAVAILABLE",
                lines.len()
            );
        }
    }
}

fn replace(cluster: &mut Cluster, service: usize) {
    match service {
        0 => {
            cluster.learner.signal("TERM");
            assert_eq!(cluster.learner.wait().code(), Some(75), "{}", cluster.learner.log());
            cluster.resume_learner();
        }
        1 => {
            let mut commander = cluster.commander.take().unwrap();
            commander.signal("TERM");
            assert_eq!(commander.wait().code(), Some(0), "{}", commander.log());
            cluster.start_commander();
        }
        _ => {
            for mut actor in std::mem::take(&mut cluster.actors) {
                actor.signal("TERM");
                actor.wait();
                cluster.start_actor();
            }
        }
    }
}

/// A client that asks for assignments all the time, with the bytes of the earlier commit.
struct Load(Arc<AtomicBool>, std::thread::JoinHandle<(u32, u32)>);

impl Load {
    fn start(address: &str) -> Self {
        let (stop, url) = (Arc::new(AtomicBool::new(false)), format!("http://{address}"));
        let stopped = stop.clone();
        let asking = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let message = Bytes::from(fs::read(golden().join("calls/1-assign")).unwrap());
            runtime.block_on(async {
                let channel = client::endpoint(&url).unwrap().connect_lazy();
                let (mut answered, mut failed) = (0, 0);
                while !stopped.load(Ordering::SeqCst) {
                    let mut client = tonic::client::Grpc::new(channel.clone());
                    let path = "/magex.v1.CommanderService/Assign".parse().unwrap();
                    if client.ready().await.is_err() {
                        failed += 1;
                        continue;
                    }
                    match client.unary(Request::new(message.clone()), path, Raw).await {
                        Ok(_) => answered += 1,
                        Err(status) => {
                            let gone = [Code::Unavailable, Code::Unknown, Code::Cancelled, Code::Internal];
                            assert!(gone.contains(&status.code()), "{status}");
                            failed += 1;
                        }
                    }
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
                (answered, failed)
            })
        });
        Self(stop, asking)
    }

    fn stop(self) -> (u32, u32) {
        self.0.store(true, Ordering::SeqCst);
        self.1.join().unwrap()
    }
}

/// Records what the program in `MAGEX_OLD` (a path) leaves and what its clients send, into `tests/golden/$MAGEX_RECORD`, from a
/// check-out of its commit.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "writes the recordings of a commit: once, with its own check-out and program"]
async fn record() {
    let (Some(old), Ok(commit)) = (std::env::var_os("MAGEX_OLD"), std::env::var("MAGEX_RECORD")) else {
        panic!("set MAGEX_OLD to a program and MAGEX_RECORD to its commit");
    };
    let golden = golden().parent().unwrap().join(commit);
    fs::create_dir_all(golden.join("calls")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (mut process, channel) = commander(Path::new(&old), folder.path()).await;
    let mut missions = String::new();
    for ((name, method, told), message) in CALLS.into_iter().zip(requests()) {
        fs::write(golden.join("calls").join(name), &message).unwrap();
        if name == "8-delete" {
            // All missions, as the file has them.
            missions = fs::read_to_string(golden.join("calls/7-list.txt")).unwrap();
            // Nearly all of it is zeros.
            let mut file = fs::File::open(folder.path().join("data/missions.redb")).unwrap();
            let packed = fs::File::create(golden.join("missions.redb.gz")).unwrap();
            let mut packed = flate2::write::GzEncoder::new(packed, flate2::Compression::best());
            std::io::copy(&mut file, &mut packed).unwrap();
            packed.finish().unwrap();
        }
        let answer = call(&channel, method, message).await.unwrap();
        fs::write(golden.join("calls").join(format!("{name}.txt")), told(answer)).unwrap();
    }
    fs::write(golden.join("missions.txt"), missions).unwrap();
    process.kill();
}

/// As the codec of a client frames it: with the checksum behind it.
fn framed(message: &impl Message) -> Bytes {
    let mut bytes = message.encode_to_vec();
    let crc32c = split(bytes.clone().into()).next().unwrap().crc32c;
    bytes.extend([0xfd, 0xff, 0xff, 0xff, 0x0f]);
    bytes.put_u32_le(crc32c);
    bytes.into()
}

fn requests() -> Vec<Bytes> {
    let member = |id: &str, place: usize| v1::Member {
        id: id.into(),
        position: [vec![0.0, 1.0], vec![4.0, 0.5], vec![-2.0, 3.25]][place].clone(),
        ..Default::default()
    };
    let positions = |coordinates| v1::Positions { dims: 2, coordinates, ..Default::default() };
    let pair =
        |agent: &str, goal: &str| v1::PairRef { agent_id: agent.into(), goal_id: goal.into(), ..Default::default() };
    let team = v1::AssignRequest {
        agents: Some(positions(vec![0.0, 0.0, 1.0, 1.0, 5.0, 2.5])),
        goals: Some(positions(vec![1.0, 0.9, 5.5, 2.0, -1.0, 0.25])),
        agent_ids: ["a", "b", "c"].map(Into::into).into(),
        goal_ids: ["x", "y", "z"].map(Into::into).into(),
        forbidden: vec![pair("a", "x")],
        scheduler: v1::AssignmentMethod::Exact.into(),
        ..Default::default()
    };
    let costs = v1::AssignRequest {
        costs: Some(v1::CostMatrix { agents: 2, goals: 3, values: vec![3.0, 1.0, 2.0, 1.5, 0.5, 9.0] }),
        scheduler: v1::AssignmentMethod::Makespan.into(),
        switching_cost: 0.25,
        ..Default::default()
    };
    let mission = |id: &str| v1::CreateMissionRequest {
        mission_id: id.into(),
        agents: vec![member("a", 0), member("b", 1)],
        goals: vec![member("x", 1), member("y", 2)],
        lifetime_seconds: Some(80_000.0),
        scheduler: v1::AssignmentMethod::Exact.into(),
        ..Default::default()
    };
    let update = v1::UpdateMissionRequest {
        mission_id: "patrol".into(),
        agents: vec![member("c", 2)],
        forbid: vec![pair("a", "y")],
        expected_revision: Some(1),
        ..Default::default()
    };
    vec![
        framed(&team),
        framed(&costs),
        framed(&v1::AssignManyRequest { teams: vec![team, costs] }),
        framed(&mission("patrol")),
        framed(&update),
        framed(&v1::GetAssignmentRequest { mission_id: "patrol".into() }),
        framed(&v1::ListAssignmentsRequest { page_size: 10, ..Default::default() }),
        framed(&v1::DeleteMissionRequest { mission_id: "patrol".into() }),
        framed(&v1::GetModelRequest {}),
    ]
}
