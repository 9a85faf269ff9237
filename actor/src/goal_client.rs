//! The client of the commander service: the goals of a shard's episodes.

use magex_proto::MAX_BATCH_BYTES;
pub use magex_proto::goals::{GoalReply, GoalRequest, WeightsKey};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use magex_runtime::peer::{Complaints, Remote};
use magex_runtime::{status, trace};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Status};
use tracing::Span;

/// Deadline of one call; a call that exceeds it is retried. The commander itself waits up to 5 s for weights.
const CALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Why there are no goals.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GoalError {
    /// The pool shuts down; the result is no longer needed.
    #[error("cancelled: the result is no longer needed")]
    Cancelled,
    /// The commander did not answer within this time; another attempt may succeed.
    #[error("the commander did not answer within {} s", .0.as_secs_f64())]
    Late(Duration),
    /// The commander rejected the actor's credentials or role, so every shard would fail here.
    #[error("the commander rejected this actor's credentials: {0}; give it an actor's token or certificate")]
    Unauthorized(String),
    /// The commander rejected the request; a retry would fail too.
    #[error("the commander rejected the request: {0}")]
    Refused(String),
    /// The answer does not match the request.
    #[error("the commander's answer is invalid: {0}")]
    Answer(String),
}

/// Assigns the goals of a shard's episodes with the weights that the shard names: calls the commander service and retries while
/// it is slow or unavailable, up to `patience`. The limit keeps a rollout thread from waiting forever for a version that the
/// commander never gets (the learner went back to an older one).
#[derive(Debug)]
pub struct GrpcGoals {
    runtime: Handle,
    commander: Arc<Remote>,
    client: CommanderServiceClient<Channel>,
    weights: WeightsKey,
    patience: Duration,
    cancelled: CancellationToken,
    waited: Duration,
    parent: Span,
}

impl GrpcGoals {
    /// A client that names these weights in every request. Calls end when cancelled or after `patience`; they are part of the
    /// trace of `parent`.
    pub(crate) fn new(
        runtime: Handle,
        commander: (Arc<Remote>, Channel),
        weights: WeightsKey,
        patience: Duration,
        cancelled: CancellationToken,
        parent: Span,
    ) -> Self {
        let client = CommanderServiceClient::new(commander.1)
            .max_decoding_message_size(MAX_BATCH_BYTES)
            .max_encoding_message_size(MAX_BATCH_BYTES);
        Self { runtime, commander: commander.0, client, weights, patience, cancelled, waited: Duration::ZERO, parent }
    }

    /// Total time that callers have waited for goals.
    pub(crate) fn waited(&self) -> Duration {
        self.waited
    }

    /// One goal per agent of every episode. Blocks.
    pub fn assign(&mut self, request: &GoalRequest) -> Result<GoalReply, GoalError> {
        let message = request.to_message(&self.weights);
        let span = tracing::info_span!(target: trace::TARGET, parent: &self.parent, "goals");
        let asked = Instant::now();
        let (patience, commander, client) = (self.patience, &self.commander, &mut self.client);
        let answer = self.runtime.block_on(self.cancelled.run_until_cancelled(async {
            // The timer must be made within the runtime.
            tokio::time::timeout(patience, ask(commander, client, message, &span))
                .await
                .map_err(|_| GoalError::Late(patience))?
        }));
        self.waited += asked.elapsed();
        let answer = answer.ok_or(GoalError::Cancelled)??;
        GoalReply::from_message(answer, request).map_err(|error| GoalError::Answer(error.to_string()))
    }
}

async fn ask(
    commander: &Remote,
    client: &mut CommanderServiceClient<Channel>,
    message: v1::AssignBatchRequest,
    span: &Span,
) -> Result<v1::AssignBatchResponse, GoalError> {
    let mut backoff = Backoff::default();
    let mut failures = 0u32;
    let mut complaints = Complaints::default();
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
            Ok(Err(status)) if is_transient(&status) => status,
            Ok(Err(status)) => {
                return Err(match status.code() {
                    Code::Unauthenticated | Code::PermissionDenied => {
                        GoalError::Unauthorized(status.message().to_owned())
                    }
                    code => GoalError::Refused(format!("{code}: {}", status.message())),
                });
            }
            Err(_) => Status::deadline_exceeded("no answer in time"),
        };
        failures += 1;
        let problem = commander.explain(&problem).await;
        if complaints.due(&problem) {
            tracing::warn!(reason = problem.text, url = commander.url, "the commander does not answer; retrying");
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

/// UNIMPLEMENTED is transient too: a commander that is starting may not have registered its service yet.
fn is_transient(status: &Status) -> bool {
    status::is_transient(status) || status.code() == Code::Unimplemented
}
