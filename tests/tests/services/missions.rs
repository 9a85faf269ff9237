//! Missions over the wire: their life, their watchers, what a restart leaves, and training episodes beside them.

use crate::sandbox::*;
use magex_commander::service::ServiceConfig;
use magex_dispatch::mission::MissionLimits;
use magex_dispatch::missions::Bounds;
use magex_learner::collector::Collector as _;
use magex_proto::goals::WeightsKey;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use std::path::Path;
use tonic::transport::Channel;
use tonic::{Code, Streaming};
use tonic_types::StatusExt as _;

type Client = CommanderServiceClient<Channel>;

fn member(id: &str, position: [f64; 2]) -> v1::Member {
    v1::Member { id: id.into(), position: position.to_vec(), ..Default::default() }
}

/// Two robots and two tasks, each pair a unit apart.
fn request(id: &str) -> v1::CreateMissionRequest {
    v1::CreateMissionRequest {
        mission_id: id.into(),
        agents: vec![member("r1", [0.0, 0.0]), member("r2", [10.0, 0.0])],
        goals: vec![member("t1", [0.0, 1.0]), member("t2", [10.0, 1.0])],
        switching_cost: 2.0,
        ..Default::default()
    }
}

async fn create(client: &mut Client, request: v1::CreateMissionRequest) -> v1::Assignment {
    client.create_mission(request).await.unwrap().into_inner().assignment.unwrap()
}

async fn update(client: &mut Client, request: v1::UpdateMissionRequest) -> v1::Assignment {
    client.update_mission(request).await.unwrap().into_inner().assignment.unwrap()
}

async fn get(client: &mut Client, id: &str) -> Result<v1::Assignment, tonic::Status> {
    let request = v1::GetAssignmentRequest { mission_id: id.into() };
    Ok(client.get_assignment(request).await?.into_inner().assignment.unwrap())
}

async fn list(client: &mut Client, request: v1::ListAssignmentsRequest) -> (Vec<String>, String) {
    let page = client.list_assignments(request).await.unwrap().into_inner();
    (page.assignments.into_iter().map(|a| a.mission_id).collect(), page.next_page_token)
}

fn moved(id: &str, agents: Vec<v1::Member>) -> v1::UpdateMissionRequest {
    v1::UpdateMissionRequest { mission_id: id.into(), agents, ..Default::default() }
}

fn pairs(a: &v1::Assignment) -> Vec<(&str, &str)> {
    a.pairs.iter().map(|p| (p.agent_id.as_str(), p.goal_id.as_str())).collect()
}

async fn next(stream: &mut Streaming<v1::WatchAssignmentsResponse>) -> (v1::WatchKind, String, u64) {
    let message = within(stream.message()).await.unwrap().unwrap();
    let kind = message.kind();
    let a = message.assignment.unwrap_or_default();
    (kind, a.mission_id, a.revision)
}

