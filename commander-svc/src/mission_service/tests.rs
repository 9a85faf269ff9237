use super::*;
use crate::metrics::CommanderMetrics;
use crate::model_store::ModelStore;
use magex_dispatch::disk::DiskError;
use magex_dispatch::missions::Bounds;
use magex_runtime::metrics::Metrics;
use std::future::Future;
use std::task::{Context, Waker};
use std::time::Duration;
use tonic::Code;

fn keeper() -> Arc<MissionService> {
    let gauges = Arc::new(CommanderMetrics::new(&Metrics::new()));
    let answering = AssignService::new(Arc::new(ModelStore::new()), gauges);
    MissionService::new(Missions::open(None, Bounds::default()).unwrap(), answering)
}

fn client(name: &str) -> Caller {
    Caller { name: name.into(), role: Role::Client }
}

fn members(side: &str, count: usize) -> Vec<v1::Member> {
    // Far from regular: the solver has something to do.
    let position = |k: usize| vec![(k * 7919 % 1009) as f64, (k * k % 997) as f64];
    (0..count).map(|k| v1::Member { id: format!("{side}{k}"), position: position(k), ..Default::default() }).collect()
}

fn request(id: &str, agents: usize, goals: usize) -> v1::CreateMissionRequest {
    let (agents, goals) = (members("a", agents), members("g", goals));
    v1::CreateMissionRequest { mission_id: id.into(), agents, goals, ..Default::default() }
}

fn budget() -> CallBudget {
    CallBudget::start(None)
}

async fn all_processors(keeper: &MissionService) -> Vec<crate::assign_service::Places> {
    let mut taken = Vec::new();
    while keeper.answering.processors.available_permits() > 0 {
        taken.push(keeper.answering.places(1, budget().left()).await.unwrap());
    }
    taken
}

#[tokio::test]
async fn the_smallest_mission_waits_for_a_processor_too() {
    let keeper = keeper();
    let (me, tiny) = (client("me"), request("m", 1, 1));
    keeper.create(me.clone(), tiny.clone(), budget()).await.unwrap();
    let taken = all_processors(&keeper).await;
    let update = v1::UpdateMissionRequest { mission_id: "m".into(), ..Default::default() };
    let (created, updated) = tokio::join!(
        keeper.create(me.clone(), v1::CreateMissionRequest { mission_id: "n".into(), ..tiny }, budget()),
        keeper.update(me.clone(), update.clone(), budget())
    );
    assert_eq!(
        (created.unwrap_err().code(), updated.unwrap_err().code()),
        (Code::ResourceExhausted, Code::ResourceExhausted)
    );
    drop(taken);
    assert_eq!(keeper.update(me, update, budget()).await.unwrap().revision, 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_planned_or_written_for_a_cancelled_call() {
    let keeper = keeper();
    keeper.create(client("me"), request("old", 1, 1), budget()).await.unwrap();
    let processors = keeper.answering.processors.available_permits();
    let large = request("new", 1000, 1000);
    let update = v1::UpdateMissionRequest {
        mission_id: "old".into(),
        agents: large.agents.clone(),
        goals: large.goals.clone(),
        ..Default::default()
    };
    let calls: [std::pin::Pin<Box<dyn Future<Output = _> + Send>>; 2] = [
        Box::pin(keeper.create(client("me"), large, budget())),
        Box::pin(keeper.update(client("me"), update, budget())),
    ];
    for mut call in calls {
        // The work is on its thread; then the caller cancels, or its deadline passes.
        assert!(call.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
        drop(call);
        while keeper.answering.processors.available_permits() < processors {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        assert_eq!(keeper.missions.count(), 1);
        assert_eq!(keeper.get(&client("me"), "old").unwrap().revision, 1);
    }
}

#[tokio::test]
async fn a_mission_of_another_client_looks_like_a_missing_one() {
    let keeper = keeper();
    keeper.create(client("me"), request("mine", 1, 1), budget()).await.unwrap();
    let you = client("you");
    // Also while no processor is free.
    let _taken = all_processors(&keeper).await;
    let said = |status: Status, id: &str| (status.code(), status.message().replace(id, "ID"));
    let update = |id: &str| v1::UpdateMissionRequest { mission_id: id.into(), ..Default::default() };
    let none = said(keeper.get(&you, "none").unwrap_err(), "none");
    assert_eq!(none.0, Code::NotFound);
    for id in ["mine", "none"] {
        assert_eq!(said(keeper.get(&you, id).unwrap_err(), id), none);
        assert_eq!(said(keeper.delete(you.clone(), id.into()).await.unwrap_err(), id), none);
        assert_eq!(said(keeper.update(you.clone(), update(id), budget()).await.unwrap_err(), id), none);
    }
    keeper.delete(client("me"), "mine".into()).await.unwrap();
    assert_eq!(keeper.missions.count(), 0);
}

#[test]
fn a_failed_write_is_unavailable_with_a_retry_delay() {
    let status = to_status(KeepError::Disk(DiskError::Paused));
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status::retry_delay(&status).is_some() && status.message().contains("free space"), "{status}");
}

#[test]
fn the_learned_scheduler_reserves_memory_for_the_square_of_the_larger_side() {
    let keeper = keeper();
    assert_eq!(keeper.cells((0, 0), (900, 1), false), 900);
    assert_eq!(keeper.cells((0, 0), (900, 1), true), 810_000);
}
