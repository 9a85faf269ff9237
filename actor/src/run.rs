//! The actor: connects, works, connects again, until told to stop or the run is complete.

use crate::cache::WeightsCache;
use crate::crew::{Crew, Tools};
use crate::gauges::ActorGauges;
pub use crate::link::ActorReport;
use crate::link::{self, End, Link, Unsettled};
use crate::weights_feed;
use crate::worker::{MakeWorker, Welcome, WorkError};
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::{MAX_MESSAGE_BYTES, PROTOCOL_VERSION, v1};
use magex_runtime::backoff::{Backoff, incarnation};
use magex_runtime::client::{Channel, Settings, UrlError};
use magex_runtime::metrics::Metrics;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

/// The learner answers a hello within this time, or the connection is made anew.
const HELLO_TIMEOUT: Duration = Duration::from_secs(10);

/// Rollout threads may finish what they do within this time after the actor was told to stop.
const DISMISS_TIMEOUT: Duration = Duration::from_secs(3);

/// Where an actor works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActorConfig {
    /// The learner, `http://host:port`.
    pub learner_url: String,
    /// The commander, `http://host:port`.
    pub commander_url: String,
    /// What both are shown.
    pub client: Settings,
    /// Name of the actor, for people.
    pub actor_id: String,
    /// Rollout threads, at least 1.
    pub threads: usize,
    /// Fingerprint of the task that the actor insists on; `None` takes the learner's.
    pub expected_task: Option<String>,
    /// Keep waiting for another run after this one is complete.
    pub stay: bool,
}

/// Why an actor gave up.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// An address is wrong.
    #[error(transparent)]
    Url(#[from] UrlError),
    /// No rollout threads.
    #[error("threads: 0 rollout threads do nothing; use --threads 1 or more")]
    NoThreads,
    /// The learner does not want this actor.
    #[error("the learner at {url} refused: {reason}")]
    Refused {
        /// Address of the learner.
        url: String,
        /// What it said.
        reason: String,
    },
    /// The learner cannot use what this actor computes.
    #[error("the learner at {url} sent this actor away: {reason}")]
    SentAway {
        /// Address of the learner.
        url: String,
        /// What it said.
        reason: String,
    },
    /// No shard can be done here.
    #[error("this actor can do no shard: {0}")]
    Useless(WorkError),
    /// The run's work cannot be done here.
    #[error("cannot work on run '{run_id}': {source}")]
    Worker {
        /// The run.
        run_id: String,
        /// What is missing.
        source: WorkError,
    },
}

/// Works until `shutdown`, or until the run is complete. A learner that is late or away is waited for; one that refuses
/// the actor ends it.
pub async fn run(
    config: ActorConfig,
    make_worker: MakeWorker,
    shutdown: CancellationToken,
) -> Result<ActorReport, ActorError> {
    run_watched(config, make_worker, &Metrics::new(), shutdown).await
}

/// [`run`], counting what it does.
pub async fn run_watched(
    config: ActorConfig,
    make_worker: MakeWorker,
    metrics: &Metrics,
    shutdown: CancellationToken,
) -> Result<ActorReport, ActorError> {
    if config.threads == 0 {
        return Err(ActorError::NoThreads);
    }
    let cache = Arc::new(WeightsCache::default());
    let commander = config.client.lazy_channel(&config.commander_url)?;
    let runtime = tokio::runtime::Handle::current();
    // Two connections: results on the one never delay weights on the other.
    let gauges = Arc::new(ActorGauges::new(metrics));
    let feed = config.client.lazy_channel(&config.learner_url)?;
    let feed = weights_feed::follow(feed, config.actor_id.clone(), cache.clone(), gauges.clone());
    let feed = tokio::spawn(feed);
    let tools = Tools { make_worker, cache, commander, runtime, gauges };
    let bulk = config.client.lazy_channel(&config.learner_url)?;
    let mut actor = Actor {
        config,
        tools,
        bulk,
        incarnation: incarnation(),
        crew: None,
        unsettled: Unsettled::default(),
        report: ActorReport::default(),
    };
    let end = actor.work(&shutdown).await;
    feed.abort();
    if let Some(crew) = actor.crew.take() {
        let _ = tokio::time::timeout(DISMISS_TIMEOUT, crew.dismiss()).await;
    }
    end.map(|()| actor.report)
}

struct Actor {
    config: ActorConfig,
    tools: Tools,
    bulk: Channel,
    incarnation: u64,
    crew: Option<Crew>,
    unsettled: Unsettled,
    report: ActorReport,
}

