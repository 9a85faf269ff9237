//! Where a worker gets its goals from.

use magex_proto::MAX_BATCH_BYTES;
pub use magex_proto::goals::{GoalReply, GoalRequest, WeightsKey};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use magex_runtime::{status, trace};
use std::time::{Duration, Instant};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Status};
use tracing::Span;

/// A call that takes longer is made again. The commander itself waits up to 5 s for weights.
const CALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Why there are no goals.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GoalError {
    /// Nobody wants the result any more.
    #[error("no longer wanted")]
    Cancelled,
    /// The commander did not answer for so long; another attempt may fare better.
    #[error("the commander did not answer within {} s", .0.as_secs_f64())]
    Late(Duration),
    /// The commander does not know this actor, or does not answer one of its role: no shard can be done here.
    #[error("the commander does not let this actor in: {0}; give it a token or a certificate of an actor")]
    NotLetIn(String),
    /// The commander refused, and would refuse again.
    #[error("the commander refused: {0}")]
    Refused(String),
    /// The answer makes no sense.
    #[error("the commander's answer makes no sense: {0}")]
    Answer(String),
}

/// Hands out the goals of a shard's episodes with the weights that the shard names. Blocks.
pub trait GoalSource {
    /// One goal per agent of every episode.
    fn assign(&mut self, request: &GoalRequest) -> Result<GoalReply, GoalError>;
}

/// Asks the commander service, again and again while it is late or away, for as long as its patience lasts: a commander that
/// never gets the version (the learner went back to an older one) must not keep a rollout thread for ever.
#[derive(Debug)]
pub struct GrpcGoals {
    runtime: Handle,
    client: CommanderServiceClient<Channel>,
    weights: WeightsKey,
    patience: Duration,
    cancelled: CancellationToken,
    waited: Duration,
    parent: Span,
}

impl GrpcGoals {
    /// Asks these weights over this channel, until cancelled or out of patience.
    pub fn new(
        runtime: Handle,
        channel: Channel,
        weights: WeightsKey,
        patience: Duration,
        cancelled: CancellationToken,
    ) -> Self {
        let client = CommanderServiceClient::new(channel)
            .max_decoding_message_size(MAX_BATCH_BYTES)
            .max_encoding_message_size(MAX_BATCH_BYTES);
        Self { runtime, client, weights, patience, cancelled, waited: Duration::ZERO, parent: Span::none() }
    }

    /// Makes the waits part of a trace.
    pub(crate) fn trace(&mut self, parent: &Span) {
        self.parent = parent.clone();
    }

    /// How long its caller has waited for goals in all.
    pub(crate) fn waited(&self) -> Duration {
        self.waited
    }
}

impl GoalSource for GrpcGoals {
    fn assign(&mut self, request: &GoalRequest) -> Result<GoalReply, GoalError> {
        let message = request.to_message(&self.weights);
        let span = tracing::info_span!(target: trace::TARGET, parent: &self.parent, "goals");
        let asked = Instant::now();
        let (patience, client) = (self.patience, &mut self.client);
        let answer = self.runtime.block_on(self.cancelled.run_until_cancelled(async {
            // The timer must be made within the runtime.
            tokio::time::timeout(patience, ask(client, message, &span)).await.map_err(|_| GoalError::Late(patience))?
        }));
        self.waited += asked.elapsed();
        let answer = answer.ok_or(GoalError::Cancelled)??;
        GoalReply::from_message(answer, request).map_err(|error| GoalError::Answer(error.to_string()))
    }
}

async fn ask(
    client: &mut CommanderServiceClient<Channel>,
    message: v1::AssignBatchRequest,
    span: &Span,
) -> Result<v1::AssignBatchResponse, GoalError> {
    let mut backoff = Backoff::default();
    let mut failures = 0u32;
    loop {
        let mut request = Request::new(message.clone());
        trace::add_to(request.metadata_mut(), span);
        let call = tokio::time::timeout(CALL_TIMEOUT, client.assign_batch(request)).await;
        let problem = match call {
            Ok(Ok(response)) => {
                if failures > 0 {
                    tracing::info!(failures, "the commander answers again");
                }
                return Ok(response.into_inner());
            }
            Ok(Err(status))
                if !is_transient(&status)
                    && matches!(status.code(), Code::Unauthenticated | Code::PermissionDenied) =>
            {
                return Err(GoalError::NotLetIn(status.message().to_owned()));
            }
            Ok(Err(status)) if !is_transient(&status) => {
                return Err(GoalError::Refused(format!("{}: {}", status.code(), status.message())));
            }
            Ok(Err(status)) => status.message().to_owned(),
            Err(_) => "no answer in time".to_owned(),
        };
        failures += 1;
        if failures == 1 {
            tracing::warn!(reason = problem, "the commander does not answer; trying again for as long as it takes");
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

/// A commander that is being started may not know its own service yet; one of another size may answer the next call.
fn is_transient(status: &Status) -> bool {
    status::is_transient(status) || status.code() == Code::Unimplemented
}
