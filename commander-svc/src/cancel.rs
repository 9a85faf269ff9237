//! Cancellation of work on another thread: when its call is dropped, or at its deadline.

use crate::call_budget::CallBudget;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Held by the future of a call; cancels the work of the call when the future is dropped.
#[derive(Debug, Default)]
pub(crate) struct CancelOnDrop(Arc<AtomicBool>);

impl CancelOnDrop {
    /// The work's side.
    pub(crate) fn work(&self, budget: CallBudget) -> Work {
        Work { cancelled: self.0.clone(), budget }
    }
}

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
