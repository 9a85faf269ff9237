//! A learner, a commander and actors in this process, and an actor that a test plays itself.

use bytes::Bytes;
use magex_actor::goal_client::{GoalRequest, GrpcGoals};
use magex_actor::run::{ActorConfig, ActorError, ActorReport};
use magex_actor::worker::{MakeWorker, WorkError, Worker};
use magex_assign::{cost_of_points, exact_points};
use magex_commander::scheduler::{GoalReply, LoadScheduler, Scheduler, SchedulerError, TeamReply};
use magex_commander::service::ServiceConfig;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{COST_RATIO, METRICS, REWARD};
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, ShardResult, Trajectory};
use magex_learner::collector::Collector;
use magex_learner::run_events::CollectError;
use magex_learner::run_identity::RunIdentity;
use magex_learner::serve::grpc_collector::GrpcCollector;
use magex_learner::serve::service::{LearnerHandle, learner_service};
use magex_learner::serve::validate::Limits;
use magex_proto::convert::encode_result;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::weights::Weights;
use magex_proto::{PROTOCOL_VERSION, parts, v1};
use magex_runtime::net::connections::ConnectionLimits;
use magex_runtime::security::Security;
use magex_runtime::{client, server};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use tonic::{Status, Streaming};

/// Long enough for anything that is going to happen at all.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) const SEED: u64 = 7;

pub(crate) fn task() -> TaskConfig {
    TaskConfig { horizon: 3, ..TaskConfig::simple_spread(5, Spawn::Uniform) }
}

pub(crate) fn weights(version: u32) -> Arc<Weights> {
    let bytes = Bytes::from(version.to_le_bytes().to_vec());
    Arc::new(Weights::new(RunId("run".into()), WeightsVersion(version), bytes))
}

pub(crate) fn plan(iteration: u32, shards: u32) -> Vec<Shard> {
    let shard = |index| Shard {
        kind: ShardKind::Train,
        iteration: Iteration(iteration),
        index,
        episodes: 2,
        first_episode: 2 * index,
        version: WeightsVersion(iteration),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    };
    (0..shards).map(shard).collect()
}

/// The result of a shard: the same from every actor.
pub(crate) fn result_of(task: &TaskConfig, shard: &Shard, weights: &[u8]) -> ShardResult {
    let (t, b, n) = (task.horizon as usize, shard.episodes as usize, task.agents);
    let shape = task.shape(b);
    let tag = weights.iter().map(|&byte| u32::from(byte)).sum();
    let mut stream = Key::new(SEED, Purpose::Action, &[shard.iteration.0, shard.index, tag]).stream();
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| stream.uniform32()).collect() };
    let (positions, velocities) = (numbers((t + 1) * b * n * 2), numbers((t + 1) * b * n * 2));
    let (landmarks, rewards) = (numbers(b * n * 2), numbers(t * b * n));
    let in_order: Vec<u32> = (0..n as u32).collect();
    let sides = |e: usize| (&positions[e * n * 2..(e + 1) * n * 2], &landmarks[e * n * 2..(e + 1) * n * 2]);
    let cost = |e| cost_of_points(sides(e).0, sides(e).1, 2, &in_order) as f32;
    let exact = |e| exact_points(sides(e).0, sides(e).1, 2).unwrap().1 as f32;
    let (costs, exact_costs): (Vec<f32>, Vec<f32>) = (0..b).map(|e| (cost(e), exact(e))).unzip();
    let metrics = |e: usize| {
        // A value that every metric may have.
        let mut metrics = EpisodeMetrics([1.0; METRICS.len()]);
        let row = |step: usize| &rewards[(step * b + e) * n..(step * b + e + 1) * n];
        metrics[REWARD] = (0..t).flat_map(row).sum::<f32>() / (t * n) as f32;
        metrics[COST_RATIO] = costs[e] / exact_costs[e];
        metrics
    };
    ShardResult::Train(Trajectory {
        shard: *shard,
        shape,
        metrics: (0..b).map(metrics).collect(),
        positions,
        velocities,
        agent_state: vec![],
        statics: Statics::landmarks(n, 2, landmarks),
        goals: (0..b * n).map(|i| (i % n) as u32).collect(),
        actions: vec![1; t * b * n],
        log_probs: vec![-1.0; t * b * n],
        rewards,
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: vec![-1.0; b],
        costs,
        exact_costs,
    })
}

