//! Work on another thread, which ends when its call is dropped, or at the deadline.

use crate::call_budget::CallBudget;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tonic::Status;

/// Runs the work of a call on a thread that may block, and drops `held` when it has finished, even if the call has ended.
///
/// # Errors
/// INTERNAL: the work panicked.
pub(crate) async fn on_thread<T: Send + 'static>(
    held: impl Send + 'static,
    budget: CallBudget,
    run: impl FnOnce(&Work) -> T + Send + 'static,
) -> Result<T, Status> {
    let cancel = CancelOnDrop::default();
    let work = Work { cancelled: cancel.0.clone(), budget };
    let running = tokio::task::spawn_blocking(move || {
        let _held = held;
        run(&work)
    });
    running.await.map_err(|error| Status::internal(error.to_string()))
}

/// Held by the future of a call; cancels the work of the call when the future is dropped.
#[derive(Debug, Default)]
struct CancelOnDrop(Arc<AtomicBool>);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Work for a call: whether it is still wanted.
#[derive(Debug)]
pub(crate) struct Work {
    cancelled: Arc<AtomicBool>,
    pub(crate) budget: CallBudget,
}

impl Work {
    /// The call waits and its deadline has not passed.
    pub(crate) fn should_continue(&self) -> bool {
        !self.cancelled.load(Ordering::Relaxed) && !self.budget.over()
    }
}
