//! The actor's loop: connect, work, reconnect, until shutdown or the end of the run.

use crate::metrics::ActorMetrics;
use crate::rollout_pool::{PoolContext, RolloutPool};
pub use crate::session::ActorReport;
use crate::session::{self, Session, SessionEnd, UnacknowledgedResults};
use crate::weights_cache::{self, WeightsCache};
use crate::worker::{MakeWorker, WorkError};
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::{COMMANDER, LEARNER, MAX_MESSAGE_BYTES, PROTOCOL_VERSION, SERVICES, v1};
use magex_runtime::backoff::{Backoff, random_id};
use magex_runtime::client::{Channel, Settings};
use magex_runtime::exit::Failure;
use magex_runtime::metrics::Metrics;
use magex_runtime::peer::{Complaints, Remote};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// The learner answers a hello within this time, or the actor reconnects.
const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// Rollout threads have this time to end after a shutdown.
const POOL_SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);

/// Where an actor works.
#[derive(Debug, Clone)]
pub struct ActorConfig {
    /// The learner, `http://host:port`.
    pub learner_url: String,
    /// The commander, `http://host:port`.
    pub commander_url: String,
    /// The credentials and TLS settings for both.
    pub client: Settings,
    /// Name of the actor, for people.
    pub actor_id: String,
    /// Rollout threads, at least 1.
    pub threads: usize,
    /// Fingerprint of the task that the actor requires; `None` accepts the learner's.
    pub expected_task: Option<String>,
    /// Wait for another run after this one is complete.
    pub stay: bool,
    /// Cancelled when a learner has accepted the actor for the first time.
    pub accepted: CancellationToken,
}

/// Why an actor ended.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// An address is wrong.
    #[error(transparent)]
    Url(#[from] Failure),
    /// No rollout threads.
    #[error("threads: 0 is too few; use --threads 1 or more")]
    NoThreads,
    /// The learner at this address rejected this actor, for this reason.
    #[error("the learner at {0} refused: {1}")]
    Refused(String, String),
    /// The learner at this address evicted this actor process: its results are invalid, or its shards fail.
    #[error("the learner at {0} evicted this actor: {1}")]
    Evicted(String, String),
    /// An error that every shard would meet.
    #[error("this actor cannot process any shard: {0}")]
    Unusable(WorkError),
    /// A rollout thread hangs. Only a new process gets rid of it.
    #[error(
        "rollout thread {thread} has not moved for {} s although it has a shard: it hangs; this actor ends so that a new process \
         takes its place (look at that machine: a debugger, memory that cannot be paged in, processor time that is used up)",
        still.as_secs_f64()
    )]
    Stuck {
        /// Which thread.
        thread: usize,
        /// How long it has been still.
        still: Duration,
    },
    /// This build cannot work on the run of this id.
    #[error("cannot work on run '{0}': {1}")]
    Worker(String, #[source] WorkError),
}

/// Works until `shutdown`, or until the run is complete, and counts in `metrics`. An actor retries while the learner is
/// unavailable and ends when the learner rejects or evicts it.
pub async fn run(
    config: ActorConfig,
    make_worker: MakeWorker,
    metrics: Arc<Metrics>,
    shutdown: CancellationToken,
) -> Result<ActorReport, ActorError> {
    if config.threads == 0 {
        return Err(ActorError::NoThreads);
    }
    let cache = Arc::new(WeightsCache::default());
    let remote =
        |url: &str, wanted| Remote { url: url.to_owned(), settings: config.client.clone(), wanted, known: &SERVICES };
    let (learner, commander) = (remote(&config.learner_url, LEARNER), remote(&config.commander_url, COMMANDER));
    let runtime = tokio::runtime::Handle::current();
    // Two connections: results never delay weights.
    let metrics = Arc::new(ActorMetrics::new(&metrics));
    let feed = learner.channel()?;
    let feed = tokio::spawn(weights_cache::follow(feed, config.actor_id.clone(), cache.clone(), metrics.clone()));
    let context = PoolContext {
        make_worker,
        cache,
        channel: commander.channel()?,
        commander: Arc::new(commander),
        runtime,
        metrics,
    };
    let bulk = learner.channel()?;
    let mut actor = Actor {
        config,
        context,
        learner,
        bulk,
        process_id: random_id(),
        pool: None,
        unacknowledged: UnacknowledgedResults::default(),
        report: ActorReport::default(),
    };
    let end = actor.run(&shutdown).await;
    feed.abort();
    if let Some(pool) = actor.pool.take() {
        let _ = tokio::time::timeout(POOL_SHUTDOWN_TIMEOUT, pool.shut_down()).await;
    }
    end.map(|()| actor.report)
}

struct Actor {
    config: ActorConfig,
    context: PoolContext,
    learner: Remote,
    bulk: Channel,
    process_id: u64,
    pool: Option<RolloutPool>,
    unacknowledged: UnacknowledgedResults,
    report: ActorReport,
}

