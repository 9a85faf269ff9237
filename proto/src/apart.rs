//! Work on long messages, apart from the threads that serve the network: a message of 31 MiB takes a hundred times as long as the
//! answer that another caller waits for.

use std::sync::{Mutex, PoisonError};
use tokio::runtime::{Handle, RuntimeFlavor};

/// Longest message, bytes, that is read between two others. A part of a trajectory or of weights is shorter.
const SHORT: usize = 2 << 20;

/// One at a time: they would only take memory bandwidth from each other, and a processor from all other calls.
static ONE: Mutex<()> = Mutex::new(());

/// Runs work on a message of this length in bytes. While a long one is read, other tasks of this thread run on another.
pub fn apart<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    let elsewhere = || Handle::try_current().is_ok_and(|own| own.runtime_flavor() == RuntimeFlavor::MultiThread);
    if bytes <= SHORT || !elsewhere() {
        return work();
    }
    tokio::task::block_in_place(|| {
        let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
        work()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// The only thread of the network goes on with other tasks.
    #[test]
    fn long_work_does_not_hold_up_the_only_thread() {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).build().unwrap();
        let (sender, receiver) = std::sync::mpsc::channel();
        runtime.block_on(async move {
            let long = tokio::spawn(async move { apart(SHORT + 1, || receiver.recv_timeout(Duration::from_secs(60))) });
            // Sent by a task that needs a thread of the network while the other one works.
            let other = tokio::spawn(async move {
                tokio::task::yield_now().await;
                sender.send(()).unwrap();
            });
            other.await.unwrap();
            long.await.unwrap().unwrap();
        });
    }

    #[test]
    fn without_other_threads_it_just_runs() {
        assert_eq!(apart(SHORT + 1, || 1), 1);
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        assert_eq!(runtime.block_on(async { apart(SHORT + 1, || 2) }), 2);
    }
}
