//! Work on several threads whose results do not depend on their number.

use std::sync::atomic::{AtomicUsize, Ordering};

/// A thread panicked; the panic message is on standard error.
#[derive(Debug, thiserror::Error)]
#[error("a worker thread panicked; its message is above")]
pub(crate) struct WorkerPanicked;

/// The results of `work` for 0..count, in this order, computed on up to `threads` threads.
pub(crate) fn in_order<T: Send>(
    threads: usize,
    count: usize,
    work: impl Fn(usize) -> T + Sync,
) -> Result<Vec<T>, WorkerPanicked> {
    let next = AtomicUsize::new(0);
    let take = || Some(next.fetch_add(1, Ordering::Relaxed)).filter(|&index| index < count);
    let worker = || std::iter::from_fn(|| take().map(|index| (index, work(index)))).collect::<Vec<_>>();
    let parts = std::thread::scope(|scope| {
        // Where the system has no more threads, there are fewer, in the end only this one.
        let start = |_| std::thread::Builder::new().spawn_scoped(scope, worker).ok();
        let handles: Vec<_> = (0..threads.clamp(1, count.max(1))).map_while(start).collect();
        let own = if handles.is_empty() { worker() } else { Vec::new() };
        let others = handles.into_iter().map(|handle| handle.join().map_err(|_| WorkerPanicked));
        std::iter::once(Ok(own)).chain(others).collect::<Result<Vec<_>, _>>()
    })?;
    let mut all: Vec<(usize, T)> = parts.into_iter().flatten().collect();
    all.sort_unstable_by_key(|(index, _)| *index);
    Ok(all.into_iter().map(|(_, result)| result).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_of_results_does_not_depend_on_the_threads() {
        for threads in [0, 1, 2, 3, 64] {
            assert_eq!(in_order(threads, 7, |k| k * k).unwrap(), [0, 1, 4, 9, 16, 25, 36]);
        }
        assert_eq!(in_order(2, 0, |k| k).unwrap(), [0usize; 0]);
    }
}
