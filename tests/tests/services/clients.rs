//! Outside clients: one team, many, streams; what stands in for what, and what a stop looks like to them.

use crate::sandbox::*;
use magex_commander::scheduler::{GoalReply, GoalRequest, Scheduler, SchedulerError, TeamReply};
use magex_commander::service::ServiceConfig;
use magex_commander::weights_file::WeightsFile;
use magex_proto::v1;
use magex_proto::v1::assign_stream_response::Result as StreamResult;
use magex_runtime::{client, status};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
use tonic_types::StatusExt as _;

pub(crate) fn positions(coordinates: &[f64]) -> Option<v1::Positions> {
    Some(v1::Positions { dims: 2, coordinates: coordinates.to_vec(), ..Default::default() })
}

/// Two agents, for a model; the goal of each is nearest to the other's place in the list.
pub(crate) fn team() -> v1::AssignRequest {
    v1::AssignRequest {
        agents: positions(&[0.0, 0.0, 3.0, 4.0]),
        goals: positions(&[3.0, 4.0, 0.0, 0.5]),
        scheduler: v1::AssignmentMethod::Learned.into(),
        ..Default::default()
    }
}

fn grid(n: usize) -> Option<v1::Positions> {
    positions(&(0..2 * n).map(|k| ((k * 7919) % 1009) as f64).collect::<Vec<_>>())
}

fn pair(agent_index: u32, goal_index: u32) -> v1::PairRef {
    v1::PairRef { agent_index, goal_index, ..Default::default() }
}

fn goals(response: &v1::AssignResponse) -> Vec<u32> {
    response.pairs.iter().map(|pair| pair.goal_index).collect()
}

fn field(status: &tonic::Status) -> String {
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    status.get_details_bad_request().unwrap().field_violations[0].field.clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn every_scheduler_and_every_kind_of_cost_over_the_wire() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    for (kind, expected) in [
        (v1::AssignmentMethod::Exact, vec![1, 0]),
        (v1::AssignmentMethod::Makespan, vec![1, 0]),
        (v1::AssignmentMethod::Greedy, vec![1, 0]),
    ] {
        let reply = client.assign(v1::AssignRequest { scheduler: kind.into(), ..team() }).await.unwrap().into_inner();
        assert_eq!((reply.scheduler(), goals(&reply)), (kind, expected));
        assert_eq!((reply.largest_cost, reply.exact_cost, reply.gap), (0.5, Some(0.5), Some(0.0)));
    }
    let random = v1::AssignRequest { scheduler: v1::AssignmentMethod::Random.into(), seed: Some(3), ..team() };
    let (one, two) = (client.assign(random.clone()).await.unwrap(), client.assign(random).await.unwrap());
    assert_eq!(one.into_inner().pairs, two.into_inner().pairs);
    let exact = v1::AssignRequest { scheduler: v1::AssignmentMethod::Exact.into(), ..team() };
    let banned = v1::AssignRequest { forbidden: vec![pair(0, 1)], ..exact.clone() };
    assert_eq!(goals(client.assign(banned).await.unwrap().get_ref()), [0, 1]);
    let sticky = v1::AssignRequest { current: vec![pair(0, 0), pair(1, 1)], switching_cost: 5.0, ..exact.clone() };
    let reply = client.assign(sticky.clone()).await.unwrap().into_inner();
    assert_eq!((goals(&reply), reply.switches), (vec![0, 1], 0));
    let reply = client.assign(v1::AssignRequest { switching_cost: 4.0, ..sticky }).await.unwrap().into_inner();
    assert_eq!((goals(&reply), reply.switches), (vec![1, 0], 2));
    let matrix = v1::CostMatrix { agents: 1, goals: 3, values: vec![3.0, 1.0, 2.0] };
    let scheduler = v1::AssignmentMethod::Learned.into();
    let reply =
        client.assign(v1::AssignRequest { costs: Some(matrix), scheduler, ..Default::default() }).await.unwrap();
    let reply = reply.into_inner();
    assert_eq!((goals(&reply), reply.cost, reply.unassigned_goals.clone()), (vec![1], 1.0, vec![0, 2]));
    assert_eq!(reply.goals_without_agent[0].reason(), v1::UnassignedReason::Outnumbered);
    assert_eq!(reply.fallback_reason, "the learned scheduler supports positions only, not costs");
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn many_teams_and_streams_of_teams() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    let wrong = v1::AssignRequest { goals: positions(&[1.0, f64::NAN]), ..team() };
    let teams = vec![team(), wrong.clone()];
    let status = client.assign_many(v1::AssignManyRequest { teams }).await.unwrap_err();
    assert_eq!(field(&status), "teams[1].goals.coordinates[1]");
    assert_eq!(client.assign_many(v1::AssignManyRequest::default()).await.unwrap().into_inner().answers, []);
    // A team without goals harms no other.
    let idle = v1::AssignRequest { goals: positions(&[]), ..team() };
    let request = v1::AssignManyRequest { teams: vec![team(), idle.clone(), team()] };
    let answers = client.assign_many(request).await.unwrap().into_inner().answers;
    assert_eq!(answers.iter().map(goals).collect::<Vec<_>>(), [vec![1, 0], vec![], vec![1, 0]]);
    assert_eq!((answers[1].cost, answers[1].unassigned_agents.as_slice()), (0.0, &[0, 1][..]));
    assert_eq!(answers[1].agents_without_goal[0].reason(), v1::UnassignedReason::Outnumbered);

    let (sender, receiver) = tokio::sync::mpsc::channel(4);
    let mut answers = client.assign_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    for (sequence, team) in [(7, Some(team())), (8, Some(wrong)), (9, None), (10, Some(idle)), (11, Some(team()))] {
        sender.send(v1::AssignStreamRequest { sequence, team }).await.unwrap();
    }
    let mut seen = Vec::new();
    for _ in 0..5 {
        let answer = within(answers.message()).await.unwrap().unwrap();
        seen.push((
            answer.sequence,
            match answer.result.unwrap() {
                StreamResult::Answer(reply) => format!("{:?}", goals(&reply)),
                StreamResult::Problem(problem) => {
                    assert_eq!(problem.code, Code::InvalidArgument as u32);
                    problem.fields[0].field.clone()
                }
            },
        ));
    }
    let text: Vec<(u64, &str)> = seen.iter().map(|(k, text)| (*k, text.as_str())).collect();
    assert_eq!(text, [(7, "[1, 0]"), (8, "team.goals.coordinates[1]"), (9, "team"), (10, "[]"), (11, "[1, 0]")]);
    // The service drains: the stream ends and says why.
    commander.shutdown.cancel();
    let status = within(answers.message()).await.unwrap_err();
    assert_eq!((status.code(), status.message()), (Code::Unavailable, "the service is stopping"));
    commander.stop().await;
}