pub(crate) fn expected(shards: &[Shard]) -> Vec<ShardResult> {
    shards.iter().map(|shard| result_of(&task(), shard, &weights(shard.version.0).bytes)).collect()
}

pub(crate) struct Learner {
    pub(crate) url: String,
    pub(crate) address: std::net::SocketAddr,
    pub(crate) handle: LearnerHandle,
    pub(crate) collector: GrpcCollector,
    pub(crate) shutdown: CancellationToken,
    pub(crate) serving: JoinHandle<()>,
}

pub(crate) struct LearnerOptions {
    pub(crate) listen: String,
    pub(crate) lease: Duration,
    pub(crate) max_actors: usize,
    pub(crate) max_watchers: usize,
    pub(crate) task: TaskConfig,
    pub(crate) max_episodes: usize,
    pub(crate) security: Security,
    pub(crate) heartbeat: Option<Duration>,
}

impl Default for LearnerOptions {
    fn default() -> Self {
        let lease = Duration::from_secs(15);
        let security = Security::default();
        Self {
            listen: "127.0.0.1:0".into(),
            lease,
            max_actors: 8,
            max_watchers: 64,
            task: task(),
            max_episodes: 2,
            security,
            heartbeat: None,
        }
    }
}

impl Learner {
    pub(crate) async fn start() -> Self {
        Self::start_with(LearnerOptions::default()).await
    }

    pub(crate) async fn start_with(options: LearnerOptions) -> Self {
        let run = RunIdentity {
            run_id: RunId("run".into()),
            name: "test".into(),
            task_fingerprint: options.task.fingerprint(),
            run_config_toml: "name = \"test\"".into(),
            seed: SEED,
            lease: options.lease,
        };
        let limits = Limits {
            max_actors: options.max_actors,
            max_watchers: options.max_watchers,
            ..Limits::for_task(&options.task, options.max_episodes)
        };
        let (handle, collector) = learner_service(run, limits);
        let (incoming, address) = server::bind(&options.listen).await.unwrap();
        let shutdown = CancellationToken::new();
        let handle = handle.beating(options.heartbeat);
        let (served, token) = (handle.clone().guarded(options.security), shutdown.clone());
        let serving = tokio::spawn(async move { served.serve(incoming, token).await.unwrap() });
        Self { url: format!("http://{address}"), address, handle, collector, shutdown, serving }
    }

    /// Publishes version k and collects the plan of iteration k.
    pub(crate) async fn iterate(&mut self, iteration: u32, shards: u32) -> Result<Vec<ShardResult>, CollectError> {
        self.collector.publish(&weights(iteration)).unwrap();
        self.collector.open(plan(iteration, shards)).unwrap();
        self.finish().await
    }

    /// Waits for the open plan without blocking the runtime. A thread that waits cannot be told that it waits in vain;
    /// the learner can.
    pub(crate) async fn finish(&mut self) -> Result<Vec<ShardResult>, CollectError> {
        let shutdown = self.shutdown.clone();
        let patience = tokio::spawn(async move {
            tokio::time::sleep(PATIENCE).await;
            shutdown.cancel();
        });
        let result = tokio::task::block_in_place(|| self.collector.wait());
        assert!(!patience.is_finished(), "this should have happened long ago: {result:?}");
        patience.abort();
        result
    }

    pub(crate) fn ledger(&self) -> v1::LedgerStatus {
        self.handle.status().ledger.unwrap()
    }

    pub(crate) async fn stop(self) {
        self.shutdown.cancel();
        within(self.serving).await.unwrap();
    }
}

pub(crate) async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("this should have happened long ago")
}