impl Actor {
    async fn run(&mut self, shutdown: &CancellationToken) -> Result<(), ActorError> {
        let mut backoff = Backoff::default();
        let (mut waiting, mut complaints) = (false, Complaints::default());
        loop {
            let sessions = self.report.sessions;
            let end = self.session(shutdown).await?;
            if self.report.sessions > sessions {
                (backoff, waiting, complaints) = (Backoff::default(), false, Complaints::default());
            }
            match end {
                SessionEnd::Shutdown => return Ok(()),
                SessionEnd::Finished if !self.config.stay => {
                    tracing::info!(accepted = self.report.accepted, "the run is complete");
                    return Ok(());
                }
                SessionEnd::Finished if waiting => tracing::debug!("no other run yet"),
                SessionEnd::Finished => {
                    tracing::info!("the run is complete; waiting for another");
                    waiting = true;
                }
                SessionEnd::Refused(reason) => {
                    return Err(ActorError::Refused(self.config.learner_url.clone(), reason));
                }
                SessionEnd::Evicted(reason) => {
                    return Err(ActorError::Evicted(self.config.learner_url.clone(), reason));
                }
                SessionEnd::Unusable(error) => return Err(ActorError::Unusable(error)),
                SessionEnd::Stuck(thread, still) => return Err(ActorError::Stuck { thread, still }),
                SessionEnd::Broken(reason) => self.complain(&Status::unavailable(reason), &mut complaints).await,
                SessionEnd::Failed(status) => self.complain(&status, &mut complaints).await,
            }
            let pause = tokio::time::sleep(backoff.next_wait());
            if shutdown.run_until_cancelled(pause).await.is_none() {
                return Ok(());
            }
        }
    }

    async fn complain(&self, status: &Status, complaints: &mut Complaints) {
        let problem = self.learner.explain(status).await;
        if complaints.due(&problem) {
            tracing::warn!(reason = problem.text, url = self.learner.url, "no learner; retrying");
        }
    }

    /// One connection, from hello to its end.
    async fn session(&mut self, shutdown: &CancellationToken) -> Result<SessionEnd, ActorError> {
        let (outbound, requests) = mpsc::channel(4);
        let hello = v1::RolloutRequest { message: Some(Request::Hello(self.hello())) };
        // The hello is queued before the call: the learner answers the call only after it has arrived.
        if outbound.send(hello).await.is_err() {
            return Ok(SessionEnd::Broken("the request stream closed".to_owned()));
        }
        let mut client = LearnerServiceClient::new(self.bulk.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let handshake = async {
            let mut inbound = client.rollout(ReceiverStream::new(requests)).await?.into_inner();
            let welcome = session::welcome(&mut inbound).await?;
            Ok::<_, SessionEnd>((inbound, welcome))
        };
        let handshake = tokio::time::timeout(HELLO_TIMEOUT, handshake);
        let (inbound, (welcome, lease)) = match shutdown.run_until_cancelled(handshake).await {
            None => return Ok(SessionEnd::Shutdown),
            Some(Err(_)) => return Ok(SessionEnd::Broken("the learner did not answer in time".to_owned())),
            Some(Ok(Err(end))) => return Ok(end),
            Some(Ok(Ok(accepted))) => accepted,
        };
        self.report.sessions += 1;
        let metrics = self.context.metrics.clone();
        metrics.reconnects.inc_by(u64::from(self.report.sessions > 1));
        let pool = self.pool_for(welcome, lease).await?;
        self.config.accepted.cancel();
        metrics.connected.set(1.0);
        let session =
            Session::new(self.pool.insert(pool), &mut self.unacknowledged, &mut self.report, &metrics, outbound);
        let end = session.run(inbound, shutdown).await;
        metrics.connected.set(0.0);
        Ok(end)
    }

    fn hello(&self) -> v1::Hello {
        v1::Hello {
            protocol_version: PROTOCOL_VERSION,
            actor_id: self.config.actor_id.clone(),
            process_id: self.process_id,
            task_fingerprint: self.config.expected_task.clone().unwrap_or_default(),
            threads: self.config.threads as u32,
        }
    }

    /// The pool for this run. The present pool is kept, with the shards it holds, if the run is the same.
    async fn pool_for(&mut self, welcome: v1::Welcome, lease: Duration) -> Result<RolloutPool, ActorError> {
        let run_id = welcome.run_id.clone();
        match self.pool.take() {
            Some(pool) if pool.welcome == welcome => {
                tracing::info!(run_id, "reconnected");
                return Ok(pool);
            }
            Some(old) => {
                tracing::info!(run_id, "another run; discarding the work on the previous one");
                self.unacknowledged.clear();
                drop(old.shut_down());
            }
            None => {}
        }
        let (threads, context) = (self.config.threads, self.context.clone());
        tracing::info!(run_id, threads, "joined a run");
        let started = tokio::task::spawn_blocking(move || RolloutPool::start(welcome, lease, threads, context)).await;
        let started = started.unwrap_or_else(|error| Err(WorkError::fatal(error.to_string())));
        started.map_err(|source| ActorError::Worker(run_id, source))
    }
}