/// Holds a model back until the test lets it go on, and says when it has begun.
struct Gate {
    /// Begun, open.
    state: Mutex<(bool, bool)>,
    changed: Condvar,
}

impl Gate {
    const fn new() -> Self {
        Self { state: Mutex::new((false, false)), changed: Condvar::new() }
    }

    fn pass(&self) {
        self.state.lock().unwrap().0 = true;
        self.changed.notify_all();
        // A test that fails leaves it shut: its runtime waits for this thread.
        drop(self.changed.wait_timeout_while(self.state.lock().unwrap(), PATIENCE, |(_, open)| !*open).unwrap());
    }

    fn open(&self) {
        self.state.lock().unwrap().1 = true;
        self.changed.notify_all();
    }

    fn wait_begun(&self) -> bool {
        self.changed.wait_timeout_while(self.state.lock().unwrap(), PATIENCE, |(begun, _)| !*begun).unwrap().0.0
    }
}

/// Thinks for as long as its gate is shut.
struct SlowScheduler(&'static Gate);

impl Scheduler for SlowScheduler {
    fn assign_batch(&self, _: &GoalRequest, _: &dyn Fn() -> bool) -> Result<GoalReply, SchedulerError> {
        Err(SchedulerError::Unsupported("not for actors".into()))
    }

    fn assign_team(&self, request: &magex_dispatch::Problem) -> Result<TeamReply, SchedulerError> {
        self.0.pass();
        let goals = (0..request.agent_count as u32).map(Some).collect();
        Ok(TeamReply { goals, probabilities: None })
    }
}

static SLOW: Gate = Gate::new();
static DRAINED: Gate = Gate::new();

fn load_slow(_: &[u8], _: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    Ok(Arc::new(SlowScheduler(&SLOW)))
}

fn load_drained(_: &[u8], _: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    Ok(Arc::new(SlowScheduler(&DRAINED)))
}

/// Dies.
struct BrokenScheduler;

impl Scheduler for BrokenScheduler {
    fn assign_batch(&self, _: &GoalRequest, _: &dyn Fn() -> bool) -> Result<GoalReply, SchedulerError> {
        panic!("broken")
    }

    fn assign_team(&self, _: &magex_dispatch::Problem) -> Result<TeamReply, SchedulerError> {
        panic!("broken")
    }
}

fn load_broken(_: &[u8], _: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    Ok(Arc::new(BrokenScheduler))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_that_is_slow_or_broken_is_stood_in_for() {
    let folder = run_folder(b"weights");
    let weights = Some(WeightsFile::find(folder.path(), None).unwrap());
    let config = ServiceConfig { weights, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config.clone(), load_slow).await;
    let mut client = commander_client(&commander.url).await;
    let asked = |n, seconds| v1::AssignRequest {
        agents: grid(n),
        goals: grid(n),
        scheduler: v1::AssignmentMethod::Learned.into(),
        deadline_seconds: Some(seconds),
        ..Default::default()
    };
    for n in [2, 100] {
        for seconds in [4.0, 6.0] {
            let reply = client.assign(asked(n, seconds)).await.unwrap().into_inner();
            assert_eq!(reply.scheduler(), v1::AssignmentMethod::Exact);
            // Those that were given up still hold their processors.
            let reasons = ["the model exceeded its time limit of", "all processors are busy"];
            assert!(
                reasons.iter().any(|reason| reply.fallback_reason.starts_with(reason)),
                "{}",
                reply.fallback_reason
            );
        }
    }
    SLOW.open();
    for n in [2, 100] {
        // Processors come back one by one.
        let learned = async {
            loop {
                let reply = client.assign(asked(n, 60.0)).await.unwrap().into_inner();
                if reply.fallback_reason.is_empty() {
                    return reply;
                }
            }
        };
        let reply = within(learned).await;
        assert_eq!((reply.scheduler(), reply.version), (v1::AssignmentMethod::Learned, 0));
        assert_eq!(reply.run_id, folder.path().file_name().unwrap().to_str().unwrap());
    }
    commander.stop().await;

    // Metrics are declared once per process.
    let config = ServiceConfig { metrics: std::sync::Arc::default(), ..config };
    let commander = Commander::start_with("127.0.0.1:0", config, load_broken).await;
    let mut client = commander_client(&commander.url).await;
    let reply = client.assign(team()).await.unwrap().into_inner();
    // Where a backtrace is written it is late as well.
    assert!(reply.scheduler() == v1::AssignmentMethod::Exact && reply.fallback_reason.starts_with("the model "));
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deadline_ends_the_work_and_the_next_caller_does_not_notice() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await.max_encoding_message_size(64 << 20);
    // Product costs make the exact solver's paths as long as they get.
    let n = 1200u32;
    let values = (0..n * n).map(|k| f64::from((k / n + 1) * (k % n + 1))).collect();
    let costs = Some(v1::CostMatrix { agents: n, goals: n, values });
    let scheduler = v1::AssignmentMethod::Exact.into();
    let hard = v1::AssignRequest { costs, scheduler, deadline_seconds: Some(0.05), ..Default::default() };
    let start = Instant::now();
    let status = client.assign(hard).await.unwrap_err();
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    assert!(start.elapsed() < Duration::from_secs(20));
    let reply = within(client.assign(v1::AssignRequest { scheduler, ..team() })).await.unwrap();
    assert_eq!(goals(reply.get_ref()), [1, 0]);
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_drains_says_so_and_finishes_what_it_has_begun() {
    let folder = run_folder(b"weights");
    let weights = Some(WeightsFile::find(folder.path(), None).unwrap());
    let config = ServiceConfig { weights, drain: Duration::from_secs(5), ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_drained).await;
    let mut client = commander_client(&commander.url).await;
    let mut health = HealthClient::new(client::endpoint(&commander.url).unwrap().connect().await.unwrap());
    let mut ask = async || {
        let request = HealthCheckRequest { service: "magex.v1.CommanderService".into() };
        health.check(request).await.unwrap().into_inner().status()
    };
    within(async { while ask().await != ServingStatus::Serving {} }).await;
    let begun = {
        let mut client = client.clone();
        let patient = v1::AssignRequest { deadline_seconds: Some(60.0), ..team() };
        tokio::spawn(async move { client.assign(patient).await })
    };
    assert!(tokio::task::spawn_blocking(|| DRAINED.wait_begun()).await.unwrap());
    commander.shutdown.cancel();
    within(async { while ask().await != ServingStatus::NotServing {} }).await;
    let refused = client.assign(team()).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    assert!(status::retry_delay(&refused).is_some());
    DRAINED.open();
    assert_eq!(within(begun).await.unwrap().unwrap().into_inner().scheduler(), v1::AssignmentMethod::Learned);
    commander.stop().await;
}