fn with_data(folder: &Path, missions: Bounds) -> ServiceConfig {
    ServiceConfig { data: Some(folder.to_owned()), missions, ..ServiceConfig::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mission_is_created_watched_updated_and_deleted() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    let first = create(&mut client, request("site")).await;
    assert_eq!((pairs(&first), first.revision), (vec![("r1", "t1"), ("r2", "t2")], 1));
    assert_eq!(client.create_mission(request("site")).await.unwrap_err().code(), Code::AlreadyExists);
    let drawn = create(&mut client, request("")).await.mission_id;
    assert!(drawn.starts_with("m-"), "{drawn}");

    let watch = v1::WatchAssignmentsRequest { mission_ids: vec!["site".into()], source: 0 };
    let mut stream = client.watch_assignments(watch).await.unwrap().into_inner();
    assert_eq!(next(&mut stream).await, (v1::WatchKind::Snapshot, "site".into(), 1));
    assert_eq!(next(&mut stream).await.0, v1::WatchKind::Synced);
    // The robots have all but swapped their places: 5.2 instead of 4.8 each is not worth two switches.
    let near = vec![member("r1", [5.2, 1.0]), member("r2", [4.8, 1.0])];
    let kept = update(&mut client, moved("site", near)).await;
    assert!(kept.changes.is_empty() && kept.gap.unwrap() > 0.08);
    let far = vec![member("r1", [8.0, 1.0]), member("r2", [2.0, 1.0])];
    let crossed = update(&mut client, moved("site", far)).await;
    assert_eq!(pairs(&crossed), [("r1", "t2"), ("r2", "t1")]);
    assert_eq!(crossed.changes[0].reason(), v1::ChangeReason::Switched);
    assert!((crossed.saving.unwrap() - 12.0).abs() < 1e-5, "{:?}", crossed.saving);
    // Another mission is none of this watcher's business.
    update(&mut client, moved(&drawn, vec![])).await;
    let failed = v1::Member { id: "r2".into(), state: v1::MemberState::Failed.into(), ..Default::default() };
    let left = update(&mut client, moved("site", vec![failed])).await;
    assert_eq!(left.goals_without_agent[0].id, "t1");
    for revision in 2..=4 {
        assert_eq!(next(&mut stream).await, (v1::WatchKind::Changed, "site".into(), revision));
    }
    let stale = v1::UpdateMissionRequest { expected_revision: Some(1), ..moved("site", vec![]) };
    assert_eq!(client.update_mission(stale).await.unwrap_err().code(), Code::Aborted);
    let wrong = moved("site", vec![member("", [0.0, 0.0])]);
    let status = client.update_mission(wrong).await.unwrap_err();
    assert_eq!(status.get_details_bad_request().unwrap().field_violations[0].field, "agents[0].id");
    assert_eq!(get(&mut client, "site").await.unwrap(), left);
    client.delete_mission(v1::DeleteMissionRequest { mission_id: "site".into() }).await.unwrap();
    assert_eq!(next(&mut stream).await, (v1::WatchKind::Deleted, "site".into(), 4));
    assert_eq!(get(&mut client, "site").await.unwrap_err().code(), Code::NotFound);
    commander.shutdown.cancel();
    assert_eq!(within(stream.message()).await.unwrap_err().code(), Code::Unavailable);
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn missions_survive_a_restart_and_are_bounded_in_number_and_age() {
    let folder = tempfile::tempdir().unwrap();
    let each = MissionLimits { lifetime_ms: 60_000, ..Bounds::default().each };
    let bounds = Bounds { per_owner: 3, each, ..Bounds::default() };
    let commander = Commander::start_with("127.0.0.1:0", with_data(folder.path(), bounds), load_fake).await;
    let mut client = commander_client(&commander.url).await;
    for id in ["a", "b"] {
        create(&mut client, request(id)).await;
    }
    let short = v1::CreateMissionRequest { lifetime_seconds: Some(1.0), ..request("short") };
    create(&mut client, short).await;
    let full = client.create_mission(request("d")).await.unwrap_err();
    assert_eq!(full.code(), Code::ResourceExhausted, "{full}");
    let mut stream = client.watch_assignments(v1::WatchAssignmentsRequest::default()).await.unwrap().into_inner();
    while next(&mut stream).await.0 != v1::WatchKind::Synced {}
    assert_eq!(next(&mut stream).await, (v1::WatchKind::Expired, "short".into(), 1));
    let far = vec![member("r1", [8.0, 1.0]), member("r2", [2.0, 1.0])];
    let last = update(&mut client, moved("b", far)).await;
    commander.stop().await;

    let commander = Commander::start_with("127.0.0.1:0", with_data(folder.path(), bounds), load_fake).await;
    let mut client = commander_client(&commander.url).await;
    assert_eq!(get(&mut client, "b").await.unwrap(), last);
    assert_eq!(list(&mut client, v1::ListAssignmentsRequest::default()).await.0, ["a", "b"]);
    let again = update(&mut client, moved("b", vec![])).await;
    assert_eq!((again.revision, again.changes.len()), (last.revision + 1, 0));
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_page_is_cut_before_it_is_too_long_to_take() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    let long = "x".repeat(60);
    let agents: Vec<_> = (0..1000).map(|k| member(&format!("{long}{k}"), [f64::from(k), 0.0])).collect();
    let mut expected = Vec::new();
    for k in 0..60 {
        let id = format!("m{k:02}");
        let mission = v1::CreateMissionRequest { agents: agents.clone(), goals: vec![], ..request(&id) };
        create(&mut client, mission).await;
        expected.push(id);
    }
    // This client takes 4 MiB, as clients do.
    let (mut names, mut token, mut pages) = (Vec::new(), String::new(), 0);
    loop {
        let ask = v1::ListAssignmentsRequest { page_size: 500, page_token: token, ..Default::default() };
        let (page, next) = list(&mut client, ask).await;
        names.extend(page);
        (token, pages) = (next, pages + 1);
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(names, expected);
    assert!(pages > 1, "all of it in one page: the test asks for too little");
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn updates_at_the_same_time_lose_nothing() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    create(&mut client, request("busy")).await;
    let tasks: Vec<_> = (0..8)
        .map(|k| {
            let mut client = client.clone();
            tokio::spawn(async move {
                update(&mut client, moved("busy", vec![member(&format!("n{k}"), [1.0, f64::from(k)])])).await
            })
        })
        .collect();
    for task in tasks {
        within(task).await.unwrap();
    }
    let last = get(&mut client, "busy").await.unwrap();
    assert_eq!((last.agents.len(), last.revision), (10, 9));
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn training_episodes_are_missions_that_no_client_changes() {
    let mut learner = Learner::start().await;
    let commander = Commander::start("127.0.0.1:0", Some(&learner.url)).await;
    let mut client = commander_client(&commander.url).await;
    create(&mut client, request("mine")).await;
    let watch = v1::WatchAssignmentsRequest { source: v1::MissionSource::Training.into(), ..Default::default() };
    let mut stream = client.watch_assignments(watch).await.unwrap().into_inner();
    assert_eq!(next(&mut stream).await.0, v1::WatchKind::Synced);
    learner.collector.publish(&weights(0)).unwrap();
    let weights = weights(0);
    let key = WeightsKey { run_id: weights.run_id.clone(), version: weights.version, sha256: weights.sha256.clone() };
    for shard in plan(0, 2) {
        let message = goal_request(&task(), &shard).to_message(&key);
        // Asked twice, as an actor does that lost the answer.
        client.assign_batch(message.clone()).await.unwrap();
        client.assign_batch(message).await.unwrap();
    }
    assert_eq!(next(&mut stream).await, (v1::WatchKind::Changed, "training.run.train-0.0".into(), 1));
    let names =
        ["training.run.train-0.0", "training.run.train-0.1", "training.run.train-0.2", "training.run.train-0.3"];
    let (mut seen, mut token) = (Vec::new(), String::new());
    loop {
        let request = v1::ListAssignmentsRequest { page_size: 2, page_token: token, source: 0 };
        let (page, next) = list(&mut client, request).await;
        assert!(page.len() <= 2);
        seen.extend(page);
        token = next;
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(seen[0], "mine");
    assert_eq!(seen[1..], names);
    let only = v1::ListAssignmentsRequest { source: v1::MissionSource::Client.into(), ..Default::default() };
    assert_eq!(list(&mut client, only).await.0, ["mine"]);
    let episode = get(&mut client, names[3]).await.unwrap();
    assert_eq!((episode.source(), episode.pairs.len()), (v1::MissionSource::Training, task().agents));
    assert_eq!((episode.version, episode.sha256.as_str()), (0, weights.sha256.as_str()));
    let status = client.update_mission(moved(names[3], vec![])).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition, "{status}");
    let delete = v1::DeleteMissionRequest { mission_id: names[3].into() };
    assert_eq!(client.delete_mission(delete).await.unwrap_err().code(), Code::FailedPrecondition);
    commander.stop().await;
    learner.stop().await;
}
