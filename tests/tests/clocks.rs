//! The time of day jumps, forwards, backwards and from 1970: no mission is lost, no lease, and no number changes.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_core::config::ExecutorKind;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use magex_tests::sandbox::{Cluster, Process, Setup, wait_until};
use magex_tests::wall::Wall;
use magex_tests::{small, train};
use std::path::Path;
use std::time::Duration;
use tonic::transport::Channel;

const HOUR: i64 = 3600;
const YEAR: i64 = 365 * 24 * HOUR;

struct Commander {
    process: Process,
    client: CommanderServiceClient<Channel>,
}

impl Commander {
    async fn start(wall: &Wall, data: &Path) -> Self {
        let data = data.display().to_string();
        let arguments = ["commander", "--listen", "127.0.0.1:0", "--data", &data];
        let mut process = Process::start_in(&arguments, &wall.environment(), &wall.path("log"));
        let url = format!("http://{}", process.ready());
        let client = CommanderServiceClient::new(client::endpoint(&url).unwrap().connect().await.unwrap());
        Self { process, client }
    }

    async fn create(&mut self, id: &str, seconds: f64) -> v1::Assignment {
        let member = |id: &str| v1::Member { id: id.into(), position: vec![0.0, 1.0], ..Default::default() };
        let request = v1::CreateMissionRequest {
            mission_id: id.into(),
            agents: vec![member("a")],
            goals: vec![member("g")],
            lifetime_seconds: Some(seconds),
            ..Default::default()
        };
        self.client.create_mission(request).await.unwrap().into_inner().assignment.unwrap()
    }

    async fn get(&mut self, id: &str) -> Option<v1::Assignment> {
        let request = v1::GetAssignmentRequest { mission_id: id.into() };
        match self.client.get_assignment(request).await {
            Ok(found) => found.into_inner().assignment,
            Err(status) => {
                assert_eq!(status.code(), tonic::Code::NotFound, "{status}");
                None
            }
        }
    }

    async fn update(&mut self, id: &str) -> v1::Assignment {
        let request = v1::UpdateMissionRequest { mission_id: id.into(), ..Default::default() };
        self.client.update_mission(request).await.unwrap().into_inner().assignment.unwrap()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn missions_keep_their_lifetimes_whatever_the_time_of_day_does() {
    let wall = Wall::new();
    let data = wall.path("missions");
    wall.set(Wall::boot_without_battery());
    let mut commander = Commander::start(&wall, &data).await;
    let first = commander.create("m", HOUR as f64).await;
    assert!(first.created_ms < YEAR * 1000, "the shim works: {first:?}");
    // A second mission that ends by itself, whatever the time of day says.
    commander.create("short", 1.0).await;
    for offset in [0, 2 * HOUR, 10 * YEAR, -2 * HOUR, Wall::boot_without_battery(), 0] {
        wall.set(offset);
        // Longer than the time between two sweeps.
        tokio::time::sleep(Duration::from_millis(2200)).await;
        let seen = commander.get("m").await.unwrap_or_else(|| panic!("lost at {offset}"));
        assert_eq!((seen.created_ms, seen.revision), (first.created_ms, first.revision));
        let fresh = commander.create(&format!("at-{offset}"), HOUR as f64).await;
        let later = commander.update(&format!("at-{offset}")).await;
        // What is shown follows the time of day: the same clock says when both end.
        assert!((seen.expires_ms - fresh.expires_ms).abs() < HOUR * 1000, "{offset}: {seen:?} {fresh:?}");
        assert!(fresh.updated_ms >= fresh.created_ms && later.updated_ms >= later.created_ms);
        let request = v1::DeleteMissionRequest { mission_id: later.mission_id };
        commander.client.delete_mission(request).await.unwrap();
    }
    assert_eq!(commander.get("short").await, None, "it has expired by its own clock");
    wall.set(-2 * HOUR);
    let later = commander.update("m").await;
    assert!(later.updated_ms >= later.created_ms && later.revision == 2);
    assert!(commander.process.log().contains("the time of day has jumped"), "{}", commander.process.log());

    // Over restarts, by a stop or a kill: neither clock takes it away.
    for (stop, offset) in [("TERM", 3 * HOUR), ("KILL", -3 * HOUR), ("TERM", 40 * YEAR), ("KILL", 0)] {
        commander.process.signal(stop);
        commander.process.wait();
        wall.set(offset);
        commander = Commander::start(&wall, &data).await;
        let seen = commander.get("m").await.unwrap_or_else(|| panic!("lost over a restart with {offset}"));
        assert_eq!((seen.revision, seen.created_ms), (2, first.created_ms));
    }
    // Lifetimes go on while the service is stopped.
    commander.create("brief", 2.0).await;
    commander.process.signal("TERM");
    commander.process.wait();
    std::thread::sleep(Duration::from_millis(2500));
    commander = Commander::start(&wall, &data).await;
    assert_eq!(commander.get("brief").await, None);
    assert!(commander.get("m").await.is_some());
}

#[test]
fn a_run_whose_clocks_jump_has_the_same_weights() {
    let wall = Wall::new();
    wall.set(Wall::boot_without_battery());
    let config = small(ExecutorKind::Local, 5, 16);
    let setup = Setup { environment: wall.environment().into(), ..Setup::default() };
    let mut cluster = Cluster::start_with(&config, setup);
    cluster.start_actor();
    cluster.start_actor();
    for (iteration, offset) in [(2, 0), (4, 10 * YEAR), (6, -5 * YEAR), (8, Wall::boot_without_battery())] {
        wait_until("an iteration", || cluster.iterations() >= iteration);
        wall.set(offset);
    }
    assert_eq!(cluster.finish(), train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256);
    assert!(cluster.actors.iter_mut().all(|actor| actor.wait().success()));
    let log = cluster.learner.log();
    assert!(!log.contains("fell silent") && log.contains("residual=0"), "{log}");
}
