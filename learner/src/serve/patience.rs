//! Sending to readers that may have stopped reading.

use std::time::Duration;
use tokio::sync::mpsc::Sender;
use tokio::sync::mpsc::error::SendTimeoutError;
use tonic::Status;

/// Sends a message of a stream. False if the stream ends because its reader disconnected or read nothing for `patience`.
pub(crate) async fn send<T>(
    reader: &Sender<Result<T, Status>>,
    message: T,
    patience: Duration,
    name: &'static str,
) -> bool {
    let sent = reader.send_timeout(Ok(message), patience).await;
    if matches!(sent, Err(SendTimeoutError::Timeout(_))) {
        tracing::warn!(?patience, "{name} reads nothing; ending its stream");
    }
    sent.is_ok()
}
