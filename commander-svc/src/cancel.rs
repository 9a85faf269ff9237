//! Work on another thread, which ends when its call is dropped, or at the deadline.

use crate::call_budget::CallBudget;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Runs the work of a call on a thread that may block, and drops `held` when it has finished, even if the call has ended.
/// INTERNAL: it panicked.
pub(crate) async fn on_thread<T: Send + 'static>(
    held: impl Send + 'static,
    budget: CallBudget,
    run: impl FnOnce(&Work) -> T + Send + 'static,
) -> Result<T, Status> {
    let work = Work { cancelled: CancellationToken::new(), budget };
    // Cancels the work when the future of the call is dropped.
    let _call = work.cancelled.clone().drop_guard();
    let running = tokio::task::spawn_blocking(move || {
        let _held = held;
        run(&work)
    });
    running.await.map_err(|error| Status::internal(error.to_string()))
}

/// Work for a call: whether it is still wanted.
#[derive(Debug)]
pub(crate) struct Work {
    cancelled: CancellationToken,
    pub(crate) budget: CallBudget,
}

impl Work {
    /// The call waits and its deadline has not passed.
    pub(crate) fn go_on(&self) -> bool {
        !self.cancelled.is_cancelled() && !self.budget.over()
    }
}
