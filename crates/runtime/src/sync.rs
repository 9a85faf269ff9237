//! Locks.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Takes a lock. The data behind our locks is consistent after every statement, so that a thread that panicked while it held
/// one leaves nothing half done.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