/// Waits for something to become true.
pub(crate) async fn until(mut holds: impl FnMut() -> bool) {
    within(async {
        while !holds() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

/// Whether a shard fails.
pub(crate) type Verdict = fn(&Shard) -> Result<(), WorkError>;

/// A worker that knows the answers.
#[derive(Clone)]
pub(crate) struct FakeWorker {
    pub(crate) task: TaskConfig,
    pub(crate) delay: Duration,
    pub(crate) ask_goals: bool,
    /// Works only once this is cancelled.
    pub(crate) gate: Option<CancellationToken>,
    pub(crate) fail: Option<Verdict>,
}

impl Default for FakeWorker {
    fn default() -> Self {
        Self { task: task(), delay: Duration::ZERO, ask_goals: false, gate: None, fail: None }
    }
}

impl FakeWorker {
    pub(crate) fn maker(self) -> MakeWorker {
        Arc::new(move |_| Ok(Box::new(self.clone())))
    }
}

pub(crate) fn goal_request(task: &TaskConfig, shard: &Shard) -> GoalRequest {
    let (b, n) = (shard.episodes as usize, task.agents);
    let points: Vec<f32> = (0..b * n * 2).map(|i| i as f32).collect();
    let (shard, agents, goals) = (*shard, points.clone(), points);
    GoalRequest { shard, seed: SEED, stages: 1, agent_count: n, goal_count: n, dims: 2, agents, goals }
}

impl Worker for FakeWorker {
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError> {
        if let Some(fail) = self.fail {
            fail(shard)?;
        }
        if self.ask_goals {
            goals.assign(&goal_request(&self.task, shard))?;
        }
        while self.gate.as_ref().is_some_and(|gate| !gate.is_cancelled()) {
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(self.delay);
        Ok(result_of(&self.task, shard, &weights.bytes))
    }
}

pub(crate) struct Actor {
    pub(crate) shutdown: CancellationToken,
    pub(crate) running: JoinHandle<Result<ActorReport, ActorError>>,
}

impl Actor {
    pub(crate) fn start(learner_url: &str, name: &str, worker: FakeWorker) -> Self {
        Self::start_with(config(learner_url, name), worker)
    }

    pub(crate) fn start_with(config: ActorConfig, worker: FakeWorker) -> Self {
        Self::start_maker(config, worker.maker())
    }

    pub(crate) fn start_maker(config: ActorConfig, maker: MakeWorker) -> Self {
        let shutdown = CancellationToken::new();
        let running = tokio::spawn(magex_actor::run::run(config, maker, Arc::default(), shutdown.clone()));
        Self { shutdown, running }
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.running.is_finished()
    }

    pub(crate) async fn stop(self) -> ActorReport {
        self.shutdown.cancel();
        self.end().await.unwrap()
    }

    pub(crate) async fn end(self) -> Result<ActorReport, ActorError> {
        within(self.running).await.unwrap()
    }
}

pub(crate) fn config(learner_url: &str, name: &str) -> ActorConfig {
    ActorConfig {
        learner_url: learner_url.into(),
        commander_url: "http://127.0.0.1:9".into(),
        client: client::Settings::default(),
        actor_id: name.into(),
        threads: 1,
        expected_task: None,
        stay: false,
        accepted: tokio_util::sync::CancellationToken::new(),
    }
}

/// An actor played by the test, message by message.
pub(crate) struct Puppet {
    pub(crate) say: mpsc::Sender<v1::RolloutRequest>,
    pub(crate) hear: Streaming<v1::RolloutResponse>,
}

impl Puppet {
    pub(crate) fn hello() -> v1::Hello {
        v1::Hello { protocol_version: PROTOCOL_VERSION, actor_id: "puppet".into(), threads: 1, ..Default::default() }
    }

    /// Connects and says hello; the welcome is still to be heard.
    pub(crate) async fn connect(url: &str, hello: v1::Hello) -> Result<Self, Status> {
        let mut client = learner_client(url).await;
        let (say, requests) = mpsc::channel(64);
        say.send(v1::RolloutRequest { message: Some(Request::Hello(hello)) }).await.unwrap();
        let hear = within(client.rollout(ReceiverStream::new(requests))).await?.into_inner();
        Ok(Self { say, hear })
    }

    /// Connects, is welcomed, and asks for work.
    pub(crate) async fn ready(url: &str, process_id: u64, credit: u32) -> Self {
        let mut puppet = Self::connect(url, v1::Hello { process_id, ..Self::hello() }).await.unwrap();
        assert!(matches!(puppet.next().await, Ok(Response::Welcome(_))));
        puppet.send(Request::Ready(v1::Ready { credit })).await;
        puppet
    }

    pub(crate) async fn send(&self, message: Request) {
        self.say.send(v1::RolloutRequest { message: Some(message) }).await.unwrap();
    }

    pub(crate) async fn next(&mut self) -> Result<Response, Status> {
        let message = within(self.hear.message()).await?;
        Ok(message.ok_or_else(|| Status::unknown("the stream ended"))?.message.unwrap())
    }

    pub(crate) async fn lease(&mut self) -> (u64, Shard) {
        match self.next().await.unwrap() {
            Response::Lease(lease) => (lease.lease_id, Shard::try_from(&lease.shard.unwrap()).unwrap()),
            other => panic!("a lease was due, not {other:?}"),
        }
    }

    pub(crate) async fn ack(&mut self) -> v1::Ack {
        match self.next().await.unwrap() {
            Response::Ack(ack) => ack,
            other => panic!("an ack was due, not {other:?}"),
        }
    }

    /// Sends a result, changed by the test, and returns its ack.
    pub(crate) async fn deliver(&mut self, lease_id: u64, result: &ShardResult) -> v1::Ack {
        let sha = weights(result.shard().version.0).sha256.clone();
        self.send_bytes(lease_id, encode_result(&RunId("run".into()), &sha, result)).await;
        self.ack().await
    }

    pub(crate) async fn send_bytes(&self, lease_id: u64, bytes: Bytes) {
        for part in parts::split(bytes) {
            self.send(Request::Part(v1::ResultPart { lease_id, part: Some(part), timing: None })).await;
        }
    }
}

pub(crate) async fn learner_client(url: &str) -> LearnerServiceClient<Channel> {
    LearnerServiceClient::new(client::endpoint(url).unwrap().connect().await.unwrap())
}

/// Assigns goal i to agent i, and notes which weights answer.
pub(crate) struct FakeScheduler;

impl Scheduler for FakeScheduler {
    fn assign_batch(&self, request: &GoalRequest, _: &dyn Fn() -> bool) -> Result<GoalReply, SchedulerError> {
        let b = request.shard.episodes as usize * request.stages;
        let n = request.agent_count as u32;
        let goals = (0..b).flat_map(|_| 0..n).collect();
        Ok(GoalReply { goals, log_probs: vec![-1.0; b], costs: vec![2.0; b], exact_costs: vec![1.0; b] })
    }

    fn assign_team(&self, request: &magex_dispatch::Problem) -> Result<TeamReply, SchedulerError> {
        if request.agent_count != request.goal_count {
            return Err(SchedulerError::Unsupported("as many goals as agents are needed".into()));
        }
        let n = request.agent_count as u32;
        Ok(TeamReply { goals: (0..n).map(Some).collect(), probabilities: Some(vec![0.5; n as usize]) })
    }
}

pub(crate) fn load_fake(bytes: &[u8], _config: &str) -> Result<Arc<dyn Scheduler>, SchedulerError> {
    if bytes.is_empty() {
        return Err(SchedulerError::Load("no weights in there".into()));
    }
    Ok(Arc::new(FakeScheduler))
}

pub(crate) struct Commander {
    pub(crate) url: String,
    pub(crate) shutdown: CancellationToken,
    pub(crate) serving: JoinHandle<()>,
}

impl Commander {
    pub(crate) async fn start(listen: &str, learner_url: Option<&str>) -> Self {
        let learner_url = learner_url.map(Into::into);
        Self::start_with(listen, ServiceConfig { learner_url, ..ServiceConfig::default() }, load_fake).await
    }

    pub(crate) async fn start_with(listen: &str, config: ServiceConfig, load: LoadScheduler) -> Self {
        let (incoming, address) = server::bind(listen).await.unwrap();
        let shutdown = CancellationToken::new();
        let run = magex_commander::service::run(config, load, incoming, shutdown.clone());
        let serving = tokio::spawn(async move { run.await.unwrap() });
        Self { url: format!("http://{address}"), shutdown, serving }
    }

    /// With a limited number of connections.
    pub(crate) async fn start_within(limits: ConnectionLimits, config: ServiceConfig) -> Self {
        let (incoming, address) = server::bind("127.0.0.1:0").await.unwrap();
        let shutdown = CancellationToken::new();
        let run = magex_commander::service::run(config, load_fake, incoming.within(limits), shutdown.clone());
        let serving = tokio::spawn(async move { run.await.unwrap() });
        Self { url: format!("http://{address}"), shutdown, serving }
    }

    pub(crate) async fn stop(self) {
        self.shutdown.cancel();
        within(self.serving).await.unwrap();
    }
}

/// A run folder with these bytes as weights.
pub(crate) fn run_folder(bytes: &[u8]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("weights.safetensors"), bytes).unwrap();
    std::fs::write(folder.path().join("config.toml"), "").unwrap();
    folder
}

/// A client of a commander.
pub(crate) async fn commander_client(url: &str) -> CommanderServiceClient<Channel> {
    CommanderServiceClient::new(client::endpoint(url).unwrap().connect().await.unwrap())
}

/// A free address of this machine: no process listens on it for now.
pub(crate) async fn free_address() -> String {
    server::bind("127.0.0.1:0").await.unwrap().1.to_string()
}
