//! Who is let in now: nobody while the service drains, and nobody with too much in flight already.

use crate::access::Caller;
use magex_runtime::status;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// When to come back to a service that has too much to do.
const BUSY: Duration = Duration::from_millis(100);
/// When to come back to a service that stops; another may have taken its place by then.
const STOPPING: Duration = Duration::from_secs(1);

/// What a caller holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A request until its answer.
    Call,
    /// A stream that stays open.
    Stream,
}

/// Counts what every caller has in flight.
#[derive(Debug)]
pub(crate) struct Admission {
    held: Mutex<HashMap<Arc<str>, [usize; 2]>>,
    /// Calls, streams.
    limits: [usize; 2],
    draining: CancellationToken,
}

impl Admission {
    pub(crate) fn new(calls: usize, streams: usize, draining: CancellationToken) -> Arc<Self> {
        Arc::new(Self { held: Mutex::default(), limits: [calls, streams], draining })
    }

    /// Lets one more in, until the slot is dropped.
    pub(crate) fn enter(self: &Arc<Self>, caller: &Caller, kind: Kind) -> Result<Slot, Status> {
        self.check_open()?;
        let limit = self.limits[kind as usize];
        let mut held = self.lock();
        let count = &mut held.entry(caller.name.clone()).or_default()[kind as usize];
        if *count >= limit {
            let what = if kind == Kind::Call { "calls in flight" } else { "open streams" };
            return Err(status::resource_exhausted(format!("'{}' has {limit} {what} already", caller.name), BUSY));
        }
        *count += 1;
        drop(held);
        Ok(Slot { admission: self.clone(), name: caller.name.clone(), kind })
    }

    /// Refuses when the service drains.
    pub(crate) fn check_open(&self) -> Result<(), Status> {
        if self.draining.is_cancelled() { Err(stopping()) } else { Ok(()) }
    }

    /// Calls in flight, of everybody.
    pub(crate) fn calls(&self) -> usize {
        self.lock().values().map(|held| held[Kind::Call as usize]).sum()
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Arc<str>, [usize; 2]>> {
        // Counting cannot fail half-way.
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a stream ends with when the service drains.
pub(crate) fn stopping() -> Status {
    status::unavailable("the service is stopping", STOPPING)
}

/// A place; free again when dropped.
#[derive(Debug)]
pub(crate) struct Slot {
    admission: Arc<Admission>,
    name: Arc<str>,
    kind: Kind,
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut held = self.admission.lock();
        if let Some(counts) = held.get_mut(&self.name) {
            counts[self.kind as usize] = counts[self.kind as usize].saturating_sub(1);
            if *counts == [0, 0] {
                held.remove(&self.name);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::Role;

    #[test]
    fn places_are_counted_per_caller_and_come_back() {
        let draining = CancellationToken::new();
        let admission = Admission::new(2, 1, draining.clone());
        let caller = |name: &str| Caller { name: name.into(), role: Role::Client };
        let first = admission.enter(&caller("a"), Kind::Call).unwrap();
        let _second = admission.enter(&caller("a"), Kind::Call).unwrap();
        let refused = admission.enter(&caller("a"), Kind::Call).unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        assert!(status::retry_delay(&refused).is_some());
        let _other = admission.enter(&caller("b"), Kind::Call).unwrap();
        let _stream = admission.enter(&caller("a"), Kind::Stream).unwrap();
        assert!(admission.enter(&caller("a"), Kind::Stream).is_err());
        drop(first);
        let _third = admission.enter(&caller("a"), Kind::Call).unwrap();
        assert_eq!(admission.calls(), 3);
        draining.cancel();
        assert_eq!(admission.enter(&caller("c"), Kind::Call).unwrap_err().code(), tonic::Code::Unavailable);
    }
}
