//! Requests to the training thread (stop, drain, checkpoint) and the signals that end streams.

use crate::run_events::StopReason;
use crate::serve::lock_order::{OrderedMutex, Rank};
use std::sync::atomic::{AtomicBool, Ordering};
use tokio_util::sync::CancellationToken;

#[derive(Debug)]
pub(crate) struct Control {
    stop: OrderedMutex<Option<StopReason>>,
    /// Cancelled by the first request to stop.
    pub(crate) stop_signal: CancellationToken,
    /// Ends every stream.
    pub(crate) closing: CancellationToken,
    /// The run is complete: there are no more shards to lease.
    pub(crate) complete: CancellationToken,
    checkpoint: AtomicBool,
}

impl Control {
    pub(crate) fn new() -> Self {
        Self {
            stop: OrderedMutex::new(Rank::Control, None),
            stop_signal: CancellationToken::new(),
            closing: CancellationToken::new(),
            complete: CancellationToken::new(),
            checkpoint: AtomicBool::new(false),
        }
    }

    /// Records a request to stop. A shutdown overrides a drain.
    pub(crate) fn request_stop(&self, reason: StopReason) {
        let mut stop = self.stop.lock();
        if stop.is_none() || reason == StopReason::Shutdown {
            *stop = Some(reason);
        }
    }

    pub(crate) fn stop_requested(&self) -> Option<StopReason> {
        self.stop.lock().clone()
    }

    pub(crate) fn request_checkpoint(&self) {
        self.checkpoint.store(true, Ordering::Release);
    }

    /// Whether a checkpoint was requested since the last call.
    pub(crate) fn take_checkpoint_request(&self) -> bool {
        self.checkpoint.swap(false, Ordering::AcqRel)
    }
}
