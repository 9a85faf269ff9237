//! New weights under load: every answer comes from one version, and says which.

use crate::clients::positions;
use crate::sandbox::*;
use magex_commander::scheduler::{GoalReply, GoalRequest, Scheduler, SchedulerError, TeamReply};
use magex_commander::service::ServiceConfig;
use magex_commander::weights_file::WeightsFile;
use magex_learner::collector::Collector as _;
use magex_proto::v1;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Answers with its version: agent 0 gets goal version mod 8, with the probability version / 2^20.
struct Numbered(u32);

impl Scheduler for Numbered {
    fn assign_batch(&self, _: &GoalRequest, _: &dyn Fn() -> bool) -> Result<GoalReply, SchedulerError> {
        Err(SchedulerError::Unsupported("not for actors".into()))
    }

    fn assign_team(&self, request: &magex_dispatch::Problem) -> Result<TeamReply, SchedulerError> {
        let n = request.agent_count as u32;
        // The version is read again and again: a torn one would show.
        let goals = (0..n).map(|agent| Some((agent + self.0) % n)).collect();
        let probabilities = (0..n).map(|_| self.0 as f32 / f32::from(1u16 << 15) / 32.0).collect();
        Ok(TeamReply { goals, probabilities: Some(probabilities) })
    }
}

fn load_numbered(bytes: &[u8], _: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    let bytes = bytes.try_into().map_err(|_| SchedulerError::Load("four bytes are needed".into()))?;
    Ok(Arc::new(Numbered(u32::from_le_bytes(bytes))))
}

fn octet() -> v1::AssignRequest {
    let points: Vec<f64> = (0..16).map(f64::from).collect();
    // So much time that a stall of this machine does not bring in the exact scheduler.
    let deadline_seconds = Some(30.0);
    let scheduler = v1::AssignmentMethod::Learned.into();
    v1::AssignRequest {
        agents: positions(&points),
        goals: positions(&points),
        scheduler,
        deadline_seconds,
        ..Default::default()
    }
}

/// The one version that an answer shows in everything it says.
fn version(reply: &v1::AssignResponse) -> u32 {
    assert_eq!(reply.scheduler(), v1::AssignmentMethod::Learned, "{}", reply.fallback_reason);
    for pair in &reply.pairs {
        assert_eq!(pair.goal_index, (pair.agent_index + reply.version) % 8, "version {}", reply.version);
        assert_eq!(pair.probability, Some(reply.version as f32 / 1_048_576.0));
    }
    assert_eq!(reply.sha256, weights(reply.version).sha256);
    reply.version
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_thousand_swaps_under_load_and_every_answer_is_of_one_version() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(1)).unwrap();
    let config = ServiceConfig { learner_url: Some(learner.url.clone()), ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_numbered).await;
    let mut client = commander_client(&commander.url).await;
    within(async { while !client.get_model(v1::GetModelRequest {}).await.unwrap().into_inner().ready {} }).await;
    // The first answer tells the service how fast the model is.
    assert_eq!(version(client.assign(octet()).await.unwrap().get_ref()), 1);
    let (stop, answers) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let load: Vec<_> = (0..3)
        .map(|_| {
            let (mut client, stop, answers) = (client.clone(), stop.clone(), answers.clone());
            tokio::spawn(async move {
                let mut newest = 0;
                while !stop.load(Ordering::Relaxed) {
                    let now = version(client.assign(octet()).await.unwrap().get_ref());
                    assert!(now >= newest, "version {now} after {newest}");
                    newest = now;
                    answers.fetch_add(1, Ordering::Relaxed);
                }
            })
        })
        .collect();
    for next in 2..=1001 {
        learner.collector.publish(&weights(next)).unwrap();
        within(async { while client.get_model(v1::GetModelRequest {}).await.unwrap().into_inner().version != next {} })
            .await;
    }
    stop.store(true, Ordering::Relaxed);
    for task in load {
        within(task).await.unwrap();
    }
    assert!(answers.load(Ordering::Relaxed) > 100);
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_that_is_replaced_is_the_next_version_and_a_broken_one_is_not() {
    let folder = run_folder(&0u32.to_le_bytes());
    let file = WeightsFile::find(folder.path(), None).unwrap();
    let config = ServiceConfig { weights: Some(file), ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_numbered).await;
    let mut client = commander_client(&commander.url).await;
    assert_eq!(version(client.assign(octet()).await.unwrap().get_ref()), 0);
    std::fs::write(folder.path().join("weights.safetensors"), b"broken").unwrap();
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert_eq!(version(client.assign(octet()).await.unwrap().get_ref()), 0);
    let next = folder.path().join("next");
    std::fs::write(&next, 1u32.to_le_bytes()).unwrap();
    std::fs::rename(next, folder.path().join("weights.safetensors")).unwrap();
    within(async { while version(client.assign(octet()).await.unwrap().get_ref()) != 1 {} }).await;
    commander.stop().await;
    assert!(WeightsFile::find(&folder.path().join("nothing"), None).is_err());
}
