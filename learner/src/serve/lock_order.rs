//! Mutexes with a fixed acquisition order, which debug builds check.

use magex_runtime::sync::lock;
use std::cell::Cell;
use std::ops::{Deref, DerefMut};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Position in the order: a thread that holds a lock may take only locks of higher rank.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Rank {
    Work = 1,
    Roster = 2,
    Control = 4,
    Status = 8,
}

thread_local! {
    /// Ranks of the locks that this thread holds, as a bit set.
    static HELD: Cell<u8> = const { Cell::new(0) };
}

#[derive(Debug)]
pub(crate) struct OrderedMutex<T> {
    rank: Rank,
    mutex: Mutex<T>,
}

impl<T> OrderedMutex<T> {
    pub(crate) fn new(rank: Rank, value: T) -> Self {
        Self { rank, mutex: Mutex::new(value) }
    }

    /// Locks the mutex. Debug builds panic if this thread holds a lock of the same or a higher rank.
    pub(crate) fn lock(&self) -> OrderedGuard<'_, T> {
        let rank = self.rank as u8;
        debug_assert!(HELD.get() < rank, "lock order: {:?} after a lock of the same or a higher rank", self.rank);
        let held = Held(rank);
        let guard = lock(&self.mutex);
        HELD.set(HELD.get() | rank);
        OrderedGuard { guard, _held: held }
    }
}

#[derive(Debug)]
pub(crate) struct OrderedGuard<'a, T> {
    guard: MutexGuard<'a, T>,
    _held: Held,
}

impl<T> OrderedGuard<'_, T> {
    pub(crate) fn wait(self, condvar: &Condvar) -> Self {
        let Self { guard, _held } = self;
        Self { guard: condvar.wait(guard).unwrap_or_else(PoisonError::into_inner), _held }
    }
}

impl<T> OrderedGuard<'_, T> {
    pub(crate) fn wait_timeout(self, condvar: &Condvar, limit: Duration) -> Self {
        let Self { guard, _held } = self;
        let (guard, _) = condvar.wait_timeout(guard, limit).unwrap_or_else(PoisonError::into_inner);
        Self { guard, _held }
    }
}

impl<T> Deref for OrderedGuard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.guard
    }
}

impl<T> DerefMut for OrderedGuard<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.guard
    }
}

/// Clears the bit of a rank when the guard is dropped.
#[derive(Debug)]
struct Held(u8);

impl Drop for Held {
    fn drop(&mut self) {
        HELD.set(HELD.get() & !self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locks_in_the_order_of_their_ranks_are_allowed() {
        let (work, status) = (OrderedMutex::new(Rank::Work, 1), OrderedMutex::new(Rank::Status, 2));
        for _ in 0..2 {
            let first = work.lock();
            assert_eq!(*first + *status.lock(), 3);
        }
        drop(status.lock());
        drop(work.lock());
    }

    #[test]
    #[cfg(debug_assertions)]
    #[should_panic(expected = "lock order: Work")]
    fn a_lock_of_lower_rank_is_refused() {
        let (work, status) = (OrderedMutex::new(Rank::Work, ()), OrderedMutex::new(Rank::Status, ()));
        let _status = status.lock();
        let _work = work.lock();
    }
}