impl Actor {
    async fn work(&mut self, shutdown: &CancellationToken) -> Result<(), ActorError> {
        let mut backoff = Backoff::default();
        let mut waiting = false;
        loop {
            let sessions = self.report.sessions;
            let end = self.session(shutdown).await?;
            if self.report.sessions > sessions {
                (backoff, waiting) = (Backoff::default(), false);
            }
            match end {
                End::Shutdown => return Ok(()),
                End::Finished if !self.config.stay => {
                    tracing::info!(accepted = self.report.accepted, "the run is complete");
                    return Ok(());
                }
                End::Finished if waiting => tracing::debug!("no other run yet"),
                End::Finished => {
                    tracing::info!("the run is complete; waiting for another");
                    waiting = true;
                }
                End::Refused(reason) => {
                    return Err(ActorError::Refused { url: self.config.learner_url.clone(), reason });
                }
                End::SentAway(reason) => {
                    return Err(ActorError::SentAway { url: self.config.learner_url.clone(), reason });
                }
                End::Useless(error) => return Err(ActorError::Useless(error)),
                End::Broken(reason) if waiting => tracing::debug!(reason, "no learner yet"),
                End::Broken(reason) => {
                    tracing::warn!(
                        reason,
                        url = self.config.learner_url,
                        "no learner; trying again until there is one"
                    );
                    waiting = true;
                }
            }
            let pause = tokio::time::sleep(backoff.next_wait());
            if shutdown.run_until_cancelled(pause).await.is_none() {
                return Ok(());
            }
        }
    }

    /// One connection, from hello to its end.
    async fn session(&mut self, shutdown: &CancellationToken) -> Result<End, ActorError> {
        let (outbound, requests) = mpsc::channel(4);
        let hello = v1::RolloutRequest { message: Some(Request::Hello(self.hello())) };
        // The first message must be there before the call: its answer comes only after it.
        if outbound.send(hello).await.is_err() {
            return Ok(End::Broken("the request stream closed".to_owned()));
        }
        let mut client = LearnerServiceClient::new(self.bulk.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let greeting = async {
            let mut inbound = client.rollout(ReceiverStream::new(requests)).await?.into_inner();
            let welcome = link::welcome(&mut inbound).await?;
            Ok::<_, End>((inbound, welcome))
        };
        let greeting = tokio::time::timeout(HELLO_TIMEOUT, greeting);
        let (inbound, welcome) = match shutdown.run_until_cancelled(greeting).await {
            None => return Ok(End::Shutdown),
            Some(Err(_)) => return Ok(End::Broken("the learner did not answer in time".to_owned())),
            Some(Ok(Err(end))) => return Ok(end),
            Some(Ok(Ok(greeted))) => greeted,
        };
        self.report.sessions += 1;
        let gauges = self.tools.gauges.clone();
        gauges.reconnects.inc_by(u64::from(self.report.sessions > 1));
        let crew = self.crew_for(welcome).await?;
        gauges.connected.set(1.0);
        let link = Link::new(self.crew.insert(crew), &mut self.unsettled, &mut self.report, &gauges, outbound);
        let end = link.serve(inbound, shutdown).await;
        gauges.connected.set(0.0);
        Ok(end)
    }

    fn hello(&self) -> v1::Hello {
        v1::Hello {
            protocol_version: PROTOCOL_VERSION,
            actor_id: self.config.actor_id.clone(),
            incarnation: self.incarnation,
            task_fingerprint: self.config.expected_task.clone().unwrap_or_default(),
            threads: self.config.threads as u32,
        }
    }

    /// The crew that works on this run: the one there is if the run is the same, with all that it has in hand.
    async fn crew_for(&mut self, welcome: Welcome) -> Result<Crew, ActorError> {
        match self.crew.take() {
            Some(crew) if crew.welcome == welcome => {
                tracing::info!(run_id = %welcome.run_id, "connected again");
                Ok(crew)
            }
            old => {
                if let Some(old) = old {
                    tracing::info!(run_id = %welcome.run_id, "another run; dropping work on the old one");
                    self.unsettled.clear();
                    drop(old.dismiss());
                }
                tracing::info!(run_id = %welcome.run_id, threads = self.config.threads, "joined a run");
                let run_id = welcome.run_id.0.clone();
                let failed = |source| ActorError::Worker { run_id: run_id.clone(), source };
                let (threads, tools) = (self.config.threads, self.tools.clone());
                tokio::task::spawn_blocking(move || Crew::start(welcome, threads, tools))
                    .await
                    .map_err(|error| failed(WorkError::fatal(error.to_string())))?
                    .map_err(failed)
            }
        }
    }
}
