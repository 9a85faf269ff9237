//! The commander for actors and for outside clients.

use crate::sandbox::*;
use magex_actor::run::ActorConfig;
use magex_learner::collector::Collector as _;
use magex_proto::goals::WeightsKey;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use tonic::transport::Channel;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
use tonic_types::StatusExt as _;

async fn connect(commander: &Commander) -> (CommanderServiceClient<Channel>, HealthClient<Channel>) {
    let channel = client::endpoint(&commander.url).unwrap().connect().await.unwrap();
    (CommanderServiceClient::new(channel.clone()), HealthClient::new(channel))
}

async fn health(client: &mut HealthClient<Channel>) -> ServingStatus {
    client.check(HealthCheckRequest { service: String::new() }).await.unwrap().into_inner().status()
}

fn positions(coordinates: &[f64]) -> Option<v1::Positions> {
    Some(v1::Positions { dims: 2, coordinates: coordinates.to_vec(), ..Default::default() })
}

#[tokio::test(flavor = "multi_thread")]
async fn an_actor_waits_for_a_commander_that_is_late() {
    let mut learner = Learner::start().await;
    let listen = free_address().await;
    let config = ActorConfig { commander_url: format!("http://{listen}"), ..config(&learner.url, "a") };
    let actor = Actor::start_with(config, FakeWorker { ask_goals: true, ..FakeWorker::default() });
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 3)).unwrap();
    until(|| learner.ledger().outstanding == 1).await;
    tokio::time::sleep(std::time::Duration::from_millis(300)).await;
    assert_eq!(learner.ledger().trained, 0);
    let commander = Commander::start(&listen, Some(&learner.url)).await;
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 3)));
    // Dead for a while, and back.
    commander.stop().await;
    learner.collector.publish(&weights(1)).unwrap();
    learner.collector.open(plan(1, 3)).unwrap();
    let commander = Commander::start(&listen, Some(&learner.url)).await;
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(1, 3)));
    assert_eq!(learner.ledger().failed, 0);
    actor.stop().await;
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_batch_waits_for_its_weights_and_is_told_when_they_do_not_come() {
    let mut learner = Learner::start().await;
    let commander = Commander::start("127.0.0.1:0", Some(&learner.url)).await;
    let (mut client, mut health_client) = connect(&commander).await;
    assert_eq!(health(&mut health_client).await, ServingStatus::NotServing);
    let shard = plan(0, 1)[0];
    let request = |version: u32| {
        let weights = weights(version);
        let key =
            WeightsKey { run_id: weights.run_id.clone(), version: weights.version, sha256: weights.sha256.clone() };
        let shard = magex_core::ids::Shard { version: weights.version, ..shard };
        goal_request(&task(), &shard).to_message(&key)
    };
    let waiting = {
        let (mut client, request) = (client.clone(), request(0));
        tokio::spawn(async move { client.assign_batch(request).await })
    };
    learner.collector.publish(&weights(0)).unwrap();
    assert_eq!(within(waiting).await.unwrap().unwrap().into_inner().version, 0);
    within(async {
        while health(&mut health_client).await != ServingStatus::Serving {
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
    assert_eq!(client.get_model(v1::GetModelRequest {}).await.unwrap().into_inner().sha256, weights(0).sha256);
    let status = within(client.assign_batch(request(9))).await.unwrap_err();
    assert_eq!(status.code(), tonic::Code::Unavailable);
    assert!(status.get_details_retry_info().is_some());
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn outside_clients_get_assignments_with_and_without_a_model() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let (mut client, mut health_client) = connect(&commander).await;
    within(async {
        while health(&mut health_client).await != ServingStatus::Serving {
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
    // The two are nearest to each other's place in the list.
    let request = v1::AssignRequest {
        agents: positions(&[0.0, 0.0, 3.0, 4.0]),
        goals: positions(&[3.0, 4.0, 0.0, 0.5]),
        agent_ids: vec!["a".into(), "b".into()],
        scheduler: v1::AssignmentMethod::Learned.into(),
        ..Default::default()
    };
    let reply = client.assign(request.clone()).await.unwrap().into_inner();
    assert_eq!(reply.scheduler(), v1::AssignmentMethod::Exact);
    assert_eq!(reply.fallback_reason, "no model is loaded");
    assert_eq!((reply.pairs[0].goal_index, reply.pairs[0].agent_id.as_str()), (1, "a"));
    assert!((reply.cost - 0.5).abs() < 1e-9 && reply.gap == Some(0.0));
    commander.stop().await;

    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(3)).unwrap();
    let commander = Commander::start("127.0.0.1:0", Some(&learner.url)).await;
    let (mut client, mut health_client) = connect(&commander).await;
    within(async {
        while health(&mut health_client).await != ServingStatus::Serving {
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
    let reply = client.assign(request.clone()).await.unwrap().into_inner();
    assert_eq!((reply.scheduler(), reply.version, reply.run_id.as_str()), (v1::AssignmentMethod::Learned, 3, "run"));
    assert_eq!((reply.pairs[0].goal_index, reply.pairs[0].probability), (0, Some(0.5)));
    assert!(reply.gap.unwrap() > 1.0 && reply.fallback_reason.is_empty());
    // What the model cannot do the exact solver does.
    let more = v1::AssignRequest { goals: positions(&[3.0, 4.0]), ..request.clone() };
    let reply = client.assign(more).await.unwrap().into_inner();
    assert_eq!((reply.scheduler(), reply.unassigned_agents.as_slice()), (v1::AssignmentMethod::Exact, &[0][..]));
    assert!(reply.fallback_reason.contains("as many goals as agents"));
    let bad = v1::AssignRequest { goals: positions(&[3.0, f64::NAN]), ..request };
    let status = client.assign(bad).await.unwrap_err();
    assert_eq!(status.get_details_bad_request().unwrap().field_violations[0].field, "goals.coordinates[1]");
    commander.stop().await;
    learner.stop().await;
}
