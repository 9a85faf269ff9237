//! A subscription to the learner's weights, as actors and commanders hold it.

use crate::MAX_MESSAGE_BYTES;
use crate::v1::learner_service_client::LearnerServiceClient;
use crate::v1::{SubscriberRole, WatchWeightsRequest, WatchWeightsResponse};
use crate::weights::{Weights, WeightsAssembler};
use std::time::Duration;
use tonic::body::Body;
use tonic::client::GrpcService;
use tonic::codegen::{Body as HttpBody, Bytes, StdError};
use tonic::{Status, Streaming};

/// A learner that does not answer the call within this time is called again. Once open, a stream may be silent for as long
/// as an update takes; the connection's keepalive notices a learner that is gone.
pub const OPEN_TIMEOUT: Duration = Duration::from_secs(10);

/// What a subscriber reports when [`OPEN_TIMEOUT`] has passed.
pub fn late<E>(_elapsed: E) -> Status {
    Status::deadline_exceeded(format!("the learner did not answer within {} s", OPEN_TIMEOUT.as_secs()))
}

/// One open stream of weights.
#[derive(Debug)]
pub struct WeightsStream {
    stream: Streaming<WatchWeightsResponse>,
    assembler: WeightsAssembler,
}

impl WeightsStream {
    /// Subscribes to whichever run the learner serves. `subscriber_id` is for people.
    pub async fn open<T>(channel: T, subscriber_id: &str, role: SubscriberRole) -> Result<Self, Status>
    where
        T: GrpcService<Body>,
        T::Error: Into<StdError>,
        T::ResponseBody: HttpBody<Data = Bytes> + Send + 'static,
        <T::ResponseBody as HttpBody>::Error: Into<StdError> + Send,
    {
        let mut client = LearnerServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let request =
            WatchWeightsRequest { run_id: String::new(), subscriber_id: subscriber_id.to_owned(), role: role.into() };
        let stream = client.watch_weights(request).await?.into_inner();
        Ok(Self { stream, assembler: WeightsAssembler::default() })
    }

    /// The next version, verified, with the run's configuration (TOML); `None` at the end of the stream.
    /// After an error, subscribe again.
    pub async fn next(&mut self) -> Result<Option<(Weights, String)>, Status> {
        while let Some(message) = self.stream.message().await? {
            if message.part.is_none() && message.sha256.is_empty() {
                // A heartbeat.
                continue;
            }
            let pushed = self.assembler.push(message);
            if let Some(weights) = pushed.map_err(|error| Status::data_loss(format!("damaged weights: {error}")))? {
                return Ok(Some(weights));
            }
        }
        Ok(None)
    }
}
