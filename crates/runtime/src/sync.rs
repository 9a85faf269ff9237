//! Locks.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Takes a lock. Our data is consistent after every statement, so a panic of another thread leaves nothing half done.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A value that is replaced as a whole while others read it. Clones share it.
pub struct Live<T>(Arc<Mutex<Arc<T>>>);

// Credentials are such values, and must not reach a log.
impl<T> fmt::Debug for Live<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Live")
    }
}

impl<T> Clone for Live<T> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<T: Default> Default for Live<T> {
    fn default() -> Self {
        Self::new(T::default())
    }
}

impl<T> Live<T> {
    /// Begins with this value.
    pub fn new(value: T) -> Self {
        Self(Arc::new(Mutex::new(Arc::new(value))))
    }

    /// The value now.
    pub fn get(&self) -> Arc<T> {
        lock(&self.0).clone()
    }

    /// Replaces the value.
    pub fn set(&self, value: T) {
        *lock(&self.0) = Arc::new(value);
    }
}
