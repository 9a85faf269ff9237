//! Locks.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Takes a lock. Our data is consistent after every statement, so a panic of another thread leaves nothing half done.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
